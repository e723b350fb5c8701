"""Takes the thrust commands of controller nodes, checks them, and waits for them in lock-step.

A thrust command is a wrench: forces along the axes of a vehicle, and the torque about z.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np

from capture_sim.dynamics.drive import Control
from capture_sim.dynamics.samples import Event, EventKind
from capture_sim.dynamics.thrust import NO_THRUST, BodyWrench, Commands
from capture_sim.errors import CaptureSimError, MessageError
from capture_sim.messages import convert
from capture_sim.messages.convert import CHASER_FRAME, TARGET_FRAME
from capture_sim.messages.topics import CHASER_CMD_WRENCH, TARGET_CMD_WRENCH, Topic
from capture_sim.nodes.base.endpoints import full_name
from capture_sim.nodes.base.node import BenchNode
from capture_sim.scene.parts import Scene

#: Events of a wait that are served before each instant without lock-step.
_SERVED = 8
_VEHICLES = ((CHASER_CMD_WRENCH, CHASER_FRAME), (TARGET_CMD_WRENCH, TARGET_FRAME))


class CommandedVehicle:
    """Keeps the newest thrust command for one vehicle.

    ``answers`` is True if its controller answers: simulated time then waits for a command after
    each odometry message of the vehicle.
    """

    def __init__(self, node: BenchNode, topic: Topic, frame: str) -> None:
        self._node, self.topic, self._frame = node, topic, frame
        self.answers = False
        self.begin()
        node.listen(topic, self._receive)

    def begin(self) -> None:
        """Discard all commands that were received before, as a run begins."""
        self._stamp = -1  # ns, of the newest command
        self._wrench: BodyWrench | None = None

    def publishers(self) -> list[str]:
        """Return the full names of the nodes that command this vehicle."""
        resolved = self._node.resolve_topic_name(self.topic.name)
        return [full_name(one) for one in self._node.get_publishers_info_by_topic(resolved)]

    def has_answered(self, stamp: int) -> bool:
        """Return True if the newest command has this stamp (ns); it may be one that is rejected."""
        return self._stamp == stamp

    def take(self, now: int, timeout: float) -> BodyWrench | None:
        """Return the wrench of the command that has come since the last call; None without one.

        A command is rejected if its stamp is more than ``timeout`` (s) before simulated time
        ``now`` (ns), or after it; a stamp of 0 is always accepted.  For a rejected command the
        result is NO_THRUST, so the vehicle coasts.
        """
        wrench, self._wrench = self._wrench, None
        age = 1e-9 * (now - self._stamp)
        problem = ""
        if wrench is None or self._stamp == 0 or 0.0 <= age <= timeout:
            return wrench
        if age > timeout:
            problem = f"stamped {age:.3g} s ago: must be <= {timeout:g} s, thrusters.timeout"
        elif age < 0.0:
            problem = f"stamped {-age:.3g} s ahead of simulated time: must be a stamp of odometry"
        self._node.reject(self.topic, MessageError(problem))
        return NO_THRUST

    def _receive(self, message: Any) -> None:
        header, wrench = message.header, message.wrench
        found = (wrench.force.x, wrench.force.y, wrench.torque.z)
        problem = ""
        if not all(map(math.isfinite, found)):
            problem = f"force.x, force.y, torque.z = {found}: must be finite, N and N m"
        elif header.frame_id not in ("", self._frame):
            problem = f"frame_id = {header.frame_id!r}: must be {self._frame} or empty"
        elif len(nodes := self.publishers()) > 1:
            problem = f"{' and '.join(sorted(nodes))} command it: must be one controller"
        self._stamp = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        self._wrench = NO_THRUST if problem else found
        if problem:
            raise MessageError(f"{problem}; the vehicle coasts")


class ThrustCommands:
    """Gives the thrust commands of other nodes to a run.

    A controller whose node name is in ``wait_for`` must answer each odometry message of its vehicle
    with a command of the same stamp.  Simulated time waits for the answer, for ``timeout()``, s
    (wall), at most; without one the run fails with CaptureSimError.  Which vehicles have such a
    controller is fixed when the run begins.  Commands of other nodes take effect at the next
    instant of ``run.rate``.  ``check`` is called while it waits, and may raise to end the run.
    """

    def __init__(
        self,
        node: BenchNode,
        wait_for: Sequence[str],
        check: Callable[[], None],
        timeout: Callable[[], float],
    ) -> None:
        self._node, self._wait_for, self._check = node, wait_for, check
        self._answer_timeout = timeout
        self._vehicles: dict[Topic, CommandedVehicle] = {}
        self._present: dict[Topic, CommandedVehicle] = {}  # those with thrusters in this run
        self._timeout = 0.0  # s, of the run's commands

    def listen(self, scene: Scene) -> None:
        """Subscribe to the commands for the vehicles of a scene that have thrusters.

        Call it before the nodes of the run are awaited, so that their controllers find it.
        """
        for (topic, frame), name in zip(_VEHICLES, ("chaser", "target"), strict=True):
            has_thruster = getattr(scene.thrusters, name, None) is not None
            if has_thruster and topic not in self._vehicles:
                self._vehicles[topic] = CommandedVehicle(self._node, topic, frame)

    def control(self, scene: Scene) -> Control | None:
        """Return the controller for a run that begins, which takes the commands of other nodes.

        None for a scene without thrusters.
        """
        if scene.thrusters is None:
            return None
        self._timeout = scene.thrusters.timeout
        # an earlier scene may have had thrusters that this one lacks
        self._present = {
            topic: vehicle
            for topic, vehicle in self._vehicles.items()
            if getattr(scene.thrusters, topic.name.partition("/")[0]) is not None
        }
        for vehicle in self._present.values():
            vehicle.begin()
            names = {name for full in vehicle.publishers() for name in (full, _last(full))}
            vehicle.answers = bool(names & set(self._wait_for))
        return Control(partial(self._commands, scene))

    def report(self, events: Iterable[Event]) -> None:
        """Log each thrust that ended because no command came in time; ``events``: of the run."""
        for event in events:
            if event.kind is EventKind.THRUST_OFF and "," in event.detail:
                self._node.get_logger().warning(f"t = {event.t:.3f} s: {event.detail}: it coasts")

    def _commands(self, scene: Scene, sample: np.void) -> Commands:
        now = convert.stamp_ns(float(sample["t"]))
        awaited = [vehicle for vehicle in self._present.values() if vehicle.answers]
        if awaited:
            self._await(awaited, now, scene.name)
        else:
            for _ in range(_SERVED):
                self._node.serve()
        found = [
            self._present[topic].take(now, self._timeout) if topic in self._present else None
            for topic, _ in _VEHICLES
        ]
        return found[0], found[1]

    def _await(self, awaited: list[CommandedVehicle], now: int, name: str) -> None:
        def is_over() -> bool:
            self._check()
            return all(vehicle.has_answered(now) for vehicle in awaited)

        limit = self._answer_timeout()
        if not self._node.wait(is_over, limit):
            silent = [v.topic.name for v in awaited if not v.has_answered(now)]
            raise CaptureSimError(
                f"{name}: {', '.join(silent)}: no answer to the odometry of t = "
                f"{1e-9 * (now - convert.EPOCH_NS):.3f} s within {limit:g} s"
            )


def _last(full_name: str) -> str:
    return full_name.rpartition("/")[2]
