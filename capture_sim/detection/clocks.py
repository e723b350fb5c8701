"""Offsets between the clocks of a bench's sources, from stamp less arrival.

At 0.1 m/s an offset of 0.05 s between the poses of chaser and target moves the tip by 5 mm, the
radius of the capture zone: beyond :data:`MAX_OFFSET` a verdict would be wrong without notice.
"""

from __future__ import annotations

from collections import deque
from statistics import median

from capture_sim.detection.align import Source

#: An offset beyond this is reported, s.  Latencies of drivers are up to about 0.03 s.
WARN_OFFSET = 0.05
#: Beyond this nothing is evaluated, s.
MAX_OFFSET = 0.2
#: Time over which the median of stamp less arrival is taken, s (wall).
WINDOW = 1.0
#: Smallest number of arrivals of each source for that median.
MIN_ARRIVALS = 5
#: Stamps that advance at another rate than arrivals are a replay's: they show no clock offset.
_LIVE_RATES = (0.8, 1.25)


class ClockOffsets:
    """Compares the sources' clocks while their messages arrive."""

    def __init__(self) -> None:
        self._arrivals: dict[Source, deque[tuple[float, float]]] = {s: deque() for s in Source}
        self._worst: tuple[Source, float] | None = None  # while all sources send

    def add(self, source: Source, stamp: float, arrival: float) -> None:
        """Note the stamp of a message and its arrival, s, each by any clock."""
        recent = self._arrivals[source]
        recent.append((arrival, stamp))
        while recent[0][0] < arrival - WINDOW:
            recent.popleft()

    def worst(self) -> tuple[Source, float] | None:
        """Return the source whose clock differs most from the others', and by how much, s.

        The middle one of the three offsets is the reference.  None while a source lacks recent
        messages.  Where stamps do not advance with arrival, the offset is the last that was known:
        a busy machine has halted, or a replay has never shown any.
        """
        latest = max((r[-1][0] for r in self._arrivals.values() if r), default=0.0)
        offsets = {}
        for source, recent in self._arrivals.items():
            if len(recent) < MIN_ARRIVALS or recent[-1][0] < latest - WINDOW:
                self._worst = None
                return None
            offsets[source] = median(stamp - arrival for arrival, stamp in recent)
        if not all(map(_is_live, self._arrivals.values())):
            return self._worst
        middle = median(offsets.values())
        source = max(offsets, key=lambda name: abs(offsets[name] - middle))
        self._worst = source, offsets[source] - middle
        return self._worst


def _is_live(recent: deque[tuple[float, float]]) -> bool:
    """Return True if stamps advance with arrival."""
    (first_arrival, first_stamp), (last_arrival, last_stamp) = recent[0], recent[-1]
    waited, passed = last_arrival - first_arrival, last_stamp - first_stamp
    return _LIVE_RATES[0] * waited <= passed <= _LIVE_RATES[1] * waited
