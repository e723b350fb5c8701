"""One method, three programs: what of SciPy's time is Python; writes a part of docs/benchmark.md.

Run it as ``.venv/bin/python -m benchmarks.same_method`` on an idle machine.
"""

from __future__ import annotations

import argparse
import functools
import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.engines import own, scipy_ivp, textbook
from benchmarks.pages import error, ratio, seconds, table, write_parts
from benchmarks.reference import load_reference
from benchmarks.trial import Errors, Prepare, errors
from capture_sim.bench import error_scale
from capture_sim.launch.scenes import load_scene
from capture_sim.scene.parts import Scene

SCENE = "paper_designed"
_RTOLS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
#: (end of the run in s, position errors in m at which times are compared)
_HORIZONS = ((0.35, (1e-6, 1e-8, 1e-9)), (1.5, (1e-6, 1e-8)))
PROGRAMS = ("capture_sim dop853", "textbook DOP853, compiled", "SciPy DOP853, compiled equations")


def scipy_job(scene: Scene) -> Prepare:
    """Return what prepares SciPy's run at the scene's tolerance, in our own norm."""
    y_0 = np.concatenate(scene.initial_coordinates())
    options = {"method": "DOP853", "rtol": 2.5e-14, "atol": error_scale(own.packed(scene)[0])[:16]}
    return functools.partial(scipy_ivp.prepare, scene, "compiled", y_0, 10.0, options)


def compare(asked: argparse.Namespace, _: Path) -> Sequence[str]:
    """Run all programs at all tolerances in turn; return a table for each horizon."""
    lines = []
    for t_end, levels in _HORIZONS:
        truth = load_reference(SCENE, load_scene(SCENE)).at(t_end)
        jobs: dict[tuple[str, float], Prepare] = {}
        for rtol in _RTOLS:
            scene = own.with_run(load_scene(SCENE), t_end=t_end, rtol=rtol, method="dop853")
            jobs[PROGRAMS[0], rtol] = functools.partial(own.prepare, scene)
            jobs[PROGRAMS[1], rtol] = functools.partial(textbook.prepare, scene)
            jobs[PROGRAMS[2], rtol] = scipy_job(scene)
        spent: dict[tuple[str, float], list[float]] = {key: [] for key in jobs}
        found: dict[tuple[str, float], tuple[int, Errors]] = {}
        for _round in range(asked.rounds):
            for key, prepare in jobs.items():
                if sum(spent[key]) > asked.enough:
                    continue
                prepare()[0]()  # fills the processor's caches
                job, read = prepare()
                began = time.thread_time()
                result = job()
                spent[key].append(time.thread_time() - began)
                if key not in found:
                    outcome = read(result)
                    found[key] = outcome.evaluations, errors(outcome, truth)
        n_touches = len(truth.touches) if truth.touches is not None else 0
        rows = []
        for level in levels:
            ours = math.nan
            for program in PROGRAMS:
                keys = [(program, rtol) for rtol in _RTOLS]
                good = [
                    key
                    for key in keys
                    if found[key][1].position <= level and found[key][1].touches == n_touches
                ]
                if not good:
                    rows.append([f"{level:.0e} m", program, *"------"])
                    continue
                key = min(good, key=lambda k: min(spent[k]))
                best, (count, e) = min(spent[key]), found[key]
                ours = best if program == PROGRAMS[0] else ours
                rows.append(
                    [
                        *(f"{level:.0e} m", program, f"{key[1]:.0e}", seconds(best)),
                        *(ratio(best / ours), count, f"{best / count * 1e9:.0f} ns"),
                        error(e.event_time),
                    ]
                )
        head = ["position error below", "program", "rtol", "CPU time", "ratio", "evaluations"]
        head += ["per evaluation", "event times, s"]
        lines += [f"To {t_end:g} s, {n_touches} touches:", "", table(head, rows), ""]
    return lines


if __name__ == "__main__":
    write_parts(
        "benchmark",
        __doc__,
        {"same_method": compare},
        rounds=(11, "rounds, all programs in turn"),
        enough=(6.0, "s after which a setting is not repeated"),
    )
