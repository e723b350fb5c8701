"""Limits and objectives of a study: the loads of its runs, and the capture range."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from capture_sim.errors import SceneError
from capture_sim.run.loads import LOADS, Load
from capture_sim.scene.paths import did_you_mean
from capture_sim.scene.quantities import POSITIVE, Declared, accept

_BEFORE_LATCH = "_before_latch"
#: Names of all loads in results, for the complete run and until the latch closes.
LOAD_KEYS = tuple(
    f"{load.key}{period}"
    for load in LOADS
    for period in ("", _BEFORE_LATCH)
    if (load.key, period) != ("max_latch_force", _BEFORE_LATCH)
)


#: Name of the share of an area of approach that is captured; see
#: :mod:`capture_sim.studies.evaluate.capture_range`.
CAPTURE_RANGE = "capture_range"
#: The capture range as an objective, described like a load; it cannot have an upper limit.
_RANGE = Load(CAPTURE_RANGE, "capture range", "1", "%", 100.0, ())
#: Least value of a load in a cost, in the unit of tables.  The logarithm of a smaller value would
#: dominate a search.
_MIN_SHOWN = 1e-3
#: Relative excess up to which a limit counts as kept: the error of a run at a study's tolerance.
ROUND_OFF = 1e-6
#: Maximum number of objectives of a design, because a front of more cannot be plotted.
MAX_OBJECTIVES = 3


@dataclass(frozen=True)
class Measure:
    """A load of the complete run or until the latch closes, or the capture range."""

    key: str  # name in results and tables, e.g. max_torsion_before_latch

    @property
    def load(self) -> Load:
        """The load, regardless of its period."""
        name = self.key.removesuffix(_BEFORE_LATCH)
        return next(load for load in (*LOADS, _RANGE) if load.key == name)

    @property
    def is_before_latch(self) -> bool:
        """True if the load is evaluated only until the latch closes."""
        return self.key.endswith(_BEFORE_LATCH)

    @property
    def sign(self) -> float:
        """1 if a smaller value is better, -1 if a larger value is better."""
        return -1.0 if self.key == CAPTURE_RANGE else 1.0

    @property
    def meaning(self) -> str:
        """The load in words."""
        return self.load.meaning + (" before the latch" if self.is_before_latch else "")

    def shown(self, value: float) -> str:
        """Return a value of the load (SI) as text in the unit of tables."""
        return f"{value * self.load.factor:.4g}"

    def cost(self, value: float) -> float:
        """Return the cost of a value (SI); a lower cost is better.

        The cost of a load is the natural logarithm of its value in the unit of tables, because a
        front spans decades.  A difference of costs is then a ratio of loads.  Values below 0.001 in
        the unit of tables have the same cost.
        """
        if self.sign < 0.0:
            return -value
        return math.log(max(value * self.load.factor, _MIN_SHOWN))


@dataclass(frozen=True)
class Limit(Measure):
    """An upper limit of a load."""

    value: float  # SI

    @property
    def text(self) -> str:
        """The limit in words, in the unit of tables."""
        return f"{self.meaning} <= {self.shown(self.value)} {self.load.shown_in}"

    def scaled(self, factor: float) -> Limit:
        """Return the limit multiplied by a factor."""
        return Limit(self.key, self.value * factor)

    def is_exceeded(self, value: float | None) -> bool:
        """Return True if a value of the load exceeds the limit by more than the error of a run."""
        return self.use(value) > 1.0 + ROUND_OFF

    def use(self, value: float | None) -> float:
        """Return a value of the load as a share of the limit; 0 if it was not measured."""
        if value is None or math.isnan(value):
            return 0.0
        return value / self.value


def make_limit(key: str, given: Any) -> Limit:
    """Return the limit of a load by its name in results.

    ``given`` is a number in SI, or a text with a unit.  SceneError if there is no such load, or if
    the value is not a positive number.
    """
    _check_load(f"limit {key}", key)
    load = Limit(key, 1.0).load
    declared = Declared(key, float, False, True, load.unit, POSITIVE, (), load.meaning)
    return Limit(key, accept(given, declared, f"limit {key}"))


def _check_load(where: str, key: str) -> None:
    if key not in LOAD_KEYS:
        near = difflib.get_close_matches(key[:100], LOAD_KEYS, n=3)
        hint = did_you_mean(near) if near else f"available: {', '.join(LOAD_KEYS)}"
        raise SceneError(f"{where}: is no load; {hint}")


def make_objectives(minimize: Iterable[str], maximize: Iterable[str] = ()) -> tuple[Measure, ...]:
    """Return the objectives of a design from the names of loads to minimise.

    ``maximize`` accepts :data:`CAPTURE_RANGE` only.  SceneError if a name is not a load or is given
    twice, or if there are no objectives or more than three.
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
    """Return limits from values by the names of their loads; see :func:`make_limit`."""
    return tuple(make_limit(key, value) for key, value in given.items())


def read_limits(texts: Iterable[str]) -> tuple[Limit, ...]:
    """Return limits from texts ``LOAD=VALUE``; SceneError if a limit is invalid or given twice."""
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
