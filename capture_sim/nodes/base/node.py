"""The base class of all nodes: one thread, callbacks run only inside :meth:`BenchNode.wait`."""

from __future__ import annotations

import gc
import math
import struct
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, ClassVar

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy

from capture_sim.base.exit_status import OK
from capture_sim.base.interrupts import STOP
from capture_sim.errors import CaptureSimError, MessageError, one_line
from capture_sim.messages.convert import Messages
from capture_sim.messages.telemetry import Sent
from capture_sim.messages.topics import Rate, Topic
from capture_sim.nodes.base.endpoints import from_bytes, full_name, is_own, message_class, qos_of
from capture_sim.nodes.base.parameters import ParameterNode
from capture_sim.nodes.base.publishers import Publishers

try:
    # needs a fortieth of the plain executor's CPU time per message; not in every rclpy
    from rclpy.experimental import EventsExecutor
except ImportError:
    EventsExecutor = SingleThreadedExecutor

#: Minimum queue depth of a subscription, in messages that wait for their callback.  Topics of
#: :attr:`Rate.CONTROL` are excepted.
MIN_DEPTH = 100
#: Maximum time between two checks of a wait's condition and of Ctrl-C, s (wall).
POLL = 0.1
#: Period of the look-up of publishers and readers of a rig's topics, s (wall).
LOOK_UP_PERIOD = 0.5
#: Exceptions that unexpected numbers, lists and bytes raise in a callback.
_ODD_CONTENTS = (ValueError, TypeError, LookupError, ArithmeticError, AssertionError, struct.error)


