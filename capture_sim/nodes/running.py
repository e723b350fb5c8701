"""What every node of the bench does: declare parameters, start, spin, end.

The main thread does the node's work, so that Ctrl-C reaches it at any moment; callbacks
run in a thread of their own.
"""

from __future__ import annotations

import array
import difflib
import importlib
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
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
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from capture_sim.errors import CaptureSimError
from capture_sim.interrupts import leave_if_busy
from capture_sim.messages.convert import Messages
from capture_sim.messages.telemetry import Sent
from capture_sim.messages.topics import Topic
from capture_sim.nodes.ending import ended_within
from capture_sim.nodes.usage import usage_of
from capture_sim.resources import config_dir

try:
    # a quarter of the plain executor's cost per message, but not in every rclpy
    from rclpy.experimental import EventsExecutor
except ImportError:
    EventsExecutor = SingleThreadedExecutor

RCLError = rclpy_implementation.RCLError

#: Exit statuses.
OK, FAILED, REFUSED = 0, 1, 2

#: Names of the threads that run callbacks and services.
CALLBACKS, SERVICES = "callbacks", "services"
#: Each of them ends within this long, on a busy machine too, and so does DDS, s (wall).
ENDING = 5
#: Where Fast DDS looks for a profile.
_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
#: A last message is given this long to arrive, s (wall).
LINGER = 0.3

#: Parameters that every ROS 2 node has, or that files for several nodes may carry.
_COMMON_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides")


class ParameterError(CaptureSimError):
    """A parameter of a node is not usable; the message says what is allowed."""


