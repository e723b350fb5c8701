"""Numbers with a unit, e.g. ``5 deg`` or ``0.5 N/mm``, converted to SI.

pint is loaded only for a text with a unit.
"""

from __future__ import annotations

import functools
import math
import re
from fractions import Fraction
from typing import Any

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?)\s*(\S.*?)?\s*", re.ASCII)
_FACTOR = r"[^\W\d_]+(?:(?:\^|\*\*)-?\d|[²³])?"
# excludes the arbitrary powers of pint's grammar, which may need any time and memory
_UNIT = re.compile(rf"(?:{_FACTOR}|[%°])(?:(?:\s*[*/·]\s*|\s+){_FACTOR})*")
#: Longest text of a number with its unit: a longer one is a mistake, and may take long to parse.
_MAX_LENGTH = 100


def split(text: str) -> tuple[str, str]:
    """Return the number and the unit in a text, both as texts; the unit may be empty.

    ValueError if the text does not begin with a number, or is longer than 100 characters.
    """
    match = _NUMBER.fullmatch(text) if len(text) <= _MAX_LENGTH else None
    if match is None:
        raise ValueError(f"{text!r} is not a number with a unit")
    return match[1], match[2] or ""


def in_si(text: str, unit: str) -> float:
    """Return the number in a text, converted to ``unit``, an SI unit.

    A ``unit`` of ``1`` or an empty one is dimensionless.  A number without a unit is taken to be in
    ``unit`` already.  A number that is too large gives infinity.  ValueError if the text does not
    begin with a number, or its unit is unknown or of another dimension.
    """
    number, text_unit = split(text)
    if not text_unit:
        return float(number)
    if not _UNIT.fullmatch(text_unit):
        raise ValueError(f"{text_unit!r} is not a unit")
    factor, dimension = _root(text_unit)
    si_factor, si_dimension = _root(unit or "1")
    if dimension != si_dimension:
        raise ValueError(f"{text_unit} is of another dimension than {unit}")
    try:
        return float(Fraction(number) * factor / si_factor)
    except OverflowError:
        return math.copysign(math.inf, float(number))


def comma_hint(text: str) -> str:
    """Return a hint for an error message if a text is a number with a decimal comma, else ""."""
    is_number = _NUMBER.fullmatch(text[:_MAX_LENGTH].replace(",", ".", 1))
    return "; decimals need a point, not a comma" if "," in text and is_number else ""


@functools.cache
def _root(unit: str) -> tuple[Fraction, Any]:
    """Return a unit as an exact factor and pint's base units; ValueError if it is unknown.

    The radian is a base unit of its own, so that an angle differs from a dimensionless number.
    """
    from pint.errors import PintError

    registry = _registry()
    try:
        factor, base = registry.get_root_units(registry.parse_units("" if unit == "1" else unit))
    except (PintError, AttributeError, ValueError, TypeError) as error:
        raise ValueError(f"{unit!r} is not a unit") from error
    return Fraction(factor), base


@functools.cache
def _registry() -> Any:
    from pint import UnitRegistry

    # exact factors: 0.5 N/mm is exactly 500 N/m
    return UnitRegistry(non_int_type=Fraction)
