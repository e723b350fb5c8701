"""Nodes in processes of their own: for signals, kills and exit statuses, and for benchmarks."""

import signal
import subprocess
import sys
import textwrap
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field

from tests.nodes.bench_client import (
    PATIENCE,
    Client,
    Simulation,
    ros_arguments,
    statuses,
    wait_until,
)

__all__ = ["Client", "Simulation", "Started", "fresh", "leave", "processes"]
__all__ += ["statuses", "wait_until"]

#: A node that is asked to end has ended by itself long before, s.
END_TIMEOUT = 30.0


@dataclass
class Started:
    """A node's process and what it prints."""

    process: subprocess.Popen
    lines: list = field(default_factory=list)

    def __post_init__(self):
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        self.lines.extend(iter(self.process.stdout.readline, ""))

    @property
    def text(self):
        return "".join(self.lines)

    def wait_for(self, words, since=0):
        """Wait until the node prints something, in the lines from ``since`` on."""
        wait_until(
            lambda: words in "".join(self.lines[since:]) or not self.reader.is_alive(),
            lambda: f"never printed {words!r}:\n{self.text}",
        )
        assert words in "".join(self.lines[since:]), f"has ended:\n{self.text}"

    def end(self):
        """End the node as Ctrl-C does and return its exit status."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        return self.status()

    def status(self):
        """Wait for the end and return the exit status."""
        status = self.process.wait(PATIENCE)
        self.reader.join(5.0)
        return status


def fresh(program, arguments):
    """Start Python with a program."""
    return subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@contextmanager
def processes(begin=fresh):
    """Give a function that starts a node: its name, Python code that changes it, parameters.

    ``begin`` starts a process of a program and its arguments.
    """
    started = []

    def start(name, change=None, **parameters):
        ends = {"exit_when_done": "true"} if name == "simulator" else {}
        arguments = ros_arguments(ends | parameters)
        program = f"from capture_sim.nodes import {name} as node\n{textwrap.dedent(change or '')}\n"
        program += "raise SystemExit(node.main())"
        started.append(Started(begin(program, arguments)))
        return started[-1]

    try:
        yield start
    finally:
        leave(started)


def leave(nodes):
    """End nodes that still run, stopped ones too, as Ctrl-C does.

    The other participants of the domain would keep killed ones for 6 s, and they find no more than
    32.
    """
    left = [node.process for node in nodes if node.process.poll() is None]
    for process in left:
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGCONT)
    for process in left:
        try:
            process.wait(END_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
