"""Calibration tried: random benches, wrong models, other starts, and a bench of known parameters.

    python -m benchmarks.calibrate recover                # ten minutes: 45 s of CPU a seed
    python -m benchmarks.calibrate lacks --seeds 8        # half an hour: 50 s of CPU a fit
    python -m benchmarks.calibrate foreign --seeds 14     # benches of another model
    python -m benchmarks.calibrate starts --seeds 8       # from starts up to a factor of 2 off
    python -m benchmarks.calibrate known --folder FOLDER  # recordings of a known bench

Each random bench has ten parameters up to 30 % from the scene's; in `recover`, what the fit holds
is off too, by draws from its standard uncertainties.  It makes three trials (tilt_0, tilt_p10,
tilt_m10), whose vehicles are placed with errors of 1 mm and 5 mrad.  Poses come at 100 Hz
with noise of 0.2 mm and 1 mrad, stroke and torsion at 500 Hz with 20 um and 0.1 mrad; each trial is
recorded from 0.2 s before the release, which is known to 50 ms, to 1.5 s after the first contact.

These measurements are of capture_sim itself.  The recordings of `known` are of another model.
"""

from __future__ import annotations

import argparse
import os
import time
import zlib
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.foreign_plant import Besides, motion_of
from benchmarks.pages import table, write_parts
from capture_sim import load_scene, read_run
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.samples import SAMPLE
from capture_sim.errors import SceneError, SimulationError
from capture_sim.run.given import Given
from capture_sim.run.run import MeasuredRun, Run
from capture_sim.run.series import Series, series_in
from capture_sim.scene.launch_plan import plan_launch
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import expanded, get, with_values
from capture_sim.studies.fit.calibrate import calibrate
from capture_sim.studies.fit.held import uncertainties
from capture_sim.studies.fit.parameters import SENSOR_ERRORS
from capture_sim.studies.fit.result import Calibration
from capture_sim.studies.fit.trial import launched

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
AXES = ("x", "y", "theta")
BEFORE, AFTER, RELEASE = 0.2, 1.5, 0.05
#: Resolution of the buffer's encoders on benches of another model, m and rad.
QUANTA = {"stroke": 1e-5, "torsion": 5e-5}
#: What benches of another model have besides, its least and largest size, and the names that may
#: stand for it.
BESIDES: dict[str, tuple[float, float, tuple[str, ...]]] = {
    "nothing": (0.0, 0.0, ()),
    "tilt, rad": (5e-5, 4e-4, ("floor.tilt_x", "floor.tilt_y")),
    "drag, N s/m": (0.03, 0.3, ("drag",)),
    "cable, N": (0.003, 0.03, ("cable", "floor.tilt")),
    "hysteresis, N": (0.02, 0.3, ("buffer.friction",)),
    "latency, s": (2e-3, 1e-2, ("delay.buffer",)),
    "gain": (1.01, 1.05, ("scale.stroke",)),
}
#: Names that count as found for a model that lacks something, and its size by a uniform number.
LACKS = {
    "friction": (("buffer.friction",), 0.02, 0.3),
    "contact": (("contact.stiffness",), 0.01, 0.2),
    "drag": (("drag",), 0.05, 0.3),
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
    besides: Besides | None = None,
) -> Run:
    """Return a trial of a bench; its launch is the one that was planned for tilt_0.

    With ``besides`` the motion is that of another model, which also has what it names.
    """
    scene = load_scene(name)
    plan = plan_launch(load_scene("tilt_0"))
    shift = rng.normal(size=(2, 3)) * PLACED
    fields = {path: value for key, value in true.items() for path in PATHS[key]}
    for vehicle, off in zip(("chaser", "target"), shift, strict=True):
        pose = getattr(scene.initial, vehicle)
        for key, change in zip(("x", "y", "theta"), off.tolist(), strict=True):
            fields[f"initial.{vehicle}.{key}"] = getattr(pose, key) + change
    launch = {"string.impact_speed": None}
    launch |= {"string.hanging_mass": plan.hanging_mass, "string.drop_height": plan.drop_height}
    more = more or {}
    late, scale = late + more.get("delay.buffer", 0.0), scale * more.get("scale.stroke", 1.0)
    gains = {"stroke": scale, "torsion": more.get("scale.torsion", 1.0)}
    off = {name: value for name, value in more.items() if name not in SENSOR_ERRORS}
    own = with_values(scene, {**fields, **launch, **off})
    dense = np.arange(0.0, 6.0, 2e-4)
    if besides is None:
        bench = Bench(own)
        samples = bench.advance(dense)
        begun = bench.touches["start"]
        end = (float(begun.min()) if begun.size else 3.0) + AFTER
    else:
        samples = np.zeros(dense.size, SAMPLE)
        samples["t"] = dense
        q, first = motion_of(own, besides, dense)
        samples["q"], samples["torsion"] = q, q[:, 3] - q[:, 2]
        samples["axial_stroke"] = q[:, 4] - own.rest_length
        end = min(first, 3.0) + AFTER
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
        if not buffer:
            columns = marked(columns, [more.get(f"marker.{quantity}.{k}", 0.0) for k in AXES])
        seen = np.stack([np.interp(since, exact_t, column) for column in columns.T], axis=1)
        off_zero = more.get(f"offset.{quantity}", 0.0)
        values = seen[:, 0] * gains[quantity] + off_zero if buffer else seen
        noisy = values + rng.normal(size=values.shape) * sigma
        if buffer and besides is not None:
            noisy = np.round(noisy / QUANTA[quantity]) * QUANTA[quantity]
        series[quantity] = {"a sensor": Series(t + wrong, noisy)}
    return MeasuredRun(name, Given(scene=scene, series=series, plan=plan))


