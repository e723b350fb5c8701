"""From received messages to what the core takes; works on the messages of any library."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from capture_sim.detection.align import Observation, Source, observed
from capture_sim.messages.convert import stamp_seconds
from capture_sim.messages.measurements import measured


def stamp_ns_of(message: Any) -> int:
    """Return the stamp of a message with a header, ns of simulated time."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


class StampMatcher:
    """Puts together messages of several topics that carry the same stamp.

    Every topic comes in the order of its stamps.  So when a set is complete, an older one
    that is not has lost a message: it is given up and counted in ``skipped``.

    Parameters
    ----------
    names
        Of the topics that make up a set.
    room
        Sets that may be incomplete at a time; the oldest is given up beyond.
    """

    def __init__(self, names: Iterable[str], room: int = 1000) -> None:
        self.skipped = 0
        self._names = frozenset(names)
        self._room = room
        self._waiting: dict[int, dict[str, Any]] = {}

    def add(self, name: str, message: Any) -> dict[str, Any] | None:
        """Take in a message; return the set that it completes, by name, or None."""
        stamp = stamp_ns_of(message)
        parts = self._waiting.setdefault(stamp, {})
        parts[name] = message
        if len(parts) == len(self._names):
            for older in [s for s in self._waiting if s < stamp]:
                del self._waiting[older]
                self.skipped += 1
            return self._waiting.pop(stamp)
        if len(self._waiting) > self._room:
            del self._waiting[min(self._waiting)]
            self.skipped += 1
        return None


def observation_of(chaser: Any, target: Any, buffer: Any) -> Observation:
    """Return what the capture detector judges, from messages of one stamp.

    Parameters
    ----------
    chaser, target
        nav_msgs/Odometry: pose in the world, twist in the vehicle's own frame.
    buffer
        capture_sim/BufferState.
    """
    return observed(
        stamp_seconds(stamp_ns_of(chaser)),
        measured(Source.CHASER, chaser),
        measured(Source.TARGET, target),
        measured(Source.BUFFER, buffer),
    )
