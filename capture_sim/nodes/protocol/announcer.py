"""How a node announces runs: who joins one, who has left it; waiting for nodes before and after."""

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

#: After a run the participants get this long to close their files, s (wall).
END_TIMEOUT = 60.0
#: A node that has heard no other this long after its start, s (wall), is alone: on a busy machine
#: discovery needs more than :data:`DISCOVERY_TIME`, and beside a trial nothing may be published.
ALONE_TIME = 1.0
#: A node that has the name of a role and is not on the roll, which a node joins last, may still be
#: starting for this long after its subscriptions were found, s (wall): on a busy machine a detector
#: was, and its run began without it.
STARTING_TIME = 5.0
#: What is waited for is logged after this long, then at growing intervals, s (wall).
_REPORT_PERIOD = 2.0


class TrialOnError(CaptureSimError):
    """A trial of a real bench is on: nothing else may publish."""


class Participants:
    """Who takes part in a run, besides the node that announces it: roles, and ids, see Roll."""

    def __init__(self, parts: Sequence[RollPart]) -> None:
        self.participants = tuple(sorted(part.id for part in parts))
        self.roles = tuple(sorted({part.role for part in parts}))
        #: Roles that have streams of their own: their counts end the run too.
        self.publishers = tuple(sorted({part.role for part in parts if has_streams(part.role)}))


