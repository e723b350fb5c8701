"""How a node announces a run and waits for the other nodes to join it and to leave it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

from rclpy.qos import ReliabilityPolicy

from capture_sim.errors import CaptureSimError
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    LAUNCHER,
    RECORDER,
    ROLL,
    RUN_INFO,
    STREAM_COUNTS,
    RunSource,
)
from capture_sim.nodes.base.endpoints import DISCOVERY_TIME, full_name
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.protocol.roll import Roll, RollPart, RunReport, has_streams, node_of, run_key

#: After a run the announcer waits this long for the participants to close their files, s (wall).
END_TIMEOUT = 60.0
#: A node that has heard no other node this long after its start, s (wall), assumes that there is
#: none.  The time is longer than :data:`DISCOVERY_TIME`, because discovery is slower on a busy
#: machine, and a node that overlooked a trial of a real bench would publish on its topics.
ALONE_TIME = 1.0
#: A node that bears the name of a role, but is not on bench/roll, may still be starting for this
#: long after its subscriptions were found, s (wall), because a node joins the roll last.  Without
#: this wait a run could begin without, for example, a detector that starts on a busy machine.
STARTING_TIME = 5.0
#: The names of the nodes that a wait is for are logged after this time, then at growing intervals,
#: s (wall).
_REPORT_PERIOD = 2.0
#: A node that has replaced another of its role is waited for this long, s (wall): a killed one
#: counts as present until it has not been heard for NAMESAKE_LIMIT.
DOUBLE_TIMEOUT = 5.0


class TrialOnError(CaptureSimError):
    """Error of a node that may not publish, because a trial of a real bench is running."""


class Participants:
    """The nodes that take part in a run, without the node that announces it.

    ``participants`` are their ids on bench/roll (:attr:`RollPart.id`), ``roles`` their roles, each
    once; both are sorted.
    """

    def __init__(self, parts: Sequence[RollPart]) -> None:
        self.participants = tuple(sorted(part.id for part in parts))
        self.roles = tuple(sorted({part.role for part in parts}))
        #: Roles that publish streams; these nodes, too, report how many messages they have sent.
        self.publishers = tuple(sorted({part.role for part in parts if has_streams(part.role)}))


class Announcement:
    """A run that this object announces when created; it tells which participants join and leave it.

    ``data``: the serialised RunInfo to publish; None to make the RunInfo from ``run``.  ``key``
    identifies the run on bench/roll, see :func:`run_key`.
    """

    def __init__(
        self, node: BenchNode, roll: Roll, run: RunDescription, data: bytes | None = None
    ) -> None:
        self.run = run
        self.key = run_key(run)
        self._node, self._roll = node, roll
        self._send(run) if data is None else node.send(RUN_INFO, data)

    def not_joined(self) -> str:
        """Return a log text that names the participants that have yet to join; empty if none.

        Nodes that have left the network, or whose readers were dropped, are not named.
        """
        return self._pending("to join the run", lambda part: part.is_ready(self.key))

    def not_left(self) -> str:
        """Return a log text that names the participants that have yet to leave; empty if none.

        Nodes that have left the network, or whose readers were dropped, are not named.
        """
        return self._pending("to end the run", lambda part: part.is_done(self.key))

    def parts(self) -> list[RollPart]:
        """Return the last report on bench/roll of each participant that has sent one."""
        ids = self.run.participants
        return [self._roll.parts[id_] for id_ in ids if id_ in self._roll.parts]

    def present(self) -> list[RollPart]:
        """Return the reports of the participants that have left neither the network nor the run.

        A participant that has sent no report on bench/roll is not included.
        """
        return [
            part
            for part in self.parts()
            if self._roll.may_be_there(part.id) and not part.is_done(self.key)
        ]

    def gone(self) -> list[str]:
        """Return the full names of the nodes that joined the run but vanished before leaving it.

        Such a node has left the network without a report of the run's end.
        """
        return [
            part.node
            for part in self.parts()
            if part.is_ready(self.key)
            and not part.is_done(self.key)
            and not self._roll.may_be_there(part.id)
        ]

    def reports(self) -> list[RunReport]:
        """Return the reports of all participants that have left the run."""
        return [part.report for part in self.parts() if part.is_done(self.key)]

    def close(self) -> None:
        """Publish the run's RunInfo with an empty run_id: no run is on any more.

        Later subscribers receive this message, with the rest of the description of the run.
        """
        self._send(replace(self.run, run_id=""))

    def _pending(self, for_what: str, has: Callable[[RollPart], bool]) -> str:
        dropped = self._node.topic_publishers.dropped
        participants = [id_ for id_ in self.run.participants if node_of(id_) not in dropped]
        return _listed(for_what, self._roll.pending(participants, has))

    def _send(self, run: RunDescription) -> None:
        messages = self._node.messages
        self._node.send(RUN_INFO, messages.serialise(messages.run_info(run)))


class Announcer:
    """Announces the runs of a simulator or player one after another, and waits for nodes.

    ``wait_for`` lists the roles, names or full names of the nodes that must be present before a
    run.  A name that is listed twice stands for two nodes.  A node that does not report on
    bench/roll, such as a user's node, counts as present when its subscriptions are matched; of such
    nodes one is enough, even if the name is listed twice.  ``source`` is the source of the runs.
    ``check`` is called during each wait, except that of :meth:`await_done`, and raises an error to
    stop it.
    """

    def __init__(
        self,
        node: BenchNode,
        roll: Roll,
        source: RunSource,
        wait_for: Sequence[str],
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self._node = node
        self._roll = roll
        self._source = source
        self._wait_for = Counter(wait_for)
        self._check = check
        self._announcement: Announcement | None = None
        self._is_on = False
        self._subscriptions: dict[str, int] = {}  # of the user's nodes, by name in wait_for
        self._changed = 0.0  # s (wall), when they did last

    def await_nodes(self, name: str, limit: float) -> None:
        """Wait until all nodes of ``wait_for`` are present.

        CaptureSimError if a node is missing after ``limit`` s (wall).  If ``wait_for`` is empty,
        wait until another node is heard, or until :data:`ALONE_TIME` after this node's start.
        TrialOnError if a trial of a real bench is running.  ``name``:
        name of the run in the log.
        """
        self._await_discovery()
        self._check_trials()
        self.await_none(name, self._missing, limit)

    def participants(
        self, name: str, chosen: Callable[[RollPart], bool] = lambda part: True
    ) -> Participants:
        """Return the nodes that can take part in the next run.

        These are the nodes that are present, in no run, and take part in runs of this source, if
        ``chosen`` returns True for them.  ``name``: name of the run in the log.  TrialOnError
        during a trial of a real bench, now or later until :meth:`close`, see :meth:`check_part`.
        CaptureSimError if for :data:`DOUBLE_TIMEOUT` more nodes fill a role than the run takes:
        one, or as many as ``wait_for`` names.
        """
        self._check_trials()
        self._is_on = True

        def parts() -> list[RollPart]:
            return [part for part in self._roll.free(self._source) if chosen(part)]

        def doubles() -> str:
            wanted = list(self._wait_for.elements())
            return "; ".join(self._roll.doubles(parts(), wanted))

        try:
            self.await_none(name, doubles, DOUBLE_TIMEOUT)
        except CaptureSimError:
            self._is_on = False
            raise
        return Participants(parts())

    def announce(self, run: RunDescription, data: bytes) -> None:
        """Announce a run and wait until all participants have joined it.

        ``data``: the run's RunInfo, serialised.  A participant that has not joined within
        ``reader_timeout`` is only logged.  If it is one of ``wait_for``, CaptureSimError is raised.
        """
        self._is_on = True
        self._announcement = on = Announcement(self._node, self._roll, run, data)
        try:
            self.await_none(run.name, on.not_joined, self._node.topic_publishers.reader_timeout)
        except CaptureSimError as error:
            self._node.get_logger().warning(f"{run.name}: {error}")
        for name, count in self._wait_for.items():
            known = [part for part in on.parts() if part.is_called(name)]
            if known and sum(part.is_ready(on.key) for part in known) < count:
                raise CaptureSimError(f"{name} has not joined the run")

    def await_read(self) -> None:
        """Wait until all readers have received every message, at most ``reader_timeout`` s (wall).

        After that, log the readers of one unread topic as dropped, unless a reader was dropped
        before or this node was asked to end.
        """
        topic_publishers = self._node.topic_publishers
        unread = topic_publishers.drain(topic_publishers.reader_timeout)
        if unread and not topic_publishers.dropped and not self._node.end_request.is_set():
            topic_publishers.report_stalled(unread[0])

    def await_done(self) -> None:
        """Wait until all participants have left the last run that was announced, if any.

        CaptureSimError after :data:`END_TIMEOUT`.
        """
        if (on := self._announcement) is not None:
            # a run that is cut ends in order all the same: nothing is checked
            self.await_none(on.run.name, on.not_left, END_TIMEOUT, check=lambda: None)

    def close(self) -> None:
        """Announce that no run is on, see :meth:`Announcement.close`."""
        self._is_on = False
        if self._announcement is not None:
            self._announcement.close()

    def await_none(
        self,
        name: str,
        pending: Callable[[], str],
        limit: float,
        check: Callable[[], None] | None = None,
    ) -> None:
        """Wait until ``pending`` returns an empty text; log its text at growing intervals.

        CaptureSimError after ``limit`` s (wall).  ``name``: name of the run in the log.  ``check``:
        called during the wait in place of the announcer's own, and raises to stop it.
        """
        check = check or self._check

        def is_over() -> bool:
            check()
            return not pending()

        left, period = limit, _REPORT_PERIOD
        while not self._node.wait(is_over, min(period, left)):
            left -= period
            period *= 2.0
            if text := pending():
                if left <= 0.0:
                    raise CaptureSimError(f"{text}: timed out after {limit:g} s")
                self._node.get_logger().info(f"{name}: {text}")

    def check_part(self, part: RollPart) -> None:
        """Raise TrialOnError if this node reports a trial of a real bench while a run is on.

        A run is on from :meth:`participants` to :meth:`close`.  Call this for each part reported.
        """
        if self._is_on and part.is_in_trial:
            raise _beside([part.node])

    def _await_discovery(self) -> None:
        """Wait until other nodes can have been discovered since this node's start.

        The wait lasts :data:`DISCOVERY_TIME` after the start.  If ``wait_for`` is empty, it lasts
        until another node has been heard as well, :data:`ALONE_TIME` at most.  After it,
        :meth:`Roll.await_heard` waits for the nodes that this one has heard.
        """

        def age() -> float:
            self._check()
            return time.monotonic() - self._node.created

        def is_over() -> bool:
            return age() > DISCOVERY_TIME and bool(self._wait_for or self._roll.parts)

        self._node.wait(is_over, max(0.0, ALONE_TIME - age()))

    def _check_trials(self) -> None:
        """Raise TrialOnError during a trial, because its nodes would read this node's topics."""
        self._roll.await_heard()
        if nodes := self._roll.in_trials():
            raise _beside(nodes)

    def _missing(self) -> str:
        """Return a log text that names the nodes of ``wait_for`` still missing; empty if none."""
        free = self._roll.free(self._source)
        missing = {
            name: count - sum(part.is_called(name) for part in free)
            for name, count in self._wait_for.items()
        }
        others = [name for name, n in missing.items() if n > 0 and not self._are_reading(name, n)]
        return _listed("to start", others)

    def _are_reading(self, name: str, needed: int) -> bool:
        """Return True if ``needed`` nodes of a name that are not on bench/roll are ready to read.

        It must subscribe to a topic of this node, and all subscriptions to these topics must be
        matched.  No subscription may have changed for :data:`DISCOVERY_TIME`, or for
        :data:`STARTING_TIME` if the name is that of a role.
        """
        if any(_is_named(node, name) for node in self._node.nodes_that_publish(ROLL)):
            return False
        count, nodes, matched = 0, 0, True
        for topic in self._node.topic_publishers.topics:
            if topic in (ROLL, RUN_INFO, STREAM_COUNTS):
                continue
            readers = self._node.topic_publishers.readers(topic)
            own = sum(_is_named(reader, name) for reader in readers)
            if own:
                count, nodes = count + own, max(nodes, own)
                matched = matched and self._node.topic_publishers.matched(topic) >= len(readers)
        now = time.monotonic()
        if self._subscriptions.get(name) != count:
            if count:
                self._warn_of_best_effort(name)
            self._subscriptions[name], self._changed = count, now
        is_role = name.rpartition("/")[2] in (LAUNCHER, CAPTURE_DETECTOR, RECORDER)
        settled = self._changed + (STARTING_TIME if is_role else DISCOVERY_TIME)
        return nodes >= needed and matched and now > settled

    def _warn_of_best_effort(self, name: str) -> None:
        for topic in self._node.topic_publishers.topics:
            resolved = self._node.resolve_topic_name(topic.name)
            for reader in self._node.get_subscriptions_info_by_topic(resolved):
                best_effort = reader.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT
                if best_effort and _is_named(full_name(reader), name):
                    text = f"{name} reads {topic.name} best effort: it can miss messages"
                    self._node.get_logger().warning(text)


def _is_named(node: str, name: str) -> bool:
    """Return True if ``name`` is the name or full name of the node with full name ``node``."""
    return name in (node, node.rpartition("/")[2])


def _beside(nodes: Sequence[str]) -> TrialOnError:
    return TrialOnError(
        f"{', '.join(nodes)} in a trial of a real bench: nothing else may publish; wait for "
        "its end, or use another ROS_DOMAIN_ID or namespace"
    )


def _listed(for_what: str, names: Sequence[str]) -> str:
    return f"waiting for {', '.join(names)} {for_what}" if names else ""
