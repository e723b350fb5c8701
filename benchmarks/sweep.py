"""Sweeps: how much slower than their kernels, and how far their verdicts can be trusted.

    python -m benchmarks.sweep [speed trust verdicts] [--runs 10000]

writes the parts of docs/evidence/random_scenes.md, in six minutes.  benchmarks/call.py measures a
row of a sweep, also beside an earlier state.
"""

from __future__ import annotations

import os
import time
from argparse import Namespace
from pathlib import Path

import numpy as np

from benchmarks.counting_executor import KernelTime
from benchmarks.pages import table, write_parts
from capture_sim import load_scene, sweep
from capture_sim.studies.evaluate.executors import open_executor

SWEEPS = {
    "tilt_0, dispersions": (
        "tilt_0",
        {
            "initial.chaser.y": "normal(5 mm, 2 mm)",
            "initial.target.theta": "uniform(-5 deg, 5 deg)",
            "buffer.k_A": "normal(500, 5%)",
        },
    ),
    "tilt_0, approaches": (
        "tilt_0",
        {
            "approach.angle": "uniform(-30 deg, 30 deg)",
            "approach.offset": "uniform(-50 mm, 50 mm)",
            "approach.speed": "uniform(0.05, 0.2)",
        },
    ),
}


#: Dispersions of the three experiments, of docs/sweep.md.
EXPERIMENTS = {
    "tilt_0": {"initial.target.theta": "normal(0 deg, 1.5 deg)"},
    "tilt_p10": {"initial.target.theta": "normal(10 deg, 1.5 deg)"},
    "tilt_m10": {"initial.target.theta": "normal(-10 deg, 1.5 deg)"},
}
_OF_ALL = {
    "string.impact_speed": "normal(0.1, 0.01)",
    "friction.mu": "uniform(0.1, 0.3)",
    "contact.restitution": "uniform(0.3, 0.9)",
    "buffer.k_A": "loguniform(50%, 200%)",
}


def speed(asked: Namespace, _: Path) -> list[str]:
    """Wall time of a sweep over the time of its kernels a core, both of one run."""
    cores = len(os.sched_getaffinity(0))
    rows = []
    for name, (scene, vary) in SWEEPS.items():
        with open_executor(cores) as pool:
            # libraries and kernels are loaded once: that is no part of the rate
            sweep(scene, vary, runs=100, executor=pool)
            executor = KernelTime(pool)
            began, used = time.perf_counter(), time.process_time()
            sweep(scene, vary, runs=asked.runs, executor=executor)
            wall, here = time.perf_counter() - began, time.process_time() - used
        least = executor.wall / cores
        kernels = executor.processor / asked.runs
        outside = (executor.tasks - executor.processor + here) / asked.runs
        rows.append(
            [name, f"{wall:.1f}", f"{least:.1f}", f"{wall / least:.2f}", f"{asked.runs / wall:.0f}"]
        )
        rows[-1] += [f"{kernels * 1e3:.2f}", f"{outside * 1e3:.2f}"]
    head = [f"{asked.runs} runs", "wall time s", "kernels / cores s", "ratio", "runs/s"]
    head += ["kernels, CPU time ms per run", "other CPU time"]
    return [f"{cores} processes on {cores} cores.", "", table(head, rows)]


def trust(asked: Namespace, _: Path) -> list[str]:
    """Runs of the map at several tolerances, against a much finer one."""
    scene = load_scene("tilt_0")
    vary = SWEEPS["tilt_0, approaches"][1]
    runs = max(asked.runs // 20, 10)

    def at(rtol: float):
        return sweep(scene, vary, {"run.rtol": rtol}, runs=runs)

    fine, rows = at(1e-11), []
    for rtol in (1e-4, 1e-5, 1e-6, 1e-8):
        found = at(rtol)
        deviation = (found["nearest_distance"] - fine["nearest_distance"]).abs() * 1e3
        force = (found["max_normal_force"] / fine["max_normal_force"] - 1.0).abs()
        rows.append(
            [
                f"{rtol:.0e}",
                int((found["verdict"] != fine["verdict"]).sum()),
                f"{deviation.median():.1e}",
                f"{deviation.max():.1e}",
                f"{np.nanmedian(force):.1e}",
                f"{np.nanmax(force):.1e}",
            ]
        )
    head = ["rtol", "other verdict", "closest approach: median mm", "worst mm"]
    return [
        f"{runs} approaches to tilt_0, compared with rtol 1e-11:",
        "",
        table([*head, "peak force: median", "worst"], rows),
    ]


def verdicts(asked: Namespace, _: Path) -> list[str]:
    """Verdicts of the experiments' dispersions at the tolerance of sweeps, against 1e-10."""
    runs, rows = max(asked.runs // 5, 10), []
    for name, own in EXPERIMENTS.items():
        usual = sweep(name, {**_OF_ALL, **own}, runs=runs)
        fine = sweep(name, {**_OF_ALL, **own}, runs=runs, rtol=1e-10)
        differ = int((usual["verdict"] != fine["verdict"]).sum())
        force = (usual["max_normal_force"] / fine["max_normal_force"] - 1.0).abs()
        n_captured = int((fine["verdict"] == "captured").sum())
        rows.append([name, runs, n_captured, differ, f"{force.max():.1e}"])
    head = ["dispersions of", "draws", "captured", "other verdict", "peak force: largest error"]
    return ["Tolerance 1e-6, the default, compared with 1e-10:", "", table(head, rows)]


if __name__ == "__main__":
    write_parts(
        "random_scenes",
        __doc__,
        {"speed": speed, "trust": trust, "verdicts": verdicts},
        untimed=("trust", "verdicts"),
        runs=(10_000, "of each sweep"),
    )
