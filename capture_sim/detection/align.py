"""Measurements of several sources interpolated to common instants.

The instants are the stamps of the chaser's poses.  The poses of the target and the measurements of
the buffer are interpolated to these instants.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

from capture_sim.detection.measurements import Counts, Reason, Source, Values

#: Smallest number of measurements of a source that stay in memory.
_N_KEPT = 5000
#: If the first stamp of a source is later than an instant by more than this, s, the cause is taken
#: to be a difference of clocks.
_MAX_LEAD = 2.0


class Observation(NamedTuple):
    """Measurements of all sources at one instant.

    ``t`` is in s.  The other fields are named like the members of :class:`Source`, which lists
    their values.
    """

    t: float
    chaser: Values
    target: Values
    buffer: Values

    @property
    def has_rates(self) -> bool:
        """True if the measurements of all sources have rates, which are used only without noise."""
        return (len(self.chaser), len(self.target), len(self.buffer)) == (6, 6, 4)


class _Track:
    """The latest measurements of a source in the order of time."""

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
        """Return the values at a time, s, interpolated between the neighbouring measurements.

        None if the time is before the first or after the last measurement, or if the neighbours are
        more than ``max_gap`` (s) apart.  Rates are left out if only one neighbour has them.
        """
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
    """Combines the measurements of all sources at the instants of the chaser's poses.

    An instant is complete as soon as target and buffer have measurements at its time or later.  An
    instant in a gap of target or buffer that is longer than ``max_gap``, s, gives no observation;
    it is counted as rejected in ``counts``.
    """

    def __init__(self, max_gap: float, counts: Counts) -> None:
        self._max_gap, self._counts = max_gap, counts
        self._tracks = {source: _Track(is_pose=source is Source.TARGET) for source in _OTHERS}
        self._waiting: deque[tuple[float, Values]] = deque()

    def add(self, source: Source, t: float, values: Values) -> None:
        """Add a measurement of a source at time ``t``, s; times of each source must increase."""
        if source is Source.CHASER:
            self._waiting.append((t, values))
        else:
            self._tracks[source].add(t, values)

    def values_between(self, source: Source, begin: float, end: float) -> list[Values]:
        """Return the values of target or buffer measured between two times, s, both excluded."""
        track = self._tracks[source]
        return track.values[bisect_right(track.times, begin) : bisect_left(track.times, end)]

    def complete(self, decided: Mapping[Source, float] | None) -> list[Observation]:
        """Return the observations that have become complete, in the order of time.

        ``decided`` has the time, s, up to which all measurements of target and buffer have been
        added.  With None, at the end of the run, no further measurements are waited for.
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
