"""Pacing: simulated or recorded time advances at a given rate of a steady wall clock."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

#: A tick that is late by more than this shifts all later ticks; a shorter delay is recovered, s
#: (wall).
MAX_RECOVERED_DELAY = 1.0
#: Maximum number of ticks whose lateness is kept.
_MAX_TICKS = 1_000_000


class Lateness(NamedTuple):
    """Percentiles and maximum of the lateness of the ticks of a paced run, s (wall)."""

    p50: float
    p99: float
    p999: float
    max: float


class RunPacer:
    """Computes when each tick is due, and keeps how late the ticks came.

    A tick is the instant at which the messages of one simulated time are sent; for a player,
    simulated time means recorded time.  ``factor``: simulated seconds per second (wall), 0 for no
    pacing; ``clock``: function that returns the time of a steady clock, s.  The first tick after
    :meth:`reset` is due at once.  ``t``: simulated time of the last tick, s, NaN before the first;
    ``ticks``: number of ticks with a factor above 0; ``skipped_delay``: delay that was not
    recovered, s (wall), see MAX_RECOVERED_DELAY.
    """

    def __init__(self, factor: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._factor = factor
        self._clock = clock
        self.reset()

    def reset(self) -> None:
        """Restart with no tick, and clear all statistics; the factor stays."""
        self.t = math.nan
        self.ticks = 0
        self.skipped_delay = 0.0
        self._origin: float | None = None  # wall, when simulated time t_origin was due
        self._t_origin = math.nan
        self._wall = self._simulated = 0.0  # s, while it ran
        self._late = array("d")

    @property
    def factor(self) -> float:
        """Simulated seconds per second (wall); a change in a run affects only the time after it."""
        return self._factor

    @factor.setter
    def factor(self, value: float) -> None:
        self.pause()
        self._factor = value

    def pause(self) -> None:
        """Stop simulated time until the next call of :meth:`delay` or :meth:`tick`."""
        if self._origin is not None:
            passed = self._clock() - self._origin
            self._wall += passed
            self._t_origin += passed * self._factor
            self._origin = None

    def delay(self, t: float) -> float:
        """Return after how many s (wall) simulated time ``t`` (s) is due; <= 0 if it is due.

        Without pacing return 0.  After a pause, simulated time starts to advance with this call.
        """
        now = self._clock()
        if self._origin is None:
            # a delay before a pause is not recovered
            self._t_origin = float(np.fmin(np.fmax(self._t_origin, self.t), t))
            self._origin = now
        if self._factor == 0.0:
            return 0.0
        return self._origin + (t - self._t_origin) / self._factor - now

    def tick(self, t: float) -> None:
        """Note that the tick of simulated time ``t`` (s) happens now."""
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
        """True while simulated time advances: from a :meth:`delay` or :meth:`tick` to a pause."""
        return self._origin is not None

    @property
    def wall(self) -> float:
        """Wall time spent running, without pauses, s."""
        return self._wall + (0.0 if self._origin is None else self._clock() - self._origin)

    @property
    def achieved(self) -> float:
        """Simulated seconds per second (wall) since :meth:`reset`, without pauses."""
        return self._simulated / max(self.wall, 1e-9)

    def lateness(self, last: int | None = None) -> Lateness | None:
        """Return the lateness of the last ``last`` ticks (>= 1), or of all if it is None.

        Return None if there was no tick with a factor above 0.  Of a long run only the latest
        500 000 to 1 000 000 ticks are kept.
        """
        kept = self._late if last is None else self._late[-last:]
        if not kept:
            return None
        # a copy: an array cannot grow while NumPy has a view of it
        values = np.percentile(np.frombuffer(bytes(kept)), [50.0, 99.0, 99.9, 100.0])
        return Lateness(*(float(value) for value in values))
