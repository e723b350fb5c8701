"""Measurements of several sources interpolated to common instants.

The statuses are evaluated at the chaser's stamps; the other sources are interpolated to these
instants.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

from capture_sim.detection.measurements import Counts, Reason, Source, Values

#: Number of measurements of a source that are kept.
_N_KEPT = 5000
#: A source whose first stamp is later than an instant by this has another clock, s.
_MAX_LEAD = 2.0


class Observation(NamedTuple):
    """Consistent measurements of all sources at one instant; keys are values of `Source`."""

    t: float
    chaser: Values
    target: Values
    buffer: Values

    @property
    def has_rates(self) -> bool:
        """True if every source gives rates; they are used only in the absence of noise."""
        return (len(self.chaser), len(self.target), len(self.buffer)) == (6, 6, 4)


class _Track:
    """The latest measurements of a source, in order."""

    def __init__(self, *, is_pose: bool) -> None:
        self.times: list[float] = []
        self.values: list[Values] = []
        self._is_pose = is_pose  # the third value is an angle that may wrap

    @property
    def newest(self) -> float:
        return self.times[-1] if self.times else -math.inf

    def add(self, t: float, values: Values) -> None:
        self.times.append(t)
        self.values.append(values)
        if len(self.times) > 2 * _N_KEPT:
            del self.times[:_N_KEPT], self.values[:_N_KEPT]

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

    An observation is returned as soon as target and buffer have a measurement of its time or of a
    later one.  An instant in a gap of a source longer than ``max_gap``, s, is left out.
    """

    def __init__(self, max_gap: float, counts: Counts) -> None:
        self._max_gap, self._counts = max_gap, counts
        self._tracks = {source: _Track(is_pose=source is Source.TARGET) for source in _OTHERS}
        self._waiting: deque[tuple[float, Values]] = deque()

    def add(self, source: Source, t: float, values: Values) -> None:
        """Add a measurement of a time, s; times of each source must increase."""
        if source is Source.CHASER:
            self._waiting.append((t, values))
        else:
            self._tracks[source].add(t, values)

    def values_between(self, source: Source, begin: float, end: float) -> list[Values]:
        """Return a source's measurements between two times, s, both excluded."""
        track = self._tracks[source]
        return track.values[bisect_right(track.times, begin) : bisect_left(track.times, end)]

    def complete(self, decided: Mapping[Source, float] | None) -> list[Observation]:
        """Return the observations that are complete.

        ``decided``: time up to which no other measurement of a source will come, s; None at the
        end.
        """
        observations: list[Observation] = []
        waiting, tracks = self._waiting, self._tracks
        while waiting:
            t, chaser = waiting[0]
            if decided is not None and any(
                track.newest < t and decided[source] <= t + self._max_gap
                for source, track in tracks.items()
            ):
                break
            waiting.popleft()
            values = {s: track.interpolate(t, self._max_gap) for s, track in tracks.items()}
            target, buffer = (values[source] for source in _OTHERS)
            if target is not None and buffer is not None:
                observations.append(Observation(t, chaser, target, buffer))
                continue
            for source, track in tracks.items():
                if values[source] is None:
                    is_ahead = bool(track.times) and track.times[0] > t + _MAX_LEAD
                    self._counts.reject(source, Reason.AHEAD if is_ahead else Reason.GAP)
        return observations


_OTHERS = (Source.TARGET, Source.BUFFER)
