"""The base of all nodes of the bench: publishers that lose nothing, and subscriptions."""

from __future__ import annotations

import importlib
import math
import signal
import struct
import threading
import time
from collections.abc import Callable, Collection, Sequence
from functools import cache
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message

from capture_sim.errors import CaptureSimError, MessageError, one_line
from capture_sim.interrupts import STOP
from capture_sim.messages.convert import Messages, RunDescription
from capture_sim.messages.telemetry import Sent
from capture_sim.messages.topics import CLOCK, RUN_INFO, STREAM_COUNTS, Rate, Topic
from capture_sim.nodes.parameters import ParameterNode

#: A subscriber of a latched topic keeps this many messages until its callback has run.
MIN_DEPTH = 100
#: A new publisher waits this long for the readers of the one it replaces, s (wall).
MATCHING_TIMEOUT = 1.0
#: Messages still on their way when the process is asked to end get this long to arrive, s (wall).
LAST_DRAIN = 0.5
#: Rejected messages of a topic are logged at most this often, s (wall); the others are counted.
REJECTION_PERIOD = 5.0
#: The last message, for those who come later.
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
#: What unexpected numbers, lists and bytes raise in a callback.
_ODD_CONTENTS = (ValueError, TypeError, LookupError, ArithmeticError, AssertionError, struct.error)


