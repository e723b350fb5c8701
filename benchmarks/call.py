"""What a call costs besides its equations: the ledger on docs/evidence/benchmark.md.

    python -m benchmarks.call                             # ten minutes; writes the table
    python -m benchmarks.call --times 4 --dry             # a try
    python -m benchmarks.call --dry --before CHECKOUT     # beside an earlier state

The least processor time of each call, in one process a state, over that of the run's own kernels
without samples at the same tolerance.  For these, the engine's record at each release is kept
during one pass, and integrated once more to the same end.
"""

from __future__ import annotations

import cProfile
import gc
import json
import math
import pstats
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.before import ROOT, Server
from benchmarks.pages import table, write_parts

SCENES = ("tilt_0", "tilt_p10", "paper_designed")
#: What everybody's own loop changes.
CHANGES = {"buffer.k_A": 501.0, "run.rtol": 1e-6}
#: Poses as measured, for a fit.
_MEASURED = {"sensors.motion_capture.rate": 100, "sensors.motion_capture.position_noise": 2e-4}
#: Runs of a sweep, and candidates of a design, whose time is that of one of them.
_ROWS = 40
#: Turns in which all calls are repeated: a machine may change its speed.
_TURNS = 4
#: Functions that are named of those that take most of the rest.
_NAMED = 3
#: Calls that make runs of their own.
STUDIES = ("`sweep", "`design", "a draw")
#: Ratios that are to be reached, by the call.
GOALS = {
    "`simulate(scene, overrides)`": 1.5,
    "... by name": 2.2,
    "... `.verdict`": 2.0,
    "... `.summary`": 2.0,
    "`sweep`, a row": 1.3,
    "`design`, a candidate": 1.3,
    "a draw of `calibrate`": 1.3,
}


class Call(NamedTuple):
    """Something that a user calls: ``work`` does it ``units`` times, or returns how many."""

    work: Callable[[], Any]
    units: int = 1
    has_runs: bool = False  # of its own, that are not the one run of the table


def calls(name: str, folder: Path) -> dict[str, Call]:
    """Return the calls of a scene; an earlier state has other rooms, and maybe fewer calls."""
    from capture_sim import load_scene, read_run, simulate, sweep
    from capture_sim.recording.offline import write_run
    from capture_sim.scene.loading import change_scene
    from capture_sim.studies.evaluate.executors import InProcess
    from capture_sim.studies.evaluate.limits import Measure
    from capture_sim.studies.search.evaluator import Evaluator, Requirements
    from tests.one_trial import identify

    scene = load_scene(name)
    tolerant = load_scene(name, {"run.rtol": CHANGES["run.rtol"]})
    path = write_run(simulate(scene, CHANGES), folder / f"{name}.mcap")
    stiffnesses = np.linspace(475.0, 525.0, _ROWS).tolist()
    buffers = [{"buffer.k_A": k_A} for k_A in stiffnesses]
    needed = Requirements(objectives=(Measure("max_torsion_before_latch"),))
    measured = simulate(load_scene(name, _MEASURED), {"run.rtol": CHANGES["run.rtol"]})

    def designed() -> None:
        Evaluator(tolerant, needed, 1, InProcess()).alone(buffers)

    def fitted() -> int:
        return identify(tolerant, measured, ["buffer.c_A", "mu"], starts=1).evaluations

    def swept() -> None:
        sweep(scene, {"buffer.k_A": stiffnesses}, executor=InProcess())

    return {
        "`simulate(scene, overrides)`": Call(lambda: simulate(scene, CHANGES)),
        "... by name": Call(lambda: simulate(name, CHANGES)),
        "... `.verdict`": Call(lambda: simulate(scene, CHANGES).verdict),
        "... `.touches`": Call(lambda: simulate(scene, CHANGES).touches),
        "... `.summary`": Call(lambda: simulate(scene, CHANGES).summary),
        "... `.samples`": Call(lambda: simulate(scene, CHANGES).samples),
        "... `.to_dataframe()`": Call(lambda: simulate(scene, CHANGES).to_dataframe()),
        "`load_scene(name)`": Call(lambda: load_scene(name)),
        "change of a field": Call(lambda: change_scene(scene, CHANGES)),
        "`read_run(path)`": Call(lambda: read_run(path)),
        "... `.samples` of it": Call(lambda: read_run(path).samples),
        "`sweep`, a row": Call(swept, _ROWS, has_runs=True),
        "`design`, a candidate": Call(designed, _ROWS, has_runs=True),
        "a draw of `calibrate`": Call(fitted, 0, has_runs=True),
    }


