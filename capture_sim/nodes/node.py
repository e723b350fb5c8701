"""What every node of the bench does: declare parameters, publish, spin, end.

The main thread does the node's work, so that Ctrl-C reaches it at any moment; callbacks run in a
thread of their own.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import math
import os
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.duration import Duration
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    NameValidationException,
    ParameterException,
)
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
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
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from capture_sim.errors import CaptureSimError, MessageError, one_line
from capture_sim.interrupts import leave_if_busy
from capture_sim.messages.convert import Messages
from capture_sim.messages.telemetry import Sent
from capture_sim.messages.topics import Rate, Topic
from capture_sim.nodes import dds
from capture_sim.resources import config_dir

try:
    # a quarter of the plain executor's cost per message; runs no coroutine, and not in every rclpy
    from rclpy.experimental import EventsExecutor
except ImportError:
    EventsExecutor = SingleThreadedExecutor

#: Exit statuses.
OK, FAILED, REFUSED = 0, 1, 2
#: Of what is latched a subscriber keeps so many until they are taken, however few are sent again.
UNTAKEN = 100
#: Last messages are given this long to arrive before a node ends, s (wall).
LINGER = 0.3
#: A latched message waits this long for what was sent before it, s (wall).
IN_ORDER = 1.0
#: Of messages of a topic that are refused one is named in so many s (wall), the others counted.
REFUSING = 5.0
#: What numbers, lists and bytes raise in a callback that no one had in mind.
_ODD_CONTENTS = (ValueError, TypeError, LookupError, ArithmeticError, AssertionError, struct.error)
#: Parameters that every ROS 2 node has, or that files for several nodes may carry.
_COMMON_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides")
_TYPES = {list: Parameter.Type.STRING_ARRAY, float: Parameter.Type.DOUBLE}
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class ParameterError(CaptureSimError):
    """A parameter of a node is not usable; the message says what is allowed."""


@cache
def message_class(type_name: str) -> Any:
    """Return the class of a message type given as ``package/msg/Name``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def qos_of(topic: Topic, *, latched: bool | None = None) -> QoSProfile:
    """Return the quality of service of a topic: reliable; a stream keeps all until it is read.

    Parameters
    ----------
    topic
        Of the table.
    latched
        Whether a subscriber wants what is kept of a latched topic; as the topic is unless given.
    """
    latched = topic.latched if latched is None else latched
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST if topic.latched and latched else HistoryPolicy.KEEP_ALL,
        depth=topic.depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class BenchNode(Node):
    """A node of the bench: parameters with range and unit, publishers by topic.

    Attributes
    ----------
    has_coroutines : bool
        Whether some callbacks are coroutines.
    """

    has_coroutines = False

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.messages = Messages()
        self.failure: Exception | None = None  # that ended the callbacks
        self.reader_timeout = 10.0  # s (wall), then a reader that takes nothing is left behind
        self.left_behind: list[str] = []  # nodes whose reading stood still
        self._senders: dict[Topic, Any] = {}
        self._retired: list[Any] = []
        self._latches: dict[Topic, Any] = {}  # of streams whose last state is kept
        self._refused: dict[Topic, tuple[float, int]] = {}  # when last said, and how many since
        self._checks: dict[str, Callable[[Any], None]] = {}
        # declared automatically, one given as [] would end rclpy with a ValueError (7.1)
        self._given = {
            given: parameter.value
            for given, parameter in self._parameter_overrides.items()
            if given.split(".")[0] not in _COMMON_PARAMETERS
        }
        self._renamed: dict[str, str] = {}
        self.add_pre_set_parameters_callback(self._with_current_names)
        self.add_on_set_parameters_callback(self._check_parameters)

    def work(self) -> int:
        """Do the node's work in the main thread; return the exit status."""
        raise NotImplementedError

    def farewell(self) -> None:
        """Wait after Ctrl-C for what is on its way; callbacks still run, no signal comes."""

    def interrupted(self) -> None:
        """End in order after Ctrl-C; no callback runs any more, sending still works."""

    # parameters

    def declare(
        self,
        name: str,
        default: Any,
        description: str,
        *,
        low: float | None = None,
        high: float | None = None,
        read_only: bool = True,
        allowed: str = "",
        check: Callable[[Any], None] | None = None,
        formerly: str = "",
    ) -> Any:
        """Declare a parameter and return its value.

        Parameters
        ----------
        name, default, description
            The description says the unit.  A default that is a type: ``list`` for texts, none
            unless given, ``float`` for a number, None unless given.  [] is refused.
        low, high
            Bounds of a number, both or neither.
        read_only
            Whether the value is fixed from the start.
        allowed
            In words, where bounds do not say it.
        check
            Called with the value, now and before every change; raises CaptureSimError if it
            is not usable.
        formerly
            The parameter's earlier name, by which it is still taken.

        Raises
        ------
        ParameterError
            One line that says what is allowed.
        """
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        allowed = allowed or _kind(default)
        if low is not None and high is not None:
            if isinstance(default, float):
                span = FloatingPointRange(from_value=float(low), to_value=float(high))
                descriptor.floating_point_range = [span]
            else:
                span = IntegerRange(from_value=int(low), to_value=int(high))
                descriptor.integer_range = [span]
            allowed += f" from {low:g} to {high:g}"
        descriptor.additional_constraints = allowed
        if formerly:
            self._rename(formerly, name)
        given = self._given.pop(name, default)
        wrong = given is None or (isinstance(given, list) and not all(given))  # rclpy: [] is None
        value: Any = None
        try:
            if isinstance(default, type):
                # an empty list has no type in ROS: declared by type, and unset when empty
                self.declare_parameter(name, _TYPES[default], descriptor)
                value = self.get_parameter_or(name).value
                if default is list:
                    value = list(value or ())
            else:
                value = self.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException):
            wrong = True
        if wrong:
            shown = "[]" if given is None else repr(given)
            raise ParameterError(
                f"parameter {name} = {shown}: allowed is {allowed} ({description})"
            )
        if check is not None:
            if value is not None:
                check(value)
            self._checks[name] = check
        return value

    def _rename(self, formerly: str, name: str) -> None:
        """Take a parameter by its earlier name, at the start and later."""
        self._renamed[formerly] = name
        if formerly in self._given:
            value = self._given.pop(formerly)
            self._given.setdefault(self._current_name(formerly), value)
            self._parameter_overrides.setdefault(name, Parameter(name, value=value))

    def _with_current_names(self, parameters: list[Parameter]) -> list[Parameter]:
        return [Parameter(self._current_name(p.name), p.type_, p.value) for p in parameters]

    def _current_name(self, name: str) -> str:
        if name in self._renamed:
            self.get_logger().warning(f"parameter {name} is now called {self._renamed[name]}")
        return self._renamed.get(name, name)

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            check = self._checks.get(parameter.name)
            try:
                if check is not None and parameter.value is not None:
                    check(parameter.value)
            except CaptureSimError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def warn_of_unknown_parameters(self) -> None:
        """Warn of parameters that were given and never declared: mistyped, most likely."""
        declared = self.list_parameters([], 0).names
        for name in self._given:
            near = difflib.get_close_matches(name, declared, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            self.get_logger().warning(f"parameter {name} is unknown here and has no effect{hint}")

    # topics

    def open(self, topics: Sequence[Topic]) -> None:
        """Make the publishers of these topics."""
        for topic in topics:
            kind = message_class(topic.type_name)
            stream = topic.latched and topic.rate is Rate.PERIODIC
            self._senders[topic] = self.create_publisher(
                kind,
                topic.name,
                qos_of(topic, latched=False if stream else None),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            if stream:
                self._latches[topic] = self.create_publisher(kind, topic.name, _LATCHED)

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
        qos.depth = max(qos.depth, UNTAKEN)
        self.create_subscription(
            message_class(topic.type_name),
            topic.name,
            take,
            qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            raw=True,  # rmw_fastrtps prints ten lines about bytes that are no message
            **options,
        )

    def refuse(self, topic: Topic, error: Exception) -> None:
        """Say that a message is refused, at most once in :data:`REFUSING` s of each topic."""
        kind = "" if isinstance(error, MessageError) else f"{type(error).__name__}: "
        said, more = self._refused.get(topic, (-math.inf, 0))
        now = time.monotonic()
        if now - said < REFUSING:
            self._refused[topic] = said, more + 1
            return
        self._refused[topic] = now, 0
        unsaid = f" ({more} more before it)" if more else ""
        self.get_logger().error(one_line(f"{topic.name}: refused: {kind}{error}{unsaid}"))

    def fail(self, error: Exception) -> None:
        """Let the main thread end the node because of an error in a callback."""
        self.failure = error
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    def send(self, topic: Topic, message: Any, *, latch: bool = False) -> None:
        """Publish a message on one of the open topics; wait while a reader's queue is full.

        Parameters
        ----------
        topic, message
            What is sent.
        latch
            Whether subscribers that come later get this message of a stream too.
        """
        if latch and topic in self._latches:
            # in order with the stream, which another publisher sends
            acknowledged(self._senders[topic], IN_ORDER)
            self._latches[topic].publish(message)
            acknowledged(self._latches[topic], IN_ORDER)
            return
        try:
            self._senders[topic].publish(message)
        except RuntimeError:  # rclpy's RCLError: the history is full of what a reader has not taken
            self._send_when_read(topic, message)

    def publish(self, sent: Sent, *, latch: bool = False) -> None:
        """Publish what a telemetry has made."""
        self.send(sent.topic, sent.data, latch=latch)

    def _send_when_read(self, topic: Topic, message: Any) -> None:
        deadline = time.monotonic() + self.reader_timeout
        while True:
            time.sleep(0.002)
            try:
                self._senders[topic].publish(message)
            except RuntimeError:
                if time.monotonic() > deadline:
                    self._leave_behind(topic)
                    deadline = math.inf
            else:
                return

    def _leave_behind(self, topic: Topic) -> None:
        """Send to all but who stands still: DDS then keeps no more than 1000 messages."""
        names = self.standing_still(topic)
        self.left_behind += names
        self.get_logger().error(
            f"{', '.join(names)}: has read nothing of {topic.name} for {self.reader_timeout:g} s "
            "and is left behind"
        )
        for stream, sender in list(self._senders.items()):
            if not stream.latched:
                readers = sender.get_subscription_count()
                self._retired.append(sender)  # others may still be sent what it keeps
                kind = message_class(stream.type_name)
                fresh = self.create_publisher(kind, stream.name, QoSProfile(depth=1000))
                self._senders[stream] = fresh
                deadline = time.monotonic() + IN_ORDER
                while fresh.get_subscription_count() < readers and time.monotonic() < deadline:
                    time.sleep(0.001)

    def standing_still(self, topic: Topic) -> list[str]:
        """Return the nodes that may be those that take nothing of a topic."""
        return sorted({*self.readers(topic)} - {self.get_fully_qualified_name()})

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
        """Wait until all that was sent has arrived, ``limit`` s (wall) at most; tell whether."""
        deadline = time.monotonic() + limit
        senders = [self._senders[topic] for topic in topics] if topics else self._senders.values()
        return all(acknowledged(s, max(0.0, deadline - time.monotonic())) for s in senders)


def from_bytes(topic: Topic, data: bytes) -> Any:
    """Return the message of a topic that was taken raw.

    Raises
    ------
    MessageError
        The bytes are no such message.
    """
    try:
        return deserialize_message(data, message_class(topic.type_name))
    except RuntimeError:  # rclpy's RMWError, of several lines
        raise MessageError(f"{len(data)} bytes are no {topic.type_name}") from None


def full_name(end: Any) -> str:
    """Return the full name of the node that an end of a topic belongs to."""
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def acknowledged(publisher: Any, limit: float) -> bool:
    """Wait until all readers have what a publisher has sent, ``limit`` s at most; tell whether."""
    deadline = time.monotonic() + limit
    # in slices: rclpy holds Python's lock while it waits
    while not publisher.wait_for_all_acked(Duration(nanoseconds=200_000)):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.001)
    return True


def _kind(default: object) -> str:
    kinds = {
        float: "a number, with a decimal point",
        int: "a whole number",
        bool: "true or false",
        list: "a list of texts, one at least, none of them empty",
        str: "a text",
    }
    return kinds[default if isinstance(default, type) else type(default)]


class _Spinner:
    """Runs a node's callbacks in a thread of their own."""

    def __init__(self, node: BenchNode) -> None:
        self._node = node
        self._executor: Executor = (
            SingleThreadedExecutor() if node.has_coroutines else EventsExecutor()
        )
        self._executor.add_node(node)
        self._stop = Future()
        self._thread = threading.Thread(target=self._spin, name="callbacks", daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            if isinstance(self._executor, SingleThreadedExecutor):
                while not self._stop.done():
                    self._executor.spin_once()
            else:
                # plain spin() of the events executor never runs a callback (rclpy 7.1.6)
                self._executor.spin_until_future_complete(self._stop, 1e9)
        except Exception as error:
            self._node.fail(error)

    def stop(self) -> None:
        """Let the callback that runs come to its end, and no other begin."""
        self._stop.set_result(None)
        # a thread that comes back from C++ when Python ends takes the process with it (SIGABRT)
        while self._thread.is_alive():
            self._executor.create_task(lambda: None)  # wakes it
            self._thread.join(0.1)
        self._executor.shutdown()


class _Interrupt:
    """Ends the node's work by KeyboardInterrupt, once for signals that come together.

    Ctrl-C on a launch reaches a node twice, from the terminal and from `ros2 launch`; the second
    would tear the end that the first has begun, before that can ignore it.  Raised within a
    destructor it is lost, so it comes again until the node has taken it.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
    TOGETHER = 1.0  # s
    AGAIN = 1.2  # s

    def __init__(self) -> None:
        self._last = -math.inf

    def __call__(self, signum: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if now - self._last > self.TOGETHER:
            self._last = now
            signal.setitimer(signal.ITIMER_REAL, self.AGAIN)
            raise KeyboardInterrupt

    def install(self) -> None:
        """Take the signals from here on."""
        for signum in self.SIGNALS:
            signal.signal(signum, self)
        sys.unraisablehook = self._lost

    @classmethod
    def ignore(cls) -> None:
        """Let no signal tear what comes now."""
        for signum in cls.SIGNALS:
            signal.signal(signum, signal.SIG_IGN)
        signal.setitimer(signal.ITIMER_REAL, 0.0)

    @staticmethod
    def _lost(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            sys.__unraisablehook__(unraisable)


def run(
    make: Callable[[], BenchNode],
    args: Sequence[str] | None = None,
) -> int:
    """Make a node, do its work, end in order; return the process's exit status.

    Parameters
    ----------
    make
        Makes the node.
    args
        Command line; ``None`` for that of the process.

    Returns
    -------
    int
        0 done, or ended by Ctrl-C, which is a node's ordinary end; 1 failed; 2 refused: a
        parameter or the scene is wrong.
    """
    if {"-h", "--help"} & set(sys.argv[1:] if args is None else args):
        print(_usage(make), flush=True)
        return OK
    # rclpy's own handlers shut DDS down at once; ours leaves time to say good-bye
    _Interrupt().install()
    try:
        # held back until here, where it can no longer hit an import
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))
        hidden = dds.configure(os.environ)
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        try:
            status = _live(make, hidden)
        finally:
            rclpy.try_shutdown()
        leave_if_busy(status)  # compiling goes on behind a Ctrl-C
        return status
    except CaptureSimError as error:
        return _refuse(str(error))
    # arguments that rclpy cannot parse (RCLError), parameters of every node, names
    except (RuntimeError, ParameterException, NameValidationException) as error:
        return _refuse(str(error).splitlines()[0])
    except KeyboardInterrupt:
        leave_if_busy(OK)
        return OK
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _refuse(reason: str) -> int:
    print(f"error: {one_line(reason)}", file=sys.stderr, flush=True)
    return REFUSED


def _live(make: Callable[[], BenchNode], hidden: bool) -> int:
    node = make()
    log = node.get_logger()
    if hidden:
        log.info(f"seen on this machine only; {dds.RANGE}=SUBNET lets others take part")
    callbacks = None
    status = FAILED
    interrupted = False
    try:
        node.warn_of_unknown_parameters()
        callbacks = _Spinner(node)
        status = node.work()
    except KeyboardInterrupt:
        interrupted = True
        status = OK
    except CaptureSimError as error:
        log.error(str(error))
    finally:
        # the end is bounded in time: a second Ctrl-C would only tear it
        _Interrupt.ignore()
        if callbacks is not None:
            if interrupted and node.failure is None:
                node.farewell()
            callbacks.stop()
        if node.failure is not None:
            log.error(_one_line(node.failure))
            status = FAILED
        elif interrupted:
            node.interrupted()
        node.drain(LINGER)
        node.destroy_node()
    return status


def _one_line(error: Exception) -> str:
    kind = "" if isinstance(error, CaptureSimError) else f"stopped by {type(error).__name__}: "
    return one_line(f"{kind}{error}")


def _usage(make: Callable[..., object]) -> str:
    """Return how this process's node is called, what it does, and which parameters it has."""
    program = Path(sys.argv[0]).name
    name = Path(program).stem.removeprefix("capture-sim-").replace("-", "_")
    file = config_dir() / "nodes.yaml"
    sections = file.read_text(encoding="utf-8").split("\n/**/")
    lines = [
        f"usage: {program} [--ros-args -p NAME:=VALUE ... --params-file FILE -r NAME:=NAME ...]",
        "",
        inspect.getdoc(make) or "",
        "",
    ]
    for section in sections:
        if section.startswith(f"{name}:"):
            lines += [f"Parameters, as they are unless changed ({file}):", "", section.rstrip(), ""]
    lines.append(f"While it runs, `ros2 param describe /{name} PARAMETER` shows what is allowed.")
    return "\n".join(lines)
