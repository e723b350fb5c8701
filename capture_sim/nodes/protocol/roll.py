"""The roll call: who takes part in runs, who is ready for one, who has done with it.

Every node that takes part publishes its part on bench/roll, transient local.  Publisher and
subscription of the roll are the last that a node creates.  DDS announces them in that order, so a
node that has a message of another's roll is matched with it in both directions: the other knows all
its subscriptions, and it knows all publishers of the other.  A node is ready when it has a message
of each participant; the first message of a run is sent when all are ready, so no node misses it.

A run, for the node that announces it: wait for nodes; RunInfo; all participants ready; messages;
the counts of a simulator, or, after a trial, a RunInfo without run; all participants done; a
RunInfo without run.  For a participant: RunInfo; get ready; hear all others; ready; begin with the
last one that is ready, or the first message; the announcer's end; the last missing message; done.
No node waits for a participant that has left.
"""

from __future__ import annotations

import math
import time
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks

from capture_sim.errors import one_line
from capture_sim.messages.topics import ROLL, RunSource, topics_of
from capture_sim.nodes.base.endpoints import message_class
from capture_sim.nodes.base.node import POLL, BenchNode

#: A node that has just joined the roll is heard within this long, s (wall).
HEARING_TIMEOUT = 2.0
#: A node whose run has ended has closed its file within this long, s (wall), as a rule.
FREE_TIMEOUT = 8.0
#: A node repeats its part so often, s (wall); one that is not heard for so long is named.
SIGN_PERIOD, SILENCE_LIMIT = 1.0, 5.0
#: Of nodes of one name, more than are discovered, those heard within this time, s (wall), count.
NAMESAKE_LIMIT = 3.0 * SIGN_PERIOD
FREE, READY, DONE = 0, 1, 2


@dataclass(frozen=True)
class RunReport:
    """The report of a participant at the end of a run."""

    problems: tuple[str, ...] = ()  # a line each; empty if nothing is missing
    file: str = ""  # recording, if it has written one


@dataclass(frozen=True)
class RollPart:
    """A node's part as it has reported it, see msg/Roll.msg."""

    id: str
    role: str
    sources: tuple[str, ...]
    state: int
    run: str
    source: str  # of that run
    report: RunReport

    @property
    def node(self) -> str:
        """Full name of the node."""
        return node_of(self.id)

    @property
    def number(self) -> str:
        """Unique number of the node, which increases with its start time."""
        return number_of(self.id)

    @property
    def is_in_trial(self) -> bool:
        """True if the node takes part in a trial of a real bench now."""
        return self.state == READY and self.source == RunSource.TRIAL

    def is_called(self, name: str) -> bool:
        """Return True if the node has this role, name or full name."""
        return name in (self.role, self.node, self.node.rpartition("/")[2])

    def is_ready(self, run: str) -> bool:
        """Return True if the node has joined this run, and perhaps left it."""
        return self.run == run and self.state in (READY, DONE)

    def is_done(self, run: str) -> bool:
        """Return True if the node has left this run."""
        return self.run == run and self.state == DONE


def node_of(participant: str) -> str:
    """Return the full name of the node in a participant's id."""
    return participant.partition("#")[0]


def number_of(participant: str) -> str:
    """Return the number in a participant's id."""
    return participant.partition("#")[2]


def has_streams(role: str) -> bool:
    """Return True if a role publishes streams, whose counts end a run too."""
    return len(topics_of(role)) > 1


def run_key(info: Any) -> str:
    """Return the key of a run in the roll, from its RunInfo or description.

    A recorded run can be announced by several players.
    """
    return f"{info.run_id}@{info.announcer}"