def marked(poses: np.ndarray, off: Sequence[float]) -> np.ndarray:
    """Return the poses (n, 3) of a marker frame that is off from its body by x, y and theta."""
    x, y, turned = off
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    moved = np.stack([c * x - s * y, s * x + c * y, np.full(len(poses), turned)], axis=1)
    return np.asarray(poses + moved)


def distance(found: Calibration, true: dict[str, float]) -> float:
    """Return the squared Mahalanobis distance of the parameters from the truth."""
    off = found.values - [true[name] for name in found.names]
    return float(off @ np.linalg.solve(found.covariance, off))


class Recovered(NamedTuple):
    """A fit of a random bench whose parameters are known."""

    seed: int
    off: float  # squared Mahalanobis distance
    verdict: str
    z: np.ndarray  # (10,), errors over their standard errors
    wider: float  # median of the standard errors over those by noise alone
    covered: int  # predicted figures inside their band
    figures: int
    left: float
    simulations: int
    spent: float  # s of CPU


def recovered(seed: int) -> Recovered | None:
    """Fit a random bench, of which what the fit holds is not as in the scene either."""
    rng = np.random.default_rng(seed)
    true = random_bench(rng)
    held = random_held(rng)
    begin = time.process_time()
    try:
        trials = [measured(name, true, rng, held) for name in TRIALS]
    except (SceneError, SimulationError):
        return None
    coming = launched(measured("tilt_0", true, rng, held).replaced(scene=_next(rng)))
    found = calibrate(trials, predict=coming)
    assert found.prediction is not None
    fields = {name: value for name, value in held.items() if name not in SENSOR_ERRORS}
    truth = _figures(coming, true, fields)
    figures = found.prediction.figures
    return Recovered(
        seed=seed,
        off=distance(found, true),
        verdict="found" if found.is_found else "; ".join(f.kind for f in found.findings),
        z=(found.values - [true[name] for name in found.names]) / found.errors,
        wider=float(np.median(found.errors / found.noise_errors)),
        covered=sum(f.low <= value <= f.high for f, value in zip(figures, truth, strict=True)),
        figures=len(figures),
        left=found.left,
        simulations=found.simulations,
        spent=time.process_time() - begin,
    )


def recover(asked: argparse.Namespace, _: Path) -> list[str]:
    """Fit right models: distances, refusals, coverage of predictions and cost."""
    from scipy.stats import chi2

    limit = float(chi2.ppf(0.99, len(PATHS)))
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as processes:
        answers = []
        for one in processes.map(recovered, _seeds(asked)):
            answers.append(one)
            print(one, flush=True)
    benches = [one for one in answers if one is not None]
    near = [one.off < limit for one in benches]
    is_found = [one.verdict == "found" for one in benches]
    z = np.concatenate([one.z for one in benches])
    counted = sum(is_near and known for is_near, known in zip(near, is_found, strict=True))
    beyond = sum(
        known and np.abs(one.z).max() > 4.0 for one, known in zip(benches, is_found, strict=True)
    )
    rows = [
        [
            one.seed,
            f"{one.off:.1f}",
            f"{np.abs(one.z).max():.1f}",
            f"{one.wider:.1f}",
            one.verdict,
            f"{one.left:.2f}",
            one.simulations,
            f"{one.spent:.0f} s",
        ]
        for one in benches
    ]
    head = ["seed", "distance", "largest", "wider", "the fit says", "converged to", "simulations"]
    return [
        f"{sum(near)} of {len(benches)} benches within the 99 % distance of {limit:.1f}; "
        f"{sum(is_found)} found, {counted} of these within it; {beyond} found with a value beyond "
        f"4 errors; rms of {z.size} errors over their standard errors "
        f"{np.sqrt(np.mean(np.square(z))):.2f}; {sum(one.covered for one in benches)} of "
        f"{sum(one.figures for one in benches)} predicted figures in their 95 % band; "
        f"{len(answers) - len(benches)} benches left out, which reach no contact:",
        "",
        table([*head, "CPU"], rows),
    ]


