"""Numbers with unit and allowed range, declared where they are fields of a dataclass."""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

from capture_sim.errors import SceneError


@dataclass(frozen=True)
class Range:
    """Allowed values of a number: bounds, and whether a bound itself is allowed."""

    low: float = -math.inf
    high: float = math.inf
    low_open: bool = False
    high_open: bool = False

    def __contains__(self, value: float) -> bool:
        if not math.isfinite(value):
            return False
        above = value > self.low if self.low_open else value >= self.low
        below = value < self.high if self.high_open else value <= self.high
        return above and below

    def __str__(self) -> str:
        if self.low == -math.inf and self.high == math.inf:
            return "any finite number"
        if self.high == math.inf:
            return f"{'>' if self.low_open else '>='} {self.low:g}"
        if self.low == -math.inf:
            return f"{'<' if self.high_open else '<='} {self.high:g}"
        return (
            f"{'>' if self.low_open else '>='} {self.low:g} and "
            f"{'<' if self.high_open else '<='} {self.high:g}"
        )


ANY = Range()
POSITIVE = Range(low=0.0, low_open=True)
NOT_NEGATIVE = Range(low=0.0)


def quantity(unit: str, allowed: Range = ANY, *, default: Any = MISSING, doc: str = "") -> Any:
    """Declare a number with its unit, allowed range and meaning."""
    metadata = {"unit": unit, "allowed": allowed, "doc": doc}
    if default is MISSING:
        return field(metadata=metadata)
    return field(default=default, metadata=metadata)


def choice(options: tuple[str, ...], *, default: str, doc: str = "") -> Any:
    """Declare a name out of a fixed list."""
    return field(default=default, metadata={"options": options, "doc": doc})


def refuse(where: str, value: object, unit: str, allowed: object) -> SceneError:
    """Make the one-line error for a value that is not allowed."""
    if isinstance(value, float) and not math.isfinite(value) and allowed != ANY:
        allowed = f"finite and {allowed}"
    shown = f"{value!r} {unit}".rstrip() if unit not in ("", "1") else repr(value)
    return SceneError(f"{where} = {shown}: allowed is {allowed}")


@dataclass(frozen=True)
class Checked:
    """Checks every declared number and name on construction."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            allowed = f.metadata.get("allowed")
            if allowed is not None and value is not None:
                number = isinstance(value, (int, float)) and not isinstance(value, bool)
                if not number or value not in allowed:
                    raise refuse(
                        f"{type(self).__name__}.{f.name}", value, f.metadata["unit"], allowed
                    )
            options = f.metadata.get("options")
            if options is not None and value not in options:
                raise refuse(
                    f"{type(self).__name__}.{f.name}", value, "", "one of " + ", ".join(options)
                )
