"""The check of each wrench that a rig returns, and the load cell's bias and noise at rest."""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from capture_sim.hardware.guard import Guard
from capture_sim.hardware.law import NO_WRENCH, TipState, Wrench


class Answer(NamedTuple):
    """A wrench of the rig, with the stamp (s) of the position that it answers, and the tip.

    ``wrench`` is the load cell's reading, or the reading without bias if :meth:`Answers.offer`
    returned the answer.  ``tip`` is the tip's measured state; None if the rig does not send it.
    """

    stamp: float
    wrench: Wrench
    tip: TipState | None


#: A stamp further than this ahead of the loop's time comes from a wall clock, s.
_CLOCK = 1e6


class Answers:
    """Checks the answers of a rig, and subtracts the load cell's bias from their wrenches.

    The answers to the first position, at rest, give bias and noise in :meth:`tare`.  ``start`` (s)
    is the stamp of the first position.  ``latest`` is the newest accepted answer, ``rejections``
    the number of rejected answers by reason.
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
        """Number of answers at rest that have been collected for :meth:`tare`."""
        return len(self._rest)

    def forget_rest(self) -> None:
        """Discard the answers at rest that have been collected so far."""
        self._rest.clear()

    def tare(self) -> None:
        """Compute bias and noise of the load cell from the answers at rest.

        The bias is the median of the wrenches.  Raise SafeStopError if its force exceeds the limit.
        """
        rest = np.array(self._rest)
        self.bias = Wrench(*np.median(rest, axis=0).tolist())
        self.noise = float(rest[:, :3].std(axis=0).max())
        self._guard.check_rest(self._rest, self.bias)
        self._is_tared = True
        self.latest = Answer(self._start, NO_WRENCH, None)

    def tared(self, wrench: Wrench) -> Wrench:
        """Return a reading of the load cell minus the bias."""
        return Wrench(*(a - b for a, b in zip(wrench, self.bias, strict=True)))

    def offer(
        self, stamp: float, now: float, wrench: Wrench, tip: TipState | None
    ) -> Answer | None:
        """Return an answer of the rig, without bias, or None if the loop cannot use it.

        Before :meth:`tare` the wrench is collected as a reading at rest, and None is returned.  A
        rejected answer is counted by its reason.  ``stamp`` (s) is the stamp of the position that
        is answered, ``now`` (s) the loop's time.  ``tip`` is the state of the tip that the rig has
        measured, None without a measurement.  After :meth:`tare`, raise SafeStopError if force or
        torque exceeds its limit, even if the stamp is not valid.
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
        """Count an answer that cannot be used, by its reason."""
        self.rejections[reason] += 1
        self._last_rejection = reason

    def check_latency(self, now: float) -> None:
        """Raise SafeStopError if the latest accepted answer is too old at the time ``now`` (s)."""
        n = sum(self.rejections.values())
        hint = f"; {n} wrenches rejected, the last one {self._last_rejection}" if n else ""
        self._guard.check_latency(now - self.latest.stamp, hint)