class Announcement:
    """A run that is announced: by whom of its participants it is joined, and left.

    ``data``: its RunInfo, serialised, where there is one already.
    """

    def __init__(
        self, node: BenchNode, roll: Roll, run: RunDescription, data: bytes | None = None
    ) -> None:
        self.run = run
        self.key = run_key(run)
        self._node, self._roll = node, roll
        self._send(run) if data is None else node.send(RUN_INFO, data)

    def not_joined(self) -> str:
        """Return which participants have yet to join the run; empty if all have."""
        return self._pending("to join the run", lambda part: part.is_ready(self.key))

    def not_left(self) -> str:
        """Return which participants have yet to leave the run."""
        return self._pending("to end the run", lambda part: part.is_done(self.key))

    def parts(self) -> list[RollPart]:
        """Return the participants that have been heard."""
        ids = self.run.participants
        return [self._roll.parts[id_] for id_ in ids if id_ in self._roll.parts]

    def present(self) -> list[RollPart]:
        """Return the participants that are there and have not left the run."""
        return [
            part
            for part in self.parts()
            if self._roll.may_be_there(part.id) and not part.is_done(self.key)
        ]

    def gone(self) -> list[str]:
        """Return the nodes that have joined the run, and were gone before they reported its end."""
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
        """Announce that no run is on; its description stays for later subscribers."""
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
    run.  A name that is listed twice stands for two nodes.  A node that is not on the roll counts
    as present when its subscriptions are matched.  ``check`` is called while the announcer waits,
    and raises to stop the wait.
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
        """Wait until all awaited nodes are present; CaptureSimError after ``limit`` s (wall).

        Without awaited nodes, wait for the time in which present nodes are usually discovered.
        """
        self._await_discovery()
        self._check_trials()
        self.await_none(name, self._missing, limit)

    def participants(self, chosen: Callable[[RollPart], bool] = lambda part: True) -> Participants:
        """Return who is there to take part; CaptureSimError during a trial of a real bench."""
        self._check_trials()
        self._is_on = True
        return Participants([part for part in self._roll.free(self._source) if chosen(part)])

    def announce(self, run: RunDescription, data: bytes) -> None:
        """Announce a run and wait until all participants are ready.

        CaptureSimError if one that the run has to wait for does not join it.
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
        """Wait until all readers have received every message, and name a reader that stalls."""
        topic_publishers = self._node.topic_publishers
        unread = topic_publishers.drain(topic_publishers.reader_timeout)
        if unread and not topic_publishers.dropped and not self._node.end_request.is_set():
            topic_publishers.report_stalled(unread[0])

    def await_done(self) -> None:
        """Wait until all participants have left the run; CaptureSimError after the limit."""
        if (on := self._announcement) is not None:
            # a run that is cut ends in order all the same: nothing is checked
            self.await_none(on.run.name, on.not_left, END_TIMEOUT, check=lambda: None)

    def close(self) -> None:
        """Announce that no run is on; its description stays for later subscribers."""
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
        """Wait until ``pending`` returns nothing; log its result at growing intervals.

        CaptureSimError after ``limit`` s (wall).
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
        """Raise CaptureSimError if a run is on and a node is found in a trial of a real bench."""
        if self._is_on and part.is_in_trial:
            raise _beside([part.node])

    def _await_discovery(self) -> None:
        """Wait after the node's start until others are heard, or until it is taken for alone."""
        is_alone = not self._wait_for

        def age() -> float:
            self._check()
            return time.monotonic() - self._node.created

        def is_over() -> bool:
            return age() > DISCOVERY_TIME and (not is_alone or bool(self._roll.parts))

        self._node.wait(is_over, max(0.0, ALONE_TIME - age()))

    def _check_trials(self) -> None:
        """Raise CaptureSimError during a trial, whose nodes would read this node's topics."""
        self._roll.await_heard()
        if nodes := self._roll.in_trials():
            raise _beside(nodes)

    def _missing(self) -> str:
        """Return the nodes that a run still waits for before its start."""
        free = self._roll.free(self._source)
        others = [
            name
            for name, count in self._wait_for.items()
            if sum(part.is_called(name) for part in free) < count
        ]
        return _listed("to start", [name for name in others if not self._is_reading(name)])

    def _is_reading(self, name: str) -> bool:
        """Return True if a node that is not on the roll is matched with all that it reads.

        Its subscriptions then have not changed for :data:`DISCOVERY_TIME`, and for
        :data:`STARTING_TIME` if the name is a role's.
        """
        if any(_is_named(node, name) for node in self._node.nodes_that_publish(ROLL)):
            return False
        count, matched = 0, True
        for topic in self._node.topic_publishers.topics:
            if topic in (ROLL, RUN_INFO, STREAM_COUNTS):
                continue
            readers = self._node.topic_publishers.readers(topic)
            own = sum(_is_named(reader, name) for reader in readers)
            if own:
                count += own
                matched = matched and self._node.topic_publishers.matched(topic) >= len(readers)
        now = time.monotonic()
        if self._subscriptions.get(name) != count:
            if count:
                self._warn_of_best_effort(name)
            self._subscriptions[name], self._changed = count, now
        is_role = name.rpartition("/")[2] in (LAUNCHER, CAPTURE_DETECTOR, RECORDER)
        settled = self._changed + (STARTING_TIME if is_role else DISCOVERY_TIME)
        return count > 0 and matched and now > settled

    def _warn_of_best_effort(self, name: str) -> None:
        for topic in self._node.topic_publishers.topics:
            resolved = self._node.resolve_topic_name(topic.name)
            for reader in self._node.get_subscriptions_info_by_topic(resolved):
                best_effort = reader.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT
                if best_effort and _is_named(full_name(reader), name):
                    text = f"{name} reads {topic.name} best effort: it can miss messages"
                    self._node.get_logger().warning(text)


def _is_named(node: str, name: str) -> bool:
    """Return True if a node, by its full name, has this name or full name."""
    return name in (node, node.rpartition("/")[2])


def _beside(nodes: Sequence[str]) -> TrialOnError:
    return TrialOnError(
        f"{', '.join(nodes)} in a trial of a real bench: nothing else may publish; wait for "
        "its end, or use another ROS_DOMAIN_ID or namespace"
    )


def _listed(for_what: str, names: Sequence[str]) -> str:
    return f"waiting for {', '.join(names)} {for_what}" if names else ""
