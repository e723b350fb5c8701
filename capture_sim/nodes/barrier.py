"""Who takes part in a run: awaited before it by their subscriptions, after it by their counts."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from typing import Any

from capture_sim.errors import CaptureSimError
from capture_sim.messages.topics import STREAM_COUNTS, Topic
from capture_sim.nodes.node import BenchNode, full_name
from capture_sim.nodes.participant import readers

#: A waiting thread looks up this often, s (wall).
POLL = 0.002
#: What is waited for is said after this long, then ever more seldom, s (wall).
_REPORT_PERIOD = 2.0


class Barrier:
    """Waits for those that take part in the runs of an announcer, whatever their names.

    Parameters
    ----------
    node
        The announcer.
    roles
        Of those that are awaited before a run; others may join at any time.
    streams
        Topics that the announcer publishes.
    own
        Roles whose counts the announcer itself publishes.
    look
        Called while waiting; raises what is to end that.
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
        self._present = 0  # others with counts to tell when the run began
        self._ended: set[str] = set()  # roles whose counts of the run have come
        node.listen(STREAM_COUNTS, self._counted, latched=False)

    def begin(self, run_id: str) -> None:
        """Note who is there when a run begins."""
        self._ended, self._run_id = set(), run_id
        self._present = self._others()

    def all_there(self) -> str:
        """Return what is waited for before a run; nothing if all that are awaited are matched."""
        counts = self._node.resolve_topic_name(STREAM_COUNTS.name)
        taking_part = {full_name(end) for end in self._node.get_publishers_info_by_topic(counts)}
        for topic in self._streams:
            wanted = readers(topic, self._roles)
            if wanted:  # besides those who only look on, such as `ros2 topic echo`
                wanted += sum(name not in taking_part for name in self._node.readers(topic))
            if self._node.matched(topic) < wanted:
                return f"waiting for {', '.join(self._roles)}: too few subscribe to {topic.name}"
        if self._others() < len(self._roles):
            return f"waiting for {', '.join(self._roles)} to start"
        return ""

    def all_ended(self) -> str:
        """Return what is waited for after a run; nothing if all have said their counts."""
        left = min(self._present, self._others()) - len(self._ended) - self._left_behind()
        return f"waiting for {left} others to end the run" if left > 0 else ""

    def wait(self, what: str, lacking: Callable[[], str], limit: float | None) -> None:
        """Wait until ``lacking`` returns nothing; say what it returns, ever more seldom.

        Raises
        ------
        CaptureSimError
            After ``limit``, s.
        """
        began = said = time.monotonic()
        silence = _REPORT_PERIOD
        while text := lacking():
            self._look()
            time.sleep(POLL)
            now = time.monotonic()
            if limit is not None and now - began > limit:
                raise CaptureSimError(f"{text}: given up after {limit:g} s")
            if now - said > silence:
                said, silence = now, 2.0 * silence
                self._node.get_logger().info(f"{what}: {text}")

    def _others(self) -> int:
        return self._node.publishers_of(STREAM_COUNTS) - 1

    def _left_behind(self) -> int:
        """Return how many of the others no longer read: they would say their counts too late."""
        if not self._node.left_behind:
            return 0
        name = self._node.resolve_topic_name(STREAM_COUNTS.name)
        others = self._node.get_publishers_info_by_topic(name)
        return sum(full_name(other) in self._node.left_behind for other in others)

    def _counted(self, counts: Any) -> None:
        if counts.run_id == self._run_id and counts.publisher not in self._own:
            self._ended.add(counts.publisher)