def random_held(rng: np.random.Generator) -> dict[str, float]:
    """Return true values of what a fit holds, by name: the scene's, and an error of each.

    The string's are those of the launch that is planned for tilt_0, which all trials have.
    """
    scene = load_scene("tilt_0")
    plan = plan_launch(scene)
    launch = {"string.hanging_mass": plan.hanging_mass, "string.drop_height": plan.drop_height}
    scene = with_values(scene, {"string.impact_speed": None, **launch})
    fitted = {path for paths in PATHS.values() for path in paths}
    found, root = {}, int(rng.integers(2**32))
    for name, error in uncertainties(scene, fitted, sensors=NOISE).items():
        # each has its own draw, so that another list of names changes no other value
        own = np.random.default_rng([root, zlib.crc32(name.encode())])
        sensor = SENSOR_ERRORS.get(name)
        centre = float(get(scene, name)) if sensor is None else sensor.value
        found[name] = centre + error * float(own.normal())
    return found


def _seeds(asked: argparse.Namespace) -> range:
    return range(asked.first, asked.first + asked.seeds)


def _next(rng: np.random.Generator) -> Scene:
    """Return the scene of a trial to come."""
    angle, y = float(rng.uniform(-0.15, 0.15)), float(rng.uniform(-5e-3, 5e-3))
    return load_scene("tilt_0", {"initial.target.theta": angle, "initial.chaser.y": y})


def _figures(scene: Scene, true: dict[str, float], more: dict[str, float]) -> list[float]:
    from capture_sim.run.loads import loads_of
    from capture_sim.studies.fit.prediction import FIGURES

    fields = {path: value for key, value in true.items() for path in PATHS[key]}
    bench = Bench(with_values(scene, {**fields, **more}))
    bench.advance(np.zeros(0))
    loads = loads_of(bench.extremes, bench.touches)
    return [float(loads[name]) for name in FIGURES]


def lacks(asked: argparse.Namespace, _: Path) -> list[str]:
    """Fit models that lack something: whether it is named, and refused."""
    rows = []
    for kind, (names, low, high) in LACKS.items():
        named = refused = made = 0
        off = []
        for seed in _seeds(asked):
            rng = np.random.default_rng([seed, len(kind)])
            true = random_bench(rng)
            size = low * (high / low) ** float(rng.uniform())
            value = size * (load_scene("tilt_0").contact_stiffness if kind == "contact" else 1.0)
            more = dict.fromkeys(expanded(names[0]), value)
            try:
                trials = [measured(name, true, rng, more) for name in TRIALS]
            except (SceneError, SimulationError):
                continue
            found = calibrate(trials, restarts=2)
            lacking = {one.score.name: one for one in found.lacking}
            is_named = bool(set(names) & set(lacking))
            made, named = made + 1, named + is_named
            refused += not found.is_found
            if is_named:
                off.append(abs(lacking[names[0]].estimate / value - 1.0))
            shown = ", ".join(f"{k} {one.estimate:.4g}" for k, one in lacking.items())
            print(f"{kind} {value:.4g}, seed {seed}: {shown or 'nothing'}", flush=True)
        typical = f"{100.0 * float(np.median(off)):.1f} %" if off else "-"
        sizes = f"{low:g} to {high:g}"
        rows.append([kind, names[0], sizes, f"{named} of {made}", f"{refused} of {made}", typical])
    head = ["what lacks", "name", "size, SI; contact as a share", "named", "refused"]
    return [table([*head, "median error of its size"], rows)]


class Foreign(NamedTuple):
    """A fit of a bench of another model, which has one thing besides."""

    seed: int
    kind: str
    size: float
    verdict: str
    z: np.ndarray  # (10,), errors over their standard errors
    wider: float  # median of the standard errors over those by noise alone
    covered: int  # predicted figures of a next trial inside their 95 % band
    figures: int
    named: str  # what the model is said to lack
    is_named: bool
    spent: float  # s of CPU


