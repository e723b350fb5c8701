"""Nodes forked from one process that has loaded all their imports and kernels.

That spares each 1 to 1.5 s of processor time.  It is a process of its own all the same, with DDS,
signals, memory and an end of its own.  How nodes load from nothing is for the tests that start
suites, replays and commands.

rclpy's wheels load LTTng-UST, whose two threads a fork does not inherit.  At the fork's exit it
cancels them all the same: a segmentation fault where their stacks have been unmapped (once in about
40 forks).  So it is told of each fork, as its manual wants, and starts its threads again.
"""

import ctypes
import gc
import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path

from capture_sim import load_scene
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.hardware.stage import LoopStage
from capture_sim.messages.definitions import typestore

NODES = ("simulator", "launcher", "capture_detector", "recorder", "player", "viewer")
NODES += ("contact_rig", "loop_simulator")
PR_SET_PDEATHSIG = 1  # of Linux
SIGSET_SIZE = 128  # bytes of a sigset_t
ROOT = Path(__file__).parents[2]


@cache
def _server():
    """Start the process that is forked; return the socket at whose end it ends, and itself."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        command = [sys.executable, "-m", "tests.nodes.forked", str(theirs.fileno())]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()], cwd=ROOT
        )
    return ours, process


def _ask(request, *files):
    server, _ = _server()
    socket.send_fds(server, [json.dumps(request).encode()], files)
    return json.loads(server.recv(100))


class Forked:
    """A forked process, with what is used here of :class:`subprocess.Popen`."""

    def __init__(self, program, arguments):
        reader, writer = os.pipe()
        self.stdout = os.fdopen(reader, encoding="utf-8")
        # as a new process has them: the domain is the test's, the folder may be
        domain, folder = os.environ.get("ROS_DOMAIN_ID", "0"), str(Path.cwd())
        self.pid = _ask([program, arguments, domain, folder], writer)
        os.close(writer)
        self.returncode = None

    def poll(self):
        if self.returncode is None:
            self.returncode = _ask(self.pid)
        return self.returncode

    def wait(self, timeout=float("inf")):
        deadline = time.monotonic() + timeout
        while self.poll() is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout)
            time.sleep(0.01)
        return self.returncode

    def send_signal(self, signum):
        if self.poll() is None:
            os.kill(self.pid, signum)

    def kill(self):
        self.send_signal(signal.SIGKILL)


def _load():
    for name in NODES:
        import_module(f"capture_sim.nodes.{name}")
    with suppress(ImportError):
        import_module("capture_sim.viewing.live")  # needs rerun
    typestore()
    compile_kernels()
    LoopStage(load_scene("_loop"))
    gc.collect()
    gc.freeze()


@cache
def _tracing():
    """Return the library LTTng-UST that is loaded; None if none is, as without wheels."""
    lines = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    paths = {line.split()[-1] for line in lines if "/liblttng-ust-" in line}
    libraries = [ctypes.CDLL(path) for path in sorted(paths)]
    return next((each for each in libraries if hasattr(each, "ust_before_fork")), None)


def _fork():
    """Fork as :func:`os.fork` does, LTTng-UST too."""
    tracing, mask = _tracing(), ctypes.create_string_buffer(SIGSET_SIZE)
    if tracing is None:
        return os.fork()
    tracing.ust_before_fork(mask)
    pid = os.fork()
    (tracing.ust_after_fork_parent if pid else tracing.ust_after_fork_child)(mask)
    return pid


def _serve(client):
    """Fork on demand; return the program of a fork, or an empty one where no more is wanted."""
    with client:
        while True:
            data, files, *_ = socket.recv_fds(client, 1 << 20, 1)
            if not data:
                return ""
            match json.loads(data):
                case [program, arguments, domain, folder]:
                    pid = _fork()
                    if pid == 0:
                        # at the end of the process that is forked, however the tests end
                        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
                        os.dup2(files[0], 1)
                        os.dup2(files[0], 2)
                        os.close(files[0])
                        signal.signal(signal.SIGINT, signal.default_int_handler)
                        os.environ["ROS_DOMAIN_ID"] = domain
                        os.chdir(folder)
                        sys.argv = ["-c", *arguments]
                        return program
                    os.close(files[0])
                    answer = pid
                case pid:
                    ended, how = os.waitpid(pid, os.WNOHANG)
                    answer = os.waitstatus_to_exitcode(how) if ended else None
            client.send(json.dumps(answer).encode())


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the forks
    _load()
    exec(_serve(socket.socket(fileno=int(sys.argv[1]))), {"__name__": "__main__"})
