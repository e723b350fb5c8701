"""Scenes from YAML: functions that parse a file, merge it with others and build the scene.

A file may contain ``extends: other``, where ``other`` is the name of a file in the same folder or
in config/scenes, or a path.  Its own values override those of the other file.  ``null`` removes a
part from the bench.

All YAML text of scenes and overrides passes through :func:`parse`, which limits its size, accepts
plain values only, and reports a mistake in one line.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sized
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from capture_sim.base.resources import config_dir
from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import alike, did_you_mean, expanded
from capture_sim.scene.quantities import Checked, Declared, accept, declared, refuse, shown

#: Longest text of a scene, characters: the package's own are 3000 at most.
MAX_TEXT = 100_000
#: Levels of mappings and lists in a text; a scene has four.
MAX_DEPTH = 20
#: Files that extend each other in a row.
MAX_FILES = 20
#: Mistakes of a scene that one message names.
MAX_MISTAKES = 5

_TAG = "tag:yaml.org,2002:"


class _Loader(yaml.SafeLoader):
    """YAML of names, numbers, texts, lists and mappings, without aliases, dates and tags."""

    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise SceneError(f"{_line(self.peek_event())}: aliases (*name) are not allowed")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise SceneError(f"{_line(self.peek_event())}: nested deeper than {MAX_DEPTH}")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def mapping(self, node: yaml.MappingNode) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise SceneError(f"{_line(key_node)}: {shown(key)} is not a field name")
            if key in values:
                raise SceneError(f"{shown(key)}: given twice ({_line(key_node)})")
            values[key] = self.construct_object(value_node, deep=True)
        return values


def _line(node: Any) -> str:
    return f"line {node.start_mark.line + 1}"


_Loader.yaml_implicit_resolvers = {}
for _kind, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", "~nN\0"),
    (
        "bool",
        r"yes|Yes|YES|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|off|Off|OFF",
        "yYnNtTfFoO",
    ),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    # includes 1e-3, which is a text in YAML 1.1
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+0123456789.",
    ),
):
    _Loader.add_implicit_resolver(
        _TAG + _kind, re.compile(rf"^(?:{_pattern})$"), [*_first.replace("\0", ""), ""]
    )
_constructors: dict[Any, Any] = {
    _TAG + kind: yaml.SafeLoader.yaml_constructors[_TAG + kind]
    for kind in ("null", "bool", "float", "str", "seq")
} | {
    None: yaml.SafeLoader.yaml_constructors[None],
    _TAG + "int": lambda loader, node: _whole(loader.construct_scalar(node)),
    _TAG + "map": _Loader.mapping,
}
_Loader.yaml_constructors = _constructors


def _whole(text: str) -> int | float:
    """Return a text of digits as an integer.

    A text of more than 4000 characters, which Python may refuse to convert, gives infinity, which
    no field accepts.
    """
    return int(text) if len(text) <= 4000 else -math.inf if text[0] == "-" else math.inf


def parse(text: str, source: str) -> Any:
    """Return the content of a YAML text as plain Python values, lists and dictionaries.

    An empty text gives None.  SceneError if the text is invalid or too long; its message is one
    line that begins with ``source``, the name of the text's origin.
    """
    if len(text) > MAX_TEXT:
        raise SceneError(f"{source}: longer than {MAX_TEXT} characters")
    try:
        return yaml.load(text, Loader=_Loader)
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from None
    except Exception as error:  # the parser raises many kinds for an invalid text
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error)
        problem = problem.splitlines()[0][:200] if problem else type(error).__name__
        raise SceneError(f"{source}{where}: not valid YAML: {problem}") from None


# studies load a scene many times with other values
_parse_cached = lru_cache(maxsize=32)(parse)


def parse_scene(text: str, source: str) -> dict[str, Any]:
    """Return the fields of a scene in a YAML text, unchecked, as a dictionary that may be changed.

    SceneError if the text is invalid (see :func:`parse`) or is not a mapping.
    """
    data = _parse_cached(text, source)
    if not isinstance(data, dict):
        content = "is empty" if data is None else f"holds {shown(data)}"
        raise SceneError(
            f"{source}: {content}: must be fields of a scene, e.g. buffer: {{k_A: 400}}"
        )
    return copy.deepcopy(data)


def scene_names() -> list[str]:
    """Return the names of the scenes that come with the package.

    Examples
    --------
    >>> from capture_sim import scene_names
    >>> [name for name in scene_names() if name.startswith("tilt")]
    ['tilt_0', 'tilt_m10', 'tilt_p10']
    """
    folder = config_dir() / "scenes"
    return sorted(p.stem for p in folder.glob("*.yaml") if not p.stem.startswith("_"))


def find_scene(name_or_path: str | Path, folder: Path | None = None) -> Path:
    """Return the file of a scene, by its name or path; SceneError if there is no such file.

    A text that contains ``/`` or ends in .yaml or .yml is a path, relative to ``folder``, or to
    the working directory without ``folder``.  Any other text is a name, which is looked up in
    ``folder``, if given, then among the packaged scenes.
    """
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text) if folder is None else folder / text
        # os.path accepts any text as a path
        if not os.path.isfile(path):  # noqa: PTH113
            raise SceneError(f"scene file {shown(text)[1:-1]}: no such file")
        return path
    for place in filter(None, (folder, config_dir() / "scenes")):
        path = place / f"{text}.yaml"
        if os.path.isfile(path):  # noqa: PTH113
            return path
    names = scene_names()
    near = difflib.get_close_matches(text[:100], names, n=1)
    hint = f"did you mean {near[0]}?" if near else f"available scenes: {', '.join(names)}"
    # os.path accepts any text as a path
    problem = "no scene: must end in .yaml" if os.path.exists(text) else "not found"  # noqa: PTH110
    raise SceneError(f"scene {shown(text)}: {problem}; {hint}")


def read_scene(path: Path, files: list[Path]) -> dict[str, Any]:
    """Return the values of a scene file, merged over the files that it extends, unchecked.

    ``files`` are the files whose ``extends`` led to this file, in order: an empty list for the
    first.  This file and the files that it extends are appended to it.  SceneError if a file is
    missing or invalid, if files extend each other in a circle, or if more than 20 do in a row.
    """
    resolved = path.resolve()
    if resolved in files:
        raise SceneError(f"{path.name}: extends itself through {files[-1].name}")
    if len(files) >= MAX_FILES:
        raise SceneError(f"{files[0].name}: more than {MAX_FILES} files extend each other")
    files.append(resolved)
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(MAX_TEXT + 1)
    except OSError as error:
        raise SceneError(f"scene file {path.name}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        kind = "an image" if path.suffix in (".png", ".svg", ".jpg") else "no text"
        raise SceneError(
            f"scene file {path.name}: is {kind}: must be a scene (.yaml) or a recording (.mcap)"
        ) from error
    data = parse_scene(text, path.name)
    parent = data.pop("extends", None)
    if parent is None:
        return data
    if not isinstance(parent, str):
        raise SceneError(f"{path.name}: extends = {shown(parent)}: must be the name of a scene")
    return _merged(read_scene(find_scene(parent, path.parent), files), data)


def _merged(base: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nested values of ``base``, with those of ``changes`` in place of or added to them.

    Mappings in both are merged; neither argument is changed.
    """
    merged = dict(base)
    for key, value in changes.items():
        if isinstance(value, Mapping):
            replaced = merged.get(key)
            value = _merged(replaced if isinstance(replaced, dict) else {}, value)
        merged[key] = value
    return merged


