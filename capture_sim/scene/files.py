"""Scenes as YAML: parsed, extended, overridden, built.

A file may say ``extends: other`` (a name beside it or in config/scenes); what it says
itself is laid over that.  ``null`` takes a part off the bench.

All text from outside comes in by :func:`parse`, which holds it to a size and to plain values,
and makes one line of whatever is wrong with it.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from capture_sim.errors import SceneError
from capture_sim.resources import config_dir
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import alike, did_you_mean
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
        found: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise SceneError(f"{_line(key_node)}: {shown(key)} is not a field name")
            if key in found:
                raise SceneError(f"{shown(key)}: given twice ({_line(key_node)})")
            found[key] = self.construct_object(value_node, deep=True)
        return found


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
    # with 1e-3, which YAML 1.1 takes for a text
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
    _TAG + "int": lambda loader, node: int(loader.construct_scalar(node)),
    _TAG + "map": _Loader.mapping,
}
_Loader.yaml_constructors = _constructors


def parse(text: str, source: str) -> Any:
    """Return what a YAML text says: texts, numbers, lists, mappings by name.

    Parameters
    ----------
    text
        From anywhere.
    source
        What the message calls it.

    Raises
    ------
    SceneError
        One line, whatever is wrong.
    """
    if len(text) > MAX_TEXT:
        raise SceneError(f"{source}: longer than {MAX_TEXT} characters")
    try:
        return yaml.load(text, Loader=_Loader)
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from None
    except Exception as error:  # whatever the parser meets, the text is wrong
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error)
        problem = problem.splitlines()[0][:200] if problem else type(error).__name__
        raise SceneError(f"{source}{where}: not valid YAML: {problem}") from None


# who loads a scene again and again, with other values, has its files parsed once
_parsed = lru_cache(maxsize=32)(parse)


def parse_scene(text: str, source: str) -> dict[str, Any]:
    """Return the parts that a YAML text says, unchecked; errors as of :func:`parse`."""
    data = _parsed(text, source)
    if not isinstance(data, dict):
        found = "is empty" if data is None else f"holds {shown(data)}"
        raise SceneError(f"{source}: {found}: must be fields of a scene, e.g. buffer: {{k_A: 400}}")
    return copy.deepcopy(data)


def scene_names() -> list[str]:
    """Return the names of the scenes that come with the package."""
    folder = config_dir() / "scenes"
    return sorted(p.stem for p in folder.glob("*.yaml") if not p.stem.startswith("_"))


def find_scene(name_or_path: str | Path, beside: Path | None = None) -> Path:
    """Return the file of a scene, by its name or path.

    Parameters
    ----------
    name_or_path
        ``"tilt_p10"``, or the path of a YAML file.
    beside
        Folder that a path starts from, and where a name is looked for first.

    Raises
    ------
    SceneError
        There is none.
    """
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text) if beside is None else beside / text
        # of os.path, for which no path is too odd
        if not os.path.isfile(path):  # noqa: PTH113
            raise SceneError(f"scene file {shown(text)[1:-1]}: no such file")
        return path
    for folder in filter(None, (beside, config_dir() / "scenes")):
        path = folder / f"{text}.yaml"
        if os.path.isfile(path):  # noqa: PTH113
            return path
    names = scene_names()
    near = difflib.get_close_matches(text[:100], names, n=1)
    hint = f"did you mean {near[0]}?" if near else f"available scenes: {', '.join(names)}"
    raise SceneError(f"scene {shown(text)}: not found; {hint}")


def read_scene(path: Path, readers: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return what a file says, laid over what it extends; unchecked.

    Parameters
    ----------
    path
        Of an existing file.
    readers
        Files that extend it, the first first.

    Raises
    ------
    SceneError
        One line that names the file.
    """
    place = path.resolve()
    if place in readers:
        raise SceneError(f"{path.name}: extends itself through {readers[-1].name}")
    if len(readers) >= MAX_FILES:
        raise SceneError(f"{readers[0].name}: more than {MAX_FILES} files extend each other")
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(MAX_TEXT + 1)
    except OSError as error:
        raise SceneError(f"scene file {path.name}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise SceneError(f"scene file {path.name}: cannot be read: no UTF-8: {error}") from None
    data = parse_scene(text, path.name)
    parent = data.pop("extends", None)
    if parent is None:
        return data
    if not isinstance(parent, str):
        raise SceneError(f"{path.name}: extends = {shown(parent)}: must be the name of a scene")
    return _laid_over(read_scene(find_scene(parent, path.parent), (*readers, place)), data)


def _laid_over(base: dict[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, Mapping):
            below = merged.get(key)
            value = _laid_over(below if isinstance(below, dict) else {}, value)
        merged[key] = value
    return merged


#: Changes of a scene: ``"buffer.c_A=13"`` items with values in YAML, or values by dotted name.
Overrides = Iterable[str] | Mapping[str, Any]


def overridden(data: dict[str, Any], overrides: Overrides) -> tuple[dict[str, Any], list[str]]:
    """Return a scene's data with values changed, and the changes as ``name=value``.

    Raises
    ------
    SceneError
        An override is none.
    """
    if isinstance(overrides, str):
        overrides = [overrides]
    items = overrides.items() if isinstance(overrides, Mapping) else map(_split, overrides)
    changes = []
    for name, value in items:
        over = value
        for part in reversed(name.split(".", MAX_DEPTH)):
            over = {part: over}
        data = _laid_over(data, over)
        changes.append(f"{name}={value if isinstance(value, str) else shown(value)}")
    return data, changes


def _split(item: str) -> tuple[str, Any]:
    name, sign, text = item.partition("=")
    name = name.strip()
    if not sign or not name:
        raise SceneError(f"override {shown(item)}: must read part.field=value, as buffer.c_A=13")
    return name, parse(text, f"override {shown(item)}")


def build(data: Any, part: Any = Scene, where: str = "") -> Any:
    """Make a scene, or a part of one, of plain data.

    Parameters
    ----------
    data
        A mapping by the fields' names.
    part
        What is made.
    where
        Dotted name of the part.

    Raises
    ------
    SceneError
        One line that names every wrong field with its value, unit and allowed range.
    """
    mistakes: list[str] = []
    made = _build(data, part, where, mistakes)
    if mistakes:
        more = len(mistakes) - MAX_MISTAKES
        rest = [f"and {more} more mistakes"] if more > 0 else []
        raise SceneError("; ".join(mistakes[:MAX_MISTAKES] + rest))
    return made


def _build(data: Any, part: Any, where: str, mistakes: list[str]) -> Any:
    """Return a part made of plain data; None where it adds to the mistakes."""
    if not isinstance(data, Mapping):
        example = next(iter(declared(part)))
        mistakes.append(str(refuse(where, data, "", f"its fields, e.g. {{{example}: VALUE}}")))
        return None
    prefix = f"{where}." if where else ""
    fields = declared(part)
    before = len(mistakes)
    mistakes += [_unknown(key, fields, prefix) for key in data if key not in fields]
    values = {}
    for name, what in fields.items():
        if name not in data:
            if what.required:
                unit = f" (in {what.unit})" if what.unit else ""
                mistakes.append(f"{prefix}{name}: missing{unit}")
        elif dataclasses.is_dataclass(what.kind) and not (data[name] is None and what.optional):
            values[name] = _build(data[name], what.kind, prefix + name, mistakes)
        else:
            try:
                values[name] = accept(data[name], what, prefix + name)
            except SceneError as error:
                mistakes.append(str(error))
    return part(**values) if len(mistakes) == before else None


def _unknown(key: object, fields: Mapping[str, Declared], prefix: str) -> str:
    name = str(key)[:100].lower()
    by_lower = {field.lower(): field for field in fields}
    inner = [f"{prefix}{field}" for field in alike(list(_inner_names(fields)), name, cutoff=0.6)]
    near = [prefix + by_lower[n] for n in difflib.get_close_matches(name, by_lower, 1, cutoff=0.5)]
    # a bare k_A means the buffer's, even if a field is similar to it
    if inner and inner[0].lower().endswith(f".{name}"):
        near = inner
    likely = near or inner
    hint = did_you_mean(likely) if likely else f"available: {', '.join(fields)}"
    return f"{prefix}{shown(key)[1:-1]}: unknown field; {hint}"


def _inner_names(fields: Mapping[str, Declared], prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of the fields of the parts in a part."""
    for name, what in fields.items():
        if isinstance(what.kind, type) and issubclass(what.kind, Checked):
            parts_fields = declared(what.kind)
            yield from (f"{prefix}{name}.{field}" for field in parts_fields)
            yield from _inner_names(parts_fields, f"{prefix}{name}.")
