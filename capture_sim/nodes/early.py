"""Messages that come before the run that they belong to is known."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

from rclpy.serialization import deserialize_message

from capture_sim.messages.topics import CAPTURE_CRITERIA, LAUNCH_COMMAND, STREAM_COUNTS, Topic
from capture_sim.nodes.running import message_class

# these say which run they belong to
_NAMED = (LAUNCH_COMMAND, CAPTURE_CRITERIA, STREAM_COUNTS)


class EarlyMessages:
    """Keeps them until the run is known, and leaves out the rest of a run before."""

    def __init__(self) -> None:
        self._kept: dict[Topic, deque[tuple[bytes, int | None]]] = {}

    def add(self, topic: Topic, data: bytes, seq: int | None) -> None:
        """Keep a serialised message and its number; None where its type has none."""
        kept = self._kept.setdefault(topic, deque(maxlen=topic.depth))
        if seq == 0:
            kept.clear()  # a run begins: all before is of another
        kept.append((data, seq))

    def take(self, run_id: str) -> Iterator[tuple[Topic, bytes]]:
        """Yield what belongs to the run that is known now, and forget all."""
        for topic, kept in self._kept.items():
            if kept and (topic in _NAMED or kept[0][1] == 0):
                for data, _ in kept:
                    if topic not in _NAMED or _run_of(topic, data) == run_id:
                        yield topic, data
        self._kept.clear()


def _run_of(topic: Topic, data: bytes) -> str:
    message: Any = deserialize_message(data, message_class(topic.type_name))
    return str(message.run_id)
