"""The services by which others start, stop, pause and reset the simulator.

Their types are capture_sim's, with the names, fields and numbers of the ROS package
``simulation_interfaces``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import capture_sim.srv
from capture_sim.nodes.base.endpoints import TRANSIT_TIME
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.simulation.control import Code, Reply, SimulationControl


class SimulationServices:
    """Serves get_simulation_state, set_simulation_state and reset_simulation of a node.

    ``control`` carries the requests out.
    """

    def __init__(self, node: BenchNode, control: SimulationControl) -> None:
        self._control = control
        self._replied_at = 0.0  # s (wall), when the last reply was sent
        callbacks: dict[str, Callable[[Any, Any], Any]] = {
            "GetSimulationState": self._get_state,
            "SetSimulationState": self._set_state,
            "ResetSimulation": self._reset,
        }
        for name, callback in callbacks.items():
            service = getattr(capture_sim.srv, name)
            node.create_service(service, f"~/{_snake(name)}", node.guarded(callback))

    def close(self) -> None:
        """Wait until the last reply has had time to arrive, before the node ends."""
        time.sleep(max(0.0, self._replied_at + TRANSIT_TIME - time.monotonic()))

    def _get_state(self, _: Any, response: Any) -> Any:
        response.state.state = int(self._control.state)
        return self._filled(response, Reply(Code.OK))

    def _set_state(self, request: Any, response: Any) -> Any:
        return self._filled(response, self._control.set_state(request.state.state))

    def _reset(self, request: Any, response: Any) -> Any:
        return self._filled(response, self._control.reset(request.scope))

    def _filled(self, response: Any, reply: Reply) -> Any:
        self._replied_at = time.monotonic()
        response.result.result = int(reply.code)
        response.result.error_message = reply.message
        return response


def _snake(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")
