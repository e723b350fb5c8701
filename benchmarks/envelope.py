"""The capture envelope: how fast, the same everywhere, and how far its verdicts can be trusted.

    .venv/bin/python -m benchmarks.envelope [trust speed picture] [--runs 10000]   # five minutes

writes the parts of docs/envelope.md and docs/envelope/map.png.  The same map is made by two
processes (timed), by one, by a Dask cluster of two workers, and by the command killed half-way and
started again.
"""

from __future__ import annotations

import functools
import hashlib
import math
import resource
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.pages import DOCS, table, write_parts
from capture_sim import load_scene, simulate
from capture_sim.commands.envelope import axis
from capture_sim.detection.exact import CaptureState
from capture_sim.recording.envelope_file import write_envelope
from capture_sim.studies.envelope import ROW, Envelope, Plan, evaluate, explore
from capture_sim.studies.envelope_runs import KeptRuns
from capture_sim.studies.executors import InProcess, answers, open_executor
from capture_sim.viewing.canvas import save
from capture_sim.viewing.studies import draw_envelope

AXES = {"angle": "-30:30:12", "offset": "-50:50:10", "speed": "0.05,0.1,0.2"}
UNITS = {"angle": "deg", "offset": "mm", "speed": "m/s"}
LEVELS = 5
CHECKS = 0.44  # of the map's points, about as many are run twice


def the_plan(runs: int) -> Plan:
    """The map that takes about so many runs to a verdict."""
    axes = {name: axis(UNITS[name])(text) for name, text in AXES.items()}
    return Plan(load_scene("tilt_0"), **axes, levels=LEVELS, runs=round(runs / (1 + CHECKS)))


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def children() -> float:
    """Processor time of the processes that this one has waited for, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@functools.cache
def made_by(runs: int, way: str = "2 processes") -> tuple[Envelope, float, float, str]:
    """Make a map; return it, the time on the clock and of other processes (s), its file's hash."""
    plan, before = the_plan(runs), children()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if way == "1 process":
            executor = InProcess()
        elif way == "2 processes":
            executor = stack.enter_context(open_executor(2))
        else:
            from distributed import LocalCluster

            local = LocalCluster(
                n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
            )
            scheduler = stack.enter_context(local).scheduler_address
            executor = stack.enter_context(open_executor(scheduler=scheduler))
        # workers load the kernels when they start: not part of the map's time on the clock
        list(answers(executor, math.sqrt, [1.0] * 8))
        began = time.perf_counter()
        envelope = explore(plan, KeptRuns(plan, executor, folder / "e.runs"))
        seconds = time.perf_counter() - began
        found = digest(write_envelope(envelope, folder / "e.parquet"))
    return envelope, seconds, children() - before, found