def message_class(type_name: str) -> Any:
    """Return the class of a message type given as ``package/msg/Name``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def qos_of(topic: Topic, *, latecomer: bool = True) -> QoSProfile:
    """Return the quality of service of a topic: reliable, the rest as its table entry says.

    A topic with a lease is one whose publisher must not vanish unnoticed: DDS renews the
    lease while the process lives, also when there is nothing to send, and tells the
    subscribers when it runs out.  Without a lease that takes 20 s.

    Parameters
    ----------
    topic
        Of the table.
    latecomer
        Whether a subscriber wants what is kept of a latched topic from before it came.
    """
    profile = QoSProfile(
        depth=topic.depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=(
            DurabilityPolicy.TRANSIENT_LOCAL
            if topic.latched and latecomer
            else DurabilityPolicy.VOLATILE
        ),
    )
    if topic.lease is not None:
        profile.liveliness = LivelinessPolicy.AUTOMATIC
        profile.liveliness_lease_duration = Duration(seconds=topic.lease)
    return profile


class BenchNode(Node):
    """A node of the bench: parameters with range and unit, publishers by topic."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.messages = Messages(message_class, serialize_message, sequence=array.array)
        self.failure: Exception | None = None  # that ended the callbacks
        self._senders: dict[Topic, Any] = {}
        self._checks: dict[str, Callable[[Any], None]] = {}
        self.add_on_set_parameters_callback(self._check_parameters)

    def work(self) -> int:
        """Do the node's work in the main thread; return the exit status."""
        raise NotImplementedError

    def farewell(self) -> None:
        """Wait after Ctrl-C for what is on its way; callbacks still run, no signal comes."""

    def interrupted(self) -> None:
        """End in order after Ctrl-C; no callback runs any more, sending still works."""

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
    ) -> Any:
        """Declare a parameter and return its value.

        Parameters
        ----------
        name, default, description
            The description says the unit.  A default that is a type, as ``list``, means a
            list of texts that is empty unless given.
        low, high
            Bounds of a number, both or neither.
        read_only
            Whether the value is fixed from the start.
        allowed
            In words, where bounds do not say it.
        check
            Called with the value, now and before every change; raises CaptureSimError if it
            is not usable.

        Raises
        ------
        ParameterError
            One line that says what is allowed.
        """
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        allowed = allowed or ("a list of texts" if default is list else _kind(default))
        if low is not None and high is not None:
            if isinstance(default, float):
                span = FloatingPointRange(from_value=float(low), to_value=float(high))
                descriptor.floating_point_range = [span]
            else:
                span = IntegerRange(from_value=int(low), to_value=int(high))
                descriptor.integer_range = [span]
            allowed += f" from {low:g} to {high:g}"
        descriptor.additional_constraints = allowed
        try:
            if default is list:
                # an empty list has no type in ROS: declared by type, and unset when empty
                self.declare_parameter(name, Parameter.Type.STRING_ARRAY, descriptor)
                value = list(self.get_parameter_or(name).value or ())
            else:
                value = self.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException):
            value = None
        if value is None:
            given = self._parameter_overrides[name].value
            shown = "[]" if given is None else repr(given)  # ROS has no empty list
            raise ParameterError(
                f"parameter {name} = {shown}: allowed is {allowed} ({description})"
            )
        if check is not None:
            check(value)
            self._checks[name] = check
        return value

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            check = self._checks.get(parameter.name)
            try:
                if check is not None:
                    check(parameter.value)
            except CaptureSimError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def warn_of_unknown_parameters(self) -> None:
        """Warn of parameters that were given and never declared: mistyped, most likely."""
        for name in self._parameter_overrides:
            if self.has_parameter(name) or name.split(".")[0] in _COMMON_PARAMETERS:
                continue
            near = difflib.get_close_matches(name, self._parameters, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            self.get_logger().warning(f"parameter {name} is unknown here and has no effect{hint}")

    def open(self, topics: Sequence[Topic]) -> None:
        """Make the publishers of these topics."""
        for topic in topics:
            kind = message_class(topic.type_name)
            self._senders[topic] = self.create_publisher(kind, self.placed(topic), qos_of(topic))

    def listen(
        self,
        topic: Topic,
        callback: Callable[[Any], None],
        *,
        latecomer: bool = True,
        **options: Any,
    ) -> None:
        """Subscribe to a topic; an error of ours in the callback ends the node in one line."""

        def take(message: Any) -> None:
            if self.failure is None:
                try:
                    callback(message)
                except CaptureSimError as error:
                    self.fail(error)

        kind = message_class(topic.type_name)
        qos = qos_of(topic, latecomer=latecomer)
        self.create_subscription(kind, self.placed(topic), take, qos, **options)

    def placed(self, topic: Topic) -> str:
        """Return a topic's name for this node: in a namespace the clock, too, is its own."""
        return topic.name if self.get_namespace() == "/" else topic.name.lstrip("/")

    def fail(self, error: Exception) -> None:
        """Let the main thread end the node because of an error in a callback."""
        self.failure = error
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    def send(self, topic: Topic, message: Any) -> None:
        """Publish a message on one of the open topics."""
        self._senders[topic].publish(message)

    def publish(self, sent: Sent) -> None:
        """Publish a serialised message on one of the open topics."""
        self._senders[sent.topic].publish(sent.data)

    def matched(self, topic: Topic) -> int:
        """Return how many subscribers an open topic has found."""
        return self._senders[topic].get_subscription_count()

    def linger(self, topic: Topic) -> None:
        """Give a last message time to arrive before the process ends, LINGER s at most.

        Only for an end without acknowledgement: DDS itself may take 3 s to know.
        """
        self._senders[topic].wait_for_all_acked(Duration(seconds=LINGER))


def _kind(default: object) -> str:
    kinds = {float: "a number, with a decimal point", int: "a whole number", bool: "true or false"}
    return kinds.get(type(default), "a list of texts" if isinstance(default, list) else "a text")


class _Spinner:
    """Runs a node's callbacks in a thread of their own."""

    def __init__(self, node: BenchNode) -> None:
        self._node = node
        self._executor: Executor = EventsExecutor()
        self._executor.add_node(node)
        self._stop = Future()
        self._thread = threading.Thread(target=self._spin, name=CALLBACKS, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            # plain spin() of the events executor never runs a callback (rclpy 7.1.6)
            self._executor.spin_until_future_complete(self._stop, 1e9)
        except Exception as error:
            self._node.fail(error)

    def stop(self) -> None:
        """Let the callback that runs come to its end, and no other begin."""
        self._stop.set_result(None)
        deadline = time.monotonic() + ENDING
        # a thread that comes back from C++ when Python ends takes the process with it (SIGABRT)
        while self._thread.is_alive() and time.monotonic() < deadline:
            self._executor.wake()
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
    *,
    interrupted: int = OK,
    command: bool = False,
) -> int:
    """Make a node, do its work, end in order; return the process's exit status.

    Parameters
    ----------
    make
        Makes the node.
    args
        Command line; ``None`` for that of the process.
    interrupted
        What Ctrl-C makes of the status: to stop a node is its ordinary end.
    command
        Whether it runs inside a command, which says itself what is wrong.

    Returns
    -------
    int
        0 done; ``interrupted`` when ended by Ctrl-C; 1 failed; 2 refused: a parameter or the
        scene is wrong.

    Raises
    ------
    CaptureSimError
        A parameter is wrong, inside a command.
    """
    if {"-h", "--help"} & set(sys.argv[1:] if args is None else args):
        print(usage_of(make), flush=True)
        return OK
    # rclpy's own handlers shut DDS down at once; ours leaves time to say good-bye
    _Interrupt().install()
    try:
        # a supervisor blocks it until here, where it can no longer hit an import
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
        if not any(name in os.environ for name in _PROFILES):
            os.environ[_PROFILES[0]] = str(config_dir() / "fast_dds.xml")
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        try:
            status = _live(make, interrupted)
        finally:
            rclpy.try_shutdown()
        leave_if_busy(status, CALLBACKS, SERVICES)
        return status
    except CaptureSimError as error:
        if command:
            raise
        return _refuse(str(error))
    except RCLError as error:
        return _refuse(str(error).splitlines()[0])
    except KeyboardInterrupt:
        leave_if_busy(interrupted, CALLBACKS, SERVICES)
        return interrupted
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _refuse(reason: str) -> int:
    print(f"error: {reason}", file=sys.stderr, flush=True)
    return REFUSED


def _live(make: Callable[[], BenchNode], when_interrupted: int) -> int:
    node = make()
    log = node.get_logger()
    callbacks = None
    status = FAILED
    interrupted = False
    try:
        node.warn_of_unknown_parameters()
        callbacks = _Spinner(node)
        status = node.work()
    except KeyboardInterrupt:
        interrupted = True
        status = when_interrupted
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
        with ended_within(ENDING, status):
            node.destroy_node()
    return status


def _one_line(error: Exception) -> str:
    if isinstance(error, CaptureSimError):
        return str(error)
    return f"stopped by {type(error).__name__}: {error}"
