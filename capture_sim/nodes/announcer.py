"""How a simulator or player announces runs: it waits for nodes before a run and after it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from rclpy.qos import ReliabilityPolicy

from capture_sim.errors import CaptureSimError
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.topics import ROLL, RUN_INFO, STREAM_COUNTS, RunSource, topics_of
from capture_sim.nodes.endpoints import full_name
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.roll import Part, Roll, node_of, run_key

#: After a run the participants get this long to close their files, s (wall).
END_TIMEOUT = 60.0
#: A node of the user's is there once its subscriptions have not changed for this long, s (wall).
SETTLING_TIME = 0.3
#: What is waited for is logged after this long, then at growing intervals, s (wall).
_REPORT_PERIOD = 2.0
_POLL = 0.02


@dataclass(frozen=True)
class Cast:
    """Who takes part in a run, besides the node that announces it."""

    participants: tuple[str, ...]  # ids, see Roll
    roles: tuple[str, ...]

    @property
    def publishing_roles(self) -> tuple[str, ...]:
        """Roles that have streams of their own: their counts end the run too."""
        return tuple(role for role in self.roles if len(topics_of(role)) > 1)


class Announcer:
    """Announces the runs of a node.

    ``wait_for``: roles, names or full names of nodes that must be there before a run; a node that
    is not on the roll is there when its subscriptions are matched.  ``check`` is called while
    waiting and raises to stop waiting.
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
        self._wait_for = tuple(wait_for)
        self._check = check
        self._description: RunDescription | None = None
        self._is_on = False
        self._subscriptions: dict[str, int] = {}  # of the user's nodes, by name in wait_for
        self._changed = 0.0  # s (wall), when they did last

    def await_nodes(self, name: str, limit: float) -> None:
        """Wait until the nodes to wait for are there; CaptureSimError after ``limit`` s (wall)."""
        self._check_trials()
        self.await_none(name, self._missing, limit)

    def cast(self, chosen: Callable[[Part], bool] = lambda part: True) -> Cast:
        """Return who is there to take part; CaptureSimError during a trial of a real bench."""
        self._check_trials()
        self._is_on = True
        parts = [part for part in self._roll.free(self._source) if chosen(part)]
        roles = sorted({part.role for part in parts})
        return Cast(tuple(sorted(part.id for part in parts)), tuple(roles))

    def announce(self, description: RunDescription, data: bytes, limit: float) -> None:
        """Announce a run and wait until all participants are ready, ``limit`` s (wall) at most.

        CaptureSimError if one that the run has to wait for does not join it.
        """
        self._description = description
        key, participants = run_key(description), description.participants
        self._node.send(RUN_INFO, data)
        try:
            self.await_none(
                description.name,
                lambda: _listed("to join the run", self._roll.not_ready(key, participants)),
                limit,
            )
        except CaptureSimError as error:
            self._node.get_logger().warning(f"{description.name}: {error}")
        for name in self._wait_for:
            parts = [self._roll.parts[id_] for id_ in participants if id_ in self._roll.parts]
            known = [part for part in parts if part.is_called(name)]
            if known and not any(part.is_ready(key) for part in known):
                raise CaptureSimError(f"{name} has not joined the run")

    def await_done(self) -> None:
        """Wait until all participants have left the run; CaptureSimError after the limit."""
        assert self._description is not None
        name, key = self._description.name, run_key(self._description)
        participants = [
            id_
            for id_ in self._description.participants
            if node_of(id_) not in self._node.outbox.dropped
        ]
        self.await_none(
            name,
            lambda: _listed("to end the run", self._roll.not_done(key, participants)),
            END_TIMEOUT,
            check=lambda: None,  # the run that is cut ends in order all the same
        )

    def close(self) -> None:
        """Announce that no run is on; its description stays for later subscribers."""
        self._is_on = False
        if self._description is not None:
            info = self._node.messages.run_info(replace(self._description, run_id=""))
            self._node.send(RUN_INFO, self._node.messages.serialise(info))

    def await_none(
        self,
        name: str,
        pending: Callable[[], str],
        limit: float | None,
        check: Callable[[], None] | None = None,
    ) -> None:
        """Wait until ``pending`` returns nothing; log its result at growing intervals.

        CaptureSimError after ``limit`` s (wall).
        """
        began = last_report = time.monotonic()
        period = _REPORT_PERIOD
        while text := pending():
            (check or self._check)()
            self._node.wait(limit=_POLL)
            now = time.monotonic()
            if limit is not None and now - began > limit:
                raise CaptureSimError(f"{text}: timed out after {limit:g} s")
            if now - last_report > period:
                last_report, period = now, 2.0 * period
                self._node.get_logger().info(f"{name}: {text}")

    def check_part(self, part: Part) -> None:
        """Raise CaptureSimError if a run is on and a node is found in a trial of a real bench."""
        if self._is_on and part.is_in_trial:
            raise _beside([part.node])

    def _check_trials(self) -> None:
        """Raise CaptureSimError during a trial, whose nodes would read this node's topics."""
        self._roll.await_heard()
        if nodes := self._roll.in_trials():
            raise _beside(nodes)

    def _missing(self) -> str:
        """Return the nodes that a run still waits for before its start."""
        free = self._roll.free(self._source)
        others = [name for name in self._wait_for if not any(part.is_called(name) for part in free)]
        return _listed("to start", [name for name in others if not self._is_reading(name)])

    def _is_reading(self, name: str) -> bool:
        """Return True if a node that is not on the roll is matched with all that it reads."""
        if any(_is_named(node, name) for node in self._node.nodes_that_publish(ROLL)):
            return False
        count, matched = 0, True
        for topic in self._node.outbox.topics:
            if topic in (ROLL, RUN_INFO, STREAM_COUNTS):
                continue
            readers = self._node.outbox.readers(topic)
            own = sum(_is_named(reader, name) for reader in readers)
            if own:
                count += own
                matched = matched and self._node.outbox.matched(topic) >= len(readers)
        now = time.monotonic()
        if self._subscriptions.get(name) != count:
            if count:
                self._warn_of_best_effort(name)
            self._subscriptions[name], self._changed = count, now
        return count > 0 and matched and now > self._changed + SETTLING_TIME

    def _warn_of_best_effort(self, name: str) -> None:
        for topic in self._node.outbox.topics:
            resolved = self._node.resolve_topic_name(topic.name)
            for reader in self._node.get_subscriptions_info_by_topic(resolved):
                best_effort = reader.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT
                if best_effort and _is_named(full_name(reader), name):
                    text = f"{name} reads {topic.name} best effort: it can miss messages"
                    self._node.get_logger().warning(text)


def _is_named(node: str, name: str) -> bool:
    """Return True if a node, by its full name, has this name or full name."""
    return name in (node, node.rpartition("/")[2])


def _beside(nodes: Sequence[str]) -> CaptureSimError:
    return CaptureSimError(
        f"{', '.join(nodes)} in a trial of a real bench: nothing else may publish; wait for "
        "its end, or use another ROS_DOMAIN_ID or namespace"
    )


def _listed(for_what: str, names: Sequence[str]) -> str:
    return f"waiting for {', '.join(names)} {for_what}" if names else ""
