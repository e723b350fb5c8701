"""Trials with known parameters as a laboratory measures them, cheap enough for tests.

They begin just before the first touch, without rail and string, and last a second.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from capture_sim.dynamics.bench import Bench
from capture_sim.run.given import Given
from capture_sim.run.run import MeasuredRun, Run
from capture_sim.run.series import Series, series_in
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import with_values

#: Standard deviations: motion capture (m, m, rad), stroke (m), torsion (rad).
NOISE = {
    "chaser": (2e-4, 2e-4, 1e-3),
    "target": (2e-4, 2e-4, 1e-3),
    "stroke": 2e-5,
    "torsion": 1e-4,
}
#: Rates of poses and of the buffer's sensors, Hz, and how long a trial is measured, s.
POSE_RATE, BUFFER_RATE, LASTS = 100.0, 500.0, 1.0


def short_scene(angle: float = 0.0, offset: float = 0.005) -> Scene:
    """Return tilt_0 in free flight before its first touch; rad, m."""
    approach = {"approach.angle": angle, "approach.offset": offset, "approach.speed": 0.1}
    return load_scene("tilt_0", {**approach, "run.t_end": LASTS})


def measured_trial(
    scene: Scene,
    true: Mapping[str, float],
    seed: int,
    *,
    name: str = "trial",
    shift: Sequence[float] = (0.0, 0.0, 0.0),
    delays: Mapping[str, float] | None = None,
    scales: Mapping[str, float] | None = None,
) -> Run:
    """Return a scene measured on a bench whose fields have other values.

    Parameters
    ----------
    scene
        The scene as its user knows it.
    true
        True values by path.
    seed
        Seed of the noise.
    name
        Name of the run.
    shift
        How far the target is from where the scene has it, m, m, rad.
    delays, scales
        By how much series are late, s, and factors of what they show.
    """
    rng = np.random.default_rng(seed)
    target = scene.initial.target
    place = {
        "initial.target.x": target.x + shift[0],
        "initial.target.y": target.y + shift[1],
        "initial.target.theta": target.theta + shift[2],
    }
    bench = Bench(with_values(scene, {**true, **place}))
    dense = np.arange(0.0, scene.run.t_end, 1e-4)
    exact = series_in(bench.advance(dense))
    series = {}
    for quantity, sigma in NOISE.items():
        rate = BUFFER_RATE if quantity in ("stroke", "torsion") else POSE_RATE
        t = np.arange(0.0, scene.run.t_end, 1.0 / rate)
        late = (delays or {}).get(quantity, 0.0)
        index = np.clip(np.rint((t - late) * 1e4).astype(int), 0, len(exact[quantity].t) - 1)
        values = exact[quantity].values[index] * (scales or {}).get(quantity, 1.0)
        noisy = values + rng.normal(size=values.shape) * sigma
        series[quantity] = {"a sensor": Series(t, noisy)}
    return MeasuredRun(name, Given(scene=scene, series=series))
