"""Starts the nodes, each in a process of its own, supervises them and ends them.

One set of processes serves all experiments: starting four of them costs several seconds of
computing (numba and DDS), a run of the bench less than one.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import yaml

from capture_sim.messages.topics import CAPTURE_DETECTOR, LAUNCHER, SIMULATOR
from capture_sim.nodes.places import Place, claim_place
from capture_sim.nodes.uninterrupted import uninterrupted
from capture_sim.scene.parts import Scene

OK, FAILED, REFUSED = 0, 1, 2
RECORDER = "recorder"

#: After the simulator has ended, or a node died, the others get this long to end too, s.
GRACE = 10.0
#: ... and this long after a Ctrl-C, before they are killed, s.
LAST_GRACE = 15.0
#: What a suite may take besides its runs, s.
START_LIMIT = 180.0
#: Wall time that an unpaced run may take for each simulated second, s.
SLOWEST = 30.0


def run_suite(scenes: Sequence[Scene], out: Path, *, record: bool = True, pace: float = 0.0) -> int:
    """Run experiments with the ROS 2 nodes.

    Uses the caller's ROS_DOMAIN_ID, or without one a domain that no other suite of this
    machine uses.  A second suite in one domain runs in a namespace of its own.

    Parameters
    ----------
    scenes
        Run one after another.
    out
        Folder of the recordings, ``<name>.mcap`` each, and of the nodes' logs.
    record
        Whether the recorder takes part.
    pace
        Simulated seconds per second; 0 as fast as it goes.

    Returns
    -------
    int
        0 when all runs are complete; 1 when a node failed or died; 2 when one refused its
        parameters.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C (or SIGTERM), when all nodes have ended.
    """
    names = [SIMULATOR, LAUNCHER, CAPTURE_DETECTOR, *([RECORDER] if record else [])]
    limit = START_LIMIT
    for scene in scenes:
        limit += scene.run.t_end * (SLOWEST if pace == 0.0 else 1.5 / pace)
    with tempfile.TemporaryDirectory(prefix="capture_sim_") as temporary, claim_place() as place:
        folder = Path(temporary)
        parameters = _write_parameters(folder, scenes, out, names[1:], pace, place)
        environment = _environment(out, place)
        _say(f"starting {', '.join(names)} {place}")
        with _interruptible(), _Processes(names, parameters, place, environment) as processes:
            status = processes.supervise(limit)
    return status


def _write_parameters(
    folder: Path,
    scenes: Sequence[Scene],
    out: Path,
    consumers: Sequence[str],
    pace: float,
    place: Place,
) -> Path:
    files = []
    for number, scene in enumerate(scenes):
        path = folder / f"{number}_{Path(scene.name).name}.yaml"
        path.write_text(scene.to_yaml(), encoding="utf-8")
        files.append(str(path))
    of_node: dict[str, dict[str, Any]] = {name: {} for name in (SIMULATOR, *consumers)}
    of_node[SIMULATOR] = {"scenes": files, "consumers": list(consumers), "pace": float(pace)}
    if RECORDER in of_node:
        of_node[RECORDER] = {"out": str(out)}
    content = {
        f"{place.prefix}/{name}": {"ros__parameters": {"exit_when_done": True, **values}}
        for name, values in of_node.items()
    }
    path = folder / "parameters.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def _environment(out: Path, place: Place) -> dict[str, str]:
    """Return the nodes' environment; what the caller has set is left as it is."""
    environment = dict(os.environ, ROS_DOMAIN_ID=str(place.domain))
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    environment.setdefault("RCUTILS_CONSOLE_OUTPUT_FORMAT", "{severity}: {message}")
    if "ROS_HOME" not in environment:
        environment.setdefault("ROS_LOG_DIR", str(out.absolute() / "log"))
    return environment


_printing = threading.Lock()


def _say(text: str, who: str = "suite") -> None:
    with _printing:
        print(f"[{who}] {text}", flush=True)


def _raise_interrupt(signum: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


@contextmanager
def _interruptible() -> Iterator[None]:
    """Make SIGTERM and a closed terminal end the suite in order, as Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {s: signal.signal(s, _raise_interrupt) for s in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


class _Processes:
    """The nodes' processes; leaving the context ends what still runs."""

    def __init__(
        self,
        names: Sequence[str],
        parameters: Path,
        place: Place,
        environment: Mapping[str, str],
    ) -> None:
        self._names = names
        self._place = place
        self._parameters = parameters
        self._environment = environment
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._readers: list[threading.Thread] = []

    def __enter__(self) -> _Processes:
        try:
            with uninterrupted():
                for name in self._names:
                    self._start(name)
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def supervise(self, limit: float) -> int:
        """Wait until all have ended, ``limit`` s at most; return the suite's exit status.

        When a node dies the others get some time to notice, to say so and to close their
        files, then they are ended too.
        """
        began = time.monotonic()
        deadline = began + limit
        status = OK
        while self._running:
            for name, code in self._ended():
                if code != OK:
                    _say(f"{name} {_describe(code)}")
                    status = max(status, REFUSED if code == REFUSED else FAILED)
                if code != OK or name == SIMULATOR:
                    patience = 0.0 if code == REFUSED else GRACE
                    deadline = min(deadline, time.monotonic() + patience)
            if self._running and time.monotonic() > deadline:
                _say(f"ending {', '.join(self._running)}")
                return max(status, FAILED)
            time.sleep(0.02)
        _say(f"all nodes have ended, after {time.monotonic() - began:.1f} s")
        return status

    def _start(self, name: str) -> None:
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", f"capture_sim.nodes.{name}"),
                *("--ros-args", "--params-file", str(self._parameters)),
                *("-r", f"__ns:={self._place.namespace}"),
            ],
            env=dict(self._environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            process_group=0,  # Ctrl-C reaches them through us alone
        )
        self._running[name] = process
        reader = threading.Thread(target=_forward, args=(name, process.stdout), daemon=True)
        reader.start()
        self._readers.append(reader)

    def _ended(self) -> list[tuple[str, int]]:
        ended = []
        for name, process in list(self._running.items()):
            code = process.poll()
            if code is not None:
                del self._running[name]
                ended.append((name, code))
        return ended

    def _end(self) -> None:
        """End what still runs: by SIGINT, and by SIGKILL what does not follow."""
        with uninterrupted():
            for process in self._running.values():
                process.send_signal(signal.SIGINT)
            deadline = time.monotonic() + LAST_GRACE
            while self._running and time.monotonic() < deadline:
                self._ended()
                time.sleep(0.02)
            for name, process in self._running.items():
                _say(f"{name} does not end on SIGINT: killed")
                process.kill()
                process.wait()
            self._running.clear()
            for reader in self._readers:
                reader.join(1.0)


def _forward(name: str, stream: Any) -> None:
    for line in stream:
        _say(line.rstrip(), name)


def _describe(code: int) -> str:
    if code < 0:
        return f"was killed by {signal.Signals(-code).name}"
    return f"ended with exit status {code}"
