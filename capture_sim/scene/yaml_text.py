"""Scenes as YAML text: the same bytes as PyYAML's ``safe_dump`` writes, but faster.

Every result contains the hash of its scene's text, and PyYAML's emitter takes twice as long as a
complete run.  PyYAML still writes each top-level field that contains a text which may need quotes,
or a number that is not finite.  Recordings of all versions contain such hashes, so the bytes must
not change.
"""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import yaml

#: Columns after which PyYAML breaks a line at the next blank, or between two items.
_WIDTH = 80
#: Texts that need no quotes; words that YAML reads as other values are excluded by _OTHER.
_PLAIN = re.compile(r"[A-Za-z][\w.,;=()+*/'%^-]*(?: [\w.,;=()+*/'%^-]+)*", re.ASCII)
_OTHER = re.compile(r"(?i:null|yes|no|true|false|on|off)")


class _NotPlainError(Exception):
    """A value that is left to PyYAML: a text that may need quotes, or NaN or infinity."""


def yaml_text(part: Any) -> str:
    """Return a scene as YAML text.

    A part that contains parts or tuples is a block, other parts are one mapping in braces.
    ``part`` is a dataclass of numbers, texts, tuples and further parts.
    """
    lines: list[str] = []
    for name, value in _items(part):
        try:
            lines += _entry(f"{name}:", value, 0)
        except _NotPlainError:
            style = None if dataclasses.is_dataclass(value) or isinstance(value, tuple) else False
            data = {name: _plain_data(value)}
            lines.append(yaml.safe_dump(data, sort_keys=False, default_flow_style=style)[:-1])
    return "\n".join([*lines, ""])


def _plain_data(part: Any) -> Any:
    if dataclasses.is_dataclass(part):
        return {name: _plain_data(value) for name, value in _items(part)}
    return [_plain_data(item) for item in part] if isinstance(part, tuple) else part


_names: dict[type, tuple[str, ...]] = {}


def _items(part: Any) -> list[tuple[str, Any]]:
    kind, values = type(part), part.__dict__
    if kind not in _names:
        _names[kind] = tuple(field.name for field in dataclasses.fields(part))
    return [(name, values[name]) for name in _names[kind]]


def _entry(head: str, value: Any, indent: int) -> list[str]:
    """Return the lines of a value after its ``head``: its indented name with a colon, or a dash.

    ``indent`` is the column of the name, or of the text after the dash.  The lines of a part are
    kept in the part.
    """
    if type(value) is float or value is None:
        return [f"{head} {_scalar(value)}"]
    if isinstance(value, tuple):
        return _group(head, value, indent)
    if isinstance(value, str | int):
        return _folded(head, _scalar(value), indent)
    # a part never changes, and the scenes of a study share most of theirs
    written = value.__dict__.get(_LINES_NAME)
    if written is None or written[:2] != (head, indent):
        written = value.__dict__[_LINES_NAME] = (head, indent, _group(head, value, indent))
    kept: list[str] = written[2]
    return kept


#: Name in a part of its head, indentation and lines.
_LINES_NAME = "_yaml_lines"


def _group(head: str, value: Any, indent: int) -> list[str]:
    """Return the lines of a part or a tuple, the first of which begins with ``head``."""
    is_part = not isinstance(value, tuple)
    items = _items(value) if is_part else [("", item) for item in value]
    if not any(isinstance(item, tuple) or dataclasses.is_dataclass(item) for _, item in items):
        return _in_brackets(head, items, "{}" if is_part else "[]", indent)
    if is_part:
        inside = " " * (indent + 2)
        nested = [_entry(f"{inside}{name}:", item, indent + 2) for name, item in items]
        return [head, *(line for lines in nested for line in lines)]
    # PyYAML writes the dashes of a list in the column of its name
    dash = " " * indent + "-"
    return [head, *(line for _, item in items for line in _entry(dash, item, indent + 2))]


def _in_brackets(head: str, items: list[tuple[str, Any]], ends: str, indent: int) -> list[str]:
    """Return the lines of a mapping or a list of scalars in ``ends``, ``"{}"`` or ``"[]"``."""
    first, last = tuple(ends)
    lines, line, sign = [], f"{head} {first}", ""
    for name, value in items:
        line += sign
        if len(line) > _WIDTH:
            lines.append(line)
            line = " " * (indent + 2)
        elif sign:
            line += " "
        text = _scalar(value)
        if isinstance(value, str) and not text.isidentifier():
            raise _NotPlainError
        line += f"{name}: {text}" if name else text
        sign = ","
    return [*lines, line + last]


def _folded(head: str, text: str, indent: int) -> list[str]:
    """Return the lines of a text after its ``head``, broken at blanks as PyYAML breaks them."""
    lines, line = [], head
    for number, word in enumerate(text.split(" ")):
        if number and len(line) > _WIDTH:
            lines.append(line)
            line = " " * (indent + 2) + word
        else:
            line += f" {word}"
    return [*lines, line]


def _scalar(value: Any) -> str:
    if type(value) is float:
        if not math.isfinite(value):
            raise _NotPlainError
        text = repr(value)
        return text.replace("e", ".0e") if "e" in text and "." not in text else text
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    text = str(value)
    if not _PLAIN.fullmatch(text) or _OTHER.fullmatch(text):
        raise _NotPlainError
    return text