@cache
def message_class(type_name: str) -> Any:
    """Return the class of a message type given as ``package/msg/Name``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def qos_of(topic: Topic, *, latched: bool | None = None) -> QoSProfile:
    """Return the quality of service of a topic: reliable; a stream keeps all until it is read.

    ``latched``: whether a subscriber wants what a latched topic keeps; as the topic unless given.
    """
    latched = topic.latched if latched is None else latched
    keeps_last = (topic.latched and latched) or topic.rate is Rate.CONTROL
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST if keeps_last else HistoryPolicy.KEEP_ALL,
        depth=topic.depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def overridable(topic: Topic) -> QoSOverridingOptions | None:
    """Return which policies of a topic the user may set: those of what a rig's drivers publish.

    The bench's own topics are reliable, as what takes part in a run counts them.
    """
    own = topic is CLOCK or topic.type_name.startswith("capture_sim/")
    return None if own else QoSOverridingOptions.with_default_policies()


class BenchNode(ParameterNode):
    """A node of the bench: publishers by topic, which lose nothing, and subscriptions.

    ``has_coroutines``: some callbacks are coroutines.
    """

    has_coroutines = False

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.created = time.monotonic()  # other nodes are discovered from here on
        self.messages = Messages()
        self.failure: Exception | None = None  # that ended the callbacks
        self.reader_timeout = 10.0  # s (wall), then a reader that reads nothing is dropped
        self.dropped_readers: list[str] = []  # nodes that had stopped reading
        self._senders: dict[Topic, Any] = {}
        self._retired: list[Any] = []
        self._rejections: dict[Topic, tuple[float, int]] = {}  # last log (s), messages since

    def work(self) -> int:
        """Do the node's work in the main thread; return the exit status."""
        raise NotImplementedError

    def await_run_end(self) -> None:
        """Wait after Ctrl-C for messages that are on their way; callbacks still run."""

    def interrupted(self) -> None:
        """End the run after Ctrl-C; no callback runs any more, sending still works."""

    def readers_changed(self) -> None:
        """Take note that readers of an open topic have come or gone."""

    # topics

    def open(self, topics: Sequence[Topic]) -> None:
        """Make the publishers of these topics."""
        for topic in topics:
            self._senders[topic] = self.create_publisher(
                message_class(topic.type_name),
                topic.name,
                qos_of(topic),
                qos_overriding_options=overridable(topic),
                event_callbacks=PublisherEventCallbacks(
                    matched=lambda event: self.readers_changed()
                ),
            )

    def listen(
        self,
        topic: Topic,
        callback: Callable[[Any], None],
        *,
        latched: bool | None = None,
        raw: bool = False,
        **options: Any,
    ) -> None:
        """Subscribe to a topic; ``raw``: the callback takes a message's bytes.

        A message that cannot be used is refused in one line, and the node goes on; an error
        that is no message's fault ends it.
        """

        def take(data: bytes) -> None:
            try:
                if self.failure is None:
                    callback(data if raw else from_bytes(topic, data))
            except (MessageError, *_ODD_CONTENTS) as error:
                self.refuse(topic, error)
            except CaptureSimError as error:
                self.fail(error)

        qos = qos_of(topic, latched=latched)
        if topic.rate is not Rate.CONTROL:  # a queue would only delay the newest message
            qos.depth = max(qos.depth, MIN_DEPTH)
        self.create_subscription(
            message_class(topic.type_name),
            topic.name,
            take,
            qos,
            qos_overriding_options=overridable(topic),
            raw=True,  # rmw_fastrtps prints ten lines about bytes that are no message
            **options,
        )

    def refuse(self, topic: Topic, error: Exception) -> None:
        """Log that a message is rejected, at most once in :data:`REJECTION_PERIOD` a topic."""
        kind = "" if isinstance(error, MessageError) else f"{type(error).__name__}: "
        last_logged, count = self._rejections.get(topic, (-math.inf, 0))
        now = time.monotonic()
        if now - last_logged < REJECTION_PERIOD:
            self._rejections[topic] = last_logged, count + 1
            return
        self._rejections[topic] = now, 0
        unlogged = f" ({count} more before it)" if count else ""
        self.get_logger().error(one_line(f"{topic.name}: refused: {kind}{error}{unlogged}"))

    def fail(self, error: Exception) -> None:
        """Let the main thread end the node because of an error in a callback."""
        self.failure = error
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    def send(self, topic: Topic, message: Any) -> bool:
        """Publish a message on one of the open topics; wait while a reader's queue is full.

        Return False if the process was asked to end meanwhile; the message is not sent then.
        """
        try:
            self._senders[topic].publish(message)
        except RuntimeError:  # rclpy's RCLError: the history is full of what a reader has not taken
            return self._send_when_read(topic, message)
        return True

    def publish(self, *messages: Sent) -> None:
        """Publish messages of a telemetry."""
        for message in messages:
            self.send(message.topic, message.data)

    def send_run_info(self, description: RunDescription) -> None:
        """Announce a run; one without ``run_id`` says that no run is on and which was the last."""
        self.send(RUN_INFO, self.messages.serialise(self.messages.run_info(description)))

    def _send_when_read(self, topic: Topic, message: Any) -> bool:
        deadline = time.monotonic() + self.reader_timeout
        while not STOP.wait(0.002):
            try:
                self._senders[topic].publish(message)
            except RuntimeError:
                if time.monotonic() > deadline:
                    self._drop_stalled_readers(topic)
                    deadline = math.inf
            else:
                return True
        return False

    def _drop_stalled_readers(self, topic: Topic) -> None:
        """Go on without the readers that do not read: DDS keeps the last 1000 messages for them."""
        self.dropped_readers += self.report_stalled_readers(topic)
        for stream, sender in list(self._senders.items()):
            if not stream.latched:
                readers = sender.get_subscription_count()
                self._retired.append(sender)  # others may still be sent what it keeps
                kind = message_class(stream.type_name)
                fresh = self.create_publisher(kind, stream.name, QoSProfile(depth=1000))
                self._senders[stream] = fresh
                deadline = time.monotonic() + MATCHING_TIMEOUT
                while fresh.get_subscription_count() < readers and time.monotonic() < deadline:
                    time.sleep(0.001)

    def report_stalled_readers(self, topic: Topic) -> list[str]:
        """Name the nodes that have not read a topic for too long; return them."""
        names = self.stalled_readers(topic)
        # those that take part report themselves what they lack; for the others nothing has failed
        log = self.get_logger().error if self.participants(names) else self.get_logger().warning
        log(
            f"{', '.join(names)}: no message read from {topic.name} for {self.reader_timeout:g} s "
            "(consumer_timeout); continuing without it"
        )
        return names

    def stalled_readers(self, topic: Topic) -> list[str]:
        """Return the nodes that may be those that do not read a topic."""
        return sorted({*self.readers(topic)} - {self.get_fully_qualified_name()})

    def participants(self, names: Collection[str]) -> list[str]:
        """Return those of these nodes that take part in runs: they report their counts."""
        counts = self.resolve_topic_name(STREAM_COUNTS.name)
        reporting = {full_name(end) for end in self.get_publishers_info_by_topic(counts)}
        return [name for name in names if name in reporting]

    def readers(self, topic: Topic) -> list[str]:
        """Return the full names of the nodes that an open topic serves, for each subscription."""
        offered = self._senders[topic].qos_profile
        return [
            full_name(reader)
            for reader in self.get_subscriptions_info_by_topic(self.resolve_topic_name(topic.name))
            if qos_check_compatible(offered, reader.qos_profile)[0] is not QoSCompatibility.ERROR
        ]

    def matched(self, topic: Topic) -> int:
        """Return how many subscribers an open topic has found."""
        return int(self._senders[topic].get_subscription_count())

    def publishers_of(self, topic: Topic) -> int:
        """Return how many publishers a topic has, those of this node among them."""
        return int(self.count_publishers(self.resolve_topic_name(topic.name)))

    def drain(self, limit: float, topics: Sequence[Topic] = ()) -> bool:
        """Wait until all that was sent has arrived, ``limit`` s (wall) at most; return whether."""
        deadline = time.monotonic() + limit
        senders = [self._senders[topic] for topic in topics] if topics else self._senders.values()
        return all(acknowledged(s, max(0.0, deadline - time.monotonic())) for s in senders)

    def unread(self) -> list[Topic]:
        """Return the topics of which not all that was sent has arrived."""
        return [topic for topic, sender in self._senders.items() if not acknowledged(sender, 0.0)]


def from_bytes(topic: Topic, data: bytes) -> Any:
    """Return the message of a topic that was taken raw; MessageError if the bytes are none."""
    try:
        return deserialize_message(data, message_class(topic.type_name))
    except RuntimeError:  # rclpy's RMWError, of several lines
        raise MessageError(f"{len(data)} bytes are not a {topic.type_name}") from None


def full_name(end: Any) -> str:
    """Return the full name of the node that an end of a topic belongs to."""
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def acknowledged(publisher: Any, limit: float) -> bool:
    """Wait until all readers have what a publisher has sent; return whether they have.

    Wait ``limit`` s (wall) at most, and :data:`LAST_DRAIN` once the process was asked to end.
    """
    deadline = time.monotonic() + limit
    shutdown_deadline = math.inf
    # in slices: rclpy holds Python's lock while it waits
    while not publisher.wait_for_all_acked(Duration(nanoseconds=200_000)):
        now = time.monotonic()
        if STOP.is_set():
            shutdown_deadline = min(shutdown_deadline, now + LAST_DRAIN)
        if now > min(deadline, shutdown_deadline):
            return False
        time.sleep(0.001)
    return True
