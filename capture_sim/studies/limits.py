"""Quantities that a study limits or minimises: the loads of its runs, and the capture range."""

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
#: Names of all loads in results: of the whole run and until the latch closes.
LOAD_KEYS = tuple(
    f"{load.key}{period}"
    for load in LOADS
    for period in ("", _BEFORE_LATCH)
    if (load.key, period) != ("max_latch_force", _BEFORE_LATCH)
)


#: Share of an area of approach that is captured; see capture_sim.studies.capture_range.
CAPTURE_RANGE = "capture_range"
#: It is an objective like a load, without a limit that it must keep.
_RANGE = Load(CAPTURE_RANGE, "capture range", "1", "%", 100.0, ())
#: Smaller values of a load, in its shown unit, count as this: their logarithm would rule a search.
_LEAST_SHOWN = 1e-3
#: A limit is kept up to this share: the error of a run at the tolerance of a study.
ROUND_OFF = 1e-6
#: Most objectives of a design: more make no picture.
MAX_OBJECTIVES = 3


@dataclass(frozen=True)
class Measure:
    """A load of the entire run, or until the latch closes; or the capture range."""

    key: str  # of the load in results and tables, e.g. max_torsion_before_latch

    @property
    def load(self) -> Load:
        """The load without its period."""
        name = self.key.removesuffix(_BEFORE_LATCH)
        return next(load for load in (*LOADS, _RANGE) if load.key == name)

    @property
    def is_before_latch(self) -> bool:
        """True if the load counts until the latch closes."""
        return self.key.endswith(_BEFORE_LATCH)

    @property
    def sign(self) -> float:
        """1 if less is better, -1 if more is."""
        return -1.0 if self.key == CAPTURE_RANGE else 1.0

    @property
    def meaning(self) -> str:
        """The load in words."""
        return self.load.meaning + (" before the latch" if self.is_before_latch else "")

    def shown(self, value: float) -> str:
        """Return a value of the load in the unit of tables."""
        return f"{value * self.load.factor:.4g}"

    def cost(self, value: float) -> float:
        """Return a number that is less for a better value.

        That of a load is its logarithm, so that differences are ratios: a front spans decades.
        Values below 0.001 in the unit of tables count as equal.
        """
        if self.sign < 0.0:
            return -value
        return math.log(max(value * self.load.factor, _LEAST_SHOWN))


@dataclass(frozen=True)
class Limit(Measure):
    """An upper limit of a load."""

    value: float  # SI

    @property
    def text(self) -> str:
        """The limit in words, in the unit of tables."""
        return f"{self.meaning} <= {self.shown(self.value)} {self.load.shown_in}"

    def scaled(self, factor: float) -> Limit:
        """Return the limit times a factor."""
        return Limit(self.key, self.value * factor)

    def is_exceeded(self, value: float | None) -> bool:
        """Whether a value of the load is above the limit by more than the error of a run."""
        return self.use(value) > 1.0 + ROUND_OFF

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
    _check_load(f"limit {key}", key)
    load = Limit(key, 1.0).load
    declared = Declared(key, float, False, True, load.unit, POSITIVE, (), load.meaning)
    return Limit(key, accept(given, declared, f"limit {key}"))


def _check_load(where: str, key: str) -> None:
    if key not in LOAD_KEYS:
        near = difflib.get_close_matches(key[:100], LOAD_KEYS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"available: {', '.join(LOAD_KEYS)}"
        raise SceneError(f"{where}: is no load; {hint}")


def make_objectives(minimize: Iterable[str], maximize: Iterable[str] = ()) -> tuple[Measure, ...]:
    """Return the objectives of a design by the names of loads to minimise.

    ``maximize`` accepts :data:`CAPTURE_RANGE` only.  SceneError if a name is no load or given
    twice, or if there are more than three or none.
    """
    least, most = tuple(minimize), tuple(maximize)
    for key in least:
        _check_load(f"minimize {key}", key)
    for key in most:
        if key != CAPTURE_RANGE:
            raise SceneError(f"maximize {key}: must be {CAPTURE_RANGE}")
    keys = (*least, *most)
    for key in keys:
        if keys.count(key) > 1:
            raise SceneError(f"minimize {key}: must be given once")
    if not 1 <= len(keys) <= MAX_OBJECTIVES:
        raise SceneError(
            f"objectives = {len(keys)} ({', '.join(keys)}): must be 1 to {MAX_OBJECTIVES}"
        )
    return tuple(Measure(key) for key in keys)


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
    return tuple(limit.key for limit in limits if limit.is_exceeded(loads[limit.key]))
