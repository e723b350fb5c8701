"""Which run a node takes part in, and when it is over; without ROS.

A run goes through these stages::

    NONE -> (REQUESTED ->) ANNOUNCED -> ON -> ENDED -> NONE

It is requested while an announcement of this node is on its way, announced by a RunInfo, on once
the node has begun it, ended when its announcer has reported how many messages it has sent, and over
when these have come, or when nothing has come for too long.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any

#: Messages that were on their way when the announcer left are waited for this long, s (wall).
GONE_TIMEOUT = 0.5
#: Messages that still come after a run was ended are waited for this long, s (wall).
MAX_DRAIN = 60.0


class Stage(Enum):
    """Where a run is."""

    NONE = "no run"
    REQUESTED = "requested"
    ANNOUNCED = "announced"  # the node has not begun it yet
    ON = "on"
    ENDED = "ended"  # messages may be on their way


class RunState:
    """The run that a node takes part in.

    ``drain_timeout``: s (wall) without a message, after which an ended run is overdue; ``clock``: a
    steady one, s.  ``info``: RunInfo of the run that is announced, on or ended, or None;
    ``counts``: the StreamCounts by which its announcer has ended it, or None; ``received``:
    messages of the run that have come, by topic name; ``finished``: runs that are over.
    """

    def __init__(self, drain_timeout: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._drain_timeout = drain_timeout
        self._clock = clock
        self.info: Any = None
        self.counts: Any = None
        self.received: Counter[str] = Counter()
        self.finished = 0
        self._begun = False
        self._requested_id = ""
        self._announcers = 0
        self._last_ended_id = ""
        self._deadline = math.inf  # when the run is overdue ...
        self._last_deadline = math.inf  # ... though messages still come

    @property
    def stage(self) -> Stage:
        """Where the run is."""
        if self.info is None:
            return Stage.REQUESTED if self._requested_id else Stage.NONE
        if not self._begun:
            return Stage.ANNOUNCED
        return Stage.ON if self.counts is None else Stage.ENDED

    @property
    def has_announcer(self) -> bool:
        """Whether a node that announces runs is there."""
        return self._announcers > 0

    def is_new(self, run_id: str) -> bool:
        """Return True if an announced run is neither the present one nor one that was ended."""
        present = "" if self.info is None else self.info.run_id
        return run_id not in ("", present, self._last_ended_id)

    # transitions

    def request(self, run_id: str) -> None:
        """A run is announced by this node; it requests no other until that has come."""
        self._requested_id = run_id

    def reject(self, run_id: str) -> None:
        """The announcement of a run cannot be used."""
        if run_id == self._requested_id:
            self._requested_id = ""

    def announce(self, info: Any) -> None:
        """A new run is announced; the one before it must be over."""
        if info.run_id == self._requested_id:
            self._requested_id = ""
        self.info, self.counts, self._begun = info, None, False
        self.received.clear()
        self._deadline = self._last_deadline = math.inf

    def begin(self) -> None:
        """The node begins the run that was announced."""
        self._begun = True
        self._extend()

    def receive(self, topic_name: str) -> None:
        """A message of the run has come."""
        self.received[topic_name] += 1
        self._extend()

    def end(self, counts: Any) -> None:
        """The announcer has ended a run, perhaps one of which this node knows nothing."""
        self._last_ended_id = counts.run_id
        if self.info is not None and counts.run_id == self.info.run_id:
            self.counts = counts
            self._last_deadline = self._clock() + max(MAX_DRAIN, self._drain_timeout)
            self._extend()

    def set_announcers(self, count: int) -> None:
        """The number of announcers has changed; without any, a run is soon overdue."""
        self._announcers = count
        if self.info is not None and self.counts is None:
            self._deadline = math.inf if count else self._clock() + GONE_TIMEOUT

    def drop(self) -> None:
        """The node cannot take part in the run."""
        self.info, self.counts, self._begun = None, None, False
        self._deadline = self._last_deadline = math.inf

    def finish(self) -> None:
        """The run is over."""
        self.drop()
        self.finished += 1

    # what follows from them

    def missing(self, topic_names: Iterable[str]) -> list[str]:
        """Return which of these streams lack messages that the announcer has sent, a line each."""
        if self.counts is None:
            return []
        sent = dict(zip(self.counts.topics, self.counts.counts, strict=True))
        return [
            f"{name}: {self.received[name]} of {sent[name]} messages received"
            for name in topic_names
            if self.received[name] < sent.get(name, 0)
        ]

    @property
    def is_overdue(self) -> bool:
        """Whether nothing has come for too long: the run is to be finished as incomplete."""
        return self._begun and self._clock() >= self._deadline

    def _extend(self) -> None:
        """Wait longer for a run that was ended, as its messages still come."""
        if self.counts is not None:
            self._deadline = min(self._clock() + self._drain_timeout, self._last_deadline)
