"""Diagnostics of a node's sources: rate, age, jitter, clock and quality of service."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from capture_sim.detection.clocks import MAX_OFFSET
from capture_sim.messages.topics import ROLL, Topic
from capture_sim.nodes.base.diagnostics import PERIOD, Diagnostics, DiagnosticStatus, Level
from capture_sim.nodes.base.endpoints import full_name
from capture_sim.nodes.base.node import BenchNode
from capture_sim.trial.interlocks import SourceMonitor, TrialLimits

#: Lag of the latest message relative to the message with the shortest delay, s, above which a
#: status is a warning.
MAX_LAG = 0.5
#: Number of publications over which the shortest delay is taken: a driver may restart with another
#: clock.
LAG_PERIODS = 60
#: A source without measurements is reported after this time, s (wall).  A recording of a trial then
#: begins, e.g. where cameras see only the cone.
SOURCES_TIMEOUT = 3.0


@dataclass
class _Source:
    """Statistics of the messages of one topic."""

    monitor: SourceMonitor = field(default_factory=SourceMonitor)
    # arrivals since the last publication, and the last arrival before it, s (wall)
    arrivals: list[float] = field(default_factory=list)
    offsets: list[float] = field(default_factory=list)  # stamp minus arrival, s
    # the largest offset between two publications: of the message with the shortest delay
    quickest: deque[float] = field(default_factory=lambda: deque(maxlen=LAG_PERIODS))

    @property
    def lag(self) -> float:
        """Delay of the latest message minus the shortest delay, s; NaN without stamps."""
        if not self.offsets:
            return math.nan
        return max((*self.quickest, *self.offsets)) - self.offsets[-1]


class SourceDiagnostics:
    """Publishes every second how the messages of a rig's drivers arrive.

    ``further``: returns other statuses of the node, which are published in the same message.
    """

    def __init__(
        self, node: BenchNode, further: Callable[[], list[DiagnosticStatus]] = list
    ) -> None:
        self._node, self._further = node, further
        self._sources: dict[Topic, _Source] = {}
        self._groups: list[tuple[Topic, ...]] = []
        self._since = time.monotonic()
        self._diagnostics = Diagnostics(node)
        node.every(PERIOD, self._publish)

    def watch(self, *topics: Topic) -> None:
        """Report on these topics from now on, even before their first message.

        The topics are alternatives: a topic without publisher is omitted if another has one.
        """
        self._groups.append(topics)
        for topic in topics:
            self._sources.setdefault(topic, _Source())

    def add(self, topic: Topic, stamp: int | None = None, values: tuple[float, ...] = ()) -> None:
        """Note a message of a watched topic; ignore messages of other topics.

        ``stamp``: ns by any clock, None to count every message.  With a stamp, only new
        measurements count, see :meth:`SourceMonitor.add`.
        """
        source, now = self._sources.get(topic), time.monotonic()
        if source is None:
            return
        if stamp is not None:
            source.offsets.append(stamp * 1e-9 - now)
        if source.monitor.add(time.monotonic_ns() if stamp is None else stamp, values, now):
            source.arrivals.append(now)

    def is_fresh(self, topic: Topic) -> bool:
        """Return True if a watched topic's last measurement is recent enough for a release.

        The limit is the default of :attr:`TrialLimits.max_pose_age`.
        """
        return self._sources[topic].monitor.age(time.monotonic()) <= TrialLimits.max_pose_age

    def _publish(self) -> None:
        now = time.monotonic()
        clocks = {t: median(s.offsets) for t, s in self._sources.items() if s.offsets}
        middle = median(clocks.values()) if clocks else math.nan
        offsets = {topic: clock - middle for topic, clock in clocks.items()}
        statuses = []
        for group in self._groups:
            published = [topic for topic in group if self._node.nodes_that_publish(topic)]
            statuses += [self._status_of(topic, now, offsets) for topic in published or group[:1]]
        for source in self._sources.values():
            del source.arrivals[:-1]
            if source.offsets:
                source.quickest.append(max(source.offsets))
            source.offsets.clear()
        self._since = now
        self._diagnostics.publish(*statuses, *self._further())

    def _status_of(
        self, topic: Topic, now: float, offsets: Mapping[Topic, float]
    ) -> DiagnosticStatus:
        name = self._node.resolve_topic_name(topic.name)
        publishers = self._node.get_publishers_info_by_topic(name)
        age = self._sources[topic].monitor.age(now)
        intervals = np.diff(self._sources[topic].arrivals)
        rate = f"{len(intervals) / (now - self._since):.2f}"
        values: dict[str, object] = {"rate [Hz]": rate}
        if math.isfinite(age):
            values["age [s]"] = f"{age:.3f}"
        if len(intervals):
            values["jitter [s]"] = f"{np.std(intervals):.6f}"
        lag = self._sources[topic].lag
        if math.isfinite(lag):
            values["lag [s]"] = f"{lag:.3f}"
        if topic in offsets:
            values["clock offset [s]"] = f"{offsets[topic]:.4f}"
        for end in publishers:
            qos = end.qos_profile
            values[f"published by {full_name(end)}"] = (
                f"{qos.reliability.name}, {qos.durability.name}".lower().replace("_", " ")
            )
        level, text = Level.OK, f"{rate} Hz"
        on_roll = set(self._node.nodes_that_publish(ROLL))
        if not publishers:
            level, text = Level.ERROR, "no publisher"
        elif not self.is_fresh(topic) and on_roll.issuperset(map(full_name, publishers)):
            text = "no run is on"  # a simulator or player sends only in a run
        elif not self.is_fresh(topic):
            level = Level.WARN
            text = f"last message {age:.1f} s ago" if math.isfinite(age) else "no message"
        elif abs(offsets.get(topic, 0.0)) > MAX_OFFSET:
            level, text = Level.WARN, f"clock {offsets[topic]:+.3f} s from the other sources'"
        elif lag > MAX_LAG:
            level, text = Level.WARN, f"read {lag:.1f} s late: this node, or the driver, is busy"
        return DiagnosticStatus(name, level, text, values)
