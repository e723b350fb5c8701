"""The publishers of a node: no message is lost as long as its readers read."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from rcl_interfaces.srv import ListParameters
from rclpy.duration import Duration
from rclpy.qos import QoSProfile

from capture_sim.errors import CaptureSimError
from capture_sim.messages.topics import Topic
from capture_sim.nodes.base.endpoints import (
    DISCOVERY_TIME,
    TRANSIT_TIME,
    full_name,
    message_class,
    qos_of,
    qos_problem,
)

#: Text of rclpy's error when a reader's queue is full; any other error is a failure.
FULL_QUEUE = "cannot publish data"
#: Number of messages that DDS keeps for a dropped reader.
DROPPED_DEPTH = 1000
#: Maximum rate of a topic after a reader was dropped, Hz, so that the other readers lose nothing.
DROPPED_RATE = 4000.0
#: A new publisher waits this long for the readers of the publisher that it replaces, s (wall).
MATCHING_TIMEOUT = 1.0
#: Number of requests that check whether a node responds: the response to a newly discovered client
#: may be lost.
ASKED = 4
#: Polling period of queues and acknowledgements, s (wall).
_POLL = 0.001


class Publishers:
    """The publishers of a node, by topic.

    ``reader_timeout``: time after which a reader that reads nothing is dropped, s (wall), see
    :meth:`send`.  ``dropped``: full names of the nodes whose readers have been dropped.
    """

    def __init__(self, node: Any) -> None:
        self.reader_timeout = 15.0
        self.dropped: list[str] = []
        self._node = node
        self._senders: dict[Topic, Any] = {}
        self._next_due: dict[Topic, float] = {}  # s (wall), of topics limited to DROPPED_RATE

    @property
    def topics(self) -> list[Topic]:
        """The topics that have a publisher."""
        return list(self._senders)

    def open(self, topics: Sequence[Topic]) -> None:
        """Create the publishers of these topics."""
        for topic in topics:
            self._senders[topic] = self._node.create_publisher(
                message_class(topic.type_name), topic.name, qos_of(topic)
            )

    def send(self, topic: Topic, message: Any) -> bool:
        """Publish a message on an open topic; wait while a reader's queue is full.

        A reader that has read nothing for ``reader_timeout`` is dropped: DDS then keeps the last
        :data:`DROPPED_DEPTH` messages for it.  Return True if the message was sent, False if the
        node was asked to end while waiting.  CaptureSimError if the message cannot be published.
        """
        if topic in self._next_due:
            now = time.monotonic()
            time.sleep(max(0.0, self._next_due[topic] - now))
            self._next_due[topic] = max(self._next_due[topic], now) + 1.0 / DROPPED_RATE
        if self._try(topic, message):
            return True
        deadline = time.monotonic() + self.reader_timeout
        while not self._node.end_request.is_set():
            self._pause(_POLL)
            if self._try(topic, message):
                return True
            if time.monotonic() > deadline:
                self._drop_stalled(topic)
                deadline = math.inf
        return False

    def matched(self, topic: Topic) -> int:
        """Return the number of subscriptions that are matched with an open topic's publisher."""
        return int(self._senders[topic].get_subscription_count())

    def readers(self, topic: Topic) -> list[str]:
        """Return the full name of the node of each subscription compatible with an open topic."""
        offered = self._senders[topic].qos_profile
        name = self._node.resolve_topic_name(topic.name)
        return [
            full_name(reader)
            for reader in self._node.get_subscriptions_info_by_topic(name)
            if not qos_problem(offered, reader.qos_profile)
        ]

    def drain(self, limit: float) -> list[Topic]:
        """Wait until all sent messages have been acknowledged, at most ``limit`` s (wall).

        Return the topics with unacknowledged messages.  After the request to end, the wait lasts at
        most :data:`TRANSIT_TIME`.
        """
        deadline = time.monotonic() + limit
        left = dict(self._senders)
        while True:
            # in short slices, because rclpy holds the GIL while it waits
            slice_ = Duration(nanoseconds=200_000)
            left = {topic: s for topic, s in left.items() if not s.wait_for_all_acked(slice_)}
            now = time.monotonic()
            if self._node.end_request.is_set():
                deadline = min(deadline, now + TRANSIT_TIME)
            if not left or now > deadline:
                return list(left)
            time.sleep(_POLL)

    def report_stalled(self, topic: Topic) -> None:
        """Log the nodes that have not read a topic for too long, and add them to ``dropped``."""
        own = self._node.get_fully_qualified_name()
        names = sorted({*self.readers(topic)} - {own})
        if not self._node.in_callback:
            names = self._unresponsive(names) or names
        self.dropped += names
        self._node.get_logger().error(
            f"{', '.join(names)}: no message read from {topic.name} for {self.reader_timeout:g} s "
            "(reader_timeout); continuing without it"
        )

    def _try(self, topic: Topic, message: Any) -> bool:
        try:
            self._senders[topic].publish(message)
        except RuntimeError as error:  # rclpy's RCLError
            if FULL_QUEUE in str(error):
                return False
            raise CaptureSimError(f"{topic.name}: cannot be published: {error}") from None
        return True

    def _pause(self, seconds: float) -> None:
        """Wait; run callbacks meanwhile, unless called from a callback."""
        if self._node.in_callback:
            time.sleep(seconds)
        else:
            self._node.wait(limit=seconds)

    def _unresponsive(self, names: Sequence[str]) -> list[str]:
        """Return the nodes that do not respond to a request for their parameters.

        A node without parameter services, such as a listener of `ros2 topic`, is not returned.
        """
        kind = ListParameters
        clients = {n: self._node.create_client(kind, f"{n}/list_parameters") for n in names}
        answers: dict[str, list[Any]] = {name: [] for name in names}
        for _ in range(ASKED):
            self._node.wait(limit=DISCOVERY_TIME)
            for name, client in clients.items():
                if client.service_is_ready():
                    answers[name].append(client.call_async(kind.Request()))
        self._node.wait(limit=DISCOVERY_TIME)
        for client in clients.values():
            self._node.destroy_client(client)
        return [n for n, sent in answers.items() if sent and not any(a.done() for a in sent)]

    def _drop_stalled(self, topic: Topic) -> None:
        """Replace the publishers by publishers that do not wait for a reader.

        Publishers of transient-local topics are not replaced.  The replaced publishers continue to
        exist, because other readers may still receive the messages that they keep.
        """
        self.report_stalled(topic)
        for stream, sender in list(self._senders.items()):
            if not stream.transient_local:
                fresh = self._node.create_publisher(
                    message_class(stream.type_name), stream.name, QoSProfile(depth=DROPPED_DEPTH)
                )
                self._senders[stream], self._next_due[stream] = fresh, 0.0
                deadline = time.monotonic() + MATCHING_TIMEOUT
                readers = sender.get_subscription_count()
                while fresh.get_subscription_count() < readers and time.monotonic() < deadline:
                    time.sleep(_POLL)