def fit_foreign(seed: int) -> Foreign | None:
    """Fit a random bench of another model; kinds of what it has besides take turns."""
    rng = np.random.default_rng([seed, 78])
    true, held = random_bench(rng), random_held(rng)
    kind = list(BESIDES)[seed % len(BESIDES)]
    low, high, names = BESIDES[kind]
    size = low * (high / low) ** float(rng.uniform()) if low else 0.0
    name, sign = kind.partition(",")[0], float(rng.choice([-1.0, 1.0]))
    tilt = tuple(held.pop(f"floor.tilt_{axis}") for axis in "xy")
    besides = Besides(tilt=tilt)  # type: ignore[arg-type]
    if name == "tilt":
        angle = float(rng.uniform(0.0, 2.0 * np.pi))
        besides = Besides(tilt=(size * float(np.cos(angle)), size * float(np.sin(angle))))
    elif name == "drag":
        besides = besides._replace(drag=(size, size))
    elif name == "cable":
        pull = [0.0] * 4
        pull[int(rng.integers(4))] = sign * size
        besides = besides._replace(cable=tuple(pull))  # type: ignore[arg-type]
    elif name == "hysteresis":
        besides = besides._replace(hysteresis=size)
    late, scale = (size if name == "latency" else 0.0), (size if name == "gain" else 1.0)
    begin = time.process_time()
    try:
        trials = [measured(one, true, rng, held, late, scale, besides) for one in TRIALS]
    except (SceneError, SimulationError):
        return None
    coming = launched(measured("tilt_0", true, rng, held).replaced(scene=_next(rng)))
    found = calibrate(trials, restarts=2, predict=coming)
    spent = time.process_time() - begin
    assert found.prediction is not None
    figures = {figure.name: figure for figure in found.prediction.figures}
    truth = _foreign_figures(coming, true, held, besides)
    lacking = [one.score.name for one in found.lacking]
    also = " ".join(finding.text for finding in found.findings if finding.kind == "lacks")
    return Foreign(
        seed=seed,
        kind=kind,
        size=size,
        verdict=found.verdict
        if found.is_usable
        else "; ".join(dict.fromkeys(f.kind for f in found.findings)),
        z=(found.values - [true[name] for name in found.names]) / found.errors,
        wider=float(np.median(found.errors / found.noise_errors)),
        covered=sum(figures[k].low <= value <= figures[k].high for k, value in truth.items()),
        figures=len(truth),
        named=", ".join(lacking),
        is_named=any(each in (*lacking, also) or each in also for each in names),
        spent=spent,
    )


def _foreign_figures(
    scene: Scene, true: dict[str, float], held: dict[str, float], besides: Besides
) -> dict[str, float]:
    """Return figures of a trial of a bench of another model by name; its force is not one."""
    fields = {path: value for key, value in true.items() for path in PATHS[key]}
    off = {name: value for name, value in held.items() if name not in SENSOR_ERRORS}
    own = with_values(scene, {**fields, **off})
    q, _ = motion_of(own, besides, np.arange(0.0, scene.run.t_end, 2e-4))
    stroke = q[:, 4] - own.rest_length
    torsion = float(np.abs(q[:, 3] - q[:, 2]).max())
    inwards, outwards = float(-stroke.min()), float(stroke.max())
    return {
        "max_axial_stroke_in": inwards,
        "max_axial_stroke_out": outwards,
        "max_torsion": torsion,
    }


def foreign(asked: argparse.Namespace, _: Path) -> list[str]:
    """Fit benches of another model, each with one thing besides."""
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as processes:
        answers = []
        for one in processes.map(fit_foreign, _seeds(asked)):
            answers.append(one)
            print(one, flush=True)
    return table_of([one for one in answers if one is not None])


def table_of(benches: Sequence[Foreign]) -> list[str]:
    """Return the fits of benches of another model as lines of the page."""
    used = [one for one in benches if one.verdict in ("found", "usable")]
    most = max((float(np.abs(one.z).max()) for one in used), default=0.0)
    rows = [
        [
            one.seed,
            one.kind,
            f"{one.size:.3g}",
            one.verdict,
            f"{np.abs(one.z).max():.1f}",
            f"{one.wider:.1f}",
            f"{one.covered} of {one.figures}",
            one.named or "-",
            f"{one.spent:.0f} s",
        ]
        for one in benches
    ]
    head = ["seed", "has besides", "size", "the fit says", "largest", "wider", "next trial"]
    head += ["named", "CPU"]
    refused = [one for one in benches if one not in used]
    return [
        f"{len(used)} of {len(benches)} found or usable, none of their values further from the "
        f"truth than {most:.1f} errors, {sum(one.covered for one in used)} of "
        f"{sum(one.figures for one in used)} figures of their next trials in the 95 % band; "
        f"{sum(one.is_named for one in refused)} of {len(refused)} refused with what they have "
        "besides among the names; median CPU "
        f"{np.median([one.spent for one in benches]):.0f} s, largest "
        f"{max(one.spent for one in benches):.0f} s:",
        "",
        table(head, rows),
    ]


