"""Numbers with unit and allowed range, declared where they are fields of a dataclass.

The declaration of a field states its allowed values.  :func:`accept` alone checks them, for YAML
files, overrides, parameters of nodes and Python.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import reprlib
import typing
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field
from typing import Any, NamedTuple

import yaml

from capture_sim.errors import SceneError
from capture_sim.scene.units import comma_hint, in_si, split


@dataclass(frozen=True)
class Range:
    """Allowed values of a number: a range with closed or open ends, never NaN or infinity."""

    low: float = -math.inf
    high: float = math.inf
    low_open: bool = False
    high_open: bool = False

    def __contains__(self, value: float) -> bool:
        if not -math.inf < value < math.inf:  # also for whole numbers beyond the largest float
            return False
        above = value > self.low if self.low_open else value >= self.low
        below = value < self.high if self.high_open else value <= self.high
        return above and below

    def __str__(self) -> str:
        low = f"{'>' if self.low_open else '>='} {self.low:g}" if self.low > -math.inf else ""
        high = f"{'<' if self.high_open else '<='} {self.high:g}" if self.high < math.inf else ""
        return " and ".join(filter(None, [low, high])) or "any finite number"


#: Sizes of numbers other than 0 that the model computes with: neither products of several of them
#: nor quotients overflow or vanish.
SMALLEST, LARGEST = 1e-30, 1e30

ANY = Range()
POSITIVE = Range(low=0.0, low_open=True)
NOT_NEGATIVE = Range(low=0.0)
#: Simulated (or recorded) seconds per second; 0 does not wait at all.
REAL_TIME_FACTORS = Range(0.0, 1000.0)


def quantity(unit: str, allowed: Range = ANY, *, default: Any = MISSING, doc: str = "") -> Any:
    """Declare a dataclass field that is a number, with its unit, allowed range and meaning.

    ``unit`` is ``"1"`` for a dimensionless number.  Without default, a value must be given.
    """
    return field(default=default, metadata={"unit": unit, "allowed": allowed, "doc": doc})


class PointList(NamedTuple):
    """Declaration of a list of points: names and units of both coordinates, and how many points."""

    names: tuple[str, str]
    units: tuple[str, str]
    fewest: int
    most: int

    def __str__(self) -> str:
        fewest = {3: "three"}.get(self.fewest, self.fewest)
        count = f"{fewest} to {self.most}" if self.most > self.fewest else f"{fewest}"
        return f"{count} points [{', '.join(self.names)}]"


def points(
    names: tuple[str, str],
    units: tuple[str, str],
    count: tuple[int, int],
    *,
    default: Any = MISSING,
    doc: str = "",
) -> Any:
    """Declare a dataclass field that is a list of points.

    ``names`` and ``units`` are those of both coordinates; ``count`` is the smallest and the largest
    number of points.
    """
    unit = units[0] if units[0] == units[1] else ", ".join(units)
    declaration = PointList(names, units, *count)
    return field(default=default, metadata={"unit": unit, "points": declaration, "doc": doc})


def choice(options: tuple[str, ...], *, default: str, doc: str = "") -> Any:
    """Declare a dataclass field whose value is one of the texts ``options``."""
    return field(default=default, metadata={"options": options, "doc": doc})


class Declared(NamedTuple):
    """Declaration of a field of a part: its type, unit, allowed values and meaning."""

    name: str
    kind: Any  # float, int, str, bool, a part, or tuple for points
    optional: bool  # None removes the part, or computes the value from other fields
    required: bool
    unit: str
    allowed: Range | None
    options: tuple[str, ...]
    doc: str
    points: PointList | None = None


_declared: dict[type, dict[str, Declared]] = {}


def declared(part: type) -> dict[str, Declared]:
    """Return the declarations of the fields of a part's class, by name."""
    if part not in _declared:
        hints = typing.get_type_hints(part)
        _declared[part] = {f.name: _declaration(f, hints[f.name]) for f in dataclasses.fields(part)}
    return _declared[part]


