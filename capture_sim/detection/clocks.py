"""Offsets between the clocks of a bench's sources, from stamp less arrival.

At 0.1 m/s an offset of 0.05 s between the poses of chaser and target moves the tip by 5 mm, the
radius of the capture zone: beyond :data:`MAX_OFFSET` a verdict would be wrong without notice.
"""

from __future__ import annotations

from statistics import median

from capture_sim.detection.measurements import Source
from capture_sim.plausibility.clocks import MAX_OFFSET, WARN_OFFSET

#: The bounds are those of the rules of plausibility.
__all__ = ["MAX_OFFSET", "WARN_OFFSET", "ClockOffsets"]
#: Smallest number of messages of each source for an offset.
_MIN_ARRIVALS = 5
#: Stamps that advance at another rate than arrivals are a replay's: they show no clock offset.
_LIVE_RATES = (0.8, 1.25)


class ClockOffsets:
    """Compares the clocks of the sources while their messages arrive.

    The offset of a source is that of its fastest message so far, as in NTP's clock filter.  A
    halted machine or a late driver delays messages, but no message can arrive too early.
    """

    def __init__(self) -> None:
        self._count = dict.fromkeys(Source, 0)
        self._offset: dict[Source, int] = {}
        self._first: dict[Source, tuple[int, int]] = {}  # stamp and arrival, ns
        self._last: dict[Source, tuple[int, int]] = {}
        self._worst: tuple[Source, float] | None = None

    def add(self, source: Source, stamp: int, arrival: int) -> None:
        """Note the stamp of a message and its arrival, ns, each by any clock."""
        self._count[source] += 1
        self._offset[source] = max(self._offset.get(source, stamp - arrival), stamp - arrival)
        self._first.setdefault(source, (stamp, arrival))
        self._last[source] = stamp, arrival

    def worst(self) -> tuple[Source, float] | None:
        """Return the source whose clock differs most from the others', and by how much, s.

        The middle one of the three offsets is the reference.  Where stamps do not advance with
        arrival, the offset is the last that was known: a busy machine has halted, or a replay has
        never shown any.
        """
        if min(self._count.values()) >= _MIN_ARRIVALS and all(map(self._is_live, Source)):
            middle = median(self._offset.values())
            source = max(Source, key=lambda each: abs(self._offset[each] - middle))
            self._worst = source, (self._offset[source] - middle) / 1e9
        return self._worst

    def _is_live(self, source: Source) -> bool:
        """Return True if stamps advance with arrival."""
        first, last = self._first[source], self._last[source]
        passed, waited = last[0] - first[0], last[1] - first[1]
        return _LIVE_RATES[0] * waited <= passed <= _LIVE_RATES[1] * waited
