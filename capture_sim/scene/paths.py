"""Parameters of a scene by name: their paths, values, ranges and changes.

A path is the dotted name of a field, e.g. ``buffer.c_A``.  A parameter is named by a path or by a
short name such as ``c_rr``, which may stand for several paths.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import ANY, declared, replaced

#: Short names of parameters and their paths in a scene.
ALIASES: Mapping[str, tuple[str, ...]] = {
    "c_rr": ("supports.chaser.c_rr", "supports.target.c_rr"),
    "e": ("contact.restitution",),
    "mu": ("friction.mu",),
    "c_A": ("buffer.c_A",),
    "drag": ("chaser.drag", "target.drag"),
}
#: Parts of a scene that describe simulation, detection and measurement, not the bench.
NO_PHYSICS = ("run", "detector", "sensors")
#: Parameters of the launch, which are known.
LAUNCH = ("string.impact_speed", "string.hanging_mass", "string.drop_height")

#: Largest number of names in a hint.
_MAX_ALIKE = 5


def expanded(name: str) -> tuple[str, ...]:
    """Return the paths that a name stands for: those of a short name, else the name itself."""
    return ALIASES.get(name) or (name,)


def paths_of(scene: Scene, name: str) -> tuple[str, ...]:
    """Return the paths of a parameter, given by a short name or a path.

    SceneError if its value in the scene is not a number, or if it is no property of the bench that
    can be fitted: a setting of the run, the detector or the sensors, or a value of the launch
    (impact speed, hanging mass, drop height).
    """
    paths = expanded(name)
    for path in paths:
        value = get(scene, path)
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number and path not in (names := field_names(scene)):
            hint = did_you_mean(alike([*ALIASES, *names], name))
            raise SceneError(f"{name}: no number of {scene.name}; {hint}")
        if not is_number or path.split(".")[0] in NO_PHYSICS or path in LAUNCH:
            raise SceneError(
                f"parameter {name}: must be one of {', '.join(ALIASES)}, or a number of the bench "
                f"as buffer.k_A; not of {', '.join(NO_PHYSICS)}, and not {', '.join(LAUNCH)}, "
                "which are as recorded"
            )
    return paths


def get(scene: Scene, path: str) -> Any:
    """Return the value or the part at a path of a scene; None if it is null or does not exist.

    Of a short name it is the value at the first of its paths.
    """
    value: Any = scene
    for name in expanded(path)[0].split("."):
        # computed properties such as probe.rod_mass cannot be changed
        is_field = dataclasses.is_dataclass(value) and name in declared(type(value))
        value = getattr(value, name) if is_field else None
    return value


def field_names(part: Any, prefix: str = "") -> list[str]:
    """Return the dotted names of all values of a scene or a part, each with ``prefix`` before it.

    A part that the scene does not have is one name.
    """
    names = []
    for name in declared(type(part)):
        value = getattr(part, name)
        inner = dataclasses.is_dataclass(value)
        names += field_names(value, f"{prefix}{name}.") if inner else [f"{prefix}{name}"]
    return names


def alike(names: Sequence[str], name: str, cutoff: float = 0.5) -> list[str]:
    """Return up to five of ``names`` (dotted names of fields) that an unknown name may mean.

    They are the fields of a part with that name.  Without such a part, they are the fields whose
    last name is most similar to that of ``name``, if their similarity (0 to 1) is at least
    ``cutoff``; if ``name`` begins with an existing part, only fields of this part are compared.
    """
    owner, _, field = name.rpartition(".")
    inside = [path for path in names if path.startswith(f"{name}.")]
    siblings = [path for path in names if owner and path.startswith(f"{owner}.")]
    last_parts: dict[str, list[str]] = {}
    for path in siblings or names:
        last_parts.setdefault(path.rpartition(".")[2].lower(), []).append(path)
    near = difflib.get_close_matches(field[:100].lower(), last_parts, n=1, cutoff=cutoff)
    return (inside or (last_parts[near[0]] if near else []))[:_MAX_ALIKE]


def did_you_mean(names: Sequence[str]) -> str:
    """Return a hint for an error message that lists similar names.

    Without names, it is the command that lists all fields.
    """
    if not names:
        return "capture-sim show lists the fields of a scene"
    *others, final = names
    return f"did you mean {', '.join(others)} or {final}?" if others else f"did you mean {final}?"


def changed(part: Any, path: str, value: Any) -> Any:
    """Return a scene, or a part of one, with another value at a path; see :func:`with_values`."""
    return with_values(part, {path: value})


def with_values(part: Any, values: Mapping[str, Any]) -> Any:
    """Return a scene, or a part of one, with other values by path.

    SceneError if a value is invalid.  The parts on each path must exist, and rules between several
    fields or parts are not checked.
    """
    fields: dict[str, Any] = {}
    part_values: dict[str, dict[str, Any]] = {}
    if isinstance(part, Scene):
        values = {path: x for name, x in values.items() for path in expanded(name)}
    for path, value in values.items():
        name, _, rest = path.partition(".")
        if rest:
            part_values.setdefault(name, {})[rest] = value
        else:
            fields[name] = value
    for name, inner_values in part_values.items():
        fields[name] = with_values(getattr(part, name), inner_values)
    return replaced(part, fields)


def range_of(scene: Scene, path: str) -> tuple[float, float]:
    """Return the lower and upper limit of the field at a path, in SI units.

    A limit is infinite if the field has none.  The field's part must exist in the scene.
    """
    owner, _, name = path.rpartition(".")
    allowed = declared(type(get(scene, owner) if owner else scene))[name].allowed or ANY
    return allowed.low, allowed.high


def usual_size(name: str) -> float:
    """Return a usual size, in SI units, of a parameter of this name.

    A fit scales a parameter by its value, and by this size if the value is zero.
    """
    sizes = {"c_rr": 1e-3, "e": 0.5, "mu": 0.3, "c_A": 10.0}
    sizes |= {"floor.tilt_x": 1e-3, "floor.tilt_y": 1e-3}
    return 0.1 if name.endswith(("drag", "cable_x", "cable_y")) else sizes.get(name, 1.0)
