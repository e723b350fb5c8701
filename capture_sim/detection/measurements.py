"""Measurements of several sources, put into the order of their stamps.

On a real bench each source has its own clock, rate and delay, and messages get lost and overtake
each other.  The :class:`Sequencer` is therefore the first step of the detector.  All later steps
depend only on stamps and values, never on times of arrival.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from enum import Enum
from typing import NamedTuple

Values = tuple[float, ...]

#: A stamp is rejected if it is later than the following stamps of its source by more than this, ns.
MAX_LEAD = 2_000_000_000
#: A message is accepted although messages of its source overtook it, if they are later by at most
#: this, ns.
REORDER = 100_000_000
#: Measurements of a source wait for a silent source only until they span more than this, ns.
MAX_WAIT = 60_000_000_000
#: If more than this share of a source's measurements is rejected, the likely cause is reported.
WARN_SHARE = 0.01


class Source(Enum):
    """A source of measurements.

    A measurement of the chaser or the target has the values x, y (m) and theta (rad) in the world,
    that of the buffer stroke (m) and torsion (rad).  Their rates follow in the same order if the
    source measures them.  If a rate is not finite, all rates count as missing.
    """

    CHASER = "chaser"
    TARGET = "target"
    BUFFER = "buffer"

    __hash__ = object.__hash__  # members are unique; Enum's own is slow

    @property
    def size(self) -> int:
        """Number of values of a measurement without the rates: 3 for a pose, 2 for the buffer."""
        return 2 if self is Source.BUFFER else 3


class Reason(Enum):
    """Reason why a measurement is not used; the member's value is the word for it in tables."""

    OUTLIER = "outlier"
    FROZEN = "frozen"
    NOT_FINITE = "not finite"
    LATE = "late"
    AHEAD = "ahead"
    GAP = "gap"


#: Likely cause of each reason, for the operator.
_LIKELY_CAUSES = {
    Reason.OUTLIER: "likely swapped or hidden markers",
    Reason.FROZEN: "likely lost tracking, with a driver that repeats its last pose",
    Reason.NOT_FINITE: "likely lost tracking, with a driver that sends NaN",
    Reason.LATE: "likely two publishers, or stamps that repeat or step back",
    Reason.AHEAD: "likely clocks that are not synchronised",
    Reason.GAP: "likely lost messages or hidden markers",
}


class Measurement(NamedTuple):
    """A measurement: its stamp, ns, its source, and its values as listed at :class:`Source`."""

    stamp: int
    source: Source
    values: Values


class Counts:
    """Numbers of received measurements by source, and of rejected ones by source and reason.

    If target or buffer have no measurement at the instant of a chaser's pose, this counts as a
    rejection with the reason ``GAP``.  For counts from a recorded status, ``received`` is empty.
    """

    def __init__(self) -> None:
        self.received: Counter[Source] = Counter()
        self.rejected: Counter[tuple[Source, Reason]] = Counter()
        #: Number of calls of :meth:`reject`, to notice changes.
        self.n_changes = 0

    def reject(self, source: Source, reason: Reason, number: int = 1) -> None:
        """Count ``number`` measurements of a source that are not used."""
        self.rejected[source, reason] += number
        self.n_changes += 1

    def of(self, source: Source) -> int:
        """Return the number of measurements of a source that were not used, for any reason."""
        return sum(self.rejected[source, reason] for reason in Reason)

    @property
    def text(self) -> str:
        """Text with all rejections, e.g. ``chaser: 3 outlier, 1 late of 1200``; '' without any.

        The likely cause is added if more than :data:`WARN_SHARE` of a source's measurements were
        not used.
        """
        return "; ".join(map(self._line, filter(self.of, Source)))

    @property
    def warnings(self) -> list[str]:
        """A line for each source with more than :data:`WARN_SHARE` of its measurements not used."""
        return [self._line(source) for source in Source if self._is_large(source)]

    def _is_large(self, source: Source) -> bool:
        received = self.received[source]
        return received > 0 and self.of(source) > WARN_SHARE * received

    def _line(self, source: Source) -> str:
        numbers = [(self.rejected[source, reason], reason) for reason in Reason]
        listed = ", ".join(f"{number} {reason.value}" for number, reason in numbers if number)
        _, first = max(numbers, key=lambda item: item[0])
        cause = f" ({_LIKELY_CAUSES[first]})" if self._is_large(source) else ""
        received = f" of {self.received[source]}" if self.received[source] else ""
        return f"{source.value}: {listed}{received}{cause}"


