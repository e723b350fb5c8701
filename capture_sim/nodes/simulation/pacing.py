"""Simulated or recorded time at a given rate of wall time, by a steady clock."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

#: Delays beyond this are skipped instead of recovered, s (wall).
MAX_RECOVERED_DELAY = 1.0
#: Ticks whose lateness is kept at most.
_MAX_TICKS = 1_000_000


class Lateness(NamedTuple):
    """Lateness of the ticks of a paced run, s (wall)."""

    p50: float
    p99: float
    p999: float
    max: float


class RunPacer:
    """Computes when ticks are due, from one origin, and keeps how late they came.

    ``factor``: simulated seconds per second, 0 for no pacing; ``clock``: a steady one, s.  The
    first tick after :meth:`reset` is due at once.  ``t``: simulated time of the last tick, s, NaN
    before the first; ``ticks``: how many were paced; ``skipped_delay``: s (wall) that were not
    recovered.
    """

    def __init__(self, factor: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._factor = factor
        self._clock = clock
        self.reset()

    def reset(self) -> None:
        """Restart; earlier pacing is forgotten."""
        self.t = math.nan
        self.ticks = 0
        self.skipped_delay = 0.0
        self._origin: float | None = None  # wall, when simulated time t_origin was due
        self._t_origin = math.nan
        self._wall = self._simulated = 0.0  # s, while it ran
        self._late = array("d")

    @property
    def factor(self) -> float:
        """Simulated seconds per second; a change in a run takes effect from the present time on."""
        return self._factor

    @factor.setter
    def factor(self, value: float) -> None:
        self.pause()
        self._factor = value

    def pause(self) -> None:
        """Let time stand still until the next :meth:`delay`."""
        if self._origin is not None:
            passed = self._clock() - self._origin
            self._wall += passed
            self._t_origin += passed * self._factor
            self._origin = None

    def delay(self, t: float) -> float:
        """Return in how many seconds (wall) simulated time ``t`` (s) is due; <= 0 if it is."""
        now = self._clock()
        if self._origin is None:
            # a delay before a pause is not recovered
            self._t_origin = float(np.fmin(np.fmax(self._t_origin, self.t), t))
            self._origin = now
        if self._factor == 0.0:
            return 0.0
        return self._origin + (t - self._t_origin) / self._factor - now

    def tick(self, t: float) -> None:
        """Note that simulated time ``t`` (s) passes now, in its turn."""
        late = -self.delay(t)
        if not math.isnan(self.t):
            self._simulated += t - self.t
        self.t = t
        if self._factor == 0.0:
            return
        self.ticks += 1
        if len(self._late) == _MAX_TICKS:
            del self._late[: _MAX_TICKS // 2]
        self._late.append(late)
        if late > MAX_RECOVERED_DELAY and self._origin is not None:
            self.skipped_delay += late
            self._wall += late
            self._origin += late

    @property
    def running(self) -> bool:
        """True while simulated time advances: from a tick in turn until a pause."""
        return self._origin is not None

    @property
    def wall(self) -> float:
        """Wall time spent running, without pauses, s."""
        return self._wall + (0.0 if self._origin is None else self._clock() - self._origin)

    @property
    def achieved(self) -> float:
        """Simulated seconds per second so far, without pauses."""
        return self._simulated / max(self.wall, 1e-9)

    def lateness(self, last: int | None = None) -> Lateness | None:
        """Return how late the ticks came, all or the ``last`` ones; None before the first."""
        kept = self._late if last is None else self._late[-last:]
        if not kept:
            return None
        # a copy: an array cannot grow while NumPy has a view of it
        values = np.percentile(np.frombuffer(bytes(kept)), [50.0, 99.0, 99.9, 100.0])
        return Lateness(*(float(value) for value in values))
