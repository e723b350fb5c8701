"""Speed against error, compared with other integrators; writes docs/evidence/benchmark.md.

    make benchmark

that is ``python -m benchmarks.speed``, eight minutes; ``--quick`` needs less than one.  It needs
neither ROS nor an installed package: ``PYTHONPATH=. python -m benchmarks.speed`` in a checkout.
The page is not written if other processes kept more than 0.2 cores busy.
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import costs, programs
from benchmarks.machine import QUIET, OthersAtWork, is_busy
from benchmarks.page import FOLDER, TRIALS, Results, measured, write_trials
from benchmarks.pages import EVIDENCE, filled
from benchmarks.plots import save_all
from benchmarks.trial import Progress
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.scene.loading import load_scene

SCENE = "paper_designed"
_ON_RAIL = "tilt_0"  # a scene with rail and string


def measure(quick: bool, progress: Progress) -> Results:
    """Measure everything; ``quick`` takes a reduced run of less than a minute."""
    scene = load_scene(SCENE)
    progress.at("compiling", 0, 1, "kernels")
    compile_kernels()
    plans = programs.QUICK if quick else programs.FULL
    for prepare in programs.compiled(scene):  # each compiles its own part
        prepare()[0]()
    gc.collect()
    gc.freeze()  # each timing collects before: only what has come since
    began, others = time.monotonic(), OthersAtWork()
    # what diverges in a trial step of some solver is rejected there, not here
    with np.errstate(all="ignore"):
        contests = [programs.measure(scene, plan, progress) for plan in plans]
    repeats, horizon = 5 if quick else 25, plans[0].t_end
    parts = costs.part_costs(SCENE, horizon, quick, 7 if quick else 101, progress)
    progress.at("cost of simulated time, and of batches", 0, 1)
    return Results(
        scene=SCENE,
        quick=quick,
        contests=contests,
        parts=parts,
        rail=costs.rail_cost(load_scene(_ON_RAIL), repeats),
        times=[
            costs.run_cost(scene, t_end, repeats)
            for t_end in ((0.1, 0.35) if quick else (0.01, 0.03, 0.1, 0.35, 1.0, 3.0, 10.0))
        ],
        batches=[
            costs.batch_cost(scene, horizon, size, 3)
            for size in ((1, 10) if quick else (1, 10, 100, 1000))
        ],
        others=others.cores(),
        seconds=time.monotonic() - began,
    )


def save(results: Results, folder: Path) -> None:
    """Write page, trials and pictures into a folder."""
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    page = filled((EVIDENCE / "benchmark.md").read_text(encoding="utf-8"), measured(results))
    (folder / "benchmark.md").write_text(page, encoding="utf-8")
    write_trials(results, folder / FOLDER / TRIALS)
    save_all(results, folder / FOLDER)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the tables, write page and pictures; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a reduced run")
    parser.add_argument("--dry", action="store_true", help="only show what was measured")
    parser.add_argument(
        "--out", type=Path, default=EVIDENCE, help="folder of the page (default: docs/evidence)"
    )
    options = parser.parse_args(arguments)
    results = measure(options.quick, Progress())
    print("\n\n".join(measured(results).values()))
    if options.dry:
        return 0
    if is_busy(results.others):
        print(
            f"not written: other processes kept {results.others:.2f} cores busy: must be at most "
            f"{QUIET:g}",
            file=sys.stderr,
        )
        return 1
    save(results, options.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
