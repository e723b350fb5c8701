"""The participants of a run: awaited before it by their subscriptions, after it by their counts."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from typing import Any

from capture_sim.errors import CaptureSimError
from capture_sim.messages.topics import STREAM_COUNTS, Topic
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.participant import readers

#: A waiting thread looks up this often, s (wall).
POLL = 0.002
#: What is waited for is logged after this long, then at growing intervals, s (wall).
_REPORT_PERIOD = 2.0


class Barrier:
    """Waits for the nodes that take part in the runs of an announcer, whatever their names.

    ``roles`` are waited for before a run; other nodes may join at any time.  ``streams`` are the
    topics that the announcer publishes, ``own`` the roles whose counts it publishes.  ``look`` is
    called while waiting and raises what is to end that.
    """

    def __init__(
        self,
        node: BenchNode,
        roles: Sequence[str],
        streams: Sequence[Topic],
        own: Collection[str],
        look: Callable[[], None],
    ) -> None:
        self._node = node
        self._roles = roles
        self._streams = [topic for topic in streams if topic is not STREAM_COUNTS]
        self._own = own
        self._look = look
        self._run_id = ""
        self._present = 0  # other nodes that report counts, when the run began
        self._ended: set[str] = set()  # roles whose counts of the run have come
        node.listen(STREAM_COUNTS, self._counted, latched=False)

    def begin(self, run_id: str) -> None:
        """Count the other nodes that are there when a run begins."""
        self._ended, self._run_id = set(), run_id
        self._present = self._others()

    def all_there(self) -> str:
        """Return what a run still waits for before it; empty once all roles are matched."""
        for topic in self._streams:
            expected = readers(topic, self._roles)
            if expected:  # besides those that only look on, such as `ros2 topic echo`
                names = self._node.readers(topic)
                expected += len(names) - len(self._node.participants(names))
            if self._node.matched(topic) < expected:
                return f"waiting for {', '.join(self._roles)}: too few subscribe to {topic.name}"
        if self._others() < len(self._roles):
            return f"waiting for {', '.join(self._roles)} to start"
        return ""

    def all_ended(self) -> str:
        """Return what a run still waits for after it; empty once all have reported counts."""
        dropped = self._node.participants(self._node.dropped_readers)  # they would be too late
        left = min(self._present, self._others()) - len(self._ended) - len(dropped)
        return f"waiting for {left} other nodes to end the run" if left > 0 else ""

    def wait(self, what: str, pending: Callable[[], str], limit: float | None) -> None:
        """Wait until ``pending`` returns nothing; log what it returns, at growing intervals.

        CaptureSimError after ``limit`` (s).
        """
        began = last_report = time.monotonic()
        period = _REPORT_PERIOD
        while text := pending():
            self._look()
            time.sleep(POLL)
            now = time.monotonic()
            if limit is not None and now - began > limit:
                raise CaptureSimError(f"{text}: timed out after {limit:g} s")
            if now - last_report > period:
                last_report, period = now, 2.0 * period
                self._node.get_logger().info(f"{what}: {text}")

    def _others(self) -> int:
        return self._node.publishers_of(STREAM_COUNTS) - 1

    def _counted(self, counts: Any) -> None:
        if counts.run_id == self._run_id and counts.publisher not in self._own:
            self._ended.add(counts.publisher)
