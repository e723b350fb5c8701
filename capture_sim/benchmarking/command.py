"""``capture-sim benchmark``: measure, show, write the page and its pictures."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from capture_sim.bench import compile_kernels
from capture_sim.benchmarking import costs, engines, machine, operations, tables, work_precision
from capture_sim.benchmarking.page import FOLDER, page
from capture_sim.benchmarking.reference import load_reference
from capture_sim.benchmarking.results import Results
from capture_sim.benchmarking.trial import Progress
from capture_sim.errors import RecordingError
from capture_sim.scene.files import load_scene

SCENE = "paper_designed"
_ON_RAIL = "tilt_0"  # a scene with rail and string


def measure(quick: bool, progress: Progress) -> Results:
    """Measure everything; ``quick`` takes a reduced sweep of less than a minute."""
    began = time.monotonic()
    before = machine.load()
    scene = load_scene(SCENE)
    progress.at("compiling", 0, 1, "kernels")
    compile_kernels()
    plans = work_precision.QUICK if quick else work_precision.FULL
    # what diverges in a trial step of some solver is rejected there, not here
    with np.errstate(all="ignore"):
        works = [work_precision.measure(scene, plan, progress) for plan in plans]
        others = engines.measure(scene, plans[0], quick, progress)
        agreement = [] if quick else engines.exudyn_agreement(scene, progress)
    repeats = 5 if quick else 25
    horizon = plans[0].t_end
    references = {name: load_reference(name) for name in _references(agreement)}
    clock = machine.clock_rate()
    return Results(
        scene=SCENE,
        quick=quick,
        machine=machine.describe(clock),
        clock=clock,
        works=works,
        engines=others,
        agreement=agreement,
        uncertainty={
            name: dict(zip(r.times, r.uncertainty, strict=True)) for name, r in references.items()
        },
        evaluation=costs.evaluation_cost(scene, repeats),
        operations=operations.count(scene),
        parts=costs.part_costs(scene, horizon, repeats, progress),
        rail=costs.rail_cost(load_scene(_ON_RAIL), repeats),
        times=costs.time_costs(
            scene,
            (0.1, 0.35) if quick else (0.01, 0.03, 0.1, 0.35, 1.0, 3.0, 10.0),
            repeats,
            progress,
        ),
        batches=costs.batch_costs(
            scene, horizon, (1, 10) if quick else (1, 10, 100, 1000), 3, progress
        ),
        loads=(before, machine.load()),
        seconds=time.monotonic() - began,
    )


def _references(agreement: list[engines.Agreement]) -> list[str]:
    return [SCENE, *dict.fromkeys(f"{SCENE}_{a.law}" for a in agreement)]


def run(options: argparse.Namespace) -> int:
    """Measure, print the tables, write page and pictures; return the exit status."""
    progress = Progress()
    try:
        results = measure(options.quick, progress)
    finally:
        progress.close()
    print(tables.summary(results))
    folder = Path(options.out)
    try:
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
        (folder / "benchmark.md").write_text(page(results), encoding="utf-8")
        tables.write_trials(results, folder / FOLDER / "trials.csv")
        try:
            from capture_sim.benchmarking.plots import save_all

            save_all(results, folder / FOLDER)
        except ImportError as error:
            print(f"no pictures: {error}")
    except OSError as error:
        raise RecordingError(f"--out {folder}: cannot be written: {error.strerror}") from None
    print(f"\npage in {folder / 'benchmark.md'}, pictures in {folder / FOLDER}")
    return 0
