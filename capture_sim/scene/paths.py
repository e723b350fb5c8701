"""Parameters of a scene by name: where they stand, what they may be, how they are changed."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import ANY, declared

#: Short names, and where the value stands in a scene.
ALIASES: Mapping[str, tuple[str, ...]] = {
    "c_rr": ("supports.chaser.c_rr", "supports.target.c_rr"),
    "e": ("contact.restitution",),
    "mu": ("friction.mu",),
    "c_A": ("buffer.c_A",),
}
#: Parts of a scene that are how it is simulated, judged and measured, not what is on the bench.
NO_PHYSICS = ("run", "detector", "sensors")
#: How the chaser was launched, which is known.
LAUNCH = ("string.impact_speed", "string.hanging_mass", "string.drop_height")

#: Fields of one name that a hint lists.
_MOST_ALIKE = 5


def value_of(scene: Scene, name: str) -> float:
    """Return the value of a parameter in a scene.

    Raises
    ------
    SceneError
        It is no number there.
    """
    return float(get(scene, paths_of(scene, name)[0]))


def paths_of(scene: Scene, name: str) -> tuple[str, ...]:
    """Return where a parameter stands in a scene.

    Raises
    ------
    SceneError
        It is no number there, or no property of the bench.
    """
    paths = ALIASES.get(name) or (name,)
    for path in paths:
        value = get(scene, path)
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or path.split(".")[0] in NO_PHYSICS or path in LAUNCH:
            raise SceneError(
                f"parameter {name}: must be one of {', '.join(ALIASES)}, or a number of the bench "
                f"as buffer.k_A; not of {', '.join(NO_PHYSICS)}, and not {', '.join(LAUNCH)}, "
                "which are as recorded"
            )
    return paths


def get(scene: Scene, path: str) -> Any:
    """Return what stands at a path of a scene; None where nothing does."""
    value: Any = scene
    for name in path.split("."):
        # what follows from fields, as probe.rod_mass does, cannot be changed
        known = dataclasses.is_dataclass(value) and name in declared(type(value))
        value = getattr(value, name) if known else None
    return value


def field_names(part: Any, prefix: str = "") -> list[str]:
    """Return the dotted names of the fields of a scene that hold no part."""
    names = []
    for name in declared(type(part)):
        value = getattr(part, name)
        inner = dataclasses.is_dataclass(value)
        names += field_names(value, f"{prefix}{name}.") if inner else [f"{prefix}{name}"]
    return names


def alike(names: Sequence[str], name: str, cutoff: float = 0.0) -> list[str]:
    """Return the fields that an unknown name may mean, at most five; none below the cutoff.

    They are the fields of the part of that name, or those whose last part is most like the name's,
    in the same part if there is one.
    """
    owner, _, field = name.rpartition(".")
    inside = [each for each in names if each.startswith(f"{name}.")]
    siblings = [each for each in names if owner and each.startswith(f"{owner}.")]
    last_parts: dict[str, list[str]] = {}
    for each in siblings or names:
        last_parts.setdefault(each.rpartition(".")[2].lower(), []).append(each)
    near = difflib.get_close_matches(field[:100].lower(), last_parts, n=1, cutoff=cutoff)
    return (inside or (last_parts[near[0]] if near else []))[:_MOST_ALIKE]


def did_you_mean(names: Sequence[str]) -> str:
    """Return the hint with the names that were found alike."""
    *others, final = names
    return f"did you mean {', '.join(others)} or {final}?" if others else f"did you mean {final}?"


def changed(part: Any, path: str, value: Any) -> Any:
    """Return a scene, or a part of one, with another value at a path."""
    return with_values(part, {path: value})


def with_values(part: Any, values: Mapping[str, Any]) -> Any:
    """Return a scene, or a part of one, with other values by path; each part is made once."""
    fields: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        name, _, rest = path.partition(".")
        if rest:
            inner.setdefault(name, {})[rest] = value
        else:
            fields[name] = value
    for name, of_part in inner.items():
        fields[name] = with_values(getattr(part, name), of_part)
    return dataclasses.replace(part, **fields)


def range_of(scene: Scene, path: str) -> tuple[float, float]:
    """Return the least and the largest value that is allowed at a path."""
    owner, _, name = path.rpartition(".")
    allowed = declared(type(get(scene, owner) if owner else scene))[name].allowed or ANY
    return allowed.low, allowed.high


def usual_size(name: str) -> float:
    """Return the scale of a parameter whose value is zero."""
    return {"c_rr": 1e-3, "e": 0.5, "mu": 0.3, "c_A": 10.0}.get(name, 1.0)
