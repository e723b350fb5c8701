"""Limits of loads that the runs of a study must keep."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from capture_sim.errors import SceneError
from capture_sim.run.loads import LOADS, Load
from capture_sim.scene.quantities import POSITIVE, Declared, accept

_BEFORE_LATCH = "_before_latch"
_KEYS = tuple(
    f"{load.key}{period}"
    for load in LOADS
    for period in ("", _BEFORE_LATCH)
    if (load.key, period) != ("max_latch_force", _BEFORE_LATCH)
)


@dataclass(frozen=True)
class Limit:
    """An upper limit of a load, of the whole run or until the latch closes."""

    key: str  # of the load in results and tables, e.g. max_torsion_before_latch
    value: float  # SI

    @property
    def load(self) -> Load:
        """The load that is limited."""
        name = self.key.removesuffix(_BEFORE_LATCH)
        return next(load for load in LOADS if load.key == name)

    @property
    def is_before_latch(self) -> bool:
        """True if the limit applies until the latch closes."""
        return self.key.endswith(_BEFORE_LATCH)

    @property
    def meaning(self) -> str:
        """The load in words."""
        return self.load.meaning + (" before the latch" if self.is_before_latch else "")

    @property
    def text(self) -> str:
        """The limit in words, in the unit of tables."""
        return f"{self.meaning} <= {self.shown(self.value)} {self.load.shown_in}"

    def shown(self, value: float) -> str:
        """Return a value of the load in the unit of tables."""
        return f"{value * self.load.factor:.4g}"

    def use(self, value: float | None) -> float:
        """Return a value of the load as a share of the limit; 0 if it was not measured."""
        if value is None or math.isnan(value):
            return 0.0
        return value / self.value


def make_limit(key: str, given: Any) -> Limit:
    """Return the limit of a load by its name in results.

    ``given`` is a number in SI, or a text with a unit.  SceneError if there is no such load, or
    the value is no positive number.
    """
    if key not in _KEYS:
        near = difflib.get_close_matches(key[:100], _KEYS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"available: {', '.join(_KEYS)}"
        raise SceneError(f"limit {key}: is no load; {hint}")
    load = Limit(key, 1.0).load
    declared = Declared(key, float, False, True, load.unit, POSITIVE, (), load.meaning)
    return Limit(key, accept(given, declared, f"limit {key}"))


def make_limits(given: Mapping[str, Any]) -> tuple[Limit, ...]:
    """Return limits by the names of their loads; see :func:`make_limit`."""
    return tuple(make_limit(key, value) for key, value in given.items())


def read_limits(texts: Iterable[str]) -> tuple[Limit, ...]:
    """Return the limits in texts ``LOAD=VALUE``; SceneError if one is invalid or given twice."""
    given: dict[str, str] = {}
    for text in texts:
        key, sign, value = (part.strip() for part in text.partition("="))
        if not sign or not key or not value or key in given:
            raise SceneError(f"limit {text}: must be LOAD=VALUE, each load once")
        given[key] = value
    return make_limits(given)


def exceeded(limits: Iterable[Limit], loads: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of the loads of a run that exceed their limits."""
    return tuple(limit.key for limit in limits if limit.use(loads[limit.key]) > 1.0)
