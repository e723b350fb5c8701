"""Measurements of several sources, put into the order of their stamps.

On a real bench each source has its own clock, rate and delay, and messages get lost and overtake
each other.  The :class:`Sequencer` is the detector's border: behind it, everything is a function
of stamps and values, never of arrival.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from enum import Enum
from typing import NamedTuple

Values = tuple[float, ...]

#: A stamp that is later than the next ones of its source by more than this is rejected, ns.
MAX_LEAD = 2_000_000_000
#: A message may be overtaken by messages of its source that are stamped later by this, ns.
REORDER = 100_000_000
#: Measurements wait for a silent source until another one has sent this much more, ns.
MAX_WAIT = 60_000_000_000
#: Share of a source's measurements that is reported with its likely cause if it was rejected.
WARN_SHARE = 0.01


class Source(Enum):
    """A source of measurements.

    Its values are, in this order: of a pose x, y (m), theta (rad) and, where the source
    gives them, their rates in the world; of the buffer stroke (m), torsion (rad) and,
    likewise, their rates.  Rates that are not finite are missing rates.
    """

    CHASER = "chaser"
    TARGET = "target"
    BUFFER = "buffer"

    __hash__ = object.__hash__  # members are unique; Enum's own is slow

    @property
    def size(self) -> int:
        """Number of values without the rates."""
        return 2 if self is Source.BUFFER else 3


class Reason(Enum):
    """Why a measurement is not used; the value is its word in tables."""

    OUTLIER = "outlier"
    FROZEN = "frozen"
    NOT_FINITE = "not finite"
    LATE = "late"
    AHEAD = "ahead"
    GAP = "gap"


#: What an operator should look for.
_LIKELY_CAUSES = {
    Reason.OUTLIER: "likely swapped or hidden markers",
    Reason.FROZEN: "likely lost tracking, with a driver that repeats its last pose",
    Reason.NOT_FINITE: "likely lost tracking, with a driver that sends NaN",
    Reason.LATE: "likely two publishers, or stamps that repeat or step back",
    Reason.AHEAD: "likely clocks that are not synchronised",
    Reason.GAP: "likely lost messages or hidden markers",
}


class Measurement(NamedTuple):
    """Values of one source, see :class:`Source`, with their stamp, ns."""

    stamp: int
    source: Source
    values: Values


class Counts:
    """Numbers of measurements that were received, and of rejected measurements.

    A measurement that is missing at an instant of the chaser's counts as a gap of its source.
    Numbers that were received are not known of a recorded status.
    """

    def __init__(self) -> None:
        self.received: Counter[Source] = Counter()
        self.rejected: Counter[tuple[Source, Reason]] = Counter()
        #: Number of changes of :attr:`rejected`.
        self.n_changes = 0

    def reject(self, source: Source, reason: Reason, number: int = 1) -> None:
        """Count measurements that are not used."""
        self.rejected[source, reason] += number
        self.n_changes += 1

    def of(self, source: Source) -> int:
        """Return how many measurements of a source were not used."""
        return sum(self.rejected[source, reason] for reason in Reason)

    @property
    def text(self) -> str:
        """The counts that are not zero; empty without.

        E.g. ``chaser: 3 outlier, 1 late of 1200``.  The likely cause follows if more than
        :data:`WARN_SHARE` of a source's measurements were not used.
        """
        return "; ".join(map(self._line, filter(self.of, Source)))

    @property
    def warnings(self) -> list[str]:
        """A line for each source of which more than :data:`WARN_SHARE` was not used."""
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
    """Merges the sources into one sequence in the order of stamps.

    A measurement is passed on once each source has sent a stamp that is later by ``reorder``, ns.
    The sequence is therefore the same for any delay and any order between the sources, and for
    messages of a source that overtake each other by less than ``reorder``.  A source whose
    messages come in the order of their stamps needs none.
    """

    def __init__(self, counts: Counts, reorder: int = REORDER) -> None:
        self._counts, self._reorder = counts, reorder
        self._waiting: dict[Source, list[tuple[int, Values]]] = {s: [] for s in Source}
        self._newest: dict[Source, int] = {}
        self._first: int | None = None

    def add(self, source: Source, stamp: int, values: Values) -> list[Measurement]:
        """Add a measurement of stamp ``stamp``, ns; return the measurements next in order."""
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
        """The earliest stamp, ns."""
        return self._first

    @property
    def newest(self) -> int | None:
        """The latest stamp, ns."""
        return max(self._newest.values(), default=None)

    def silent(self, max_age: int) -> list[Source]:
        """Return the sources whose latest stamp is older than the newest one by this, ns."""
        if self._first is None or not self._newest:
            return []
        newest = max(self._newest.values())
        return [s for s in Source if newest - self._newest.get(s, self._first) > max_age]

    def finish(self) -> list[Measurement]:
        """Return the measurements that still wait."""
        return self._up_to(math.inf)

    def _note_newest(self, source: Source) -> None:
        """Note a source's latest stamp; a jump ahead does not count before another follows."""
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
