"""The services of ``simulation_interfaces`` on the simulator's control.

With that package's own types where it is installed, else with ours, which have the same
names and fields.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future

from capture_sim.control.simulation import Answer, Code, Request, SimulationControl

#: What SimulatorFeatures.msg lists and is here, by its numbers there; a player has no reset.
FEATURES = {
    "SIMULATION_RESET": 20,
    "SIMULATION_STATE_GETTING": 24,
    "SIMULATION_STATE_SETTING": 25,
    "SIMULATION_STATE_PAUSE": 26,
    "STEP_SIMULATION_SINGLE": 31,
    "STEP_SIMULATION_MULTIPLE": 32,
}
#: A response arrives within this long, s (wall).
ANSWER_TIMEOUT = 0.5


def definitions() -> str:
    """Return the package whose service definitions are used."""
    try:
        importlib.import_module("simulation_interfaces.srv")
    except ImportError:
        return "capture_sim"
    return "simulation_interfaces"


class SimulationServices:
    """Serves ``<node>/set_simulation_state`` and its kin for a control.

    Their callbacks are coroutines, which wait e.g. for a step without blocking others: the node
    needs an executor that runs coroutines.  ``info``: text beside the features.
    """

    def __init__(
        self,
        node: Node,
        control: SimulationControl,
        info: str,
    ) -> None:
        self._node = node
        self._control = control
        self._info = info
        self._answered = 0.0  # wall, when the state was set last
        self._package = definitions()
        group = ReentrantCallbackGroup()
        callbacks: dict[str, Callable[[Any, Any], Any]] = {
            "GetSimulatorFeatures": self._features,
            "GetSimulationState": self._get_state,
            "SetSimulationState": self._set_state,
            "StepSimulation": self._step,
            "ResetSimulation": self._reset,
        }
        module = importlib.import_module(f"{self._package}.srv")
        for name, callback in callbacks.items():
            service = getattr(module, name)
            node.create_service(service, f"~/{_snake(name)}", callback, callback_group=group)

    def close(self) -> None:
        """Answer all that wait, and give the answers time to arrive; callbacks still run."""
        self._control.close()
        time.sleep(max(0.0, self._answered + ANSWER_TIMEOUT - time.monotonic()))

    def _features(self, _: Any, response: Any) -> Any:
        response.features.features = [
            number
            for name, number in FEATURES.items()
            if self._control.resets or name != "SIMULATION_RESET"
        ]
        response.features.custom_info = self._info
        return response

    def _get_state(self, _: Any, response: Any) -> Any:
        response.state.state = int(self._control.state)
        return _answered(response, Answer(Code.OK))

    async def _set_state(self, request: Any, response: Any) -> Any:
        return await self._await_request(self._control.set_state(request.state.state), response)

    async def _step(self, request: Any, response: Any) -> Any:
        return await self._await_request(self._control.step(request.steps), response)

    async def _reset(self, request: Any, response: Any) -> Any:
        return await self._await_request(self._control.reset(request.scope), response)

    async def _await_request(self, request: Request, response: Any) -> Any:
        """Fill a response when its request is answered; the node must not end before it is sent."""
        answered = Future()

        def wake(_: Request) -> None:
            self._answered = time.monotonic()
            answered.set_result(None)
            if self._node.executor is not None:
                self._node.executor.wake()  # it looks at its coroutines when something happens

        request.add_done_callback(wake)
        await answered
        return _answered(response, request.result())


def _answered(response: Any, answer: Answer) -> Any:
    response.result.result = int(answer.code)
    response.result.error_message = answer.message
    return response


def _snake(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")
