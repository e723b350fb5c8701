"""Sources of a node on the topic diagnostics: rate, age, jitter and quality of service of each."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from capture_sim.messages.topics import Topic
from capture_sim.nodes.endpoints import full_name, message_class
from capture_sim.nodes.node import BenchNode

#: Published this often, s (wall).
PERIOD = 1.0
#: A source without a message for this long is a warning, s (wall).
STALE = 0.3


@dataclass
class _Arrivals:
    """Arrivals of one topic since the last publication; times in s (wall)."""

    last: float = math.nan
    count: int = 0
    intervals: float = 0.0  # sum
    squares: float = 0.0  # sum of the squares


class SourceDiagnostics:
    """Publishes, per second, how the messages of a rig's drivers arrive.

    Stamped with the wall's time, as diagnostics are.  ``extra`` values of a topic can be set in
    :attr:`extras`, e.g. the offset of its clock.
    """

    def __init__(self, node: BenchNode) -> None:
        self.extras: dict[Topic, Mapping[str, object]] = {}
        self._node = node
        self._arrivals: dict[Topic, _Arrivals] = {}
        self._groups: list[tuple[Topic, ...]] = []
        self._since = time.monotonic()
        self._array = message_class("diagnostic_msgs/msg/DiagnosticArray")
        self._status = message_class("diagnostic_msgs/msg/DiagnosticStatus")
        self._value = message_class("diagnostic_msgs/msg/KeyValue")
        self._publisher = node.create_publisher(self._array, "diagnostics", 10)
        self._wall = Clock(clock_type=ClockType.SYSTEM_TIME)
        node.every(PERIOD, self._publish)

    def watch(self, *topics: Topic) -> None:
        """Report on these topics from now on, also without a message.

        They are alternatives: those without publisher are left out if another one has one.
        """
        self._groups.append(topics)
        for topic in topics:
            self._arrivals.setdefault(topic, _Arrivals())

    def note(self, topic: Topic) -> None:
        """Take note of a message of a watched topic; others are ignored."""
        arrivals = self._arrivals.get(topic)
        if arrivals is None:
            return
        now = time.monotonic()
        interval = now - arrivals.last
        arrivals.last = now
        if interval == interval:  # not the first
            arrivals.count += 1
            arrivals.intervals += interval
            arrivals.squares += interval * interval

    def _publish(self) -> None:
        now = time.monotonic()
        statuses = []
        for group in self._groups:
            published = [topic for topic in group if self._node.nodes_that_publish(topic)]
            for topic in published or group[:1]:
                statuses.append(self._status_of(topic, self._arrivals[topic], now))
        self._since = now
        message = self._array(status=statuses)
        message.header.stamp = self._wall.now().to_msg()
        self._publisher.publish(message)

    def _status_of(self, topic: Topic, arrivals: _Arrivals, now: float) -> Any:
        name = self._node.resolve_topic_name(topic.name)
        publishers = self._node.get_publishers_info_by_topic(name)
        age, count = now - arrivals.last, arrivals.count
        values: dict[str, object] = {"rate [Hz]": f"{count / (now - self._since):.2f}"}
        if count:
            mean = arrivals.intervals / count
            variance = max(0.0, arrivals.squares / count - mean * mean)
            values["jitter [s]"] = f"{math.sqrt(variance):.6f}"
        values["age [s]"] = f"{age:.3f}"
        for end in publishers:
            qos = end.qos_profile
            values[f"published by {full_name(end)}"] = (
                f"{qos.reliability.name}, {qos.durability.name}".lower().replace("_", " ")
            )
        values |= self.extras.get(topic, {})
        level, text = self._status.OK, f"{values['rate [Hz]']} Hz"
        if not publishers:
            level, text = self._status.ERROR, "no publisher"
        elif not age <= STALE:
            level = self._status.WARN
            text = "no message" if math.isnan(age) else f"last message {age:.1f} s ago"
        arrivals.count, arrivals.intervals, arrivals.squares = 0, 0.0, 0.0
        return self._status(
            level=level,
            name=f"{self._node.get_name()}: {name}",
            message=text,
            hardware_id="capture_sim",
            values=[self._value(key=key, value=str(value)) for key, value in values.items()],
        )
