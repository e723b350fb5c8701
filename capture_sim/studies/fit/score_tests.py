"""Score tests: search for effects that the model lacks, after a fit.

A candidate is one more parameter, such as a friction or a sensor's delay.  Its gain is the decrease
of chi2 that a linear model predicts if it is fitted together with all other parameters (Rao, 1948).
The gain follows from the derivative of the residuals with respect to the candidate, without the
part that the fitted parameters explain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.scene.parts import Scene, Stops
from capture_sim.scene.paths import expanded, get, range_of, with_values
from capture_sim.studies.fit.joint import Asked, Linear, Problem
from capture_sim.studies.fit.parameters import COMPUTED, SENSOR_ERRORS, default_names
from capture_sim.studies.fit.trial import sensor_column
from capture_sim.studies.vary.inputs import Input, declaration_of

#: Gain above which a candidate is reported; by chance, one in 100 000 candidates has it.
NAMED = 20.0
#: A step of a candidate, in standard errors, must be between these numbers; else it is corrected,
#: at most twice.
_TOO_SMALL, _TOO_LARGE = 0.2, 5.0
#: Largest logarithm of a decrease of the distance to the end of a range.
_MAX_DECREASE = 5.0
#: Position of a tried stop, as a share of the longest measured stroke, and its stiffness, N/m.
_STOP_SHARE, _STOP_STIFFNESS = 0.95, 2e4


class Score(NamedTuple):
    """Result of a score test: the gain and the value of a candidate if it were fitted too."""

    name: str  # of the parameter, for --fit; "stops" for a stop
    words: str
    gain: float  # decrease of chi2
    estimate: float  # SI
    error: float  # standard error, SI; infinite if the fitted parameters explain it, NaN for a stop
    unit: str
    can_be_fitted: bool = True


@dataclass(frozen=True)
class _Field:
    """A field of the scene as a candidate for one more parameter."""

    name: str
    words: str
    guess: Callable[[Scene], float]  # returns a step that changes the motion a little, SI

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths of the field in a scene; an alias such as c_rr sets several fields."""
        return expanded(self.name)


def _share(path: str, share: float) -> Callable[[Scene], float]:
    return lambda scene: share * abs(float(get(scene, path) or 0.0))


FIELDS = (
    _Field("buffer.friction", "friction of the probe in its slide", lambda s: 0.01),
    _Field("buffer.c_A_rebound", "another damping outwards", lambda s: 0.01 * s.buffer.c_A),
    _Field("buffer.c_A2", "quadratic damping", lambda s: 0.1 * s.buffer.c_A),
    _Field("buffer.k_A3", "progressive axial spring", lambda s: 20.0 * s.buffer.k_A),
    _Field("buffer.c_T", "torsional damping", lambda s: 1e-3 * s.buffer.k_T),
    _Field("buffer.k_T3", "progressive torsional spring", lambda s: 100.0 * s.buffer.k_T),
    _Field("contact.stiffness", "contact stiffness", lambda s: 0.1 * s.contact_stiffness),
    _Field("latch.stiffness", "stiffness of the latch", _share("latch.stiffness", 0.05)),
    _Field("latch.damping", "damping of the latch", _share("latch.damping", 0.05)),
    _Field("latch.radius", "distance at which the latch closes", _share("latch.radius", 0.01)),
    _Field("supports.target.c_rr", "rolling resistance of the target by itself", lambda s: 1e-5),
    _Field("string.pulley_inertia", "inertia of the pulley", lambda s: 1e-7),
    _Field("cone.half_angle", "angle of the cone", lambda s: 1e-3),
    _Field("buffer.hinge_offset", "place of the hinge", lambda s: 1e-4),
    _Field("floor.tilt_x", "slope of the floor along x", lambda s: 1e-5),
    _Field("floor.tilt_y", "slope of the floor along y", lambda s: 1e-5),
    _Field("drag", "drag of both vehicles", lambda s: 1e-2),
    *(
        _Field(
            f"{body}.cable_{axis}", f"force of a cable on the {body} along {axis}", lambda s: 1e-3
        )
        for body in ("chaser", "target")
        for axis in "xy"
    ),
    *(
        _Field(f"stops.{name}", "stop", _share(f"stops.{name}", 0.01))
        for name in ("compression", "extension", "stiffness")
    ),
)


