"""Runs with known parameters as a bench would measure them: noisy poses, strokes and touches."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from capture_sim.bench import Bench
from capture_sim.launch.plan import LaunchPlan, plan_launch
from capture_sim.launch.scenes import load_scene
from capture_sim.run import Run
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import changed
from capture_sim.series import Series, series_in
from capture_sim.touches import Touches, located

#: What is fitted.
NAMES = ("c_rr", "e", "mu", "c_A")
#: The true values are drawn evenly between these.
LOW, HIGH = (0.0007, 0.2, 0.2, 8.0), (0.0013, 0.85, 0.45, 18.0)
#: Standard deviations: motion capture (m, m, rad), stroke (m), torsion (rad), start of a
#: touch (s) and its peak force (N).
POSE_NOISE = (2e-4, 2e-4, 1e-3)
STROKE_NOISE, TORSION_NOISE = 5e-5, 2e-4
START_NOISE, PEAK_NOISE = 2e-4, 2.0
#: Rate of the measurements, Hz, and how many touches are used.
RATE, TOUCHES = 100.0, 4


@dataclass(frozen=True)
class NoisyRun:
    """A run as measured.

    Attributes
    ----------
    scene
        Where a search may begin: its parameters are not the true ones.
    true : ndarray (4,)
        Of :data:`NAMES`.
    run, touches
        With noise; the launch is planned for the scene.
    """

    scene: Scene
    true: np.ndarray
    run: Run
    touches: Touches


def noisy_run(name: str, seed: int, true: tuple[float, ...] | None = None) -> NoisyRun:
    """Run an experiment with parameters drawn at random, or given, and measure it."""
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(LOW, HIGH)
    parameters = drawn if true is None else np.array(true)
    scene = load_scene(name)
    plan = plan_launch(scene)
    bench = Bench(with_parameters(scene, plan, *parameters.tolist()))
    samples = bench.advance(np.arange(0.0, scene.run.t_end, 1.0 / RATE))
    exact = series_in(samples)
    measured = {}
    for quantity, sigma in (
        ("chaser", POSE_NOISE),
        ("target", POSE_NOISE),
        ("stroke", STROKE_NOISE),
        ("torsion", TORSION_NOISE),
    ):
        t, values, _ = exact[quantity]
        noisy = Series(t, values + rng.normal(size=values.shape) * sigma)
        measured[quantity] = {"a sensor": noisy}
    met = bench.touches[np.argsort(bench.touches["start"], kind="stable")][:TOUCHES]
    touches = dataclasses.replace(
        located(met).with_noise(START_NOISE, PEAK_NOISE),
        start=met["start"] + rng.normal(size=met.size) * START_NOISE,
        peak=met["peak_force"] + rng.normal(size=met.size) * PEAK_NOISE,
    )
    return NoisyRun(scene, parameters, Run(name, series=measured, plan=plan), touches)


def later(run: Run, by: float) -> Run:
    """Return a run whose measurements are all later, s."""
    series = {
        quantity: {name: each._replace(t=each.t + by) for name, each in sources.items()}
        for quantity, sources in run.series.items()
    }
    return run.replaced(series=series)


def with_parameters(
    scene: Scene, plan: LaunchPlan, c_rr: float, e: float, mu: float, c_A: float
) -> Scene:
    """Return a scene with these parameters and the launch as planned."""
    for path, value in (
        *(("supports.chaser.c_rr", c_rr), ("supports.target.c_rr", c_rr)),
        *(("contact.restitution", e), ("friction.mu", mu), ("buffer.c_A", c_A)),
    ):
        scene = changed(scene, path, value)
    launch = {"hanging_mass": plan.hanging_mass, "drop_height": plan.drop_height}
    string = dataclasses.replace(scene.string, impact_speed=None, **launch)
    return dataclasses.replace(scene, string=string)
