"""The bench with this package's own integrators."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.trial import TOUCHED, Outcome
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.model.parameters import pack
from capture_sim.scene.launch_plan import plan_launch
from capture_sim.scene.parts import Scene


def with_run(scene: Scene, **changes: Any) -> Scene:
    """Return a scene with values of its ``run`` changed."""
    return dataclasses.replace(scene, run=dataclasses.replace(scene.run, **changes))


def packed(scene: Scene) -> np.ndarray:
    """Return the (1,) record of a scene's constants that the compiled kernels read."""
    plan = plan_launch(scene)
    return pack(scene, plan.hanging_mass, plan.drop_height, plan.impact_speed)


def prepare(scene: Scene) -> tuple[Callable[[], np.void], Callable[[np.void], Outcome]]:
    """Set a run up; return what runs it to its end and what reads the outcome."""
    bench, times = Bench(scene), np.array([scene.run.t_end])

    def read(last: np.void) -> Outcome:
        ended = np.sort(bench.touches, order="start")
        touches = np.zeros(ended.size, TOUCHED)
        for name in TOUCHED.names or ():
            touches[name] = ended[name]
        # the run's end closes a touch that is still on
        touches["end"][touches["end"] >= scene.run.t_end] = np.nan
        return Outcome(
            q=last["q"].copy(),
            evaluations=bench.statistics.evaluations,
            touches=touches,
            impulse=float(last["impulse"].sum()),
            peak_force=float(touches["peak_force"].max(initial=0.0)),
        )

    return lambda: bench.advance(times)[-1], read
