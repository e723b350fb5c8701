"""Start, supervision and end of the ROS 2 nodes, each of which is a process of its own.

The same processes run all experiments, because the start of four nodes takes seconds of computing
time and a run of the bench less than one second.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from capture_sim.base.exit_status import BAD_INPUT, FAILED, OK, RECORDING_IN, REFUSAL
from capture_sim.base.interrupts import tied, watch_signals
from capture_sim.errors import CaptureSimError, MissingPackageError, explain_import_error
from capture_sim.messages.topics import CAPTURE_DETECTOR, LAUNCHER, PLAYER, RECORDER, SIMULATOR
from capture_sim.scene.parts import Scene

#: Time that the other nodes get to close their files after one node has ended, and that a node
#: gets to end after a SIGINT before it is killed, s.
GRACE = 15.0
#: Signals that end a command.
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def check_ros() -> None:
    """Raise MissingPackageError if ROS 2 or the compiled messages are not installed."""
    for package in ("rclpy", "capture_sim.msg"):
        if find_spec(package) is None:
            raise MissingPackageError(explain_import_error(ModuleNotFoundError(name=package)))


class SuiteResult(NamedTuple):
    """The result of :func:`run_suite`: the exit status, and the files of the recordings."""

    status: int  # 0 all runs are complete; 1 a node failed or died; 2 it rejected its parameters
    recordings: list[Path]  # in the order of the runs


def run_suite(
    scenes: Sequence[Scene],
    out: Path,
    *,
    rtf: float = 0.0,
    namespace: str = "",
) -> SuiteResult:
    """Run experiments one after another with the nodes, in the caller's ROS_DOMAIN_ID.

    ``out`` is the folder of the recordings, ``<name>.mcap``, and of the logs of the nodes.  ``rtf``
    is the simulated time over the real time; 0 runs without pacing.  ``namespace`` is the ROS
    namespace of all nodes and topics, which separates two suites in one domain.

    KeyboardInterrupt is raised after Ctrl-C, SIGTERM or SIGHUP, when all nodes have ended.
    """
    consumers = [LAUNCHER, CAPTURE_DETECTOR, RECORDER]
    with tempfile.TemporaryDirectory(prefix="capture_sim_") as folder:
        files = []
        for number, scene in enumerate(scenes):
            path = Path(folder, f"{number}.yaml")
            path.write_text(scene.to_yaml(), encoding="utf-8")
            files.append(str(path))
        parameters: dict[str, dict[str, Any]] = {name: {} for name in (SIMULATOR, *consumers)}
        parameters[SIMULATOR] = {"scenes": files, "wait_for": consumers, "rtf": float(rtf)}
        parameters[RECORDER] = {"out": str(out)}
        status, processes = _run_nodes(parameters, SIMULATOR, Path(folder), namespace, out)
    return SuiteResult(status, [path for path in processes.recordings if path.is_file()])


def replay(parameters: Mapping[str, Any], out: Path) -> int:
    """Play a recording with the player node; return the exit status, see :class:`SuiteResult`.

    ``parameters`` are the parameters of the player.  The nodes that its parameter ``wait_for``
    names are started too, and are ended when the player ends.  ``out`` is the folder of the
    recorder's files.

    Raises MissingPackageError without ROS 2, and CaptureSimError if a node has rejected its
    parameters.  After Ctrl-C, SIGTERM or SIGHUP it raises KeyboardInterrupt when all nodes have
    ended.
    """
    check_ros()
    nodes: dict[str, dict[str, Any]] = {PLAYER: dict(parameters)}
    for name in parameters.get("wait_for", ()):
        nodes[name] = {"out": str(out)} if name == RECORDER else {}
    with tempfile.TemporaryDirectory(prefix="capture_sim_") as folder:
        status, processes = _run_nodes(nodes, PLAYER, Path(folder))
    if processes.refusals:
        raise CaptureSimError(processes.refusals[0])
    return status


def _run_nodes(
    parameters: Mapping[str, Mapping[str, Any]],
    announcer: str,
    folder: Path,
    namespace: str = "",
    log: Path | None = None,
) -> tuple[int, _Processes]:
    """Run nodes until they end; return the exit status and the processes.

    The status is that of :class:`SuiteResult`.  The processes have the paths of the recordings and
    the reasons of nodes that rejected their parameters.  ``parameters`` are by the name of the
    node.  ``announcer`` is the node with whose end the other nodes are ended, the simulator or the
    player.  ``folder`` gets the file of parameters, and ``log`` is the folder above the logs.
    """
    file = folder / "parameters.yaml"
    content = {}
    for name, values in parameters.items():
        ends = {"exit_when_done": True} if name == SIMULATOR else {}
        content[f"/**/{name}"] = {"ros__parameters": {**ends, **values}}
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    environment = dict(os.environ)
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    environment.setdefault("RCUTILS_CONSOLE_OUTPUT_FORMAT", "{severity}: {message}")
    if log is not None and "ROS_HOME" not in environment:
        environment.setdefault("ROS_LOG_DIR", str(log.absolute() / "log"))
    arguments = ["--ros-args", "--params-file", str(file), "-r", f"__ns:=/{namespace.strip('/')}"]
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    where = f"on ROS_DOMAIN_ID {domain}" + (f" in {namespace}" if namespace else "")
    _print(f"starting {', '.join(parameters)} {where}")
    stop = threading.Event()
    ignored = (signal.SIG_IGN, None)  # by nohup, or for a job in the background: stays so
    restore = watch_signals(stop, [s for s in _ENDING if signal.getsignal(s) not in ignored])
    try:
        with _Processes(list(parameters), arguments, environment) as processes:
            status = processes.supervise(announcer, stop)
    finally:
        restore()
    return status, processes


def _print(text: str, who: str = "suite") -> None:
    print(f"[{who}] {text}\n", end="", flush=True)  # one write: several threads print


class _Processes:
    """Context manager that starts the processes of the nodes, and at its exit ends those left."""

    def __init__(
        self, names: Sequence[str], arguments: Sequence[str], environment: Mapping[str, str]
    ) -> None:
        self._names = names
        self._arguments = arguments
        self._environment = environment
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._readers: list[threading.Thread] = []
        self.refusals: list[str] = []  # why nodes have rejected their parameters
        self.recordings: list[Path] = []  # files of the recorder, in their order

    def __enter__(self) -> _Processes:
        # a node inherits the blocked signals, and unblocks them once it can follow them
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
        try:
            for name in self._names:
                self._start(name)
        except BaseException:
            self._end()
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def supervise(self, announcer: str, stop: threading.Event) -> int:
        """Wait until all nodes have ended; return the exit status, see :class:`SuiteResult`.

        When the announcer (simulator or player) has ended, the other nodes get a SIGINT.  After
        the announcer's end or the failure of a node, the others have :data:`GRACE` s to end; then
        the function returns a failure.  If a node has rejected its parameters, it returns at once.
        KeyboardInterrupt is raised if ``stop`` is set.
        """
        began, deadline, status = time.monotonic(), math.inf, OK
        while self._running:
            for name, process in list(self._running.items()):
                code = process.poll()
                if code is None:
                    continue
                del self._running[name]
                if code != OK:
                    _print(f"{name} {_describe(code)}")
                    status = max(status, BAD_INPUT if code == BAD_INPUT else FAILED)
                if name == announcer:
                    self._interrupt()
                if code != OK or name == announcer:
                    patience = 0.0 if code == BAD_INPUT else GRACE
                    deadline = min(deadline, time.monotonic() + patience)
            if self._running and time.monotonic() > deadline:
                _print(f"ending {', '.join(self._running)}")
                return max(status, FAILED)
            if stop.wait(0.02):
                raise KeyboardInterrupt
        _print(f"all nodes have ended, after {time.monotonic() - began:.1f} s")
        return status

    def _interrupt(self) -> None:
        for process in self._running.values():
            process.send_signal(signal.SIGINT)

    def _start(self, name: str) -> None:
        process = subprocess.Popen(
            tied([sys.executable, "-m", "capture_sim.nodes.start", name, *self._arguments]),
            env=dict(self._environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            process_group=0,  # Ctrl-C reaches them through us alone
        )
        self._running[name] = process
        reader = threading.Thread(target=self._forward, args=(name, process.stdout), daemon=True)
        reader.start()
        self._readers.append(reader)

    def _end(self) -> None:
        """Send SIGINT to the remaining processes, and kill those that do not end in time."""
        self._interrupt()
        deadline = time.monotonic() + GRACE
        for name, process in self._running.items():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                _print(f"{name} does not end on SIGINT: killed")
                process.kill()
                process.wait()
        self._running.clear()
        for reader in self._readers:
            reader.join(1.0)

    def _forward(self, name: str, stream: Any) -> None:
        for line in stream:
            _print(line.rstrip(), name)
            if line.startswith(REFUSAL):
                self.refusals.append(line.removeprefix(REFUSAL).rstrip())
            if name == RECORDER and RECORDING_IN in line:
                self.recordings.append(Path(line.partition(RECORDING_IN)[2].rstrip()))


def _describe(code: int) -> str:
    if code < 0:
        return f"was killed by {signal.Signals(-code).name}"
    return f"ended with exit status {code}"