class BenchNode(ParameterNode):
    """A node with one thread, whose callbacks run only inside :meth:`wait` and :meth:`serve`.

    ``options``: arguments of :class:`rclpy.node.Node`.  ``end_request``: event that ends the node,
    by default the process's Ctrl-C.  ``exit_status``: exit status of the process after Ctrl-C.
    ``failure``: first error in a callback; the next wait raises it.
    """

    #: Returns the node of rclpy's default context, of which a process has at most one.
    _of_process: ClassVar[Callable[[], BenchNode | None]] = lambda: None

    def __init__(self, name: str, **options: Any) -> None:
        if options.get("context") is None:
            self._refuse_company(name)
        super().__init__(name, **options)
        self.created = time.monotonic()  # other nodes are discovered from here on
        self.messages = Messages()
        self.end_request: threading.Event = STOP
        self.exit_status = OK
        self.failure: Exception | None = None
        self.in_callback = False
        self.topic_publishers = Publishers(self)
        self.callback_executor: Executor | None = None
        self._interrupted = False
        self._rejections: Counter[Topic] = Counter()
        self._best_effort: list[Callable[[], None]] = []  # each replaces a subscription

    def _refuse_company(self, name: str) -> None:
        """Raise CaptureSimError if this process already has a node of the suite."""
        if (other := BenchNode._of_process()) is not None:
            raise CaptureSimError(
                f"{name}: this process has the node {other.get_name()}: must be one node of "
                "capture_sim a process; start each by its program"
            )
        BenchNode._of_process = weakref.ref(self)

    @property
    def executor(self) -> Any:
        """The executor that serves this node; only the node's own executor may."""
        return super().executor

    @executor.setter
    def executor(self, executor: Any) -> None:
        if executor is not None and getattr(self, "callback_executor", None) is None:
            raise CaptureSimError(
                f"{self.get_name()}: serves itself in one thread, and runs in no other executor: "
                "start its program, or call its work()"
            )
        super(BenchNode, type(self)).executor.fset(self, executor)

    def work(self) -> int:
        """Do the node's work; return the exit status."""
        raise NotImplementedError

    # waiting: callbacks run only here

    def wait(self, until: Callable[[], bool] | None = None, limit: float = math.inf) -> bool:
        """Run callbacks until ``until()`` is true or ``limit`` s (wall) have passed.

        Return True if ``until()`` is true.  The first wait after the request to end raises
        KeyboardInterrupt; later waits belong to the shutdown and do not raise it again.  A wait
        also raises an error that a callback has raised.
        """
        deadline = time.monotonic() + limit
        has_served = False  # a wait with limit 0 serves once
        while True:
            if self.failure is not None:
                raise self.failure
            if self.end_request.is_set() and not self._interrupted:
                self._interrupted = True
                raise KeyboardInterrupt
            if until is not None and until():
                return True
            left = deadline - time.monotonic()
            if left <= 0.0 and has_served:
                return False
            self.serve(min(max(left, 0.0), POLL))
            has_served = True

    def serve(self, limit: float = 0.0) -> None:
        """Run the callbacks of the first event within ``limit`` s (wall), if any."""
        if self.callback_executor is None:
            self.callback_executor = EventsExecutor(context=self.context)
            self.callback_executor.add_node(self)
        self.callback_executor.spin_once(limit)
        while self._best_effort:
            self._best_effort.pop()()

    def wake(self) -> None:
        """Let a wait check its condition at once; may be called from any thread."""
        executor = self.callback_executor
        if executor is not None:
            executor.create_task(lambda: None)

    def freeze_objects(self) -> None:
        """Exclude the objects that exist now from later garbage collections.

        A collection of all objects takes longer than a tick.  Call this method when a node starts
        its work.
        """
        gc.collect()
        gc.freeze()

    def close(self) -> None:
        """Remove the node from its executor, then leave the network."""
        if self.callback_executor is not None:
            self.callback_executor.remove_node(self)
            self.callback_executor.shutdown()
            self.callback_executor = None
        if BenchNode._of_process() is self:
            BenchNode._of_process = lambda: None
        self.destroy_node()

    def guarded(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a callback: an error in it is raised by the node's next :meth:`wait`."""

        @wraps(callback)
        def call(*arguments: Any) -> Any:
            self.in_callback = True
            try:
                return callback(*arguments)
            except Exception as error:
                self.failure = self.failure or error
                return arguments[-1] if arguments else None  # for a service: its response
            finally:
                self.in_callback = False

        return call

    # subscriptions and timers

    def listen(
        self,
        topic: Topic,
        callback: Callable[[Any], None],
        *,
        transient_local: bool | None = None,
        raw: bool = False,
        **options: Any,
    ) -> None:
        """Subscribe to a topic; ``raw``: the callback accepts a message's bytes.

        An unusable message is rejected with one log line, and the node continues.  An error that no
        message has caused ends the node.  The subscription to a rig's topic changes to best effort
        once a publisher offers no more.
        """

        def take(data: bytes) -> None:
            try:
                callback(data if raw else from_bytes(topic, data))
            except (MessageError, *_ODD_CONTENTS) as error:
                self.reject(topic, error)

        qos = qos_of(topic, transient_local=transient_local)
        if topic.rate is not Rate.CONTROL:  # a queue would only delay the newest message
            qos.depth = max(qos.depth, MIN_DEPTH)
        self._subscribe(topic, self.guarded(take), qos, **options)

    def _subscribe(self, topic: Topic, take: Any, qos: QoSProfile, **options: Any) -> None:
        if not is_own(topic) and qos.reliability is ReliabilityPolicy.RELIABLE:

            def adapt(_: Any) -> None:
                if remake not in self._best_effort and qos.reliability.name == "RELIABLE":
                    self._best_effort.append(remake)

            def remake() -> None:
                self.destroy_subscription(subscription)
                qos.reliability = ReliabilityPolicy.BEST_EFFORT
                self.get_logger().warning(
                    f"{self.resolve_topic_name(topic.name)}: read best effort, as it is published: "
                    "messages can be lost"
                )
                self._subscribe(topic, take, qos)

            watch = SubscriptionEventCallbacks(incompatible_qos=self.guarded(adapt))
            options.setdefault("event_callbacks", watch)
        subscription = self.create_subscription(
            message_class(topic.type_name),
            topic.name,
            take,
            qos,
            raw=True,  # otherwise rmw_fastrtps prints ten lines about bytes that are no message
            **options,
        )

    def every(self, period: float, callback: Callable[[], None]) -> None:
        """Call a function every ``period`` s (wall) while the node waits."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(period, self.guarded(callback), clock=steady)

    def reject(self, topic: Topic, error: Exception) -> None:
        """Log the first rejected message of a topic; count further rejected messages."""
        self._rejections[topic] += 1
        if self._rejections[topic] == 1:
            kind = "" if isinstance(error, MessageError) else f"{type(error).__name__}: "
            text = f"{topic.name}: rejected: {kind}{error}; further ones are counted"
            self.get_logger().error(one_line(text))

    def report_rejections(self) -> None:
        """Log how many messages of each topic were rejected, if more than one; reset the counts."""
        for topic, count in self._rejections.items():
            if count > 1:
                self.get_logger().warning(f"{topic.name}: {count} messages rejected")
        self._rejections.clear()

    # sending

    def open(self, topics: Sequence[Topic]) -> None:
        """Create the publishers of these topics."""
        self.topic_publishers.open(topics)

    def send(self, topic: Topic, data: Any) -> bool:
        """Publish a message; return True if it was sent, False if the node was asked to end.

        It waits while a reader's queue is full, see :meth:`Publishers.send`.
        """
        return self.topic_publishers.send(topic, data)

    def publish(self, *messages: Sent) -> None:
        """Publish the messages that a telemetry object has made."""
        for message in messages:
            self.topic_publishers.send(message.topic, message.data)

    # the graph

    def nodes_that_publish(self, topic: Topic) -> list[str]:
        """Return the full name of the node of each publisher of a topic."""
        ends = self.get_publishers_info_by_topic(self.resolve_topic_name(topic.name))
        return [full_name(end) for end in ends]


def named_end_error(error: Exception) -> str:
    """Return the log line of an error that ends a node."""
    kind = "" if isinstance(error, CaptureSimError) else f"stopped by {type(error).__name__}: "
    return one_line(f"{kind}{error}")
