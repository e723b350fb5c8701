"""The services of ``simulation_interfaces`` on the simulator's control.

With that package's own types where it is installed, else with ours, which have the same
names and fields.
"""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node

from capture_sim.control.simulation import Answer, Code, SimulationControl
from capture_sim.nodes.running import ENDING, SERVICES

#: What SimulatorFeatures.msg lists and this simulator has, by its numbers there.
FEATURES = {
    "SIMULATION_RESET": 20,
    "SIMULATION_STATE_GETTING": 24,
    "SIMULATION_STATE_SETTING": 25,
    "SIMULATION_STATE_PAUSE": 26,
    "STEP_SIMULATION_SINGLE": 31,
    "STEP_SIMULATION_MULTIPLE": 32,
}
INFO = (
    "capture_sim: a step is one sample, 1 / run.state_rate s. Reset is of time and state together "
    "(scope 0, 3, 7 or 255) and keeps playing or paused. Worlds are experiments: set the "
    "parameters scenes and overrides while stopped."
)
#: Longest that a pause, stop or reset may take, s (wall).
LIMIT = 120.0
#: An answer arrives within this long, s (wall).
GOOD_BYE = 0.5


def definitions() -> str:
    """Return the package whose service definitions are used."""
    try:
        importlib.import_module("simulation_interfaces.srv")
    except ImportError:
        return "capture_sim"
    return "simulation_interfaces"


class SimulationServices:
    """Serves ``<node>/set_simulation_state`` and its kin.

    A node of their own and threads of their own, since their callbacks wait: for a step to
    be taken, say, which needs the acknowledgements that the main node receives.

    Parameters
    ----------
    node
        The simulator; the services carry its name.
    control
        Asked to do what is wanted.
    features, info
        What is answered to the question for features.
    """

    def __init__(
        self,
        node: Node,
        control: SimulationControl,
        features: Mapping[str, int] = FEATURES,
        info: str = INFO,
    ) -> None:
        self._control = control
        self._features_there = list(features.values())
        self._info = info
        self._answered = 0.0  # wall, when the state was set last
        self._package = definitions()
        # arguments of the process, as a new name, are the simulator's own
        self._node = Node(
            f"{node.get_name()}_services",
            namespace=node.get_namespace(),
            context=node.context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        group = ReentrantCallbackGroup()
        served: dict[str, Callable[[Any, Any], Any]] = {
            "GetSimulatorFeatures": self._features,
            "GetSimulationState": self._get_state,
            "SetSimulationState": self._set_state,
            "StepSimulation": self._step,
            "ResetSimulation": self._reset,
        }
        module = importlib.import_module(f"{self._package}.srv")
        for name, callback in served.items():
            topic = f"{node.get_fully_qualified_name()}/{_snake(name)}"
            self._node.create_service(getattr(module, name), topic, callback, callback_group=group)
        self._executor = MultiThreadedExecutor(4, context=node.context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name=SERVICES, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        """Serve no more; what has just been answered gets time to arrive."""
        left = self._answered + GOOD_BYE - time.monotonic()
        if left > 0.0:
            time.sleep(left)
        self._executor.shutdown(2.0)
        # a thread that comes back from C++ when Python ends takes the process with it (SIGABRT)
        self._thread.join(ENDING)
        self._node.destroy_node()

    def _features(self, _: Any, response: Any) -> Any:
        response.features.features = self._features_there
        response.features.custom_info = self._info
        return response

    def _get_state(self, _: Any, response: Any) -> Any:
        response.state.state = int(self._control.state)
        return _answered(response, Answer(Code.OK))

    def _set_state(self, request: Any, response: Any) -> Any:
        self._answered = time.monotonic()  # will be: the node must not end before
        answer = self._control.set_state(request.state.state).wait(LIMIT)
        self._answered = time.monotonic()
        return _answered(response, answer)

    def _step(self, request: Any, response: Any) -> Any:
        return _answered(response, self._control.step(request.steps).wait())

    def _reset(self, request: Any, response: Any) -> Any:
        return _answered(response, self._control.reset(request.scope).wait(LIMIT))


def _answered(response: Any, answer: Answer) -> Any:
    response.result.result = int(answer.code)
    response.result.error_message = answer.message
    return response


def _snake(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")