def _declaration(f: dataclasses.Field[Any], hint: Any) -> Declared:
    kinds = typing.get_args(hint)
    optional = type(None) in kinds
    kind = kinds[0] if optional else hint
    kind = typing.get_origin(kind) or kind
    names = ("unit", "allowed", "options", "doc", "points")
    unit, allowed, options, doc, points = map(f.metadata.get, names)
    required = f.default is MISSING
    options, doc = options or (), doc or ""
    return Declared(f.name, kind, optional, required, unit or "", allowed, options, doc, points)


#: Values in messages: a line has room for so many letters, and for so many nested lists.
_shortened = reprlib.Repr()
_shortened.maxstring = _shortened.maxother = 80
_shortened.maxlevel = 3


def shown(value: object) -> str:
    """Return a value as one short line for a message; a long value is abbreviated."""
    if isinstance(value, float):
        return repr(float(value))  # also of NumPy's
    if isinstance(value, int) and value.bit_length() > 256:
        return f"a number of {int(value.bit_length() * math.log10(2.0)) + 1} digits"
    return _shortened.repr(value)


def refuse(where: str, value: object, unit: str, allowed: object) -> SceneError:
    """Return, but do not raise, the one-line error for a value that is not allowed.

    ``where`` is the name of the field, and ``allowed`` follows the words "must be".
    """
    if isinstance(value, float) and not math.isfinite(value) and str(allowed) != str(ANY):
        allowed = f"finite and {allowed}"
    with_unit = f"{shown(value)} {unit}" if unit not in ("", "1") else shown(value)
    return SceneError(f"{where} = {with_unit}: must be {allowed}")


_KIND_TEXTS = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}


def accept(value: Any, spec: Declared, where: str) -> Any:
    """Check a value of any type and return it in the type of its field.

    A text with a unit, e.g. ``5 mm``, is converted to the field's unit.  None is returned as it is
    if the field is optional.  ``where`` is the name of the field in the message, e.g.
    ``buffer.c_A``.  SceneError, with field, value, unit and range, if the value is invalid.
    """
    if value is None and spec.optional:
        return None
    if spec.kind in (float, int):
        return _number(value, spec, where)
    if spec.kind is tuple:
        return _points(value, spec, where)
    if not isinstance(value, spec.kind):
        raise refuse(where, value, spec.unit, _KIND_TEXTS.get(spec.kind, spec.kind.__name__))
    if spec.options and value not in spec.options:
        raise refuse(where, value, "", "one of " + ", ".join(spec.options))
    return value


def _number(value: Any, spec: Declared, where: str) -> float | int:
    is_plain = True
    if isinstance(value, str) and spec.kind is float:
        text, value = value, _text_in_si(value, spec, where)
        is_plain = not split(text)[1]
    number: float | int = value
    try:
        if type(value) is not spec.kind:
            if isinstance(value, bool) or not isinstance(value, numbers.Real):
                raise TypeError
            number = spec.kind(value)
            if number != value and not math.isnan(value):
                raise ValueError  # no whole number
    except OverflowError:
        raise refuse(where, value, spec.unit, f"finite and {spec.allowed or ANY}") from None
    except (TypeError, ValueError):
        kind = _KIND_TEXTS[spec.kind]
        required = kind if spec.allowed in (None, ANY) else f"{kind}, {spec.allowed}"
        raise refuse(where, value, spec.unit, required) from None
    if spec.allowed is not None and number not in spec.allowed:
        in_degrees = is_plain and spec.unit == "rad" and math.radians(number) in spec.allowed
        hint = f"; did you mean {number:g} deg?" if in_degrees else ""
        raise refuse(where, value, spec.unit, f"{spec.allowed}{hint}")
    if spec.kind is float and number != 0.0 and not SMALLEST <= abs(number) <= LARGEST:
        allowed = "" if spec.allowed in (None, ANY) else f"{spec.allowed}, "
        raise refuse(where, value, spec.unit, f"{allowed}between {SMALLEST:g} and {LARGEST:g}")
    return number


def _text_in_si(text: str, spec: Declared, where: str) -> float:
    try:
        return in_si(text, spec.unit)
    except ValueError:
        unit = "" if spec.unit in ("", "1") else f" in {spec.unit}"
        allowed = "" if spec.allowed in (None, ANY) else f", {spec.allowed}"
        raise refuse(where, text, "", f"a number{unit}{allowed}{comma_hint(text)}") from None


