"""Values that a fit does not ask for, although they are known only to some error.

A value of the scene that is neither fitted nor weighed is held while the fit searches.  At its end
all held values join it as weighed parameters, each with its standard uncertainty as prior knowledge
(Schmidt, 1966: consider parameters), and the search goes on for a few steps.  So what the trials
leave open of them is in the errors of the fit, and what the trials say of them in its values.
Errors of sensors are such parameters from the start: their derivatives need no simulation.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import LAUNCH, get, range_of
from capture_sim.scene.units import in_si
from capture_sim.studies.fit.parameters import SENSOR_ERRORS, parameters_of, paths_known
from capture_sim.studies.vary.inputs import LOGARITHM, Input, Known, declaration_of

#: Standard uncertainties of the sensors' errors that are held by default, SI: no marker frame is
#: exactly the body's, no encoder exactly in step with the cameras, no gain exactly 1, and no zero
#: that is read from noise exactly 0.
SENSORS: Mapping[str, float] = {
    **{
        name: 1e-3 if name.endswith("theta") else 5e-4
        for name in SENSOR_ERRORS
        if name.startswith("marker.")
    },
    "delay.buffer": 3e-3,
    **dict.fromkeys(("scale.stroke", "scale.torsion"), 1e-2),
    "scale.force": 2e-2,
    "offset.stroke": 2e-5,
    "offset.torsion": 1e-4,
}
#: Default standard uncertainties: shares of the value, and SI values, by path.  The radii of tip
#: and BE are not among them: a bench of which they are equal works only if they are exact.
SHARES: Mapping[str, float] = {
    **dict.fromkeys(("chaser.mass", "target.mass", "cylinder.mass", "probe.density"), 1e-3),
    **dict.fromkeys(("string.hanging_mass", "string.drop_height"), 1e-3),
    **dict.fromkeys(("chaser.inertia", "target.inertia", "buffer.k_A", "buffer.k_T"), 1e-2),
    **dict.fromkeys(("latch.stiffness", "latch.damping"), 0.1),
}
SIZES: Mapping[str, float] = {
    **dict.fromkeys(("buffer.hinge_offset", "cylinder.length", "probe.length"), 1e-4),
    **dict.fromkeys(("cone.L_T", "latch.radius", "rail.length"), 1e-4),
    "cone.half_angle": 1e-3,
    **dict.fromkeys(("floor.tilt_x", "floor.tilt_y"), 5e-5),
}


@dataclass(frozen=True)
class Held:
    """A held value, its standard uncertainty, and what the trials say of it; SI."""

    name: str
    value: float  # of the scene
    error: float  # standard uncertainty
    unit: str
    fitted: float  # with the trials
    known_to: float  # standard error of that
    moves: np.ndarray  # (k,), of the fitted values if this one is larger by ``known_to``


def uncertainties(
    scene: Scene,
    fitted: Collection[str],
    given: Mapping[str, str | float] | None = None,
    sensors: Collection[str] | None = None,
) -> dict[str, float]:
    """Return the standard uncertainty (SI, above 0) of each held field of a scene, by path.

    ``fitted``: paths, and names of sensors' errors, that are fitted.  ``given``: uncertainties in
    place of the defaults, as a text (``"0.02 mrad"``, ``"0.5 %"``) or SI; 0 for a value that is
    exact.  ``sensors``: names of the quantities that are measured; None for all.  SceneError if one
    is no such number, if its field is fitted, or if the scene has no such field.
    """
    found = {
        name: error
        for name, error in SENSORS.items()
        if name not in fitted
        and (sensors is None or set(SENSOR_ERRORS[name].channel) & set(sensors))
    }
    for path in (*SHARES, *SIZES):
        value = number_at(scene, path)
        if value is not None and path not in fitted:
            found[path] = SHARES[path] * abs(value) if path in SHARES else SIZES[path]
    for name, text in (given or {}).items():
        if name in SENSOR_ERRORS:
            if name in fitted:
                raise SceneError(f"uncertain {name}: is fitted: must be weighed, or not named")
            sensor = SENSOR_ERRORS[name]
            found[name] = _error_of(name, sensor.unit, sensor.value, text)
            continue
        for path in paths_known(scene, name):
            if path in fitted:
                raise SceneError(f"uncertain {name}: is fitted: must be weighed, or not named")
            value = number_at(scene, path)
            if value is None:
                raise SceneError(f"uncertain {name}: is not a number of {scene.name}")
            found[path] = _error_of(name, declaration_of(scene, path).unit, value, text)
    return {path: error for path, error in found.items() if error > 0.0}


def number_at(scene: Scene, path: str) -> float | None:
    """Return the number at a path of a scene, SI; None if it has none there."""
    try:
        value = get(scene, path)
    except (SceneError, AttributeError):
        return None
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number else None


def _error_of(name: str, unit: str, value: float, text: str | float) -> float:
    try:
        if isinstance(text, str) and text.strip().endswith("%"):
            error = abs(value) * float(text.strip()[:-1]) / 100.0
        else:
            error = in_si(text, unit) if isinstance(text, str) else float(text)
    except ValueError:
        error = math.nan
    if not 0.0 <= error < math.inf:
        raise SceneError(f"uncertain {name} = {text}: must be a number in {unit} or %, >= 0")
    return error


def held_parameters(scenes: Sequence[Scene], errors: Mapping[str, float]) -> tuple[Input, ...]:
    """Return the held values as weighed parameters.

    ``errors``: standard uncertainties by path, see :func:`uncertainties`.  A value of the launch is
    left out if it differs between the trials' ``scenes``.
    """
    found, scene = [], scenes[0]
    for path, error in errors.items():
        sensor = SENSOR_ERRORS.get(path)
        value = float(get(scene, path)) if sensor is None else sensor.value
        known = Known(value, error)
        if path not in LAUNCH:
            (parameter,) = parameters_of(scene, [path], {path: known})
            found.append(parameter)
        elif all(get(other, path) == value for other in scenes):
            unit, limits = declaration_of(scene, path).unit, range_of(scene, path)
            one = Input(path, unit, (), None, *limits, LOGARITHM, (path,))
            found.append(replace(one, begin=value, known=known))
    return tuple(found)


def held_of(
    parameters: Sequence[Input], coordinates: np.ndarray, covariance: np.ndarray, fitted: int
) -> tuple[Held, ...]:
    """Return the held values of a fit in which they are the parameters from ``fitted`` on.

    ``coordinates`` (n,) and ``covariance`` (n, n) are those of all parameters.
    """
    slopes = np.array([p.slope(float(x)) for p, x in zip(parameters, coordinates, strict=True)])
    wide = covariance * np.outer(slopes, slopes)
    found = []
    for j, parameter in enumerate(parameters[fitted:], fitted):
        assert parameter.known is not None
        error = math.sqrt(max(wide[j, j], 1e-300))
        found.append(
            Held(
                *(parameter.name, parameter.known.value, parameter.known.error, parameter.unit),
                parameter.value(float(coordinates[j])),
                error,
                wide[:fitted, j] / error,
            )
        )
    return tuple(found)
