"""The bench with this package's own integrators."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.trial import TOUCHED, Outcome
from capture_sim.bench import Bench
from capture_sim.errors import SimulationError
from capture_sim.launch.plan import plan_launch
from capture_sim.model.parameters import pack
from capture_sim.scene.parts import Scene


def with_run(scene: Scene, **changes: Any) -> Scene:
    """Return a scene with values of its ``run`` changed."""
    return dataclasses.replace(scene, run=dataclasses.replace(scene.run, **changes))


def packed(scene: Scene) -> np.ndarray:
    """Return the (1,) record of a scene's constants that the compiled kernels read."""
    plan = plan_launch(scene)
    return pack(scene, plan.hanging_mass, plan.drop_height, plan.impact_speed)


def prepare(scene: Scene) -> Callable[[], Callable[[], Outcome]]:
    """Return a function that runs the scene to its end and returns what reads the outcome.

    Everything that is made once is made here; what is returned is what takes the time.
    """
    bench = Bench(scene)
    times = np.array([scene.run.t_end])

    def run() -> Callable[[], Outcome]:
        try:
            samples = bench.advance(times)
        except SimulationError as error:
            failure = str(error).partition(": ")[2]
            nothing = Outcome(np.full(8, np.nan), bench.statistics.evaluations, failure=failure)
            return lambda: nothing
        return lambda: _outcome(bench, samples[-1])

    return run


def _outcome(bench: Bench, last: np.void) -> Outcome:
    ended = np.sort(bench.touches, order="start")
    touches = np.zeros(ended.size, TOUCHED)
    for name in TOUCHED.names or ():
        touches[name] = ended[name]
    # the run's end closes a touch that is still on
    touches["end"][touches["end"] >= bench.scene.run.t_end] = np.nan
    return Outcome(
        q=last["q"].copy(),
        evaluations=bench.statistics.evaluations,
        touches=touches,
        impulse=float(last["impulse"].sum()),
        peak_force=float(touches["peak_force"].max(initial=0.0)),
    )