class Roll:
    """The roll as one node sees it: its own part, and :attr:`parts` of the others, by id.

    Create it after all publishers and subscriptions of the node.  ``on_part`` is called with each
    part that is reported.  A node that is not listed only listens.
    """

    def __init__(
        self,
        node: BenchNode,
        role: str,
        sources: Collection[RunSource] = (),
        on_part: Callable[[RollPart], None] = lambda part: None,
        *,
        is_listed: bool = True,
    ) -> None:
        started = (
            f"{time.time_ns():016x}"  # in front: the older of two nodes has the smaller number
        )
        self.id = f"{node.get_fully_qualified_name()}#{started}{uuid.uuid4().hex[:8]}"
        self.parts: dict[str, RollPart] = {}
        self.ignored: set[str] = set()  # announcers whose runs are ignored
        self._node = node
        self._role = role
        self._sources = [str(source) for source in sources]
        self._on_part = on_part
        self._is_listed = is_listed
        self._seen: set[str] = set()  # participants that have been there
        self._present: Counter[str] = Counter()  # publishers of the roll, by node
        self._looked = -1.0
        self._own: Any = None  # message of this node's part
        self._heard: dict[str, float] = {}  # s (wall), when a node was last heard, by full name
        self._signs: dict[str, float] = {}  # s (wall), when a participant was, by id
        self._silent: set[str] = set()  # nodes that have been named
        self._checked = time.monotonic()
        if is_listed:
            node.open([ROLL])
        watch = SubscriptionEventCallbacks(matched=node.guarded(self._changed))
        node.listen(ROLL, self._hear, event_callbacks=watch)
        self.report(FREE)
        node.every(SIGN_PERIOD, self.repeat)

    def report(self, state: int, run: Any = None, report: RunReport | None = None) -> None:
        """Publish this node's part; ``run``: RunInfo or description of the run."""
        if not self._is_listed:
            return
        report = report or RunReport()
        message = message_class(ROLL.type_name)(
            participant=self.id,
            role=self._role,
            sources=self._sources,
            state=state,
            run="" if run is None else run_key(run),
            source="" if run is None else str(run.source),
            complete=not report.problems,
            reason="; ".join(report.problems),
            file=report.file,
        )
        self._own = message
        self._node.send(ROLL, message)

    def repeat(self) -> None:
        """Repeat this node's part, and name the nodes that are there but no longer heard.

        Such a node stands still, or it has forgotten this one in a stop longer than the lease
        (config/fast_dds.xml) and asks in vain for endpoints that this one takes for acknowledged.
        Fast DDS does not mend that; docs/evidence/node_suite.md shows the packets.
        """
        if self._own is not None:
            self._node.send(ROLL, self._own)
        now, own = time.monotonic(), self._node.get_fully_qualified_name()
        if now > self._checked + 2.0 * SIGN_PERIOD:  # this node has stood still itself
            self._heard.clear()
        self._checked = now
        there = {name for name in self._nodes() if name != own}
        self._heard = {name: self._heard.get(name, now) for name in there}
        self._silent &= there
        for participant in self.parts:
            self.is_there(participant)  # notes that it was
        for name in sorted(there - self._silent):
            if now > self._heard[name] + SILENCE_LIMIT:
                self._silent.add(name)
                self._node.get_logger().warning(
                    f"{name}: connected, but not heard for {SILENCE_LIMIT:g} s: continue it if it "
                    "is stopped or busy, else start it again"
                )

    def pending(
        self, participants: Sequence[str], has: Callable[[RollPart], bool] = lambda part: True
    ) -> list[str]:
        """Return the nodes that have not been heard, or whose part ``has`` is not true of.

        A node that was there and has left is not waited for; one that never was may not have been
        discovered yet, or its name may be unknown still.
        """
        return [
            node_of(id_)
            for id_ in participants
            if not (id_ in self.parts and has(self.parts[id_]))
            and self.may_be_there(id_)
            and id_ != self.id
        ]

    def free(self, source: RunSource) -> list[RollPart]:
        """Return the parts of nodes that are there, in no run, and take part in such runs."""
        return [
            part
            for part in self.parts.values()
            if part.state != READY and str(source) in part.sources and self.is_there(part.id)
        ]

    def busy(self, source: RunSource) -> list[RollPart]:
        """Return the parts of nodes that take part in such runs, but are in another run now."""
        return [
            part
            for part in self.parts.values()
            if part.state == READY and str(source) in part.sources and self.is_there(part.id)
        ]

    def await_free(self, source: RunSource, until: Callable[[], bool]) -> None:
        """Wait until no node is :meth:`busy`, or ``until()`` is true, for a while at most.

        A recorder may still be closing the file of a run that was played.
        """
        self._node.wait(lambda: until() or not self.busy(source), FREE_TIMEOUT)

    def in_trials(self) -> list[str]:
        """Return the nodes that take part in a trial of a real bench now.

        On a busy machine a node is heard before it is discovered: it counts.
        """
        return [p.node for p in self.parts.values() if p.is_in_trial and self.may_be_there(p.id)]

    def await_heard(self) -> None:
        """Wait until all nodes that publish on the roll have been heard, for a while at most."""
        own = Counter([self._node.get_fully_qualified_name()] * self._is_listed)

        def all_heard() -> bool:
            return not self._nodes() - own - Counter(part.node for part in self.parts.values())

        self._node.wait(all_heard, HEARING_TIMEOUT)

    def report_ignored(self, info: Any, reason: str) -> None:
        """Log that an announced run is ignored, and why, once for each announcer."""
        if info.announcer not in self.ignored:
            self.ignored.add(info.announcer)
            who = node_of(info.announcer) or "a node"
            text = f"{who} announces {info.name} ({info.source}): ignored, {reason}"
            self._node.get_logger().warning(one_line(text))

    def is_there(self, participant: str) -> bool:
        """Return True if a participant's publisher is present.

        Of several nodes with one name, the newest count as present, and so do nodes that were heard
        a moment ago.  The reason: on a busy machine a new node can be heard before it is
        discovered, and must not replace an older node of its name then.
        """
        name = node_of(participant)
        count = self._nodes()[name] - (
            self._is_listed and name == self._node.get_fully_qualified_name()
        )
        namesakes = [part.id for part in self.parts.values() if part.node == name]
        newest = namesakes[max(0, len(namesakes) - count) :]
        last_sign = self._signs.get(participant, math.inf)  # not heard yet: one of the publishers
        is_there = participant in newest or (
            count > 0 and time.monotonic() < last_sign + NAMESAKE_LIMIT
        )
        if is_there:
            self._seen.add(participant)
        return is_there or participant == self.id

    def may_be_there(self, participant: str) -> bool:
        """Return False if a participant has left: it was there, and is not now."""
        return self.is_there(participant) or participant not in self._seen

    def _nodes(self) -> Counter[str]:
        now = time.monotonic()
        if now > self._looked + POLL:  # a look-up costs 0.1 ms
            self._looked = now
            self._present = Counter(self._node.nodes_that_publish(ROLL))
        return self._present

    def _changed(self, _: Any) -> None:
        self._looked = -1.0

    def _hear(self, message: Any) -> None:
        if message.participant == self.id:
            return
        part = RollPart(
            message.participant,
            message.role,
            tuple(message.sources),
            message.state,
            message.run,
            message.source,
            RunReport(() if message.complete else (message.reason,), message.file),
        )
        self.parts[part.id] = part
        self._heard[part.node] = self._signs[part.id] = time.monotonic()
        if part.node in self._silent:
            self._silent.remove(part.node)
            self._node.get_logger().info(f"{part.node}: heard again")
        self._on_part(part)
