"""Axes of a sweep: fields of a scene or values of the approach, with values or a distribution."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.scene import paths
from capture_sim.scene.approach import APPROACH, Approach
from capture_sim.scene.files import parse
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Checked, Declared, accept, declared, shown
from capture_sim.scene.units import comma_hint, in_si, split

#: Maximum number of values of one axis.
MAX_VALUES = 1_000_000


@dataclass(frozen=True)
class Axis:
    """One varied input, with ``values`` or a ``distribution`` (frozen, of scipy.stats)."""

    name: str
    unit: str
    values: tuple[Any, ...] = ()
    distribution: Any = None
    text: str = ""

    def quantile(self, u: np.ndarray) -> np.ndarray:
        """Return the quantiles of the distribution at probabilities ``u``, with the shape of u."""
        tiny = np.finfo(float).eps / 2.0  # the quantiles at 0 and 1 may be infinite
        return np.asarray(self.distribution.ppf(np.clip(u, tiny, 1.0 - tiny)))


def typed_unit(axis: Axis) -> tuple[str, float]:
    """Return the unit in which an axis was given, and the factor from SI to this unit.

    It is the SI unit if the axis was given without one.
    """
    for text in re.split(r"[,:()]", axis.text):
        with suppress(ValueError):  # the name of a distribution, or a list
            unit = split(text)[1]
            if unit and unit != "%":
                return unit, 1.0 / in_si(f"1 {unit}", axis.unit)
    return axis.unit, 1.0


def declaration_of(scene: Scene, name: str) -> Declared:
    """Return the declaration of a field of the scene or the approach.

    A short name has that of its first field.  SceneError if there is no such field, or if the field
    is not a single value.
    """
    name = paths.expanded(name)[0]
    owner, _, field = name.rpartition(".")
    part = Approach if owner == "approach" else type(paths.get(scene, owner) if owner else scene)
    what = declared(part).get(field) if issubclass(part, Checked) else None
    if what is None or dataclasses.is_dataclass(what.kind):
        near = paths.alike([*paths.field_names(scene), *APPROACH], name)
        raise SceneError(f"{name}: no number of {scene.name}; {paths.did_you_mean(near)}")
    if what.kind not in (float, int, str, bool):
        raise SceneError(f"{name}: must be a single value, is a list; change it with --set")
    return what


def make_axis(scene: Scene, name: str, given: Any) -> Axis:
    """Return the axis of a field (``buffer.c_A``) or of the approach (``approach.angle``).

    ``given`` is a text (``LOW:HIGH:COUNT``, ``A,B,C``, ``normal(500, 5%)``), values, or a frozen
    distribution of scipy.stats.  If it is invalid, SceneError names the axis and the valid values.
    """
    what = declaration_of(scene, name)
    if hasattr(given, "ppf"):
        return Axis(name, what.unit, distribution=_checked(given, name, shown(given)))
    if not isinstance(given, str):
        values = given if isinstance(given, Iterable) else (given,)
        return _valued(what, name, list(values), shown(given))
    text = given.strip()
    call = re.fullmatch(r"(\w+)\s*\((.*)\)", text)
    if call:
        reference = _nominal(scene, name)
        distribution = _distribution(call[1], call[2].split(","), what, reference, name, text)
        return Axis(name, what.unit, distribution=_checked(distribution, name, text), text=text)
    if text.count(":") == 2 and what.kind in (float, int):
        return _valued(what, name, _span(what, name, text), text)
    if text.count(":") == 1 and what.kind in (float, int):
        usage = "must be LOW:HIGH:COUNT, A,B,C or a distribution"
        raise SceneError(f"{name} = {_brief(text)}: {usage}")
    items = [item.strip() for item in text.split(",")]
    values = items if what.kind is float else [parse(item, name) for item in items]
    return _valued(what, name, values, text)


def _valued(what: Declared, name: str, values: list[Any], text: str) -> Axis:
    if not 0 < len(values) <= MAX_VALUES:
        raise SceneError(f"{name} = {_brief(text)}: must be 1 to {MAX_VALUES} values")
    accepted = tuple(accept(_plain(value), what, name) for value in values)
    return Axis(name, what.unit, accepted, text=text)


def _brief(text: str) -> str:
    """Return the text of a value, shortened to 200 characters for a message."""
    return text if len(text) <= 200 else f"{text[:200]}..."


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _span(what: Declared, name: str, text: str) -> list[Any]:
    low, high, count = text.split(":")
    try:
        ends = in_si(low, what.unit), in_si(high, what.unit)
        number = int(count)
    except ValueError:
        hint = max(map(comma_hint, (low, high)), key=len)
        raise SceneError(
            f"{name} = {_brief(text)}: must be LOW:HIGH:COUNT in {what.unit or '1'}{hint}"
        ) from None
    if not 1 <= number <= MAX_VALUES:
        raise SceneError(f"{name} = {_brief(text)}: COUNT must be 1 to {MAX_VALUES}")
    for end in ends[:number]:
        # the ends must be finite, or the values between them would be NaN
        accept(end, what._replace(kind=float), name)
    values: list[Any] = np.linspace(*ends, number).tolist()
    return values


def _nominal(scene: Scene, name: str) -> float:
    """Return the value of a field in the scene, the reference of percentages; NaN if none."""
    value = None if name in APPROACH else paths.get(scene, name)
    return float(value) if isinstance(value, (int, float)) else math.nan


#: Usage of the distributions with common arguments, by name; all other names are of scipy.stats.
FAMILIAR = {
    "normal": "normal(MEAN, STD)",
    "uniform": "uniform(LOW, HIGH)",
    "triangular": "triangular(LOW, MODE, HIGH)",
    "loguniform": "loguniform(LOW, HIGH)",
    "truncated_normal": "truncated_normal(MEAN, STD, LOW, HIGH)",
}


def _distribution(
    kind: str, arguments: list[str], what: Declared, nominal: float, name: str, text: str
) -> Any:
    from scipy import stats

    family: Any = getattr(stats, kind, None)
    usage = FAMILIAR.get(kind, f"{kind}(SHAPE.., LOC, SCALE)")
    try:
        if kind not in FAMILIAR and not isinstance(family, stats.rv_continuous):
            usage = f"a distribution of scipy.stats, as {', '.join(FAMILIAR.values())}"
            raise ValueError(kind)
        shapes = 0 if kind in FAMILIAR else family.numargs
        shape = [float(argument) for argument in arguments[:shapes]]
        first = arguments[shapes:][:1]
        if first and not first[0].strip().endswith("%"):
            nominal = in_si(first[0], what.unit)
        sizes = [_size(argument, what.unit, nominal) for argument in arguments[shapes:]]
        if kind == "normal":
            return stats.norm(*_exactly(sizes, 2))
        if kind == "uniform":
            low, high = _exactly(sizes, 2)
            return stats.uniform(low, high - low)
        if kind == "triangular":
            low, mode, high = _exactly(sizes, 3)
            return stats.triang((mode - low) / (high - low), low, high - low)
        if kind == "loguniform":
            return stats.loguniform(*_exactly(sizes, 2))
        if kind == "truncated_normal":
            mean, std, low, high = _exactly(sizes, 4)
            return stats.truncnorm((low - mean) / std, (high - mean) / std, mean, std)
        loc, scale = _exactly(sizes, 2)
        return family(*shape, loc=loc, scale=scale)
    except (ValueError, ZeroDivisionError):
        raise SceneError(
            f"{name} = {_brief(text)}: must be {usage} in {what.unit or '1'}"
        ) from None


def _exactly(sizes: list[float], count: int) -> list[float]:
    if len(sizes) != count:
        raise ValueError(f"{len(sizes)} arguments, {count} wanted")
    return sizes


def _size(text: str, unit: str, nominal: float) -> float:
    """Return the number of a text in SI units; a percentage refers to ``nominal``."""
    number, given = split(text)
    if given == "%":
        return float(number) / 100.0 * nominal
    return in_si(text, unit)


def _checked(distribution: Any, name: str, text: str) -> Any:
    """Return the distribution; SceneError unless its quartiles are finite and ascending."""
    with np.errstate(all="ignore"):
        quartiles = distribution.ppf([0.25, 0.5, 0.75])
    if not (np.all(np.isfinite(quartiles)) and np.all(np.diff(quartiles) > 0.0)):
        why = " (a percentage of 0 is 0)" if "%" in text else ""
        raise SceneError(
            f"{name} = {_brief(text)}: must have a width > 0, bounds in ascending order{why}"
        )
    return distribution
