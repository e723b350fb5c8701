"""Thrusters: the wrench that acts on a vehicle, from the commands of a controller.

A command is clipped to the thruster's limits and takes effect after its delay.  It waits until the
present wrench has lasted for the shortest pulse.  The wrench then holds until the next command or
the timeout.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from capture_sim.scene.parts import Thruster, Thrusters

#: Force (N, N) and moment (N m) on a vehicle, in its own axes.
BodyWrench = tuple[float, float, float]
#: What a controller commands, for chaser and target; None: no new command.
Commands = tuple[Sequence[float] | None, Sequence[float] | None]

#: The wrench of a vehicle whose thrusters are off.
NO_THRUST: BodyWrench = (0.0, 0.0, 0.0)


class HeldWrench:
    """The wrench of one vehicle's thrusters over time.

    ``applied`` is the wrench in effect.  ``timeout`` (s) is the timeout that has ended the last
    command, else 0.
    """

    def __init__(self, thruster: Thruster, timeout: float) -> None:
        self._thruster, self._timeout = thruster, timeout
        self._waiting: deque[tuple[float, BodyWrench]] = deque()  # time of effect (s), wrench
        self._since = -math.inf  # s, of the last change
        self._expires = math.inf  # s
        self.applied: BodyWrench = NO_THRUST
        self.timeout = 0.0

    def command(self, t: float, wrench: Sequence[float]) -> None:
        """Take a command at a time, s, not before the last one."""
        limit = self._thruster
        fx, fy = (max(-limit.force, min(limit.force, float(f))) for f in wrench[:2])
        tz = max(-limit.torque, min(limit.torque, float(wrench[2])))
        self._waiting.append((_later(t, limit.delay), (fx, fy, tz)))

    def next_change(self) -> float:
        """Return when the wrench may change next, s; inf without a command that waits."""
        following = self._expires
        if self._waiting:
            following = min(following, max(self._waiting[0][0], self._held_until))
        return following

    def go_to(self, t: float) -> None:
        """Let everything take effect that is due by a time, s, not before the last one."""
        while self.next_change() <= t:
            if self._expires <= t and not self._is_due(self._expires):
                self._change(self._expires, NO_THRUST)
                self._expires, self.timeout = math.inf, self._timeout
                continue
            # of several commands that waited for the end of a pulse the last one counts
            begins = max(self._waiting[0][0], self._held_until)
            wrench = NO_THRUST
            while self._waiting and self._waiting[0][0] <= begins:
                _, wrench = self._waiting.popleft()
            self._change(begins, wrench)
            self._expires = _later(begins, self._timeout) if any(wrench) else math.inf
            self.timeout = 0.0

    @property
    def _held_until(self) -> float:
        return _later(self._since, self._thruster.min_pulse)

    def _is_due(self, t: float) -> bool:
        """Return True if a command takes effect by a time, s."""
        return bool(self._waiting) and max(self._waiting[0][0], self._held_until) <= t

    def _change(self, t: float, wrench: BodyWrench) -> None:
        if wrench != self.applied:
            self.applied, self._since = wrench, t


def _later(t: float, duration: float) -> float:
    """Return a time a duration later, s, without the rounding that leaves the grid of samples."""
    return round(t + duration, 12)


class Actuation:
    """The wrenches on both vehicles over time."""

    def __init__(self, thrusters: Thrusters) -> None:
        self._held = [
            None if thruster is None else HeldWrench(thruster, thrusters.timeout)
            for thruster in (thrusters.chaser, thrusters.target)
        ]

    def command(self, t: float, commands: Commands) -> None:
        """Take the commands of a time, s; those for a vehicle without thrusters do nothing."""
        for held, wrench in zip(self._held, commands, strict=True):
            if held is not None and wrench is not None:
                held.command(t, wrench)

    def go_to(self, t: float) -> None:
        """Let everything take effect that is due by a time, s."""
        for held in filter(None, self._held):
            held.go_to(t)

    def next_change(self) -> float:
        """Return when a wrench may change next, s."""
        return min(held.next_change() for held in self._held if held is not None)

    @property
    def applied(self) -> tuple[BodyWrench, BodyWrench]:
        """The wrenches in effect on chaser and target."""
        chaser, target = (NO_THRUST if h is None else h.applied for h in self._held)
        return chaser, target

    @property
    def timeouts(self) -> tuple[float, float]:
        """The timeouts (s) by which the wrenches have ended, 0 for one that has not."""
        chaser, target = (0.0 if h is None else h.timeout for h in self._held)
        return chaser, target
