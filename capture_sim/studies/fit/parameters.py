"""Fitted parameters: numbers of the bench and errors of its sensors, each with a coordinate.

The search changes coordinates, in which all parameters have about the same size.  The coordinate is
the logarithm of a positive value whose range excludes negative values.  For any other value, and
for the restitution, it is the value divided by its usual size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import (
    LAUNCH,
    expanded,
    get,
    paths_of,
    range_of,
    usual_size,
    with_values,
)
from capture_sim.studies.vary.inputs import (
    KNOWN,
    LOGARITHM,
    Input,
    Known,
    Scale,
    declaration_of,
    read_input,
)

#: Parameters that are fitted by default, if they are positive numbers in the scene.
DEFAULT = (
    *("c_rr", "e", "mu", "c_A", "buffer.k_A", "buffer.k_T"),
    *("chaser.mass", "target.mass", "chaser.inertia", "target.inertia"),
)
#: Fields that may be null in a scene, and the function that gives their value in that case.
COMPUTED: Mapping[str, Callable[[Scene], float]] = {
    "buffer.c_A_rebound": lambda scene: scene.buffer.c_A,
    "contact.stiffness": lambda scene: float(scene.contact_stiffness),
}
#: Start of the names of a trial's start poses, which are always fitted.
START = "initial."


@dataclass(frozen=True)
class SensorError:
    """An error of a sensor that can be fitted as a parameter."""

    channel: tuple[str, ...]  # quantities that have it
    kind: str  # delay, scale, offset or marker
    value: float  # value of a sensor without an error, SI
    size: float  # usual size of an error, SI
    unit: str
    words: str


#: Errors of sensors by their names as parameters.  Delays count from the chaser's poses.
SENSOR_ERRORS: Mapping[str, SensorError] = {
    "delay.target": SensorError(
        ("target",), "delay", 0.0, 1e-3, "s", "the target's poses come later than the chaser's"
    ),
    "delay.buffer": SensorError(
        ("stroke", "torsion"), "delay", 0.0, 1e-3, "s", "stroke and torsion come later than poses"
    ),
    "scale.stroke": SensorError(
        ("stroke",), "scale", 1.0, 1e-2, "1", "the stroke's sensor reads by this factor"
    ),
    "scale.torsion": SensorError(
        ("torsion",), "scale", 1.0, 1e-2, "1", "the torsion's sensor reads by this factor"
    ),
    "scale.chaser": SensorError(
        ("chaser",), "scale", 1.0, 1e-2, "1", "the chaser's path is measured by this factor"
    ),
    "scale.target": SensorError(
        ("target",), "scale", 1.0, 1e-2, "1", "the target's path is measured by this factor"
    ),
    "scale.force": SensorError(
        ("force",), "scale", 1.0, 1e-2, "1", "the load cell reads by this factor"
    ),
    "offset.stroke": SensorError(
        ("stroke",), "offset", 0.0, 1e-4, "m", "the stroke's sensor reads this much at rest"
    ),
    "offset.torsion": SensorError(
        ("torsion",), "offset", 0.0, 1e-3, "rad", "the torsion's sensor reads this much at rest"
    ),
    **{
        f"marker.{body}.{axis}": SensorError(
            (body,), "marker", 0.0, size, unit, f"the {body}'s marker frame is off along its {axis}"
        )
        for body in ("chaser", "target")
        for axis, size, unit in (("x", 1e-3, "m"), ("y", 1e-3, "m"), ("theta", 1e-3, "rad"))
    },
}


def parameters_of(
    scene: Scene,
    names: Sequence[str] | None,
    weighed: Mapping[str, Known] | None = None,
) -> tuple[Input, ...]:
    """Return the parameters with some names, followed by all others that were weighed.

    ``names``: None for those of ``DEFAULT`` that the scene has.  A value that the scene leaves
    to be computed begins at what is computed.  Raise SceneError if there is no name, if a name is
    unknown, if two names set one field, or if a weighed value is out of range.
    """
    weighed = weighed or {}
    given = list(default_names(scene) if names is None else names)
    for name in given:
        if given.count(name) > 1:
            raise SceneError(f"parameter {name}: given twice: must be given once")
    given += [name for name in weighed if name not in given]
    if not given:
        raise SceneError("parameters: must be one name or more")
    scene = filled(scene, given)
    found = [_parameter(scene, name, weighed.get(name)) for name in given]
    taken: dict[str, str] = {}
    for parameter in found:
        for path in parameter.paths:
            if path in taken:
                raise SceneError(
                    f"parameter {parameter.name}: is also fitted as {taken[path]}: must be named "
                    "once"
                )
            taken[path] = parameter.name
    return tuple(found)


def filled(scene: Scene, names: Iterable[str]) -> Scene:
    """Return a scene with numbers for those of some fields that it leaves to be computed."""
    values = {n: COMPUTED[n](scene) for n in names if n in COMPUTED and get(scene, n) is None}
    return with_values(scene, values) if values else scene


def default_names(scene: Scene) -> tuple[str, ...]:
    """Return the names of ``DEFAULT`` that are positive numbers in a scene."""

    def has(name: str) -> bool:
        value = get(scene, expanded(name)[0])
        return isinstance(value, (int, float)) and value > 0.0

    return tuple(filter(has, DEFAULT))


def _parameter(scene: Scene, name: str, known: Known | None) -> Input:
    if name in SENSOR_ERRORS:
        error = SENSOR_ERRORS[name]
        low, high = (0.5, 2.0) if error.kind == "scale" else (-math.inf, math.inf)
        begin = error.value if known is None else known.value
        scale = Scale(size=error.size)
        return Input(name, error.unit, (), None, low, high, scale, begin=begin, known=known)
    if name.startswith(START):
        raise SceneError(f"parameter {name}: is of one trial, and always fitted: must not be named")
    paths = paths_of(scene, name)
    value = float(get(scene, paths[0]))
    low, high = range_of(scene, paths[0])
    if known is not None:
        if not (low <= known.value <= high) or not known.error > 0.0:
            raise SceneError(
                f"weighed {name} = {known.value:g} +- {known.error:g}: must be {low:g} to "
                f"{high:g}, with an error > 0"
            )
        value = known.value
    is_restitution = paths[0] == "contact.restitution"
    scale = LOGARITHM
    if not (value > 0.0 and low >= 0.0) or is_restitution:
        scale = Scale(size=1.0 if is_restitution else abs(value) or usual_size(name))
    unit = declaration_of(scene, paths[0]).unit
    return Input(name, unit, (), None, low, high, scale, paths, begin=value, known=known)


def paths_known(scene: Scene, name: str) -> tuple[str, ...]:
    """Return the paths of a parameter, or of the hanging mass or drop height, which have errors."""
    if name in LAUNCH[1:] and scene.string is not None:
        return (name,)
    return paths_of(filled(scene, [name]), name)


def read_weighed(scene: Scene, text: str) -> tuple[str, Known]:
    """Return the name and the weighed value (SI) of a text ``NAME=VALUE +- ERROR [UNIT]``.

    The error may be in percent of the value.  Hanging mass and drop height can be weighed too.
    Raise SceneError if the text has another form.
    """
    name, sign, given = (part.strip() for part in text.partition("="))
    if not sign:
        raise SceneError(
            f"weighed {text}: must be NAME='VALUE +- ERROR UNIT', e.g. "
            "chaser.mass='22.6 +- 0.02 kg'"
        )
    what = declaration_of(scene, paths_known(scene, name)[0])
    known = read_input(scene, name, given, (KNOWN,), what).known
    assert known is not None
    return name, known


def begins(parameters: Sequence[Input]) -> np.ndarray:
    """Return the coordinates (k,) where the search begins."""
    return np.array([p.position(p.begin) for p in parameters])
