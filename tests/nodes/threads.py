"""Nodes in threads of this process, each a DDS participant of its own, over real DDS.

Loading and compiling is spared, so a test takes one to two seconds.  Tests of signals, kills and
exit statuses need processes: see bench_processes.
"""

import gc
import sys
import threading
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib import import_module

from capture_sim.nodes.process import live
from tests.nodes.bench_client import (
    PATIENCE,
    Client,
    give_back,
    ros_arguments,
    statuses,
    take_participant,
    wait_until,
)

__all__ = ["Client", "Running", "statuses", "threads", "wait_until"]

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
#: rclpy allows one severity for each line of code that logs.
LOG = {
    "info": lambda logger, text: logger.info(text),
    "warning": lambda logger, text: logger.warning(text),
    "error": lambda logger, text: logger.error(text),
}


class Running:
    """A node in its thread; :attr:`node` is the node itself, to look at."""

    def __init__(self, name, parameters, change):
        self.name = name
        self.lines = []
        self._context = take_participant()
        make = getattr(import_module(f"capture_sim.nodes.{name}"), CLASSES[name])
        options = {"cli_args": ros_arguments(parameters), "use_global_arguments": False}
        try:
            self.node = make(context=self._context, **options)
        except BaseException:
            give_back(self._context)
            raise
        self.end_request = self.node.end_request = threading.Event()
        self._keep_lines()
        if change is not None:
            change(self.node)
        self._status = None
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def _keep_lines(self):
        """Keep what the node logs, beside logging it; what is throttled is logged once."""
        logger, lines, throttled = self.node.get_logger(), self.lines, set()

        def log(severity, text, **options):
            caller = sys._getframe(1)
            place = caller.f_code.co_filename, caller.f_lineno
            if place in throttled:
                return
            if options:
                throttled.add(place)
            lines.append(f"{severity}: {text}")
            LOG[severity](logger, text)

        class Kept:
            debug = logger.debug
            info, warning, error = (partial(log, severity) for severity in LOG)

        self.node.get_logger = Kept

    def _live(self):
        try:
            self._status = live(self.node)
        finally:
            for part in list(self.node.waitables):  # of an action: destroy_node leaves them
                getattr(part, "destroy", lambda: None)()
            self.node.close()
            give_back(self._context)

    @property
    def text(self):
        return "\n".join(self.lines)

    @property
    def is_alive(self):
        return self._thread.is_alive()

    def wait_for(self, words, since=0):
        """Wait until the node logs something, in the lines from ``since`` on."""
        wait_until(
            lambda: words in "\n".join(self.lines[since:]) or not self.is_alive,
            lambda: f"{self.name} never logged {words!r}:\n{self.text}",
        )
        assert words in "\n".join(self.lines[since:]), f"{self.name} has ended:\n{self.text}"

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
        with ExitStack() as stack:  # all of them, though one fails
            stack.callback(gc.collect)
            stack.callback(gc.unfreeze)  # nodes freeze what is there when they begin
            stack.callback(started.clear)
            for running in started:
                stack.callback(running.status)