def scores(at: Linear, problem: Problem) -> list[Score]:
    """Return the scores of all candidates at a fit, with the largest gain first.

    Candidates whose gain is not finite are left out.
    """
    found = [score for score in _all(at, problem) if math.isfinite(score.gain)]
    return sorted(found, key=lambda score: -score.gain)


def differing(at: Linear, problem: Problem, number: int, fitted: int) -> list[tuple[Score, float]]:
    """Return the parameters that may have another value in one trial, the likeliest first.

    ``number`` is that of the trial, ``fitted`` the number of parameters that may.  Each comes with
    its change in that trial as a share of its value, NaN of a value of 0.  Its gain is the decrease
    of chi2 if it alone is another one there.
    """
    found = []
    for j, parameter in enumerate(problem.parameters[:fitted]):
        columns = [J[:, j] * (n == number) for n, J in enumerate(at.jacobians)]
        score = _score(at, problem, parameter.name, "", columns, 0.0, 1.0, parameter.unit)
        x = float(at.place[j])
        value = parameter.value(x)
        found.append((score, parameter.slope(x) * score.estimate / value if value else math.nan))
    return sorted(found, key=lambda each: -each[0].gain)


def needed(at: Linear, problem: Problem, held: Input) -> Score | None:
    """Return the score of a held value of the scene; None if it cannot be another one."""
    assert held.known is not None
    step = held.known.error
    return _field_score(at, problem, _Field(held.name, "a held value", lambda scene: step))


def _all(at: Linear, problem: Problem) -> Iterator[Score]:
    scene = problem.trials[0].scene
    fitted = {p.name for p in problem.parameters}
    paths = {path for p in problem.parameters if len(p.paths) == 1 for path in p.paths}
    names = set[str]().union(*(trial.sensors for trial in problem.trials))
    for name, error in SENSOR_ERRORS.items():
        if name in fitted or not set(error.channel) & names:
            continue
        columns = [
            sensor_column(trial, one.motion, one.view, name) * error.size
            for trial, one in zip(problem.trials, at.shown, strict=True)
        ]
        yield _score(at, problem, name, error.words, columns, error.value, error.size, error.unit)
    others = (
        _Field(name, "another value than the scene's", _share(expanded(name)[0], 0.01))
        for name in default_names(scene)
        if name not in fitted
    )
    for field in (*FIELDS, *others):
        if set(field.paths) <= paths or not _has(scene, field.paths[0]):
            continue
        if (score := _field_score(at, problem, field)) is not None:
            yield score
    if scene.stops is None and (score := _stop_score(at, problem)) is not None:
        yield score


def _has(scene: Scene, path: str) -> bool:
    """Return True if the field at a path can be a candidate in this scene.

    It must be a number, or one of the fields that may be null.
    """
    owner, _, name = path.rpartition(".")
    part = get(scene, owner)
    if part is None or not hasattr(part, name):
        return False
    if path == "buffer.c_A_rebound":
        return scene.buffer.c_A > 0.0
    if path == "contact.stiffness":
        return scene.contact.force_table is None
    if path == "buffer.k_A3" and scene.buffer.force_table is not None:
        return False
    return isinstance(getattr(part, name), (int, float))