#: Changes of a scene: ``"buffer.c_A=13"`` items with values in YAML, or values by dotted name.
Overrides = Iterable[str] | Mapping[str, Any]


def has_overrides(overrides: Overrides) -> bool:
    """Return True if there are overrides, and for an iterator, whose length is unknown.

    A row of a pandas table, whose truth value pandas does not define, is accepted too.
    """
    return not isinstance(overrides, Sized) or len(overrides) > 0


def override_items(overrides: Overrides) -> list[tuple[str, Any]]:
    """Return the dotted names of overrides with their values, unchecked.

    A short name, e.g. ``c_rr``, stands for its fields.

    A single ``name=value`` text is accepted, too.  SceneError if a text is not of this form, or
    its value is invalid YAML.
    """
    if isinstance(overrides, str):
        overrides = [overrides]
    # a row of a pandas table has items(), but is no Mapping
    named = getattr(overrides, "items", None)
    items = map(_split_override, overrides) if named is None else named()
    return [(path, value) for name, value in items for path in expanded(name)]


def override_texts(items: Iterable[tuple[str, Any]]) -> list[str]:
    """Return overrides as ``name=value``, for display: long lists are abbreviated with ``...``."""
    return [f"{name}={_text_of(value)}" for name, value in items]


def _text_of(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "null" if value is None else shown(value)


def overridden(data: dict[str, Any], items: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return the nested values of a scene with those of overrides, given as dotted name and value.

    ``data`` is not changed.
    """
    for name, value in items:
        nested = value
        for part in reversed(name.split(".", MAX_DEPTH)):
            nested = {part: nested}
        data = _merged(data, nested)
    return data


def _split_override(item: str) -> tuple[str, Any]:
    name, sign, text = item.partition("=")
    name = name.strip()
    if not sign or not name:
        raise SceneError(f"override {shown(item)}: must read part.field=value, as buffer.c_A=13")
    return name, parse(text, f"override {shown(item)}")


def build(data: Any, part: Any = Scene, where: str = "") -> Any:
    """Return a scene, or a part of one, from a nested mapping by field names.

    ``part`` is the class to build, and ``where`` its dotted name in messages, empty for a scene.
    SceneError if a field is missing, unknown or wrong; its one line names up to five of them, with
    value, unit and range.
    """
    mistakes: list[str] = []
    built = _build(data, part, where, mistakes)
    if mistakes:
        n_further = len(mistakes) - MAX_MISTAKES
        rest = [f"and {n_further} more mistakes"] if n_further > 0 else []
        raise SceneError("; ".join(mistakes[:MAX_MISTAKES] + rest))
    return built


def _build(data: Any, part: Any, where: str, mistakes: list[str]) -> Any:
    """Return a part from a mapping; None if it has mistakes, which are added to ``mistakes``."""
    if not isinstance(data, Mapping):
        example = next(iter(declared(part)))
        mistakes.append(str(refuse(where, data, "", f"its fields, e.g. {{{example}: VALUE}}")))
        return None
    prefix = f"{where}." if where else ""
    fields = declared(part)
    n_mistakes = len(mistakes)
    mistakes += [_unknown_field(key, fields, prefix) for key in data if key not in fields]
    values = {}
    for name, spec in fields.items():
        if name not in data:
            if spec.required:
                mistakes.append(f"{prefix}{name}: missing{_missing_hint(name, spec)}")
        elif dataclasses.is_dataclass(spec.kind) and not (data[name] is None and spec.optional):
            values[name] = _build(data[name], spec.kind, prefix + name, mistakes)
        else:
            try:
                values[name] = accept(data[name], spec, prefix + name)
            except SceneError as error:
                mistakes.append(str(error))
    return part(**values) if len(mistakes) == n_mistakes else None


#: Present names of fields, by the names that they had in earlier versions.
RENAMED = {"min_pulse": "min_hold"}


def known_fields(data: Mapping[str, Any], part: type = Scene) -> dict[str, Any]:
    """Return nested data of a part without the fields that this version does not know.

    A recording by a newer version may contain such fields.  One by an older version may have
    fields under their former names.
    """
    kept = {}
    data = {RENAMED.get(name, name): value for name, value in data.items()}
    for name, spec in declared(part).items():
        if name in data:
            value, kind = data[name], spec.kind
            is_inner = isinstance(kind, type) and dataclasses.is_dataclass(kind)
            kept[name] = (
                known_fields(value, kind) if is_inner and isinstance(value, Mapping) else value
            )
    return kept


def _missing_hint(name: str, spec: Declared) -> str:
    """Return the end of the message for a missing field.

    It is the unit of a number, or how to get a part whose fields all have default values.
    """
    is_part = dataclasses.is_dataclass(spec.kind)
    if is_part and not any(field.required for field in declared(spec.kind).values()):
        return f"; {name}: {{}} has all default values"
    return f" (in {spec.unit})" if spec.unit else ""


def _unknown_field(key: object, fields: Mapping[str, Declared], prefix: str) -> str:
    name = str(key)[:100].lower()
    by_lower = {field.lower(): field for field in fields}
    inner = [f"{prefix}{field}" for field in alike(list(_inner_names(fields)), name, cutoff=0.6)]
    near = [prefix + by_lower[n] for n in difflib.get_close_matches(name, by_lower, 1, cutoff=0.5)]
    # a bare k_A means the buffer's, even if a field is similar to it
    if inner and inner[0].lower().endswith(f".{name}"):
        near = inner
    similar = near or inner
    hint = did_you_mean(similar) if similar else f"available: {', '.join(fields)}"
    return f"{prefix}{shown(key)[1:-1]}: unknown field; {hint}"


def _inner_names(fields: Mapping[str, Declared], prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of all fields of the parts that are among ``fields``, at any depth."""
    for name, spec in fields.items():
        if isinstance(spec.kind, type) and issubclass(spec.kind, Checked):
            inner_fields = declared(spec.kind)
            yield from (f"{prefix}{name}.{field}" for field in inner_fields)
            yield from _inner_names(inner_fields, f"{prefix}{name}.")
