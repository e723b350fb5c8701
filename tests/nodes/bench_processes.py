"""Nodes as users run them, a process each."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.nodes.bench_client import Client, Simulation, ros_arguments, statuses, wait_until

__all__ = ["Client", "Simulation", "Started", "fresh", "leave", "processes"]
__all__ += ["statuses", "wait_until"]

#: A node that is asked to end has ended by itself long before, s.
END_TIMEOUT = 30.0
#: An idle node takes less processor time than this in the time of a wait, s.
WORK = 1.0


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

    @property
    def is_alive(self):
        return self.process.poll() is None

    def wait_for(self, words, since=0):
        """Wait until the node prints something, in the lines from ``since`` on."""
        wait_until(
            lambda: words in "".join(self.lines[since:]) or not self.reader.is_alive(),
            lambda: f"never printed {words!r}:\n{self.text}",
            self._progress,
        )
        assert words in "".join(self.lines[since:]), f"has ended:\n{self.text}"

    def end(self):
        """End the node as Ctrl-C does and return its exit status."""
        if self.is_alive:
            self.process.send_signal(signal.SIGINT)
        return self.status()

    def status(self):
        """Wait for the end and return the exit status."""
        wait_until(lambda: not self.is_alive, lambda: f"does not end:\n{self.text}", self._progress)
        self.reader.join(60.0)
        return self.process.returncode

    def _progress(self):
        """Return what changes while the node does something: its lines, its processor time."""
        try:
            stat = Path(f"/proc/{self.process.pid}/stat").read_text()
        except OSError:
            return len(self.lines), 0
        user, system = stat.rpartition(")")[2].split()[11:13]
        seconds = (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
        return len(self.lines), seconds // WORK


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

    The code has the node's module as ``node`` and those of :mod:`changes`.  ``begin`` starts a
    process of a program and its arguments.
    """
    started = []

    def start(name, change=None, **parameters):
        ends = {"exit_when_done": "true"} if name == "simulator" else {}
        arguments = ros_arguments(ends | parameters)
        program = f"from capture_sim.nodes import {name} as node\n"
        program += f"from tests.nodes import changes\n{textwrap.dedent(change)}\n" if change else ""
        program += "raise SystemExit(node.main())"
        started.append(Started(begin(program, arguments)))
        return started[-1]

    try:
        yield start
    finally:
        leave(started)


def leave(nodes):
    """End nodes that still run, stopped ones too, as Ctrl-C does.

    The other participants of the domain would keep killed ones for 12 s, and they find no more than
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
