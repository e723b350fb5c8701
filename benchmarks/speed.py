"""Speed against error on this machine, beside what else there is; writes docs/benchmark.md.

    make benchmark

that is ``python -m benchmarks.speed``, eleven minutes; ``--quick`` for a reduced sweep of less than
a minute.
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import costs, other_engines, work_precision
from benchmarks.machine import OthersAtWork
from benchmarks.page import FOLDER, Results, measured, write_trials
from benchmarks.pages import DOCS, filled
from benchmarks.plots import save_all
from benchmarks.trial import Progress
from capture_sim.bench import compile_kernels
from capture_sim.launch.scenes import load_scene

SCENE = "paper_designed"
_OF_ENGINES = ("engines", "agreement")  # parts of the page that need the other engines
_ON_RAIL = "tilt_0"  # a scene with rail and string


def measure(quick: bool, progress: Progress) -> Results:
    """Measure everything; ``quick`` takes a reduced sweep of less than a minute."""
    began, others = time.monotonic(), OthersAtWork()
    scene = load_scene(SCENE)
    progress.at("compiling", 0, 1, "kernels")
    compile_kernels()
    gc.collect()
    gc.freeze()  # each timing collects before: only what has come since
    plans = work_precision.QUICK if quick else work_precision.FULL
    # what diverges in a trial step of some solver is rejected there, not here
    with np.errstate(all="ignore"):
        works = [work_precision.measure(scene, plan, progress) for plan in plans]
        found = other_engines.measure(scene, plans[0], quick, progress)
        agreement = [] if quick else other_engines.exudyn_agreement(scene, progress)
    repeats, horizon = 5 if quick else 25, plans[0].t_end
    parts = costs.part_costs(SCENE, horizon, quick, 7 if quick else 101, progress)
    progress.at("cost of simulated time, and of batches", 0, 1)
    return Results(
        scene=SCENE,
        quick=quick,
        works=works,
        engines=found,
        agreement=agreement,
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


def save(results: Results, folder: Path) -> str:
    """Write page, trials and pictures into a folder; return what was measured, for a terminal."""
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    found = measured(results)
    lacking = [engine.name for engine in results.engines if not engine.version]
    if lacking:
        print(
            f"not installed: {', '.join(lacking)}. The page keeps their earlier numbers; "
            "pip install -c requirements/lock.txt '.[benchmark]' installs them.",
            file=sys.stderr,
        )
        found = {name: text for name, text in found.items() if name not in _OF_ENGINES}
    page = filled((DOCS / "benchmark.md").read_text(encoding="utf-8"), found)
    (folder / "benchmark.md").write_text(page, encoding="utf-8")
    write_trials(results, folder / FOLDER / "trials.csv")
    save_all(results, folder / FOLDER)
    return "\n\n".join([*found.values(), f"page in {folder / 'benchmark.md'}"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the tables, write page and pictures; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a reduced sweep")
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of the page (default: docs)")
    options = parser.parse_args(arguments)
    print(save(measure(options.quick, Progress()), options.out))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
