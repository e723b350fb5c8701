"""Prediction of a new trial of a calibrated bench: peak loads and series with 95 % bands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture_sim.dynamics.bench import Bench
from capture_sim.errors import SceneError, SimulationError
from capture_sim.run.loads import LOADS, loads_of
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import with_values
from capture_sim.scene.units import in_si
from capture_sim.studies.vary.inputs import Input

#: Keys of the predicted loads.
FIGURES = ("max_axial_stroke_in", "max_axial_stroke_out", "max_torsion", "max_normal_force")
#: Predicted series.
SERIES = ("stroke", "torsion")
#: Number of random draws in a prediction, which gives a standard deviation to 5 %.
DRAWS = 200
#: Quantiles at the ends of the 95 % band.
LOW, HIGH = 0.025, 0.975
#: Rate of the series, Hz.
_RATE = 200.0


@dataclass(frozen=True)
class Placement:
    """Accuracy of the vehicles' placement: standard deviations of each vehicle's pose."""

    position: float  # m, along x and along y
    angle: float  # rad


def read_placement(text: str) -> Placement:
    """Return the placement that a text such as ``'0.2 mm, 1 mrad'`` describes.

    Raise SceneError if the text has another form, or if a value is not in [0, 1) m or rad.
    """
    parts = [part.strip() for part in text.split(",")]
    try:
        if len(parts) != 2:
            raise ValueError(text)
        placement = Placement(in_si(parts[0], "m"), in_si(parts[1], "rad"))
    except ValueError:
        raise SceneError(
            f"placement {text}: must be a length and an angle, e.g. '0.2 mm, 1 mrad'"
        ) from None
    if not (0.0 <= placement.position < 1.0 and 0.0 <= placement.angle < 1.0):
        raise SceneError(f"placement {text}: must be 0 to 1 m and 0 to 1 rad")
    return placement


@dataclass(frozen=True)
class PredictedLoad:
    """A predicted load with its 95 % band, SI; ``name`` is a key of FIGURES."""

    name: str
    value: float  # at the calibrated values
    error: float  # standard deviation due to the parameters' errors alone
    low: float  # ends of the 95 % band, including errors of the placement if there are any
    high: float
    spread: float  # standard deviation with the same errors as the band


@dataclass(frozen=True)
class Prediction:
    """Predicted loads and series of a future trial."""

    scene: Scene
    placement: Placement | None
    figures: tuple[PredictedLoad, ...]
    failed: int  # draws that could not be simulated
    t: np.ndarray  # (n,), s since the release
    series: Mapping[str, np.ndarray]  # (3, n) each: low, at the calibrated values, high


def predict(
    scene: Scene,
    parameters: Sequence[Input],
    coordinates: np.ndarray,
    covariance: np.ndarray,
    placement: Placement | None = None,
    *,
    draws: int = DRAWS,
    seed: int = 0,
) -> Prediction:
    """Return the predicted loads and series of a scene with calibrated parameters.

    Parameters
    ----------
    scene
        Scene of the future trial, with its launch.
    parameters, coordinates, covariance
        The shared parameters, their coordinates (k,), and the covariance (k, k) of the coordinates.
    placement
        Errors of the placement of both vehicles; None for a trial placed exactly.
    draws
        Number of draws of the errors.
    seed
        Seed of the draws.

    Raises
    ------
    SceneError, SimulationError
        The scene cannot be simulated with the calibrated values, or in fewer than three draws.
    """
    rng = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))

    def at(place: np.ndarray, shift: np.ndarray) -> Scene:
        fields: dict[str, float] = {}
        for parameter, coordinate in zip(parameters, place, strict=True):
            value = min(max(parameter.value(float(coordinate)), parameter.low), parameter.high)
            fields |= dict.fromkeys(parameter.paths, value)
        for vehicle, (x, y, theta) in zip(("chaser", "target"), shift, strict=True):
            pose = getattr(scene.initial, vehicle)
            fields |= {
                f"initial.{vehicle}.x": pose.x + x,
                f"initial.{vehicle}.y": pose.y + y,
                f"initial.{vehicle}.theta": math.remainder(pose.theta + theta, math.tau),
            }
        changed: Scene = with_values(scene, fields)
        return changed

    nowhere = np.zeros((2, 3))
    t, central, at_centre = _run(at(coordinates, nowhere))
    own, both, courses, failed = [], [], [], 0
    spread = np.zeros(3)
    if placement is not None:
        spread = np.array([placement.position, placement.position, placement.angle])
    for _ in range(draws):
        place = coordinates + root @ rng.standard_normal(values.size)
        shift = spread * rng.standard_normal((2, 3))
        try:
            _, placed_exactly, course = _run(at(place, nowhere))
            figures = placed_exactly
            if placement is not None:
                _, figures, course = _run(at(place, shift))
        except (SceneError, SimulationError):
            failed += 1
            continue
        own.append(placed_exactly)
        both.append(figures)
        courses.append(course)
    if len(both) < 3:
        raise SceneError(f"{scene.name}: {failed} of {draws} draws cannot be simulated")
    alone, full = np.array(own), np.array(both)
    found = []
    for k, name in enumerate(FIGURES):
        low, high = np.quantile(full[:, k], [LOW, HIGH])
        error, wide = float(alone[:, k].std(ddof=1)), float(full[:, k].std(ddof=1))
        found.append(PredictedLoad(name, float(central[k]), error, float(low), float(high), wide))
    n = min(len(t), *(course.shape[1] for course in courses))
    stack = np.stack([course[:, :n] for course in courses])
    low, high = np.quantile(stack, [LOW, HIGH], axis=0)
    series = {name: np.stack([low[k], at_centre[k, :n], high[k]]) for k, name in enumerate(SERIES)}
    return Prediction(scene, placement, tuple(found), failed, t[:n], series)


def _run(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate a scene; return times (n,), loads (4,) and series (2, n).

    They are in the order of FIGURES and SERIES, SI.  A load that the run does not have is NaN.
    """
    bench = Bench(scene)
    samples = bench.advance(np.arange(0.0, scene.run.t_end, 1.0 / _RATE))
    bench.advance(np.zeros(0))
    loads = loads_of(bench.extremes, bench.touches)
    figures = [loads[name] for name in FIGURES]
    return (
        samples["t"],
        np.array([math.nan if x is None else x for x in figures], dtype=float),
        np.stack([samples["axial_stroke"], samples["torsion"]]),
    )


def shown_figure(name: str) -> tuple[str, float, str]:
    """Return how a load is displayed: its meaning in words, factor from SI, and unit."""
    load = next(load for load in LOADS if load.key == name)
    return load.meaning, load.factor, load.shown_in
