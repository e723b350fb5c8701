"""Thrusters: the wrenches on the vehicles that result from a controller's commands.

A command is limited to the thruster's maximum force and torque.  It takes effect after the delay,
but not before the present wrench has been held for the shortest pulse.  The wrench is then held
until the next command takes effect, or until the timeout.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from capture_sim.scene.parts import Thruster, Thrusters

#: Force (N, N) and moment (N m) on a vehicle, in its own axes.
BodyWrench = tuple[float, float, float]
#: Commanded wrenches of chaser and target; None: no new command.
Commands = tuple[Sequence[float] | None, Sequence[float] | None]

#: The wrench of a vehicle whose thrusters are off.
NO_THRUST: BodyWrench = (0.0, 0.0, 0.0)


class HeldWrench:
    """The wrench of one vehicle's thrusters over time.

    ``applied`` is the wrench in effect.  ``timeout`` is the timeout, s, if it has ended the last
    command's wrench, else 0.
    """

    def __init__(self, thruster: Thruster, timeout: float) -> None:
        self._thruster, self._timeout = thruster, timeout
        self._waiting: deque[tuple[float, BodyWrench]] = deque()  # time of effect (s), wrench
        self._since = -math.inf  # time of the last change, s
        self._expires = math.inf  # s
        self.applied: BodyWrench = NO_THRUST
        self.timeout = 0.0

    def command(self, t: float, wrench: Sequence[float]) -> None:
        """Accept a command at a time, s, which must not be before that of the last command."""
        limit = self._thruster
        fx, fy = (max(-limit.force, min(limit.force, float(f))) for f in wrench[:2])
        tz = max(-limit.torque, min(limit.torque, float(wrench[2])))
        self._waiting.append((_later(t, limit.delay), (fx, fy, tz)))

    def next_change(self) -> float:
        """Return the time at which the wrench may change next, by a command or its timeout, s.

        Returns inf if no command waits and no wrench can time out.
        """
        following = self._expires
        if self._waiting:
            following = min(following, max(self._waiting[0][0], self._held_until))
        return following

    def go_to(self, t: float) -> None:
        """Apply all commands and timeouts that are due by a time, s; times must not decrease."""
        while self.next_change() <= t:
            if self._expires <= t and not self._is_due(self._expires):
                self._change(self._expires, NO_THRUST)
                self._expires, self.timeout = math.inf, self._timeout
                continue
            # if several commands waited for the end of a pulse, the last command takes effect
            begins = max(self._waiting[0][0], self._held_until)
            wrench = NO_THRUST
            while self._waiting and self._waiting[0][0] <= begins:
                _, wrench = self._waiting.popleft()
            self._change(begins, wrench)
            self._expires = _later(begins, self._timeout) if any(wrench) else math.inf
            self.timeout = 0.0

    @property
    def _held_until(self) -> float:
        return _later(self._since, self._thruster.min_hold)

    def _is_due(self, t: float) -> bool:
        """Return True if a command takes effect by a time, s."""
        return bool(self._waiting) and max(self._waiting[0][0], self._held_until) <= t

    def _change(self, t: float, wrench: BodyWrench) -> None:
        if wrench != self.applied:
            self.applied, self._since = wrench, t


def _later(t: float, duration: float) -> float:
    """Return ``t + duration``, s, rounded to 1e-12 s so that it stays on the sample grid."""
    return round(t + duration, 12)


class Actuation:
    """The wrenches on both vehicles over time."""

    def __init__(self, thrusters: Thrusters) -> None:
        self._held = [
            None if thruster is None else HeldWrench(thruster, thrusters.timeout)
            for thruster in (thrusters.chaser, thrusters.target)
        ]

    def command(self, t: float, commands: Commands) -> None:
        """Accept the commands of a time, s; commands to a vehicle without thrusters are ignored."""
        for held, wrench in zip(self._held, commands, strict=True):
            if held is not None and wrench is not None:
                held.command(t, wrench)

    def go_to(self, t: float) -> None:
        """Apply all commands and timeouts of both vehicles that are due by a time, s."""
        for held in filter(None, self._held):
            held.go_to(t)

    def next_change(self) -> float:
        """Return the time at which a wrench may change next, s."""
        return min(held.next_change() for held in self._held if held is not None)

    @property
    def applied(self) -> tuple[BodyWrench, BodyWrench]:
        """Wrenches in effect on chaser and target."""
        chaser, target = (NO_THRUST if h is None else h.applied for h in self._held)
        return chaser, target

    @property
    def timeouts(self) -> tuple[float, float]:
        """Timeouts (s) that ended the wrenches of chaser and target; 0 if none has ended it."""
        chaser, target = (0.0 if h is None else h.timeout for h in self._held)
        return chaser, target
