"""Measurements of a running node for the rules of plausibility, kept as they arrive."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

from capture_sim.messages.topics import Topic
from capture_sim.plausibility.check import rules_among
from capture_sim.plausibility.measured import Measured
from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.plausibility.rules import RULES, Doubt, Grade
from capture_sim.recording.bag import Bag
from capture_sim.recording.contents import Contents
from capture_sim.recording.evidence import evidence_in
from capture_sim.run.doubts import examined
from capture_sim.scene.parts import Scene

#: Length of the latest messages, s, that are checked before a release.
BEFORE = 2.0
#: Limits of what is kept of each topic: time, s, and bytes.
MAX_AGE, MAX_BYTES = 120.0, 32 * 2**20


class _Kept:
    """The latest messages of one topic."""

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self.rows: deque[tuple[int, bytes]] = deque()  # arrival, ns
        self._n_bytes = 0

    def add(self, data: bytes, arrival: int) -> None:
        rows = self.rows
        rows.append((arrival, data))
        self._n_bytes += len(data)
        while rows[0][0] < arrival - MAX_AGE * 1e9 or self._n_bytes > MAX_BYTES:
            self._n_bytes -= len(rows.popleft()[1])


class Evidence:
    """Keeps serialised messages, and checks them by the rules, as ``detect`` checks a recording.

    ``waived`` are the names of rules that are not checked; names that are not rules of plausibility
    are ignored.  Arrivals are ns by the steady clock of this machine.
    """

    def __init__(self, waived: Collection[str]) -> None:
        self._waived = waived
        self._kept: dict[str, _Kept] = {}

    def add(self, topic: Topic, data: bytes, arrival: int) -> None:
        """Add a serialised message of a topic."""
        kept = self._kept.get(topic.name)
        if kept is None:
            kept = self._kept[topic.name] = _Kept(topic)
        kept.add(data, arrival)

    def latest(self, now: int) -> Bag:
        """Return the messages of the last :data:`BEFORE` s, for :meth:`before_release`.

        It is a copy, which another thread may check.
        """
        return self._since(now - int(BEFORE * 1e9))

    def before_release(self, latest: Bag, scene: Scene | None) -> tuple[Doubt, ...]:
        """Return the broken rules of the latest messages, each with its finding.

        Without a scene, the rules that need one are not checked.
        """
        held = [replace(each, is_before_release=True) for each in evidence_in(latest)]
        # here a clock that varies is refused, and tried again a moment later
        return self._doubts_of(held, scene, [name for name in self._waived if name in RULES])

    def of_trial(self, scene: Scene, but: Collection[str] = ()) -> tuple[Doubt, ...]:
        """Return the broken rules of all messages that were added, each with its finding.

        Of a long trial, only the last :data:`MAX_AGE` s count.  ``but``: names of rules that are
        left out.
        """
        evidence = evidence_in(self._since(0))
        return self._doubts_of(evidence, scene, rules_among((*self._waived, *but)))

    def _doubts_of(
        self, evidence: Sequence[Measured], scene: Scene | None, waived: Collection[str]
    ) -> tuple[Doubt, ...]:
        return examined([MeasuredMotion(each, scene) for each in evidence], waived)[0]

    def _since(self, begin: int) -> Bag:
        contents = Contents()
        for kept in self._kept.values():
            rows = list(takewhile(lambda row: row[0] >= begin, reversed(kept.rows)))[::-1]
            name = kept.topic.absolute_name
            if rows:
                contents.types[name] = kept.topic.type_name
                contents.log_times[name] = [arrival for arrival, _ in rows]
                contents.messages[name] = [data for _, data in rows]
        return Bag(Path("the last messages"), contents)


def refusing(doubts: Collection[Doubt]) -> list[Doubt]:
    """Return the doubts that refuse a release, and that make a verdict undecided.

    These are doubts of grade *refused*, and those by which no message of a topic can be used.
    """
    return [d for d in doubts if d.grade is Grade.REFUSED or d.leaves_out_topic]