def killed_and_resumed(plan: Plan) -> tuple[str, int]:
    """Kill the command half-way and start it again; return its file's hash and the points kept."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "e.parquet"
        command = [sys.executable, "-m", "capture_sim.cli", "envelope", "--workers=2", "--mark"]
        command += [f"--{name}={text}" for name, text in AXES.items()]
        command += [f"--levels={LEVELS}", f"--runs={plan.runs}", f"--out={out}"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        kept, runs = 0, out.with_suffix(".runs")
        with subprocess.Popen(command, **quiet) as first:
            while kept < plan.runs * (1 + CHECKS) / 2:
                assert first.poll() is None, "the command ended before it could be killed"
                time.sleep(0.05)
                data = runs.read_bytes() if runs.exists() else b""
                kept = len(data.partition(b"\n")[2]) // ROW.itemsize  # behind the plan's line
            first.kill()
        subprocess.run(command, check=True, **quiet)
        return digest(out), kept


def trust(asked: Namespace, _: Path) -> list[str]:
    """Runs near the boundary at several tolerances, against a much finer one."""
    envelope = made_by(asked.runs)[0]
    checked = envelope.rows[envelope.rows["checked"]]
    keys = [(int(r["slice"]), int(r["i"]), int(r["j"])) for r in checked]
    keys = keys[:: max(1, len(keys) // 300)]
    fine = evaluate(envelope.plan, keys, 1e-11)
    caught = fine["verdict"] == CaptureState.CAPTURED
    rows = []
    for rtol in (1e-3, 1e-4, 1e-5, 1e-6, 1e-8):
        began = time.process_time()
        found = evaluate(envelope.plan, keys, rtol)
        each = 1e3 * (time.process_time() - began) / len(keys)
        off = np.abs(found["nearest"] - fine["nearest"]) * 1e3
        rows.append(
            [
                f"{rtol:.0e}",
                f"{each:.1f}",
                (found["verdict"] != fine["verdict"]).sum(),
                ((found["verdict"] == CaptureState.CAPTURED) != caught).sum(),
                f"{np.median(off):.1e}",
                f"{off.max():.1e}",
            ]
        )
    own = envelope.rows[[envelope.places[key] for key in keys]]
    wrong = own["verdict"] != fine["verdict"]
    flagged = own["verdict"] != own["finer_verdict"]
    shares = [
        [
            f"{value:g}",
            f"{share['surely']:.2%}",
            f"{share['perhaps']:.2%}",
            f"{share['ill_conditioned']:.4%}",
        ]
        for value, share in zip(envelope.plan.slices, envelope.shares, strict=True)
    ]
    head = ["rtol", "ms a run", "other verdict", "capture or not", "nearest off: median mm"]
    return [
        table(["speed m/s", "captured at least", "at most", "ill-conditioned"], shares),
        "",
        f"{len(keys)} points next to the boundary, against rtol 1e-11:",
        "",
        table([*head, "worst"], rows),
        "",
        f"Of the {wrong.sum()} verdicts that are other at the maps' own rtol "
        f"{envelope.plan.rtol:.0e}, halving the tolerance flags {(wrong & flagged).sum()}; it "
        f"flags {flagged.sum()} in all.",
    ]


def speed(asked: Namespace, _: Path) -> list[str]:
    """What the map by two processes took, and whether the other ways give the same file."""
    envelope, wall, busy, own = made_by(asked.runs)
    plan, rows = envelope.plan, envelope.rows
    runs = int((~np.isnan(rows["nearest"])).sum() + rows["checked"].sum())
    (_, across), (_, up) = plan.plane
    grid = len(plan.slices) * ((across.cells << LEVELS) + 1) * ((up.cells << LEVELS) + 1)
    ways = [["2 processes", f"{wall:.1f}", ""]]
    for way in ("1 process", "a Dask cluster of 2 workers"):
        _, seconds, _, file = made_by(asked.runs, way)
        ways.append([way, f"{seconds:.1f}", "yes" if file == own else "**NO**"])
    file, kept = killed_and_resumed(plan)
    resumed = f"the command, killed with {kept} points done, and resumed"
    ways.append([resumed, "", "yes" if file == own else "**NO**"])
    return [
        f"{runs} runs to a verdict ({len(rows)} points, {rows['checked'].sum()} of them twice) in "
        f"{wall:.1f} s by 2 processes, {wall / runs * 1e4:.0f} s for 10 000. Their processors were "
        f"busy for {busy:.1f} s, {busy / runs * 1e4:.0f} s for 10 000: half of that is what two "
        "cores need that do nothing else. A full grid as fine as the finest cells would take "
        f"{grid} points, {grid / len(rows):.0f} times as many.",
        "",
        table(["the same map by", "s on the clock", "the same bytes"], ways),
    ]


def picture(asked: Namespace, _: Path) -> list[str]:
    """The map with the experiments' places in it; no text."""
    if not asked.dry:
        marks = [simulate(load_scene(name)) for name in ("tilt_0", "tilt_p10", "tilt_m10")]
        save(draw_envelope(made_by(asked.runs)[0], marks), DOCS / "envelope" / "map.png")
    return []


if __name__ == "__main__":
    write_parts(
        "envelope",
        __doc__,
        {"speed": speed, "trust": trust, "picture": picture},
        runs=(10_000, "to a verdict, about"),
    )
