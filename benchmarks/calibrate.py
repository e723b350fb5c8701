"""Calibration tried: random benches, wrong models, predictions, and a bench of known parameters.

python -m benchmarks.calibrate recover --seeds 20             # about 25 s of CPU a seed
python -m benchmarks.calibrate lacks --seeds 20               # a delay, friction, contact, a scale
python -m benchmarks.calibrate known FOLDER                   # recordings of a known bench

Each random bench has ten parameters up to 30 % from the scene's; it makes three trials (tilt_0,
tilt_p10, tilt_m10), whose vehicles are placed with errors of 1 mm and 5 mrad.  Poses come at 100 Hz
with noise of 0.2 mm and 1 mrad, stroke and torsion at 500 Hz with 20 um and 0.1 mrad; each trial is
recorded from 0.2 s before the release, which is known to 50 ms, to 1.5 s after the first contact.

These measurements are of capture_sim itself.  The recordings of `known` are of another model.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from capture_sim import load_scene, read_run
from capture_sim.dynamics.bench import Bench
from capture_sim.errors import SceneError, SimulationError
from capture_sim.run.run import Run
from capture_sim.run.series import Series, series_in
from capture_sim.scene.launch_plan import plan_launch
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import with_values
from capture_sim.studies.calibration.calibrate import Calibration, calibrate
from capture_sim.studies.calibration.trial import launched

TRIALS = ("tilt_0", "tilt_p10", "tilt_m10")
PATHS = {
    "c_rr": ("supports.chaser.c_rr", "supports.target.c_rr"),
    "e": ("contact.restitution",),
    "mu": ("friction.mu",),
    "c_A": ("buffer.c_A",),
    **{
        name: (name,)
        for name in (
            *("buffer.k_A", "buffer.k_T", "chaser.mass", "target.mass"),
            *("chaser.inertia", "target.inertia"),
        )
    },
}
SPREAD = 0.3
PLACED = (1e-3, 1e-3, 5e-3)
NOISE = {
    "chaser": (2e-4, 2e-4, 1e-3),
    "target": (2e-4, 2e-4, 1e-3),
    "stroke": 2e-5,
    "torsion": 1e-4,
}
BEFORE, AFTER, RELEASE = 0.2, 1.5, 0.05
#: Names that count as found for a model that lacks something, and its size by a uniform number.
LACKS = {
    "delay": (("delay.buffer",), 2e-3, 10e-3),
    "friction": (("buffer.friction",), 0.02, 0.3),
    "contact": (("contact.stiffness",), 0.01, 0.2),
    "scale": (("scale.stroke",), 1.01, 1.05),
}
#: The bench of the known recordings, and the next trial's figures.
KNOWN = {
    "c_rr": 0.00085,
    "e": 0.66,
    "mu": 0.27,
    "c_A": 17.5,
    "buffer.k_A": 640.0,
    "buffer.k_T": 235.0,
    "chaser.mass": 22.6,
    "target.mass": 23.2,
    "chaser.inertia": 0.468,
    "target.inertia": 0.505,
}
KNOWN_NEXT = {
    "max_axial_stroke_in": 7.794e-3,
    "max_axial_stroke_out": 5.759e-3,
    "max_torsion": 8.028e-3,
    "max_normal_force": 367.0,
}


def random_bench(rng: np.random.Generator) -> dict[str, float]:
    """Return true values of a bench by parameter."""
    scene = load_scene("tilt_0")
    values = {}
    for name, paths in PATHS.items():
        owner: object = scene
        for part in paths[0].split("."):
            owner = getattr(owner, part)
        assert isinstance(owner, float)
        values[name] = owner * float(rng.uniform(1.0 - SPREAD, 1.0 + SPREAD))
    return values


def measured(
    name: str,
    true: dict[str, float],
    rng: np.random.Generator,
    more: dict[str, float] | None = None,
    late: float = 0.0,
    scale: float = 1.0,
) -> Run:
    """Return a trial of a bench; its launch is the one that was planned for the scene."""
    scene = load_scene(name)
    plan = plan_launch(scene)
    shift = rng.normal(size=(2, 3)) * PLACED
    fields = {path: value for key, value in true.items() for path in PATHS[key]}
    for vehicle, off in zip(("chaser", "target"), shift, strict=True):
        pose = getattr(scene.initial, vehicle)
        for key, change in zip(("x", "y", "theta"), off.tolist(), strict=True):
            fields[f"initial.{vehicle}.{key}"] = getattr(pose, key) + change
    launch = {"string.impact_speed": None}
    launch |= {"string.hanging_mass": plan.hanging_mass, "string.drop_height": plan.drop_height}
    bench = Bench(with_values(scene, {**fields, **launch, **(more or {})}))
    dense = np.arange(0.0, 6.0, 2e-4)
    samples = bench.advance(dense)
    begun = bench.touches["start"]
    end = (float(begun.min()) if begun.size else 3.0) + AFTER
    exact = series_in(samples)
    wrong = float(rng.uniform(-RELEASE, RELEASE))
    series = {}
    for quantity, sigma in NOISE.items():
        buffer = quantity in ("stroke", "torsion")
        rate = 500.0 if buffer else 100.0
        t = np.arange(-BEFORE, end, 1.0 / rate) + rng.uniform(0.0, 1.0 / rate)
        since = np.maximum(t - (late if buffer else 0.0), 0.0)
        columns = exact[quantity].values.reshape(len(samples), -1)
        exact_t = exact[quantity].t
        seen = np.stack([np.interp(since, exact_t, column) for column in columns.T], axis=1)
        values = (seen[:, 0] if buffer else seen) * (scale if quantity == "stroke" else 1.0)
        noisy = values + rng.normal(size=values.shape) * sigma
        series[quantity] = {"a sensor": Series(t + wrong, noisy)}
    return Run(name, given_scene=scene, series=series, plan=plan)


def distance(found: Calibration, true: dict[str, float]) -> float:
    """Return the squared Mahalanobis distance of the parameters from the truth."""
    off = found.values - [true[name] for name in found.names]
    return float(off @ np.linalg.solve(found.covariance, off))


def recover(seeds: Sequence[int]) -> None:
    """Fit right models; print distances, refusals, coverage of predictions and cost."""
    from scipy.stats import chi2

    limit = float(chi2.ppf(0.99, len(PATHS)))
    near = refused = false = covered = figures = 0
    z: list[float] = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        true = random_bench(rng)
        begin = time.process_time()
        try:
            trials = [measured(name, true, rng) for name in TRIALS]
        except (SceneError, SimulationError) as error:
            print(f"seed {seed}: bench left out: {error}", flush=True)
            continue
        coming = launched(measured("tilt_0", true, rng).replaced(given_scene=_next(rng)))
        found = calibrate(trials, predict=coming)
        off = distance(found, true)
        is_near = off < limit
        near += is_near
        refused += is_near and not found.is_found
        false += not is_near and found.is_found
        z += ((found.values - [true[n] for n in found.names]) / found.errors).tolist()
        assert found.prediction is not None
        for figure, value in zip(found.prediction.figures, _figures(coming, true), strict=True):
            figures += 1
            covered += figure.low <= value <= figure.high
        print(
            f"seed {seed}: distance {off:.1f} (99 %: {limit:.1f}), found {found.is_found}, "
            f"left {found.left:.2f}, trials p {found.agreement.p:.2g}, {found.simulations} "
            f"simulations, {time.process_time() - begin:.0f} s CPU; "
            f"{'; '.join(f.text for f in found.findings)}",
            flush=True,
        )
    if z:
        rms = float(np.sqrt(np.mean(np.square(z))))
        print(
            f"{near} of {len(z) // len(PATHS)} within 99 %, {refused} right fits refused, {false} "
            f"false ones accepted; rms z {rms:.2f}; {covered} of {figures} predicted figures in "
            "their 95 % band"
        )


def _next(rng: np.random.Generator) -> Scene:
    """Return the scene of a trial to come."""
    angle, y = float(rng.uniform(-0.15, 0.15)), float(rng.uniform(-5e-3, 5e-3))
    return load_scene("tilt_0", {"initial.target.theta": angle, "initial.chaser.y": y})


def _figures(scene: Scene, true: dict[str, float]) -> list[float]:
    from capture_sim.run.loads import loads_of
    from capture_sim.studies.calibration.prediction import FIGURES

    fields = {path: value for key, value in true.items() for path in PATHS[key]}
    bench = Bench(with_values(scene, fields))
    bench.advance(np.zeros(0))
    loads = loads_of(bench.extremes, bench.touches)
    return [float(loads[name]) for name in FIGURES]


def lacks(seeds: Sequence[int]) -> None:
    """Fit models that lack something; print whether it is named."""
    for kind, (names, low, high) in LACKS.items():
        named = refused = 0
        for seed in seeds:
            rng = np.random.default_rng([seed, len(kind)])
            true = random_bench(rng)
            size = low * (high / low) ** float(rng.uniform())
            more: dict[str, float] = {}
            late, scale = 0.0, 1.0
            if kind == "delay":
                late = size
            elif kind == "scale":
                scale = size
            elif kind == "friction":
                more["buffer.friction"] = size
            else:
                more["contact.stiffness"] = load_scene("tilt_0").contact_stiffness * size
            try:
                trials = [measured(name, true, rng, more, late, scale) for name in TRIALS]
            except (SceneError, SimulationError):
                continue
            begin = time.process_time()
            found = calibrate(trials, restarts=2)
            lacking = {one.score.name: one for one in found.lacking}
            is_named = bool(set(names) & set(lacking))
            named, refused = named + is_named, refused + (not found.is_found)
            shown = ", ".join(f"{k} {one.estimate:.4g}" for k, one in lacking.items())
            print(
                f"{kind} {size:.4g}, seed {seed}: named {is_named} ({shown or 'nothing'}), found "
                f"{found.is_found}, {time.process_time() - begin:.0f} s CPU",
                flush=True,
            )
        print(f"{kind}: named in {named}, refused in {refused} of {len(seeds)}", flush=True)


def known(folder: Path) -> None:
    """Fit the recordings of a bench whose parameters are known; print errors and z."""
    sets = (
        ("three trials", ("trial_0", "trial_p10", "trial_m10"), False),
        ("masses weighed to 0.1 %", ("trial_0", "trial_p10", "trial_m10"), True),
        (
            "with start_displaced",
            ("trial_0", "trial_p10", "trial_m10", "start_displaced"),
            False,
        ),
        ("start_displaced alone", ("start_displaced",), False),
    )
    coming = launched(read_run(folder / "next_trial.mcap"))
    for title, names, is_weighed in sets:
        trials = [read_run(folder / f"{name}.mcap") for name in names]
        weighed = {"chaser.mass": "22.6 +- 0.1 %", "target.mass": "23.2 +- 0.1 %"}
        begin = time.process_time()
        found = calibrate(trials, weighed=weighed if is_weighed else None, predict=coming)
        print(
            f"{title}: found {found.is_found}, chi2 {found.reduced_chi2:.3f}, "
            f"{found.simulations} simulations, {time.process_time() - begin:.0f} s CPU"
        )
        for name, value, error in zip(found.names, found.values, found.errors, strict=True):
            z = (value - KNOWN[name]) / error
            print(f"  {name:15} {value:.6g} +- {100.0 * error / value:.2f} % ({z:+.1f})")
        assert found.prediction is not None
        for figure in found.prediction.figures:
            print(
                f"  {figure.name} {figure.value:.6g} +- {figure.error:.2g}, truth "
                f"{KNOWN_NEXT[figure.name]:.6g}"
            )
        for finding in found.findings:
            print(f"  not found: {finding.text}")


def main() -> None:
    """Run the parts that are named."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("part", choices=("recover", "lacks", "known"))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    if options.part == "recover":
        recover(seeds)
    elif options.part == "lacks":
        lacks(seeds)
    elif options.folder is None:
        parser.error("known: must have the folder of the recordings")
    else:
        known(options.folder)


if __name__ == "__main__":
    main()
