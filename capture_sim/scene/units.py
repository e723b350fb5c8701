"""Numbers with a unit, as ``5 deg`` or ``0.5 N/mm``, converted to SI.

pint, which knows the units, is loaded only where a text has one.
"""

from __future__ import annotations

import functools
import math
import re
from fractions import Fraction
from typing import Any

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?)\s*(\S.*?)?\s*", re.ASCII)
_FACTOR = r"[^\W\d_]+(?:(?:\^|\*\*)-?\d|[²³])?"
# without the free powers of pint's own grammar, which take any time and memory to raise
_UNIT = re.compile(rf"(?:{_FACTOR}|[%°])(?:(?:\s*[*/·]\s*|\s+){_FACTOR})*")
_MAX_LENGTH = 100


def split(text: str) -> tuple[str, str]:
    """Return the number in a text and its unit, empty where it has none; ValueError if neither."""
    found = _NUMBER.fullmatch(text) if len(text) <= _MAX_LENGTH else None
    if found is None:
        raise ValueError(f"{text!r} is not a number with a unit")
    return found[1], found[2] or ""


def in_si(text: str, unit: str) -> float:
    """Return the number that a text holds, with or without a unit, in SI.

    Parameters
    ----------
    text
        ``0.5 N/mm``, or ``500``, which is in ``unit``.
    unit
        SI unit of the number, as ``N/m``; ``1`` or empty if it has none.

    Raises
    ------
    ValueError
        The text is no number, or its unit is unknown or of another dimension.
    """
    number, given = split(text)
    if not given:
        return float(number)
    if not _UNIT.fullmatch(given):
        raise ValueError(f"{given!r} is not a unit")
    factor, dimension = _root(given)
    si_factor, si_dimension = _root(unit or "1")
    if dimension != si_dimension:
        raise ValueError(f"{given} is of another dimension than {unit}")
    try:
        return float(Fraction(number) * factor / si_factor)
    except OverflowError:
        return math.copysign(math.inf, float(number))


def comma_hint(text: str) -> str:
    """Return a hint for a text that is a number with a decimal comma, otherwise nothing."""
    is_number = _NUMBER.fullmatch(text[:_MAX_LENGTH].replace(",", ".", 1))
    return "; decimals need a point, not a comma" if "," in text and is_number else ""


@functools.cache
def _root(unit: str) -> tuple[Fraction, Any]:
    """Return a unit as a factor and base units, of which the radian is one."""
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

    # exact factors: 0.5 N/mm are 500 N/m, not the float beside it
    return UnitRegistry(non_int_type=Fraction)
