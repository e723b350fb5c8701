"""The wrenches of a rig: which of them are used, and the load cell's bias and noise."""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from capture_sim.hardware.guard import Guard
from capture_sim.hardware.law import NO_WRENCH, TipState, Wrench


class Answer(NamedTuple):
    """A wrench, its stamp (s), and the measured tip; :meth:`Answers.offer` subtracts the bias."""

    stamp: float
    wrench: Wrench
    tip: TipState | None


#: A stamp so far ahead is of a wall clock, s.
_CLOCK = 1e6


class Answers:
    """The rig's answers: at rest bias and noise are taken, then each is checked.

    ``start`` (s) is the stamp of the first position.
    """

    def __init__(self, guard: Guard, start: float = 0.0) -> None:
        self._guard, self._start = guard, start
        self._rest: list[Wrench] = []
        self._is_tared = False
        self._last_rejection = ""
        self.bias = NO_WRENCH
        self.noise = 0.0  # N, standard deviation of a component of the force
        self.rejections: Counter[str] = Counter()
        self.latest = Answer(-math.inf, NO_WRENCH, None)

    @property
    def n_at_rest(self) -> int:
        """How many answers to the first position have come."""
        return len(self._rest)

    def forget_rest(self) -> None:
        """Begin the answers at rest again."""
        self._rest.clear()

    def tare(self) -> None:
        """Take bias and noise from the answers at rest; SafeStopError beyond the bias's limit."""
        rest = np.array(self._rest)
        self.bias = Wrench(*np.median(rest, axis=0).tolist())
        self.noise = float(rest[:, :3].std(axis=0).max())
        self._guard.check_rest(self._rest, self.bias)
        self._is_tared = True
        self.latest = Answer(self._start, NO_WRENCH, None)

    def tared(self, wrench: Wrench) -> Wrench:
        """Return a reading without the bias."""
        return Wrench(*(a - b for a, b in zip(wrench, self.bias, strict=True)))

    def offer(
        self, stamp: float, now: float, wrench: Wrench, tip: TipState | None
    ) -> Answer | None:
        """Return the answer if it can be used; else count the reason.

        ``stamp`` (s) is the stamp of the position that it answers, ``now`` (s) the loop's time, and
        ``tip`` the position where the rig has measured its tip.  SafeStopError if force or torque
        exceeds its limit, whatever the stamp is.
        """
        is_finite = all(map(math.isfinite, wrench))
        if self._is_tared and is_finite:
            self._guard.check_wrench(self.tared(wrench))
        if not (is_finite and all(map(math.isfinite, (stamp, *(tip or ()))))):
            reason = "not finite"
        elif stamp - now > _CLOCK:
            reason = "stamped by a wall clock; must be the stamp of the position it answers"
        elif stamp > now + 1e-9:
            reason = "stamped ahead of the loop"
        elif stamp < self._start - 1e-9:
            reason = "stamped before the loop's start"
        elif not self._is_tared:
            self._rest.append(wrench)
            return None
        elif stamp <= self.latest.stamp:
            reason = "not newer than the previous wrench"
        else:
            self.latest = Answer(stamp, self.tared(wrench), tip)
            return self.latest
        self.reject(reason)
        return None

    def reject(self, reason: str) -> None:
        """Count an answer that cannot be used."""
        self.rejections[reason] += 1
        self._last_rejection = reason

    def check_latency(self, now: float) -> None:
        """Raise SafeStopError if the latest answer is too old."""
        n = sum(self.rejections.values())
        hint = f"; {n} wrenches rejected, the last one {self._last_rejection}" if n else ""
        self._guard.check_latency(now - self.latest.stamp, hint)