def starts(asked: argparse.Namespace, _: Path) -> list[str]:
    """Fit one bench from scenes whose values are up to a factor of 2 off."""
    rng = np.random.default_rng(0)
    true = random_bench(rng)
    trials = [measured(name, true, rng) for name in TRIALS]
    reference = calibrate(trials)
    rows = []
    same = said = 0
    for seed in _seeds(asked):
        factors = 2.0 ** np.random.default_rng(seed).uniform(-1.0, 1.0, len(PATHS))
        fields = {
            path: min(true[key] * factor, 0.95) if key == "e" else true[key] * factor
            for (key, paths), factor in zip(PATHS.items(), factors.tolist(), strict=True)
            for path in paths
        }
        moved = [run.replaced(scene=with_values(run.scene, fields)) for run in trials]
        try:
            found = calibrate(moved)
        except (SceneError, SimulationError) as error:
            rows.append([seed, "-", f"refused: {error}"[:60]])
            said += 1
            continue
        away = float(np.max(np.abs(found.values - reference.values) / reference.errors))
        same += away < 0.3
        said += away >= 0.3 and not found.is_found
        verdict = "found" if found.is_found else "; ".join(f.kind for f in found.findings)
        rows.append([seed, f"{away:.2f}", verdict])
        print(*rows[-1], sep=", ", flush=True)
    return [
        f"Of {len(rows)} starts, {same} ended within 0.3 standard errors of the optimum that the "
        f"start of `recover` gives, and {said} elsewhere with a refusal:",
        "",
        table(["seed", "largest distance, errors", "the fit says"], rows),
    ]


def known(asked: argparse.Namespace, _: Path) -> list[str]:
    """Fit the recordings of a bench whose parameters are known."""
    folder = asked.folder
    if folder is None:
        return []
    three = ("trial_0", "trial_p10", "trial_m10")
    sets = (
        ("three trials", three, False),
        ("masses weighed to 0.1 %", three, True),
        ("with start_displaced", (*three, "start_displaced"), False),
        ("start_displaced alone", ("start_displaced",), False),
    )
    coming = launched(read_run(folder / "next_trial.mcap"))
    columns: list[list[str]] = []
    for _, names, is_weighed in sets:
        trials = [read_run(folder / f"{name}.mcap") for name in names]
        weighed = {"chaser.mass": "22.6 +- 0.1 %", "target.mass": "23.2 +- 0.1 %"}
        begin = time.process_time()
        found = calibrate(trials, weighed=weighed if is_weighed else None, predict=coming)
        spent = time.process_time() - begin
        assert found.prediction is not None
        values = dict(zip(found.names, zip(found.values, found.errors, strict=True), strict=True))
        verdict = "found" if found.is_found else "; ".join(f.kind for f in found.findings)
        columns.append(
            [
                verdict,
                f"{found.reduced_chi2:.3f}",
                f"{found.simulations}",
                f"{spent:.0f} s",
                *(
                    f"{100.0 * values[n][1] / values[n][0]:.2f} % "
                    f"({(values[n][0] - KNOWN[n]) / values[n][1]:+.1f})"
                    for n in KNOWN
                ),
                *(
                    f"{f.value:.6g} +- {f.error:.2g} ({f.value - KNOWN_NEXT[f.name]:+.2g})"
                    for f in found.prediction.figures
                ),
            ]
        )
    assert found.prediction is not None
    labels = ["the fit says", "chi2 per degree of freedom", "simulations", "CPU", *KNOWN]
    labels += [f.name for f in found.prediction.figures]
    head = ["", *(title for title, *_ in sets)]
    return [table(head, zip(labels, *columns, strict=True))]


if __name__ == "__main__":
    write_parts(
        "calibration_checked",
        __doc__,
        {
            "recover": recover,
            "lacks": lacks,
            "foreign": foreign,
            "starts": starts,
            "known": known,
        },
        untimed=("recover", "lacks", "foreign", "starts", "known"),
        seeds=(20, "number of seeds"),
        first=(0, "first seed"),
        folder=(None, "folder of the recordings of a known bench"),
    )