def _points(value: Any, spec: Declared, where: str) -> tuple[tuple[float, float], ...]:
    allowed = spec.points
    assert allowed is not None
    try:
        if isinstance(value, str):  # e.g. '[[0, 0], [0.2 mm, 4 N]]'
            value = yaml.safe_load(value)
        found = tuple(
            (_coordinate(x, allowed.units[0]), _coordinate(y, allowed.units[1])) for x, y in value
        )
    except (TypeError, ValueError, OverflowError, yaml.YAMLError):
        found = ()
    is_count = allowed.fewest <= len(found) <= allowed.most
    if not is_count or not all(abs(c) <= LARGEST for point in found for c in point):
        raise refuse(where, value, spec.unit, f"{allowed} up to {LARGEST:g}")
    return found


def _coordinate(value: Any, unit: str) -> float:
    return in_si(value, unit) if isinstance(value, str) else float(value)


@dataclass(frozen=True)
class Checked:
    """Base class of parts: it checks each field when a part is created.

    SceneError if a value is not as declared.  A list of the fields is added to the docstring of
    each subclass.
    """

    def __init_subclass__(cls) -> None:
        if "Attributes\n" in (cls.__doc__ or ""):
            return
        text, title, examples = (cls.__doc__ or "").partition("    Examples\n")
        lines = [text.rstrip(), "", "    Attributes", "    ----------"]
        for name, kind, meaning, part_lines in _described(cls):
            lines += [f"    {name} : {kind}", f"        {meaning}."]
            lines += [f"        - {text}" for text in part_lines]
        cls.__doc__ = "\n".join([*lines, "", title + examples, "    "])

    def __post_init__(self) -> None:
        part, values = type(self).__name__, self.__dict__
        for name, spec in declared(type(self)).items():
            value = accept(values[name], spec, f"{part}.{name}")
            if value is not values[name]:
                object.__setattr__(self, name, value)


def replaced(part: Any, fields: Mapping[str, Any]) -> Any:
    """Return a copy of a part with other values in some fields.

    Only these values are checked, because ``dataclasses.replace``, which checks all fields again,
    takes ten times as long.  It is used only for a part with a check of its own (a scene, for its
    name) if a new value is a text.  SceneError if a value is invalid, TypeError if a field is
    unknown.
    """
    kind = type(part)
    declarations = declared(kind)
    # a check of a part's own is one of its texts, not of the parts in it
    has_own_check = kind.__post_init__ is not Checked.__post_init__
    if has_own_check and any(isinstance(value, str) for value in fields.values()):
        return dataclasses.replace(part, **fields)
    copy = object.__new__(kind)
    values = copy.__dict__
    values.update(part.__dict__)
    if len(values) > len(declarations):  # what was computed from the fields and is cached
        for name in values.keys() - declarations.keys():
            del values[name]
    for name, value in fields.items():
        if name not in declarations:
            return dataclasses.replace(part, **fields)  # raises
        values[name] = accept(value, declarations[name], f"{kind.__name__}.{name}")
    return copy


def _described(part: type) -> Iterator[tuple[str, str, str, list[str]]]:
    """Yield the name, the type with unit, the meaning and the inner fields of each field of a part.

    The inner fields are one line each if the field is itself a part; otherwise the list is empty.
    """
    # a class under construction has its declarations in __dict__; a dataclass has moved them
    declarations = part.__dict__.get("__dataclass_fields__", part.__dict__)
    for name, hint in part.__annotations__.items():
        declaration = declarations.get(name)
        if getattr(declaration, "metadata", None):
            unit = declaration.metadata.get("unit", "1")
            kind = f"{hint} ({unit})" if unit != "1" else hint
            yield name, kind, declaration.metadata["doc"], []
        else:
            kind = hint.partition(" ")[0]  # without "| None"
            inner = next(p for p in Checked.__subclasses__() if p.__name__ == kind)
            summary = (inner.__doc__ or "").partition("\n")[0].rstrip(".")
            yield name, hint, summary, list(_field_lines(inner))


def _field_lines(part: type) -> Iterator[str]:
    """Yield a line for each value in a part; a value in an inner part has its dotted name."""
    for name, kind, meaning, inner in _described(part):
        if inner:
            yield from (f"{name}.{line}" for line in inner)
        else:
            yield f"{name} : {kind}: {meaning}"
