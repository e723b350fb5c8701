"""Offsets between the clocks of a bench's sources, from stamp minus arrival time.

At 0.1 m/s, an offset of 0.05 s between the poses of chaser and target moves the tip by 5 mm, the
radius of the capture zone.  Beyond :data:`MAX_OFFSET`, a verdict could be wrong unnoticed.
"""

from __future__ import annotations

from statistics import median

from capture_sim.detection.measurements import Source
from capture_sim.plausibility.clocks import MAX_OFFSET, WARN_OFFSET

#: Public names; the two limits come from :mod:`capture_sim.plausibility.clocks`.
__all__ = ["MAX_OFFSET", "WARN_OFFSET", "ClockOffsets"]
#: Smallest number of messages of each source from which an offset is computed.
_MIN_ARRIVALS = 5
#: Limits of the rate of stamps relative to arrivals.  Outside, the messages come from a replay,
#: which gives no clock offset.
_LIVE_RATES = (0.8, 1.25)


class ClockOffsets:
    """Comparison of the sources' clocks while their messages arrive.

    The offset of a source is the offset of its message with the smallest delay so far, as in NTP's
    clock filter.  A paused machine or a slow driver can only delay messages, never advance them.
    """

    def __init__(self) -> None:
        self._count = dict.fromkeys(Source, 0)
        self._offset: dict[Source, int] = {}
        self._first: dict[Source, tuple[int, int]] = {}  # stamp and arrival, ns
        self._last: dict[Source, tuple[int, int]] = {}
        self._worst: tuple[Source, float] | None = None

    def add(self, source: Source, stamp: int, arrival: int) -> None:
        """Add a message by its stamp and its time of arrival, ns, each by any clock."""
        self._count[source] += 1
        self._offset[source] = max(self._offset.get(source, stamp - arrival), stamp - arrival)
        self._first.setdefault(source, (stamp, arrival))
        self._last[source] = stamp, arrival

    def worst(self) -> tuple[Source, float] | None:
        """Return the source whose clock differs most from the others', and the difference, s.

        The middle one of the three offsets is the reference.  If the stamps of a source do not
        advance with their arrival, the last known result is returned, or None.  Such stamps come
        from a machine that has halted, or from a replay.
        """
        if min(self._count.values()) >= _MIN_ARRIVALS and all(map(self._is_live, Source)):
            middle = median(self._offset.values())
            source = max(Source, key=lambda each: abs(self._offset[each] - middle))
            self._worst = source, (self._offset[source] - middle) / 1e9
        return self._worst

    def _is_live(self, source: Source) -> bool:
        """Return True if the stamps of a source advance at about the rate of its arrivals."""
        first, last = self._first[source], self._last[source]
        passed, waited = last[0] - first[0], last[1] - first[1]
        return _LIVE_RATES[0] * waited <= passed <= _LIVE_RATES[1] * waited
