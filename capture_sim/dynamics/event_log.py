"""The events of a run, made from the records in the engine's log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import overload

import numpy as np

from capture_sim.dynamics.event_text import AT_WALL, event_text
from capture_sim.dynamics.samples import Event, EventKind


def events_in(log: np.ndarray) -> Iterator[Event]:
    """Yield an Event for each record of the engine's log (n,), in order."""
    columns = (log[name].tolist() for name in ("kind", "t", "which", "value"))
    for number, (code, t, which, value) in enumerate(zip(*columns, strict=True)):
        kind = EventKind(code)
        touch = log["touch"][number] if kind is EventKind.LIFT_OFF else None
        wall, detail = which if kind in AT_WALL else 0, event_text(kind, which, value)
        yield Event(kind, t, log["q"][number], log["v"][number], wall, detail, touch)


class EventLog(Sequence[Event]):
    """Sequence of all events of a run, in order.

    Objects are made from the engine's logs only when events are read, because a run with many
    touches has hundreds of events.  ``first``: events that come before those of ``logs``.
    """

    def __init__(self, first: Sequence[Event], logs: Sequence[np.ndarray]) -> None:
        self._first, self._logs = tuple(first), tuple(logs)

    @cached_property
    def _all(self) -> tuple[Event, ...]:
        return (*self._first, *(event for log in self._logs for event in events_in(log)))

    def __len__(self) -> int:
        return len(self._first) + sum(map(len, self._logs))

    def __iter__(self) -> Iterator[Event]:
        """Yield the events in order; each Event is made only when the iteration reaches it."""
        if "_all" in self.__dict__:
            yield from self._all
            return
        yield from self._first
        for log in self._logs:
            yield from events_in(log)

    @overload
    def __getitem__(self, index: int) -> Event: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Event, ...]: ...

    def __getitem__(self, index: int | slice) -> Event | tuple[Event, ...]:
        """Return the event at an index, or a tuple of the events in a slice."""
        return self._all[index]
