"""Measurements of several sources interpolated to common instants.

Simulated poses and buffer states have the same stamps.  On a real bench each source has its own
clock, rate and delay, and messages get lost and overtake each other.  The statuses are evaluated
at the chaser's stamps; the other sources are interpolated to these instants.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from enum import Enum
from typing import NamedTuple

Values = tuple[float, ...]

#: Largest number of measurements of a source that wait for those of the others.
MAX_WAITING = 1000
#: A stamp that is later than both other sources' latest ones by more than this is rejected, s.
MAX_LEAD = 2.0


class Source(Enum):
    """A source of measurements.

    Its values are, in this order: of a pose x, y (m), theta (rad) and, where the source
    gives them, their rates in the world; of the buffer stroke (m), torsion (rad) and,
    likewise, their rates.
    """

    CHASER = "chaser"
    TARGET = "target"
    BUFFER = "buffer"


class Observation(NamedTuple):
    """Consistent measurements of all sources at one instant; the values are those of `Source`."""

    t: float
    chaser: Values
    target: Values
    buffer: Values

    @property
    def has_rates(self) -> bool:
        """True if every source gives rates; they are used only in the absence of noise."""
        return (len(self.chaser), len(self.target), len(self.buffer)) == (6, 6, 4)


class _Track:
    """The latest measurements of a source in the order of their times."""

    def __init__(self, *, is_pose: bool) -> None:
        self.times: list[float] = []
        self.values: list[Values] = []
        self._is_pose = is_pose  # the third value is an angle that may wrap

    def add(self, t: float, values: Values) -> bool:
        """Add a measurement; return False if there is one of this time already."""
        index = len(self.times)
        if index and t <= self.times[-1]:
            index = bisect_left(self.times, t)
            if self.times[index] == t:
                return False
        self.times.insert(index, t)
        self.values.insert(index, values)
        if len(self.times) > MAX_WAITING:
            del self.times[0], self.values[0]
        return True

    @property
    def newest(self) -> float:
        """The latest time; one far later than the rest does not count before another follows."""
        times = self.times
        if len(times) > 1 and times[-1] - times[-2] > MAX_LEAD:
            return times[-2]
        return times[-1] if times else -math.inf

    def drop_after(self, t: float) -> list[float]:
        """Remove the measurements later than ``t``; return their times."""
        first = bisect_right(self.times, t)
        dropped = self.times[first:]
        del self.times[first:], self.values[first:]
        return dropped

    def interpolate(self, t: float, max_gap: float) -> Values | None:
        """Return the values at a time, or None if the neighbours are further apart than a gap."""
        after = bisect_left(self.times, t)
        if after < len(self.times) and self.times[after] == t:
            return self.values[after]
        if after in (0, len(self.times)):
            return None
        t0, t1 = self.times[after - 1], self.times[after]
        if t1 - t0 > max_gap:
            return None
        share = (t - t0) / (t1 - t0)
        first, second = self.values[after - 1], self.values[after]
        if len(first) != len(second):
            first, second = first[: len(second)], second[: len(first)]
        values = [(1.0 - share) * a + share * b for a, b in zip(first, second, strict=True)]
        if self._is_pose:
            turn = math.remainder(second[2] - first[2], 2.0 * math.pi)
            values[2] = first[2] + share * turn
        return tuple(values)


class Aligner:
    """Combines the measurements of one instant.

    An observation is returned as soon as every source has a measurement of its time or of a later
    one; a late measurement completes one too, late.  An instant in a gap of a source longer than
    ``max_gap``, s, is left out.  If every source keeps its own order, the result does not depend
    on the order between sources.
    """

    def __init__(self, max_gap: float) -> None:
        #: Number of instants without an observation.
        self.skipped = 0
        #: Number of measurements rejected because there was one with the same stamp.
        self.repeated = 0
        #: By source, number and largest lead, s, of the stamps that were rejected because they
        #: were more than :data:`MAX_LEAD` later than both other sources' latest ones.
        self.rejected_leads: dict[Source, tuple[int, float]] = {}
        self._max_gap = max_gap
        self._tracks = {source: _Track(is_pose=source is not Source.BUFFER) for source in Source}
        self._last: dict[Source, float] = {}  # stamp of each source's latest message
        self._waiting: list[tuple[float, Values]] = []

    def add(self, source: Source, t: float, values: Values) -> list[Observation]:
        """Add a measurement of stamp ``t``, s; return the observations that it completes, in order.

        The values are those of :class:`Source`; a measurement that is not finite is left out.
        """
        if not (math.isfinite(t) and all(map(math.isfinite, values))):
            self.skipped += source is Source.CHASER
            return []
        self._last[source] = t
        if not self._tracks[source].add(t, values):
            self.repeated += 1
            return []
        if source is Source.CHASER:
            self._waiting.append((t, values))
            self._waiting.sort()
        self._reject_leads(source)
        return self._complete(is_end=False)

    def values_between(self, source: Source, begin: float, end: float) -> list[Values]:
        """Return what a source has measured between two times, without these, s."""
        track = self._tracks[source]
        return track.values[bisect_right(track.times, begin) : bisect_left(track.times, end)]

    @property
    def newest(self) -> float:
        """The latest stamp of all sources, s."""
        return max(track.newest for track in self._tracks.values())

    def silent(self, max_age: float) -> list[Source]:
        """Return the sources whose last stamp is older than the newest one by more than this, s."""
        newest = self.newest
        oldest = min((t.times[0] for t in self._tracks.values() if t.times), default=0.0)
        return [
            source
            for source, track in self._tracks.items()
            if newest - (track.newest if track.times else oldest) > max_age
        ]

    def flush(self) -> list[Observation]:
        """Return the remaining observations at the end of the run."""
        return self._complete(is_end=True)

    def _reject_leads(self, witness: Source) -> None:
        """Remove stamps of other sources that the witness's message shows to be far ahead."""
        for source, track in self._tracks.items():
            if source is witness or not track.times:
                continue
            others = max(t for other, t in self._last.items() if other is not source)
            if track.times[-1] <= others + MAX_LEAD:
                continue
            dropped = track.drop_after(others + MAX_LEAD)
            count, lead = self.rejected_leads.get(source, (0, 0.0))
            lead = max(lead, dropped[-1] - others)
            self.rejected_leads[source] = count + len(dropped), lead
            if source is Source.CHASER:
                self._waiting = [item for item in self._waiting if item[0] < dropped[0]]

    def _complete(self, *, is_end: bool) -> list[Observation]:
        observations: list[Observation] = []
        others = (self._tracks[Source.TARGET], self._tracks[Source.BUFFER])
        while self._waiting:
            t, chaser = self._waiting[0]
            is_covered = is_end or all(track.newest >= t for track in others)
            if not is_covered and len(self._waiting) <= MAX_WAITING:
                break
            del self._waiting[0]
            target, buffer = (track.interpolate(t, self._max_gap) for track in others)
            if target is None or buffer is None:
                self.skipped += 1
                continue
            observations.append(Observation(t, chaser, target, buffer))
        return observations
