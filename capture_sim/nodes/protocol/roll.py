"""The roll, bench/roll: each node reports whether it is free, ready for a run, or done with it.

Such a report is called the node's part.  The topic is transient local.  A node creates its
publisher and its subscription of the roll after all its others, and DDS announces them in the order
of their creation.  If node A has received a part from node B, they are therefore matched in both
directions: B knows all subscriptions of A, and A knows all publishers of B.  A node reports that it
is ready once it has a part from each participant.  The first message of a run is sent when all
participants are ready, so none of them misses it.  Both waits have a time limit.

A part also lists the nodes that its sender has heard.  Before a node announces a run, it waits at
most HEARING_TIMEOUT until it has heard all listed nodes.  It waits for each of them only once,
because a listed node may have been killed.

The node that announces a run waits for nodes, sends RunInfo, waits until all participants are
ready, and sends the messages.  It then ends the run: a simulator by its StreamCounts, a trial by a
RunInfo with an empty run_id.  Then it waits until all participants are done.  After a simulated run
it finally sends the RunInfo with an empty run_id.

A participant receives RunInfo, prepares, waits for a part from each other participant, and reports
that it is ready.  It begins when all are ready, or with the first message of a simulator.  When the
announcer has ended the run and the last missing message has come, it reports that it is done.  No
node waits for a participant that has left the network.
"""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks

from capture_sim.errors import one_line
from capture_sim.messages.topics import ROLL, RunSource, topics_of
from capture_sim.nodes.base.endpoints import message_class
from capture_sim.nodes.base.node import POLL, BenchNode

#: Longest wait for the first part of a node that DDS or another node reports, s (wall).
HEARING_TIMEOUT = 2.0
#: A node has normally closed its file within this time after the end of a run, s (wall).
FREE_TIMEOUT = 8.0
#: Period at which a node repeats its part, and time without any part from a node after which its
#: name is logged, s (wall).
SIGN_PERIOD, SILENCE_LIMIT = 1.0, 5.0
#: If more nodes of one name are heard than are discovered, each that was heard within this time,
#: s (wall), counts as present.
NAMESAKE_LIMIT = 3.0 * SIGN_PERIOD
FREE, READY, DONE = 0, 1, 2


@dataclass(frozen=True)
class RunReport:
    """The report of a participant at the end of a run."""

    problems: tuple[str, ...] = ()  # a line each; empty if nothing is missing
    file: str = ""  # recording, if it has written one


@dataclass(frozen=True)
class RollPart:
    """A node's last report on bench/roll; the fields are those of msg/Roll.msg."""

    id: str
    role: str
    sources: tuple[str, ...]
    state: int
    run: str
    source: str  # of that run
    report: RunReport
    heard: tuple[str, ...]  # ids of the nodes that it has heard, and that are there

    @property
    def node(self) -> str:
        """Full name of the node."""
        return node_of(self.id)

    @property
    def number(self) -> str:
        """Unique hexadecimal number of the node, as text that sorts by the node's start time."""
        return number_of(self.id)

    @property
    def is_in_trial(self) -> bool:
        """True if the node takes part in a trial of a real bench at present."""
        return self.state == READY and self.source == RunSource.TRIAL

    def is_called(self, name: str) -> bool:
        """Return True if the node has this role, name or full name."""
        return name in (self.role, self.node, self.node.rpartition("/")[2])

    def is_ready(self, run: str) -> bool:
        """Return True if the node has joined the run with this key, or has already left it."""
        return self.run == run and self.state in (READY, DONE)

    def is_done(self, run: str) -> bool:
        """Return True if the node has left the run with this key, see :func:`run_key`."""
        return self.run == run and self.state == DONE


def node_of(participant: str) -> str:
    """Return the full name of a node from its id, which is ``full name#number``."""
    return participant.partition("#")[0]


def number_of(participant: str) -> str:
    """Return the number of a node from its id, which is ``full name#number``."""
    return participant.partition("#")[2]


