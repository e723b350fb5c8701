"""Runs with known parameters as a bench would measure them: noisy poses, strokes and touches."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from capture_sim.dynamics.bench import Bench
from capture_sim.run.given import Given
from capture_sim.run.run import MeasuredRun, Run
from capture_sim.run.sensors import sensor_series
from capture_sim.run.series import Series, series_in
from capture_sim.run.touches import Touches, in_messages, located
from capture_sim.scene.launch_plan import LaunchPlan, plan_launch
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import LoadCell, Scene, Sensors
from capture_sim.scene.paths import changed

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
#: Of a sampled force: rate, Hz, bias and standard deviation, N, and how long it is measured before
#: and after the first touch, s.
CELL_RATE, CELL_BIAS, CELL_NOISE, AROUND = 2e4, (1.5, -0.8), 0.5, 0.3


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
    return NoisyRun(
        scene, parameters, MeasuredRun(name, Given(series=measured, plan=plan)), touches
    )


def tip_force(run: NoisyRun, rng: np.random.Generator) -> Series:
    """Measure the force on the tip in its own frame, (n, 2), N, around the first touches."""
    samples = _bench_of(run).advance(_cell_times(run))
    force = samples["contact_force"] + samples["latch_force"]
    c, s = np.cos(samples["q"][:, 3]), np.sin(samples["q"][:, 3])
    own = np.stack([c * force[:, 0] + s * force[:, 1], c * force[:, 1] - s * force[:, 0]], axis=1)
    return Series(samples["t"], _as_measured(own, rng))


def cell_force(run: NoisyRun, rng: np.random.Generator, bandwidth: float) -> Series:
    """Measure it by a load cell under the cone, in the cone's axes, (n, 2), N."""
    bench = _bench_of(run)
    sensors = Sensors(None, LoadCell(rate=CELL_RATE, bandwidth=bandwidth))
    rates = dataclasses.replace(bench.scene.run, state_rate=CELL_RATE)
    scene = dataclasses.replace(bench.scene, sensors=sensors, run=rates)
    force = sensor_series(scene, bench.advance(_cell_times(run)))["cone_force"]
    return force._replace(values=_as_measured(force.values, rng))


def counted(run: NoisyRun, rng: np.random.Generator, rate: float) -> Touches | None:
    """Measure the touches by messages that have the number and the peak since the last one.

    The messages have any phase: with the same one, touches of the same run are always as late.
    """
    bench = _bench_of(run)
    t = np.arange(rng.uniform(), (_first_touch(run) + AROUND) * rate) / rate
    bench.advance(t)
    met = located(bench.touches)
    begun, peak = np.zeros(t.size, dtype=int), np.zeros(t.size)
    met = met.of(met.start < t[-1])
    np.add.at(begun, np.searchsorted(t, met.start), 1)
    measured = met.peak + PEAK_NOISE * rng.normal(size=met.peak.size)
    np.maximum.at(peak, np.minimum(np.searchsorted(t, met.peak_time), t.size - 1), measured)
    in_touch = np.zeros(t.size, dtype=bool)
    for start, lasted in zip(met.start, met.lasted, strict=True):
        in_touch |= (t >= start) & (t < start + lasted)
    return in_messages(t, begun, peak, in_touch)


def _first_touch(run: NoisyRun) -> float:
    return float(run.touches.start[0])


def _bench_of(run: NoisyRun) -> Bench:
    assert run.run.plan is not None
    return Bench(with_parameters(run.scene, run.run.plan, *run.true.tolist()))


def _cell_times(run: NoisyRun) -> np.ndarray:
    met = _first_touch(run)
    return np.arange(met - AROUND, met + AROUND, 1.0 / CELL_RATE)


def _as_measured(force: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy: np.ndarray = force + np.array(CELL_BIAS) + CELL_NOISE * rng.normal(size=force.shape)
    return noisy


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
