"""Measurements of several sources brought to common instants.

Simulated poses and buffer states carry the same stamps.  On a real bench each source has
its own clock, rate and delay, messages get lost and overtake each other.  The chaser's
stamps are the instants of the statuses; what the other sources did then is interpolated.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from enum import Enum
from typing import NamedTuple

Values = tuple[float, ...]

#: Measurements of a source that are kept for those still to come of the others.
ROOM = 1000


class Source(Enum):
    """What is measured, each at its own times.

    The values are, in this order: of a pose x, y (m), theta (rad) and, where the source
    gives them, their rates in the world; of the buffer stroke (m), torsion (rad) and,
    likewise, their rates.
    """

    CHASER = "chaser"
    TARGET = "target"
    BUFFER = "buffer"


class Observation(NamedTuple):
    """One consistent measurement of all sources; the values are those of :class:`Source`."""

    t: float
    chaser: Values
    target: Values
    buffer: Values

    @property
    def has_rates(self) -> bool:
        """Whether every source gives rates; used only where the measurements do not scatter."""
        return (len(self.chaser), len(self.target), len(self.buffer)) == (6, 6, 4)


class _Track:
    """The latest measurements of a source in the order of their times."""

    def __init__(self, turns: bool) -> None:
        self.times: list[float] = []
        self.values: list[Values] = []
        self._turns = turns  # the third value is an angle that may wrap

    def add(self, t: float, values: Values) -> bool:
        """Add a measurement; False for a time that is there already."""
        place = len(self.times)
        if place and t <= self.times[-1]:
            place = bisect_left(self.times, t)
            if self.times[place] == t:
                return False
        self.times.insert(place, t)
        self.values.insert(place, values)
        if len(self.times) > ROOM:
            del self.times[0], self.values[0]
        return True

    def at(self, t: float, longest: float) -> Values | None:
        """Return the values at a time; None where no measurements close enough lie round it."""
        after = bisect_left(self.times, t)
        if after < len(self.times) and self.times[after] == t:
            return self.values[after]
        if after in (0, len(self.times)):
            return None
        t0, t1 = self.times[after - 1], self.times[after]
        if t1 - t0 > longest:
            return None
        share = (t - t0) / (t1 - t0)
        first, second = self.values[after - 1], self.values[after]
        if len(first) != len(second):
            first, second = first[: len(second)], second[: len(first)]
        mixed = [(1.0 - share) * a + share * b for a, b in zip(first, second, strict=True)]
        if self._turns:
            turn = math.remainder(second[2] - first[2], 2.0 * math.pi)
            mixed[2] = first[2] + share * turn
        return tuple(mixed)

    def covers(self, t: float) -> bool:
        """Whether a measurement of this time or later is there."""
        return bool(self.times) and self.times[-1] >= t


class Aligner:
    """Puts together what was measured at the same instant.

    An observation is handed out as soon as every source has a measurement of its time or
    of a later one; a measurement that comes late gives one too, late.  An instant at which
    a source has a hole is left out and counted in ``skipped``.  Where every source keeps
    its own order, the result does not depend on how they come between each other.

    Parameters
    ----------
    gap
        s, longest hole of a source that is interpolated over.

    Attributes
    ----------
    skipped : int
        Instants that were given up.
    repeated : int
        Measurements with a time that was there already.
    """

    def __init__(self, gap: float) -> None:
        self.skipped = 0
        self.repeated = 0
        self._gap = gap
        self._tracks = {source: _Track(source is not Source.BUFFER) for source in Source}
        self._waiting: list[tuple[float, Values]] = []

    def add(self, source: Source, t: float, values: Values) -> list[Observation]:
        """Add a measurement; return the observations that it completes, in order.

        Parameters
        ----------
        source
            What was measured.
        t
            When, s.
        values
            See :class:`Source`; such as are not finite are left out.
        """
        if not (math.isfinite(t) and all(map(math.isfinite, values))):
            self.skipped += source is Source.CHASER
            return []
        if not self._tracks[source].add(t, values):
            self.repeated += 1
            return []
        if source is Source.CHASER:
            self._waiting.append((t, values))
            self._waiting.sort()
        return self._take(whole=False)

    def silent(self, longer: float) -> list[Source]:
        """Return the sources that have fallen behind the newest of all by more than this, s."""
        known = {source: track.times for source, track in self._tracks.items()}
        newest = max((times[-1] for times in known.values() if times), default=0.0)
        oldest = min((times[0] for times in known.values() if times), default=0.0)
        return [
            source
            for source, times in known.items()
            if newest - (times[-1] if times else oldest) > longer
        ]

    def flush(self) -> list[Observation]:
        """Return the rest at the end, when nothing more will come."""
        return self._take(whole=True)

    def _take(self, *, whole: bool) -> list[Observation]:
        found: list[Observation] = []
        others = (self._tracks[Source.TARGET], self._tracks[Source.BUFFER])
        while self._waiting:
            t, chaser = self._waiting[0]
            complete = whole or all(track.covers(t) for track in others)
            if not complete and len(self._waiting) <= ROOM:
                break
            del self._waiting[0]
            target, buffer = (track.at(t, self._gap) for track in others)
            if target is None or buffer is None:
                self.skipped += 1
                continue
            found.append(Observation(t, chaser, target, buffer))
        return found