def has_streams(role: str) -> bool:
    """Return True if nodes of a role publish topics of a run besides bench/stream_counts.

    True for simulator, launcher and capture_detector.
    """
    return len(topics_of(role)) > 1


def run_key(info: Any) -> str:
    """Return the key that identifies a run on the roll, from its RunInfo or RunDescription.

    The key contains the announcer's id, because several players can announce one recorded run.
    """
    return f"{info.run_id}@{info.announcer}"


class Roll:
    """Publishes one node's part on bench/roll and keeps the last part of each other node.

    ``id`` is this node's id; ``parts`` has the parts of the other nodes, also of nodes that have
    left the network, by id.  Create this object after all publishers and subscriptions of the node.
    ``sources`` are the sources of the runs that the node takes part in.  ``on_part`` is called with
    each part that another node reports.  With ``is_listed`` False the node publishes no part and
    only listens.
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
        self._given_up: set[str] = set()  # participants that only other nodes have heard
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
        """Publish this node's part; do nothing if the node is not listed.

        ``state``: FREE, READY or DONE.  ``run``: RunInfo or RunDescription of the run, None for
        FREE.  ``report``: report on the run's end, for DONE.
        """
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
        self._send()

    @contextmanager
    def keep_reporting(self) -> Iterator[None]:
        """Publish this node's part from a second thread while in the context.

        For a node that does not serve its callbacks meanwhile, because it compiles.
        """
        is_over = threading.Event()

        def work() -> None:
            while not is_over.wait(SIGN_PERIOD):
                self._node.send(ROLL, self._own)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        try:
            yield
        finally:
            is_over.set()
            thread.join()

    def repeat(self) -> None:
        """Publish this node's part again, and log nodes that are connected but no longer heard.

        Such a node is stopped or busy.  Or it was stopped for longer than the DDS lease
        (config/fast_dds.xml) and has forgotten this node.  It then asks in vain for endpoints that
        this node regards as acknowledged.  Fast DDS does not recover from that;
        docs/evidence/node_suite.md shows the packets.
        """
        self._send()
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
        """Return the nodes that have not been heard, or for whose part ``has`` returns False.

        ``participants``: ids of the nodes to check.  The result contains full names, without those
        of nodes that were present and have left the network.  It contains nodes that were never
        present, because they may not have been discovered yet; but no node of this node's own name,
        which this node replaces if it was killed.
        """
        return [
            node_of(id_)
            for id_ in participants
            if not (id_ in self.parts and has(self.parts[id_]))
            and self.may_be_there(id_)
            and node_of(id_) != node_of(self.id)
        ]

    def free(self, source: RunSource) -> list[RollPart]:
        """Return the parts of nodes that are present, in no run, and accept runs of this source."""
        return [
            part
            for part in self.parts.values()
            if part.state != READY and str(source) in part.sources and self.is_there(part.id)
        ]

    def busy(self, source: RunSource) -> list[RollPart]:
        """Return the parts of nodes that are present, in a run, and accept runs of this source."""
        return [
            part
            for part in self.parts.values()
            if part.state == READY and str(source) in part.sources and self.is_there(part.id)
        ]

    def doubles(self, parts: Sequence[RollPart], wanted: Collection[str] = ()) -> list[str]:
        """Return a line for each role that more nodes fill than a run takes.

        A run takes one node of a role, or as many as ``wanted`` names: roles, names or full names,
        a name that is listed twice stands for two.  Of ``parts`` only the nodes count that were
        heard within NAMESAKE_LIMIT, because a killed node remains discovered for longer.
        """
        lines = []
        now = time.monotonic()
        for role in sorted({part.role for part in parts}):
            of_role = [part for part in parts if part.role == role]
            allowed = sum(any(part.is_called(name) for part in of_role) for name in wanted)
            here = [p.node for p in of_role if now < self._signs.get(p.id, now) + NAMESAKE_LIMIT]
            if len(here) > max(1, allowed):
                nodes = " and ".join(sorted(here))
                lines.append(f"{nodes} are {role} both: a run takes {max(1, allowed)}")
        return lines

    def await_free(self, source: RunSource, until: Callable[[], bool]) -> None:
        """Wait until no node is :meth:`busy`, or ``until()`` is true, at most FREE_TIMEOUT.

        Reason: a recorder may still be closing the file of a run that was played.
        """
        self._node.wait(lambda: until() or not self.busy(source), FREE_TIMEOUT)

    def in_trials(self) -> list[str]:
        """Return the full names of the nodes that take part in a trial of a real bench at present.

        They include nodes that are heard but not yet discovered, as can happen on a busy machine.
        """
        return [p.node for p in self.parts.values() if p.is_in_trial and self.may_be_there(p.id)]

    def await_heard(self) -> None:
        """Wait until all nodes of the roll are heard, at most HEARING_TIMEOUT.

        These are the nodes that DDS reports, and those that another node has heard.  A node of the
        second kind that is not heard in this time is not waited for again.
        """
        own = Counter([self._node.get_fully_qualified_name()] * self._is_listed)

        def all_heard() -> bool:
            here = Counter(part.node for part in self.parts.values())
            return not self._nodes() - own - here and not self._unheard()

        if not self._node.wait(all_heard, HEARING_TIMEOUT):
            self._given_up |= self._unheard()

    def report_ignored(self, info: Any, reason: str) -> None:
        """Log that this node ignores an announced run, and why, once for each announcer.

        ``info``: RunInfo of the run.
        """
        if info.announcer not in self.ignored:
            self.ignored.add(info.announcer)
            who = node_of(info.announcer) or "a node"
            text = f"{who} announces {info.name} ({info.source}): ignored, {reason}"
            self._node.get_logger().warning(one_line(text))

    def is_there(self, participant: str) -> bool:
        """Return True if the node with this id publishes on the roll at present, or is this node.

        DDS reports only names.  If nodes of one name are heard, the last ones to report first
        count as present, as many as DDS reports.  If DDS reports at least one, each node of this
        name counts that was heard within NAMESAKE_LIMIT, or not yet.  Reason: on a busy machine a
        new node can be heard before it is discovered, and must not replace an older one then.
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
        """Return False if a node has left the network: it was present, and is not at present.

        True for a node that was never present, because it may not have been discovered yet.
        """
        return self.is_there(participant) or participant not in self._seen

    def _unheard(self) -> set[str]:
        """Return the ids of nodes that other nodes have heard and this node has not.

        It contains no node of this node's own name, which this node replaces.
        """
        heard = {id_ for p in self.parts.values() if self.may_be_there(p.id) for id_ in p.heard}
        unheard = heard - set(self.parts) - self._given_up
        return {id_ for id_ in unheard if node_of(id_) != node_of(self.id)}

    def _send(self) -> None:
        """Publish this node's part, if it is listed, with the nodes that it has heard by now."""
        if self._own is not None:
            self._own.heard = [id_ for id_ in self.parts if self.is_there(id_)]
            self._node.send(ROLL, self._own)

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
            tuple(message.heard),
        )
        is_new = part.id not in self.parts
        self.parts[part.id] = part
        self._heard[part.node] = time.monotonic()
        if part.id not in self._signs and part.role == self._role and self._is_listed:
            self._node.get_logger().warning(
                f"{part.node} is a {part.role}, as this node is: a run takes one, unless the "
                "parameter wait_for of the simulator names two"
            )
        self._signs[part.id] = time.monotonic()
        if part.node in self._silent:
            self._silent.remove(part.node)
            self._node.get_logger().info(f"{part.node}: heard again")
        self._on_part(part)
        if is_new:
            self._send()  # for a node that starts before the next repetition
