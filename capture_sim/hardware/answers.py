"""What comes from a rig: which answers are used, the load cell's bias and noise."""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from capture_sim.hardware.law import NO_WRENCH, TipState, Wrench
from capture_sim.hardware.limits import Limits, check_limit
from capture_sim.hardware.stage import SafeStopError


class Answer(NamedTuple):
    """A wrench without the cell's bias, its stamp (s), and where the rig measured its tip."""

    stamp: float
    wrench: Wrench
    tip: TipState | None


#: A stamp so far ahead is of a wall clock, s.
_CLOCK = 1e6


class Answers:
    """The rig's answers: at rest bias and noise are taken, then each is checked."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._rest: list[Wrench] = []
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
        if self.bias.force > self._limits.bias:
            raise SafeStopError(
                f"force at rest = {self.bias.force:.4g} N: must be <= {self._limits.bias:g} "
                "(bias_limit); the tip is in contact, or the load cell must be tared"
            )
        self.latest = Answer(0.0, NO_WRENCH, None)

    def offer(
        self, stamp: float, now: float, wrench: Wrench, tip: TipState | None
    ) -> Answer | None:
        """Return the answer if it can be used; else count why not.

        ``stamp`` (s) is that of the position that it answers, ``now`` (s) the loop's time, ``tip``
        where the rig has measured its tip.  SafeStopError if force or torque is beyond its limit.
        """
        numbers = (stamp, *wrench, *(tip or ()))
        if not all(map(math.isfinite, numbers)):
            reason = "not finite"
        elif stamp - now > _CLOCK:
            reason = "stamped by a wall clock; must be the stamp of the position it answers"
        elif stamp > now + 1e-9:
            reason = "stamped ahead of the loop"
        elif stamp < -1e-9:
            reason = "stamped before the loop's start"
        elif now == 0.0:
            self._rest.append(wrench)
            return None
        elif stamp <= self.latest.stamp:
            reason = "not newer than the one before"
        else:
            tared = Wrench(*(a - b for a, b in zip(wrench, self.bias, strict=True)))
            self.latest = Answer(stamp, tared, tip)
            check_limit("force on the rig", tared.force, "N", self._limits.force)
            check_limit("torque on the rig", tared.torque, "N m", self._limits.torque)
            return self.latest
        self.reject(reason)
        return None

    def reject(self, reason: str) -> None:
        """Count an answer that cannot be used."""
        self.rejections[reason] += 1
        self._last_rejection = reason

    def check_latency(self, now: float) -> None:
        """Raise SafeStopError if the latest answer is too old."""
        age = now - self.latest.stamp
        if age > self._limits.latency + 1e-9:
            n = sum(self.rejections.values())
            why = f"; {n} wrenches rejected, the last one {self._last_rejection}" if n else ""
            limit = f"{self._limits.latency:g} (timeout)"
            raise SafeStopError(f"latency of the wrench = {age:.3g} s: must be <= {limit}{why}")
