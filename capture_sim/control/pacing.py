"""Simulated time at a given rate of wall time, by a steady clock."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from capture_sim.scene.quantities import Range

#: Allowed simulated (or recorded) seconds per second; 0 does not wait at all.
FACTORS = Range(0.0, 1000.0)
#: What a run is late by more than this is given up, not caught up with, s (wall).
MOST_BEHIND = 1.0
#: Ticks whose lateness is kept; the oldest are overwritten beyond.
_KEPT = 1_000_000


class Lateness(NamedTuple):
    """How late the ticks of a paced run came, s (wall)."""

    p50: float
    p99: float
    p999: float
    max: float


class Pacer:
    """Lets ticks come when they are due; what is late is caught up with.

    The due time of every tick is counted from one origin, so that an error of one tick does
    not move the others.

    Parameters
    ----------
    factor
        Simulated seconds per second; 0 does not wait at all.
    clock, sleep
        A steady clock, s, and a way to wait on it, s.

    Attributes
    ----------
    given_up : float
        Wall time by which the run fell behind for good, s.
    """

    def __init__(
        self,
        factor: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.given_up = 0.0
        self._clock = clock
        self._sleep = sleep
        self._wanted = self._factor = factor
        self._origin = clock()  # wall, when simulated time t_origin was due
        self._t_origin = 0.0
        self._late = array("d")
        self._next = 0
        self._ticks = 0

    @property
    def factor(self) -> float:
        """The factor that is wanted; may be set by another thread."""
        return self._wanted

    @factor.setter
    def factor(self, value: float) -> None:
        self._wanted = value

    def restart(self, t: float) -> None:
        """Take up pacing again: simulated time ``t`` (s) is due now."""
        self._factor = self._wanted
        self._origin, self._t_origin = self._clock(), t

    def wait_for(self, t: float) -> None:
        """Wait until simulated time ``t`` (s) is due."""
        if self._factor != self._wanted:
            self.restart(t)
            return
        if self._factor == 0.0:
            return
        due = self._origin + (t - self._t_origin) / self._factor
        delay = due - self._clock()
        if delay > 0.0:
            self._sleep(delay)
        late = self._clock() - due
        self._note(late)
        if late > MOST_BEHIND:
            self.given_up += late
            self._origin += late

    def _note(self, late: float) -> None:
        self._ticks += 1
        if len(self._late) < _KEPT:
            self._late.append(late)
        else:
            self._late[self._next] = late
            self._next = (self._next + 1) % _KEPT

    @property
    def ticks(self) -> int:
        """Ticks that were paced."""
        return self._ticks

    def late_ticks(self, limit: float) -> int:
        """Return how many of the ticks that are kept came later than ``limit``, s."""
        # a copy: the stepping thread could not append to an array that is looked at
        return int(np.count_nonzero(np.frombuffer(bytes(self._late)) > limit))

    def lateness(self, last: int | None = None) -> Lateness | None:
        """Return how late the ticks came, all or the ``last`` ones; None before the first."""
        kept = self._late if last is None else self._late[-last:]
        if not kept:
            return None
        values = np.percentile(np.frombuffer(bytes(kept)), [50.0, 99.0, 99.9, 100.0])
        return Lateness(*(float(value) for value in values))
