"""Nodes in threads of this process, each a DDS participant of its own, over real DDS.

Loading and compiling is spared, so a test takes one to two seconds.  Tests of signals, kills and
exit statuses need processes: see bench_processes.
"""

import gc
import threading
import time
from contextlib import contextmanager, suppress
from importlib import import_module

import rclpy
from bench_processes import PATIENCE, Asking
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from capture_sim.nodes.endpoints import message_class, qos_of
from capture_sim.nodes.process import live

CLASSES = {
    "simulator": "SimulatorNode",
    "launcher": "LauncherNode",
    "capture_detector": "CaptureDetectorNode",
    "recorder": "RecorderNode",
    "player": "PlayerNode",
    "viewer": "ViewerNode",
    "contact_rig": "ContactRigNode",
    "loop_simulator": "LoopSimulatorNode",
}


def new_context():
    """Return a context, which is a DDS participant of its own once it has a node."""
    context = rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    return context


def wait_until(condition, what="waited in vain", timeout=PATIENCE):
    """Wait until a condition holds."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, what() if callable(what) else what
        time.sleep(0.002)


class Running:
    """A node in its thread; :attr:`node` is the node itself, to look at."""

    def __init__(self, name, parameters, change):
        arguments = ["--ros-args"]
        for key, value in parameters.items():
            is_remap = key.startswith("__") or "/" in key
            arguments += ["-r" if is_remap else "-p", f"{key}:={value}"]
        self.name = name
        self.lines = []
        self._context = new_context()
        make = getattr(import_module(f"capture_sim.nodes.{name}"), CLASSES[name])
        options = {"cli_args": arguments, "use_global_arguments": False}
        try:
            self.node = make(context=self._context, **options)
        except BaseException:
            rclpy.shutdown(context=self._context)
            raise
        self.end_request = self.node.end_request = threading.Event()
        self._keep_lines()
        if change is not None:
            change(self.node)
        self._status = None
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def _keep_lines(self):
        """Keep what the node logs, beside logging it."""
        logger, lines = self.node.get_logger(), self.lines

        class Kept:  # rclpy allows one severity for each line of code that logs
            def __getattr__(self, name):
                return getattr(logger, name)

            def info(self, text, **options):
                lines.append(f"info: {text}")
                logger.info(text, **options)

            def warning(self, text, **options):
                lines.append(f"warning: {text}")
                logger.warning(text, **options)

            def error(self, text, **options):
                lines.append(f"error: {text}")
                logger.error(text, **options)

        self.node.get_logger = Kept

    def _live(self):
        try:
            self._status = live(self.node)
        finally:
            self.node.close()
            with suppress(RuntimeError):
                rclpy.shutdown(context=self._context)

    @property
    def text(self):
        return "\n".join(self.lines)

    @property
    def is_alive(self):
        return self._thread.is_alive()

    def wait_for(self, words, since=0):
        """Wait until the node logs something, in the lines from ``since`` on."""
        wait_until(
            lambda: words in "\n".join(self.lines[since:]),
            lambda: f"{self.name} never logged {words!r}:\n{self.text}",
        )

    def status(self):
        """Wait for the node's end and return its exit status."""
        self._thread.join(PATIENCE)
        assert not self.is_alive, f"{self.name} does not end:\n{self.text}"
        return self._status

    def end(self):
        """Ask the node to end, as Ctrl-C does; return its exit status."""
        self.end_request.set()
        return self.status()


@contextmanager
def threads():
    """Give a function that starts a node: its name, a function that changes it, parameters."""
    started = []

    def start(name, change=None, **parameters):
        if name == "simulator":
            parameters = {"exit_when_done": "true", **parameters}
        started.append(Running(name, parameters, change))
        return started[-1]

    try:
        yield start
    finally:
        for running in started:
            running.end_request.set()
        for running in started:
            running.status()
        gc.collect()


def statuses(nodes, first="simulator"):
    """Wait for the end of one node, then end the others; return all exit statuses by name."""
    found = {first: nodes[first].status()}
    return found | {name: node.end() for name, node in nodes.items() if name != first}


class Client(Asking):
    """A plain node of this process that calls services, sets parameters and listens."""

    def __init__(self, name="experimenter", **options):
        self._context = new_context()
        self.node = rclpy.create_node(name, context=self._context, **options)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self):
        while not self._closing.is_set():
            self._executor.spin_once(timeout_sec=0.02)

    def __enter__(self):
        return self

    def stop(self):
        """Run no callback any more."""
        self._closing.set()
        self._thread.join()

    def __exit__(self, *error):
        self.stop()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def listen(self, topic, is_wanted=lambda message: True, qos=None):
        """Return a list that collects a topic's messages from now on, those that are wanted."""
        messages = []
        self.node.create_subscription(
            message_class(topic.type_name),
            topic.name,
            lambda message: messages.append(message) if is_wanted(message) else None,
            qos or qos_of(topic),
        )
        return messages