class Sequencer:
    """Merges the measurements of all sources into one sequence in the order of their stamps.

    A measurement is passed on once each source has sent a stamp that is later by ``reorder``, ns.
    Therefore the delays of the sources, and the order in which their messages arrive, do not affect
    the sequence.  Within a source, a message may be overtaken by messages stamped up to ``reorder``
    later.  If the messages of each source arrive in the order of their stamps, it can be 0.
    """

    def __init__(self, counts: Counts, reorder: int = REORDER) -> None:
        self._counts, self._reorder = counts, reorder
        self._waiting: dict[Source, list[tuple[int, Values]]] = {s: [] for s in Source}
        self._newest: dict[Source, int] = {}
        self._first: int | None = None

    def add(self, source: Source, stamp: int, values: Values) -> list[Measurement]:
        """Add a measurement with a stamp in ns; return the measurements that can be passed on now.

        They are in the order of their stamps.  Measurements that cannot be used are counted as
        rejected.
        """
        self._counts.received[source] += 1
        size = source.size
        if not all(map(math.isfinite, values)):
            if not all(map(math.isfinite, values[:size])):
                self._counts.reject(source, Reason.NOT_FINITE)
                return []
            values = values[:size]
        if self._first is None or stamp < self._first:
            self._first = stamp
        waiting = self._waiting[source]
        while waiting and waiting[-1][0] > stamp + MAX_LEAD:
            waiting.pop()
            self._newest.pop(source, None)
            self._counts.reject(source, Reason.AHEAD)
        if waiting and stamp <= waiting[-1][0]:
            index = bisect_left(waiting, (stamp,))
            if waiting[index][0] == stamp:
                self._counts.reject(source, Reason.LATE)
                return []
        else:
            index = len(waiting)
        if stamp <= self._newest.get(source, stamp - 1) - self._reorder:
            self._counts.reject(source, Reason.LATE)
            return []
        waiting.insert(index, (stamp, values))
        self._note_newest(source)
        if len(self._newest) < len(Source):
            return self._up_to(-math.inf)
        return self._up_to(min(self._newest.values()) - self._reorder)

    @property
    def first(self) -> int | None:
        """The earliest stamp of all sources, ns; None before the first measurement."""
        return self._first

    @property
    def newest(self) -> int | None:
        """The latest stamp of all sources, ns; None before the first measurement."""
        return max(self._newest.values(), default=None)

    def silent(self, max_age: int) -> list[Source]:
        """Return the sources whose latest stamp is too old.

        It is too old if it is earlier than the newest stamp of all sources by more than
        ``max_age``, ns.  For a source without measurements, the first stamp of all sources counts.
        """
        if self._first is None or not self._newest:
            return []
        newest = max(self._newest.values())
        return [s for s in Source if newest - self._newest.get(s, self._first) > max_age]

    def finish(self) -> list[Measurement]:
        """Return all measurements that were not passed on yet, in the order of their stamps."""
        return self._up_to(math.inf)

    def _note_newest(self, source: Source) -> None:
        """Update the latest stamp of a source.

        A stamp that jumps ahead by more than MAX_LEAD counts only after a later one confirms it.
        """
        waiting, before = self._waiting[source], self._newest.get(source)
        newest = waiting[-1][0]
        earlier = waiting[-2][0] if len(waiting) > 1 else before
        if earlier is not None and newest - earlier > MAX_LEAD:
            newest = earlier
        self._newest[source] = newest if before is None else max(newest, before)

    def _up_to(self, limit: float) -> list[Measurement]:
        released: list[Measurement] = []
        for source, waiting in self._waiting.items():
            count = 0
            for stamp, values in waiting:
                if stamp > limit and waiting[-1][0] - stamp <= MAX_WAIT:
                    break
                released.append(Measurement(stamp, source, values))
                count += 1
            if count:
                del waiting[:count]
        if len(released) > 1:
            released.sort(key=lambda each: (each.stamp, each.source.value))
        return released
