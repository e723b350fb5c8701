"""A scene as a template: every field with its value, unit, range and meaning."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import yaml

from capture_sim.scene.parts import Scene, as_mapping
from capture_sim.scene.quantities import ANY, Declared, declared

#: Comments of the template begin in this column, to the right of its longest value.
_COMMENT_COLUMN = 48


def template(scene: Scene) -> str:
    """Return a scene as YAML text with unit, range and meaning of each field in a comment.

    Parts that the scene does not have are null, followed by their fields as comments.
    """
    head = [
        "# A complete scene. Replace its values by your bench's. A value without a unit is",
        "# in the unit of its comment; with a unit it is a text, e.g. '5 mm'.",
        "# null removes an optional part.",
    ]
    return "\n".join([*head, *_lines(scene, "")]) + "\n"


def _lines(part: Any, indent: str) -> Iterator[str]:
    for name, spec in declared(type(part)).items():
        value = getattr(part, name)
        if not _is_part(spec):
            yield _commented(f"{indent}{name}: {_text(value)}", _meaning(spec))
        elif value is not None:
            yield _commented(f"{indent}{name}:", _summary(spec.kind))
            yield from _lines(value, f"{indent}  ")
        else:
            yield _commented(f"{indent}{name}: null", f"optional: {_summary(spec.kind)}")
            yield from (f"# {line}" for line in _absent(spec.kind, f"{indent}  "))


def _absent(part: type, indent: str) -> Iterator[str]:
    """Yield a line for each field of a part that is absent from the scene, with its default value.

    A field without default has the value ``VALUE``.
    """
    for name, spec in declared(part).items():
        if _is_part(spec):
            yield _commented(f"{indent}{name}:", _summary(spec.kind))
            yield from _absent(spec.kind, f"{indent}  ")
        else:
            default = next(f.default for f in dataclasses.fields(part) if f.name == name)
            text = "VALUE" if default is dataclasses.MISSING else _text(default)
            yield _commented(f"{indent}{name}: {text}", _meaning(spec))


def _is_part(spec: Declared) -> bool:
    return bool(dataclasses.is_dataclass(spec.kind))


def _text(value: Any) -> str:
    text: str = yaml.safe_dump(as_mapping(value), default_flow_style=True, width=1000)
    return text.removesuffix("...\n").strip()


def _meaning(spec: Declared) -> str:
    """Return the comment on a field: its unit, allowed values and meaning."""
    allowed = f"one of {', '.join(spec.options)}" if spec.options else ""
    if spec.allowed not in (None, ANY):
        allowed = str(spec.allowed)
    if spec.points is not None:
        allowed = str(spec.points)
    if spec.kind is bool:
        allowed = "true or false"
    unit = "" if spec.unit == "1" else spec.unit
    limits = ", ".join(text for text in (unit, allowed) if text)
    return f"{limits}: {spec.doc}" if limits else spec.doc


def _summary(part: type) -> str:
    return (part.__doc__ or "").partition("\n")[0].rstrip(".")


def _commented(line: str, comment: str) -> str:
    return f"{line:{_COMMENT_COLUMN}} # {comment}"
