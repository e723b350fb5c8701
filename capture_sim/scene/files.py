"""Scenes as YAML: read, extend, override, check, write.

A file may say ``extends: other`` (a name beside it or in config/scenes); what it says
itself is laid over that.  ``null`` takes a part off the bench.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml

from capture_sim.errors import SceneError
from capture_sim.resources import config_dir
from capture_sim.scene.parts import Scene, as_mapping
from capture_sim.scene.quantities import refuse


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 1e-3 as a number and refuses a key given twice."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, rx) for tag, rx in resolvers if tag != "tag:yaml.org,2002:float"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"
    ),
    list("-+0123456789."),
)


def _mapping_without_twins(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen: set[Any] = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node, deep=True)
        if key in seen:
            raise SceneError(f"{key}: given twice (line {key_node.start_mark.line + 1})")
        seen.add(key)
    return dict(loader.construct_pairs(node, deep=True))


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping_without_twins)


def _parse(text: str, source: str) -> dict[str, Any]:
    try:
        data = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise SceneError(f"{source}{where}: not valid YAML: {problem}") from None
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from None
    if not isinstance(data, dict):
        raise SceneError(f"{source}: a scene is a mapping of parts, got {type(data).__name__}")
    return data


def scene_names() -> list[str]:
    """Return the names of the scenes that come with the package."""
    folder = config_dir() / "scenes"
    return sorted(p.stem for p in folder.glob("*.yaml") if not p.stem.startswith("_"))


def _find(name_or_path: str | Path, beside: Path | None = None) -> Path:
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text)
        if beside is not None and not path.is_absolute():
            path = beside / path
        if not path.is_file():
            raise SceneError(f"scene file {text}: no such file")
        return path
    places = [beside] if beside is not None else []
    places.append(config_dir() / "scenes")
    for folder in places:
        path = folder / f"{text}.yaml"
        if path.is_file():
            return path
    names = scene_names()
    near = difflib.get_close_matches(text, names, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise SceneError(f"scene {text!r}: unknown; known are {', '.join(names)}{hint}")


def _merge(base: dict[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, Mapping) and isinstance(merged.get(key), dict):
            merged[key] = _merge(merged[key], value)
        else:
            merged[key] = dict(value) if isinstance(value, Mapping) else value
    return merged


def _read_extended(path: Path, seen: tuple[Path, ...] = ()) -> dict[str, Any]:
    if path in seen:
        raise SceneError(f"{path.name}: extends itself by way of {seen[-1].name}")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"scene file {path}: cannot be read: {error}") from None
    data = _parse(text, path.name)
    parent = data.pop("extends", None)
    if parent is None:
        return data
    if not isinstance(parent, str):
        raise SceneError(f"{path.name}: extends = {parent!r}: allowed is the name of a scene")
    return _merge(_read_extended(_find(parent, path.parent), (*seen, path)), data)


def _apply_overrides(data: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    for item in overrides:
        key, sign, text = item.partition("=")
        key = key.strip()
        if not sign or not key:
            raise SceneError(f"override {item!r}: must read part.field=value, as buffer.c_A=13")
        try:
            value = yaml.load(text, Loader=_Loader)
        except yaml.YAMLError:
            raise SceneError(f"override {item!r}: the value is not valid YAML") from None
        over: Any = value
        for name in reversed(key.split(".")):
            over = {name: over}
        data = _merge(data, over)
    return data


_RENAMED = {"float": "a number", "int": "a whole number", "str": "a text", "bool": "true or false"}


def _scalar(kind: type, value: Any, where: str, unit: str, allowed: Any) -> Any:
    if kind in (float, int):
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or (kind is int and value != int(value)):
            wanted = _RENAMED[kind.__name__] + (f", {allowed}" if allowed is not None else "")
            raise refuse(where, value, unit, wanted)
        if allowed is not None and value not in allowed:
            raise refuse(where, value, unit, allowed)
        return kind(value)
    if not isinstance(value, kind):
        raise refuse(where, value, unit, _RENAMED.get(kind.__name__, kind.__name__))
    return value


def _points(value: Any, where: str) -> tuple[tuple[float, float], ...]:
    try:
        points = tuple((float(x), float(y)) for x, y in value)
    except (TypeError, ValueError):
        points = ()
    if len(points) != 3 or not all(math.isfinite(c) for p in points for c in p):
        raise refuse(where, value, "m", "three points [x, y] of finite numbers")
    return points


def _build(kind: Any, value: Any, where: str, metadata: Mapping[str, Any]) -> Any:
    """Make a value of the declared type, or raise SceneError that names the field."""
    unit, allowed = metadata.get("unit", ""), metadata.get("allowed")
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        if value is None:
            return None
        kind = next(arg for arg in typing.get_args(kind) if arg is not type(None))
    if is_dataclass(kind):
        return _build_part(typing.cast("type", kind), value, where)
    if typing.get_origin(kind) is tuple:
        return _points(value, where)
    value = _scalar(kind, value, where, unit, allowed)
    options = metadata.get("options")
    if options is not None and value not in options:
        raise refuse(where, value, "", "one of " + ", ".join(options))
    return value


def _build_part(part: type, data: Any, where: str = "") -> Any:
    prefix = f"{where}." if where else ""
    if not isinstance(data, dict):
        raise SceneError(f"{where} = {data!r}: allowed is a mapping of its fields")
    declared = {f.name: f for f in fields(part)}
    for key in data:
        if key not in declared:
            by_lower = {name.lower(): name for name in declared}
            near = difflib.get_close_matches(str(key).lower(), by_lower, n=1, cutoff=0.5)
            hint = f"; did you mean {prefix}{by_lower[near[0]]}?" if near else ""
            raise SceneError(
                f"{prefix}{key}: unknown field; allowed are {', '.join(declared)}{hint}"
            )
    hints = typing.get_type_hints(part)
    values = {}
    for name, f in declared.items():
        if name in data:
            values[name] = _build(hints[name], data[name], f"{prefix}{name}", f.metadata)
        elif f.default is MISSING:
            unit = f.metadata.get("unit")
            raise SceneError(f"{prefix}{name}: missing{f' (in {unit})' if unit else ''}")
    return part(**values)


def load_scene_text(text: str, overrides: Iterable[str] = ()) -> Scene:
    """Make a scene from resolved YAML text (no ``extends``).

    Raises
    ------
    SceneError
        One line that names the field, the value, the unit and the allowed range.
    """
    return _changed(_parse(text, "scene"), list(overrides))


def load_scene(name_or_path: str | Path, overrides: Iterable[str] = ()) -> Scene:
    """Load a scene by name (config/scenes) or path, with values overridden.

    Parameters
    ----------
    name_or_path
        ``"tilt_p10"``, or the path of a YAML file.
    overrides
        ``"part.field=value"`` items, as ``"buffer.c_A=13"``; SI units.

    Raises
    ------
    SceneError
        One line that names the field, the value, the unit and the allowed range.
    """
    overrides = list(overrides)
    path = _find(name_or_path)
    data = _read_extended(path)
    data.setdefault("name", path.stem)
    data.setdefault("title", str(data["name"]))
    if path.parent != config_dir() / "scenes":
        # a file of the user's own: say that it is this one, before its values are changed
        try:
            _build_part(Scene, data)
        except SceneError as error:
            raise SceneError(f"{path.name}: {error}") from None
    return _changed(data, overrides)


def _changed(data: dict[str, Any], overrides: list[str]) -> Scene:
    """Make a scene with values changed; its title says which."""
    scene: Scene = _build_part(Scene, _apply_overrides(data, overrides))
    if overrides and not any(item.startswith("title=") for item in overrides):
        scene = dataclasses.replace(scene, title=f"{scene.title}; with {', '.join(overrides)}")
    return scene


def scene_to_text(scene: Scene) -> str:
    """Write a scene as YAML; loading it gives an equal scene (floats by repr)."""
    text: str = yaml.safe_dump(as_mapping(scene), sort_keys=False, default_flow_style=None)
    return text