def _field_score(at: Linear, problem: Problem, field: _Field) -> Score | None:
    fields, _ = problem.values(at.place)
    scene, path = problem.trials[0].scene, field.paths[0]
    value = get(scene, path)
    if value is None:
        fitted: Scene = with_values(scene, fields)
        value = COMPUTED[path](fitted)
    value = float(fields.get(path, value))
    low, high = range_of(scene, path)
    unit, step = declaration_of(scene, path).unit, field.guess(scene)
    if not step > 0.0:
        return None
    step = step if value + step < high else -step
    for attempt in range(3):
        columns = _columns(at, problem, dict.fromkeys(field.paths, value + step))
        if columns is None:
            return None
        score = _score(at, problem, field.name, field.words, columns, value, step, unit)
        change = abs(step) / score.error if score.error > 0.0 else 0.0
        if change == 0.0 or attempt == 2 or _TOO_SMALL < change < _TOO_LARGE:
            break
        wanted = abs(step) / max(change, 1e-6)
        step = math.copysign(min(wanted, max(0.3 * abs(value), 30.0 * abs(step))), step)
    if (value <= low and score.estimate < value) or (value >= high and score.estimate > value):
        score = score._replace(gain=0.0)  # the estimate is out of range, so no bench can have it
    return score._replace(estimate=possible(value, score.estimate, low, high))


def possible(value: float, estimate: float, low: float, high: float) -> float:
    """Return the estimate of a linear model about ``value``, moved into the range if necessary.

    An estimate at or beyond an end of the range is replaced by a value short of that end: the step
    is then applied to the logarithm of the distance from ``value`` to the end.
    """
    for end in (low, high):
        left = end - value
        if left != 0.0 and math.isfinite(left) and (share := (estimate - value) / left) >= 1.0:
            return end - left * math.exp(-min(share, _MAX_DECREASE))
    return min(max(estimate, low), high)


def _columns(at: Linear, problem: Problem, more: dict[str, float]) -> list[np.ndarray] | None:
    """Return the change of each trial's residuals, (n,), if fields have the values of ``more``.

    None if a trial cannot be simulated with them.
    """
    asked = [Asked(number, at.place, more) for number in range(len(at.shown))]
    columns = []
    for one, there in zip(at.shown, problem.residuals_at(asked), strict=True):
        if there is None:
            return None
        columns.append(there - one.residuals)
    return columns


def _stop_score(at: Linear, problem: Problem) -> Score | None:
    """Return the score of a stop that the probe hits just before its longest measured stroke.

    None if no stroke exceeds 0.1 mm, or if a trial cannot be simulated with the stop.
    """
    strokes = [
        channel.values for t in problem.trials for channel in t.channels if channel.name == "stroke"
    ]
    longest = -min((float(values.min()) for values in strokes), default=0.0)
    if longest <= 1e-4:
        return None
    stops = Stops(_STOP_SHARE * longest, None, _STOP_STIFFNESS, 0.0)
    columns = _columns(at, problem, {"stops": stops})  # type: ignore[dict-item]
    if columns is None:
        return None
    score = _score(at, problem, "stops", "a stop of the probe", columns, 0.0, 1.0, "1")
    # the step is a complete stop, so a small or negative share of it is no stop
    if score.estimate < 0.2:
        score = score._replace(gain=0.0)
    return score._replace(
        estimate=_STOP_SHARE * longest, error=math.nan, unit="m", can_be_fitted=False
    )


def _score(
    at: Linear,
    problem: Problem,
    name: str,
    words: str,
    columns: list[np.ndarray],
    value: float,
    step: float,
    unit: str,
) -> Score:
    """Return the score of a candidate.

    ``columns`` are the changes of each trial's residuals, (n,), if the candidate is changed from
    ``value`` by ``step`` (in SI).
    """
    cross, along, size = np.zeros(problem.dimension), 0.0, 0.0
    for number, (column, one, J) in enumerate(zip(columns, at.shown, at.jacobians, strict=True)):
        cross[np.r_[0 : problem.shared, problem.own(number)]] += J.T @ column
        along += float(column @ one.residuals)
        size += float(column @ column)
    covariance = at.covariance
    along -= float(cross @ covariance @ at.gradient)
    left = size - float(cross @ covariance @ cross)
    if left <= 1e-9 * size or size == 0.0:  # the fitted parameters explain it
        return Score(name, words, 0.0, value, math.inf, unit)
    error = abs(step) / math.sqrt(left)
    return Score(name, words, along**2 / left, value - step * along / left, error, unit)
