"""The capture envelope: how fast, the same everywhere, and how far its verdicts can be trusted.

    .venv/bin/python -m benchmarks.envelope [--runs 10000]

writes docs/envelope.md and docs/envelope/map.png.  The same map is made by two processes (timed),
by one, by a Dask cluster of two workers, and by the command killed half-way and started again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.machine import OthersAtWork
from capture_sim import load_scene, simulate
from capture_sim.bench import compile_kernels
from capture_sim.commands.envelope import read_axis
from capture_sim.detection.exact import CaptureState
from capture_sim.recording.envelope_file import write_envelope
from capture_sim.studies.envelope import ROW, Envelope, Plan, evaluate
from capture_sim.studies.envelope_runs import map_envelope
from capture_sim.studies.executors import InProcess, open_executor, ordered
from capture_sim.viewing.canvas import save
from capture_sim.viewing.studies import draw_envelope

DOCS = Path(__file__).resolve().parent.parent / "docs"
ANGLE, OFFSET, SPEED = "-30:30:12", "-50:50:10", "0.05,0.1,0.2"
LEVELS = 5
CHECKS = 0.44  # of the map's points, about as many are run twice


@dataclass(frozen=True)
class Timed:
    """A map made in some way: how long it took, the processors' time, and its file's hash."""

    envelope: Envelope
    seconds: float
    digest: str
    busy: float = math.nan

    @property
    def runs(self) -> int:
        """Runs to a verdict: points that were not missed by far, and those run twice."""
        rows = self.envelope.rows
        return int((~np.isnan(rows["nearest"])).sum() + rows["checked"].sum())


def the_plan(points: int) -> Plan:
    return Plan(
        load_scene("tilt_0"),
        angle=read_axis("--angle", ANGLE, "deg"),
        offset=read_axis("--offset", OFFSET, "mm"),
        speed=read_axis("--speed", SPEED, "m/s"),
        levels=LEVELS,
        runs=points,
    )


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def timed(plan: Plan, executor: Executor, folder: Path) -> Timed:
    began = time.perf_counter()
    envelope = map_envelope(plan, executor, folder / "e.runs")
    seconds = time.perf_counter() - began
    return Timed(envelope, seconds, digest(write_envelope(envelope, folder / "e.parquet")))


def by_processes(plan: Plan, count: int) -> Timed:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder, open_executor(count) as executor:
        # workers load the kernels when they start: not part of the map's time on the clock
        ordered(executor, math.sqrt, [1.0] * 4 * count)
        made = timed(plan, executor, Path(folder))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return replace(made, busy=busy)


def by_dask(plan: Plan) -> Timed | None:
    try:
        from distributed import LocalCluster
    except ImportError:
        return None
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
        ) as cluster,
        open_executor(scheduler=cluster.scheduler_address) as executor,
    ):
        ordered(executor, math.sqrt, [1.0] * 8)
        return timed(plan, executor, Path(folder))


def kept_runs(path: Path) -> int:
    """How many rows a file of runs holds behind the line of its plan."""
    if not path.exists():
        return 0
    return len(path.read_bytes().partition(b"\n")[2]) // ROW.itemsize


def killed_and_resumed(plan: Plan, points: int) -> tuple[str, int]:
    """Kill the command half-way and start it again; return its file's hash and the points kept."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "e.parquet"
        command = [sys.executable, "-m", "capture_sim.cli", "envelope", f"--angle={ANGLE}"]
        command += [f"--offset={OFFSET}", f"--speed={SPEED}", f"--levels={LEVELS}"]
        command += [f"--runs={points}", "--workers=2", f"--out={out}", "--mark"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        first = subprocess.Popen(command, **quiet)
        half = plan.runs * (1 + CHECKS) / 2
        while (kept := kept_runs(out.with_suffix(".runs"))) < half:
            if first.poll() is not None:
                raise SystemExit("the command ended before it could be killed")
            time.sleep(0.05)
        os.kill(first.pid, signal.SIGKILL)
        first.wait()
        subprocess.run(command, check=True, **quiet)
        return digest(out), kept


def verdict_errors(envelope: Envelope) -> list[str]:
    """Runs near the boundary at several tolerances, against a much finer one."""
    checked = envelope.rows[envelope.rows["checked"]]
    keys = [(int(r["slice"]), int(r["i"]), int(r["j"])) for r in checked]
    keys = keys[:: max(1, len(keys) // 300)]
    fine = evaluate(envelope.plan, keys, 1e-11)
    own = envelope.rows[[envelope.places[key] for key in keys]]
    wrong = own["verdict"] != fine["verdict"]
    flagged = own["verdict"] != own["finer_verdict"]
    lines = [
        "| rtol | ms a run | other verdict | capture or not | nearest off: median, worst mm |",
        "|---|---|---|---|---|",
    ]
    caught = fine["verdict"] == CaptureState.CAPTURED
    for rtol in (1e-3, 1e-4, 1e-5, 1e-6, 1e-8):
        began = time.perf_counter()
        rows = evaluate(envelope.plan, keys, rtol)
        each = (time.perf_counter() - began) / len(keys)
        off = np.abs(rows["nearest"] - fine["nearest"]) * 1e3
        other = int((rows["verdict"] != fine["verdict"]).sum())
        flips = int(((rows["verdict"] == CaptureState.CAPTURED) != caught).sum())
        lines.append(
            f"| {rtol:.0e} | {each * 1e3:.1f} | {other} | {flips} | "
            f"{np.median(off):.1e}, {off.max():.1e} |"
        )
    return [
        f"{len(keys)} points next to the boundary, against rtol 1e-11:",
        "",
        *lines,
        "",
        f"So maps are made at rtol {envelope.plan.rtol:.0e}. Of the {int(wrong.sum())} verdicts "
        f"that are other there, halving the tolerance flags {int((wrong & flagged).sum())}; it "
        f"flags {int(flagged.sum())} in all.",
    ]


#: What an earlier checkout is asked: runs, seconds and processor time of the same map.
_EARLIER = """
import sys, envelope
made = envelope.by_processes(envelope.the_plan(int(sys.argv[1])), 2)
print(made.runs, made.seconds, made.busy)
"""


def earlier(checkout: Path, points: int, two: Timed, others: OthersAtWork) -> list[str]:
    """Measure an earlier checkout, with its own interpreter, in turn with this one."""
    root, python = Path(__file__).resolve().parent, checkout / ".venv/bin/python"
    environment = os.environ | {"PYTHONPATH": f"{checkout}:{checkout / 'benchmarks'}"}

    def ask(interpreter: Path | str, arguments: list[str], env: dict[str, str]) -> str:
        called = [str(interpreter), *arguments]
        return subprocess.run(called, env=env, check=True, capture_output=True, text=True).stdout

    best: list[dict[str, float]] = []
    for interpreter, env in ((python, environment), (sys.executable, dict(os.environ))):
        rounds = [
            json.loads(ask(interpreter, [str(root / "verdict.py")], dict(env))) for _ in range(3)
        ]
        best.append({name: min(each[name] for each in rounds) for name in rounds[0]})
    runs, seconds, busy = map(
        float, ask(python, ["-c", _EARLIER, str(points)], environment).split()
    )
    was, now = best
    then, each = busy / runs * 1e4, two.busy / two.runs * 1e4
    return [
        "Against an earlier state, measured in turn, ms of a processor (the least of 3 times 15; "
        f"others kept {others.cores():.1f} cores busy meanwhile):",
        "",
        "| what | before | now |",
        "|---|---|---|",
        f"| kernel, tilt_p10 to its verdict | {was['kernel']:.1f} | {now['kernel']:.1f} |",
        f"| the run to its verdict | {was['run']:.1f} | {now['run']:.1f} |",
        f"| ... over the kernel's time | {was['run'] / was['kernel']:.2f} | "
        f"{now['run'] / now['kernel']:.2f} |",
        f"| a point of a map | {was['point']:.2f} | {now['point']:.2f} |",
        f"| 10 000 runs, 2 processes: s of processors | {then:.0f} | {each:.0f} "
        f"({then / each:.1f} times less) |",
        f"| ... on the clock | {seconds / runs * 1e4:.0f} | {two.seconds / two.runs * 1e4:.0f} |",
        "",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10_000, help="to a verdict, about")
    parser.add_argument("--before", type=Path, help="checkout of an earlier state, to compare")
    options = parser.parse_args()
    compile_kernels()
    others = OthersAtWork()
    points = round(options.runs / (1 + CHECKS))
    plan = the_plan(points)
    two = by_processes(plan, 2)
    print(f"2 processes: {two.runs} runs in {two.seconds:.1f} s, busy {two.busy:.1f} s", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        one = timed(plan, InProcess(), Path(folder))
    print(f"1 process: {one.seconds:.1f} s", flush=True)
    dask = by_dask(plan)
    print(f"Dask: {dask.seconds:.1f} s" if dask else "Dask: not installed", flush=True)
    resumed, kept = killed_and_resumed(plan, points)
    print(f"killed with {kept} points kept, resumed", flush=True)
    compared = [] if options.before is None else earlier(options.before, points, two, others)
    envelope = two.envelope
    marks = [simulate(load_scene(name)) for name in ("tilt_0", "tilt_p10", "tilt_m10")]
    save(draw_envelope(envelope, marks), DOCS / "envelope" / "map.png")
    (_, across), (_, up) = plan.plane
    grid = len(plan.slices) * ((across.cells << LEVELS) + 1) * ((up.cells << LEVELS) + 1)
    command = (
        f".venv/bin/capture-sim envelope --angle={ANGLE} --offset={OFFSET} --speed={SPEED} "
        f"--levels {LEVELS} --runs {points}"
    )
    same = {
        "1 process": one.digest == two.digest,
        "a Dask cluster of 2 workers": None if dask is None else dask.digest == two.digest,
        f"killed with {kept} points done, and resumed": resumed == two.digest,
    }
    words = {True: "the same bytes", False: "**another file**", None: "not installed"}
    finest = 0.25**LEVELS / (across.cells * up.cells)
    text = "\n".join(
        [
            "# The capture envelope",
            "",
            "Made by `.venv/bin/python -m benchmarks.envelope"
            + (f" --runs {options.runs}`." if options.runs != 10_000 else "`."),
            "",
            "![Capture envelope of the bench](envelope/map.png)",
            "",
            "```sh {.minutes}",
            command,
            "```",
            "",
            "The bench of the three experiments, without rail and string: each run starts 2 mm "
            "before the touch, at the speed that is asked for there. Offset: of the chaser's path "
            "from the target's centre of mass.",
            "",
            "## How sure",
            "",
            f"A cell of the finest level is {finest:.4%} of its plane. 'At least' are the cells "
            "all of whose corners are captured, 'at most' those with one; a pocket smaller than a "
            "coarse cell, no corner of which falls into it, is not seen. Ill-conditioned are cells "
            "of the boundary where a corner's verdict changes when the tolerance is halved: there "
            "a touch more or less decides, and no finer map would help.",
            "",
            "| speed m/s | captured at least | at most | ill-conditioned |",
            "|---|---|---|---|",
            *(
                f"| {value:g} | {share['surely']:.2%} | {share['perhaps']:.2%} | "
                f"{share['ill_conditioned']:.4%} |"
                for value, share in zip(plan.slices, envelope.shares, strict=True)
            ),
            "",
            *verdict_errors(envelope),
            "",
            "## How fast",
            "",
            f"{two.runs} runs to a verdict ({len(envelope.rows)} points, "
            f"{int(envelope.rows['checked'].sum())} of them twice) in {two.seconds:.1f} s by 2 "
            f"processes, {two.seconds / two.runs * 1e4:.0f} s for 10 000. Their processors were "
            f"busy for {two.busy:.1f} s, {two.busy / two.runs * 1e4:.0f} s for 10 000: half of "
            "that is what two cores need that do nothing else. By 1 process "
            f"{one.seconds:.1f} s ({one.seconds / two.seconds:.2f} times that)"
            + (f", by a Dask cluster of 2 workers {dask.seconds:.1f} s" if dask else "")
            + ". A full grid as fine as the finest cells would take "
            f"{grid} points, {grid / len(envelope.rows):.0f} times as many.",
            "",
            *compared,
            "## The same everywhere",
            "",
            "Beside the file of 2 processes: "
            + "; ".join(f"{how}: {words[holds]}" for how, holds in same.items())
            + ".",
            "",
        ]
    )
    (DOCS / "envelope.md").write_text(text, encoding="utf-8")
    print(text)
    if False in same.values():
        raise SystemExit("the files differ")


if __name__ == "__main__":
    main()
