"""What many cores give one study: its runs over the runs on its longest path.

    python -m benchmarks.gain             # ten minutes

A study hands its runs to an executor in batches.  With W workers a batch takes as long as the runs
of one of them; their sum is the longest path.  Here all runs are made one after another and only
counted, so no figure depends on the machine.  Runs that a search asks for ahead, and may not need,
are in the path and not in the study.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.calibrate import TRIALS, measured, random_bench, random_held
from benchmarks.pages import table, write_parts
from capture_sim import load_scene
from capture_sim.studies.evaluate.executors import InProcess
from capture_sim.studies.evaluate.limits import make_limits, make_objectives
from capture_sim.studies.fit.calibrate import calibrate
from capture_sim.studies.search.design import design_buffer
from capture_sim.studies.search.evaluator import Requirements

#: Numbers of workers.
WORKERS = (2, 16, 200)


class Ideal(InProcess):
    """Executor in this process that counts as if it had some workers."""

    def __init__(self, workers: int) -> None:
        self.workers, self.runs, self.path = workers, 0, 0

    def map(self, fn: Callable[..., Any], *iterables: Iterable[Any], **_: Any) -> Iterator[Any]:
        """Return the results; a task that is a list has a run for each item."""
        tasks = list(zip(*iterables, strict=True))
        sizes = [len(task[0]) if isinstance(task[0], list) else 1 for task in tasks]
        # each task goes to the worker with the fewest runs, the largest first
        load = np.zeros(self.workers, dtype=int)
        for size in sorted(sizes, reverse=True):
            load[load.argmin()] += size
        self.runs, self.path = self.runs + sum(sizes), self.path + int(load.max())
        return (fn(*task) for task in tasks)


def a_design(executor: Ideal) -> tuple[str, int]:
    """Return what a front of two objectives finds, and the buffers that it tries."""
    objectives = make_objectives(["max_axial_stroke_in", "max_buffer_force"])
    asked = Requirements(objectives, make_limits({"max_torsion": 8e-3}))
    found = design_buffer(load_scene("tilt_p10"), asked, executor=executor)
    return repr(found.front), len(found.history)


def a_fit(executor: Ideal) -> tuple[str, int]:
    """Return what a fit of three trials finds, and its simulations."""
    rng = np.random.default_rng([0, 78])
    true, held = random_bench(rng), random_held(rng)
    trials = [measured(one, true, rng, held) for one in TRIALS]
    found = calibrate(trials, executor=executor)
    return repr(found.values), found.simulations


STUDIES = {"design, two objectives": a_design, "calibrate, three trials": a_fit}


def gain(_: Namespace, __: Path) -> list[str]:
    """Return the table of ideal gains, after the check that no result depends on the workers."""
    rows = []
    for name, study in STUDIES.items():
        found = set()
        for workers in WORKERS:
            executor = Ideal(workers)
            result, runs = study(executor)
            found.add(result)
            rows.append(
                [name, workers, runs, executor.runs, executor.path, f"{runs / executor.path:.1f}"]
            )
        assert len(found) == 1, f"{name}: results depend on the number of workers"
    head = ["study", "workers", "runs of it", "runs made", "longest path", "ideal gain"]
    return [table(head, rows)]


if __name__ == "__main__":
    write_parts("random_scenes", __doc__, {"gain": gain}, untimed={"gain"})