class Kernels:
    """Keeps the runs that some work makes, and integrates them once more without samples."""

    def __init__(self) -> None:
        from capture_sim.dynamics.engine import loop

        self._loop, self._advance = loop, loop.advance
        self._runs: list[list[Any]] = []  # of each the record at the release, and its last time

    def __enter__(self) -> Kernels:
        self._loop.advance = self._kept
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.advance = self._advance

    def _kept(self, workspace: Any, times: Any, samples: Any, trace: Any) -> Any:
        if not workspace[0]["progress"]["begun"]:
            self._runs.append([workspace.copy(), 0.0])
        if len(times):
            self._runs[-1][1] = float(times[-1])
        return self._advance(workspace, times, samples, trace)

    def seconds(self) -> float:
        """Return the processor time of the kernels of all runs, s."""
        from capture_sim.base.compiled.kernels import records
        from capture_sim.dynamics.engine.state import StepStatus
        from capture_sim.dynamics.samples import SAMPLE

        spent, room = 0.0, records(np.zeros(1, SAMPLE))
        for record, last in self._runs:
            workspace, times = record.copy(), np.array([last])
            progress = workspace[0]["progress"]
            began, status = time.process_time(), StepStatus.INTERRUPTED
            while status == StepStatus.INTERRUPTED:
                progress["n_log"] = 0
                self._advance(workspace, times, room, room[:0])
                status = progress["status"]
            spent += time.process_time() - began
        return spent


def rest_of(call: Call) -> str:
    """Return the functions with the largest own time in a profile, but for the kernels."""
    from capture_sim.dynamics.engine import loop

    kernel = loop.advance

    def advance_kernel(*arguments: Any) -> Any:
        return kernel(*arguments)

    profile = cProfile.Profile()
    loop.advance = advance_kernel
    try:
        profile.enable()
        for _ in range(1 if call.has_runs else _ROWS):
            call.work()
    finally:
        profile.disable()
        loop.advance = kernel
    own = {
        f"{Path(file).stem}.{name}" if file != "~" else name.strip("<>").rpartition(" ")[2]: entry[
            2
        ]
        for (file, _, name), entry in pstats.Stats(profile).stats.items()  # type: ignore[attr-defined]
        if name != "advance_kernel" and "engine/loop" not in file
    }
    whole = sum(own.values())
    named = sorted(own, key=lambda name: -own[name])[:_NAMED]
    return ", ".join(f"{name} {own[name] / whole:.0%}" for name in named)


def serve(times: int) -> None:
    """Print a line of JSON for each scene: CPU time of kernels and each call (s), and the rest."""
    gc.disable()
    with tempfile.TemporaryDirectory() as folder:
        for scene in SCENES:
            print(json.dumps(measured_calls(calls(scene, Path(folder)), times)), flush=True)


def measured_calls(found: dict[str, Call], times: int) -> dict[str, Any]:
    """Return for each call its least CPU time, that of its kernels (s), and what else it does."""
    kernels, units = {}, {}
    for name, call in found.items():
        with Kernels() as kernels[name]:
            made = call.work()
        units[name] = call.units or made
    least = {name: [math.inf, math.inf] for name in found}
    for _ in range(_TURNS):
        for name, call in found.items():
            # a pass of many runs is long enough for fewer
            n = max(times // _TURNS // (10 if call.has_runs else 1), 1)
            for _ in range(n):
                began = time.process_time()
                call.work()
                spent = time.process_time() - began
                own = kernels[name].seconds()
                least[name] = list(map(min, least[name], (spent, own)))
    return {
        name: [*(seconds / units[name] for seconds in least[name]), rest_of(call)]
        for name, call in found.items()
    }


def ledger(asked: Namespace, _: Path) -> list[str]:
    """Measure all calls; of two states the earlier one has a table of its own."""
    states = [ROOT] if asked.before is None else [asked.before.resolve(), ROOT]
    lines = []
    for state in states:
        server = Server(__file__, state, asked.times)
        found = [server.answer() for _ in SCENES]
        server.end()
        if state != ROOT:
            lines += [f"At {commit(state)}:", "", ledger_table(found), "", "Now:", ""]
    return [*lines, ledger_table(found)]


def commit(state: Path) -> str:
    asked = ["git", "-C", str(state), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, check=True, stdout=subprocess.PIPE, text=True).stdout.strip()


def ledger_table(found: Sequence[dict[str, Any]]) -> str:
    """Return the table of one state, of the answers for each scene."""
    first = next(iter(found[0]))
    rows = [["kernels alone", *(f"{1e3 * of[first][1]:.2f} ms" for of in found), "", ""]]
    for name in found[0]:
        base = name if name.startswith(STUDIES) else first  # studies have runs of their own
        cells = [f"{1e3 * of[name][0]:.2f} ms ({of[name][0] / of[base][1]:.2f})" for of in found]
        rows.append([name, *cells, str(GOALS.get(name, "")), found[0][name][2]])
    return table(["call", *SCENES, "goal", f"of the rest, on {SCENES[0]}"], rows)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(int(sys.argv[2]))
    else:
        write_parts(
            "benchmark",
            __doc__,
            {"call": ledger},
            before=(None, "checkout of an earlier state"),
            times=(40, "that each call is repeated"),
        )
