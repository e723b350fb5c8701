"""Inputs of a study: numbers of a scene that a sweep varies, a design chooses or a fit estimates.

One grammar serves all of them.  A text is ``LOW:HIGH:COUNT`` (equally spaced values), ``[A,B,C]``
(values; a sweep needs no brackets), ``LOW:HIGH`` (a range), a distribution as ``normal(500, 5%)``,
or ``VALUE +- ERROR`` (known from elsewhere).  Each study accepts some of these forms.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.scene import paths
from capture_sim.scene.approach import APPROACH, Approach
from capture_sim.scene.files import parse
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Checked, Declared, Range, accept, declared, shown
from capture_sim.scene.units import comma_hint, in_si, split

#: Maximum number of values of one input.
MAX_VALUES = 1_000_000
#: Forms of a text.
GRID, LIST, RANGE = "LOW:HIGH:COUNT", "[A,B,C]", "LOW:HIGH"
DRAWN, KNOWN = "a distribution", "VALUE +- ERROR"
#: The forms that a sweep and a design take.
FORMS_OF_SWEEP, FORMS_OF_DESIGN = (GRID, LIST, DRAWN, KNOWN), (RANGE, GRID, LIST)
#: Values within this share of an end of their range are at that end.
_AT_END = 0.02
#: A distribution with less than this share of its draws inside the allowed range has none.
_RARE = 1e-9
#: Largest logarithm of a value; the exponential function of a larger one may overflow.
_LARGEST = 300.0
_CALL = re.compile(r"\w+\s*\(.*\)")
_PLUS_MINUS = re.compile(r"\+-|\+/-|±")


class Scale(NamedTuple):
    """Positions of values in a search: a step of one has about the same effect everywhere."""

    kind: str = "linear"  # linear, logarithmic or cubic
    origin: float = 0.0  # value at position 0
    size: float = 1.0  # change of a linear or cubic value from position 0 to 1; of a log: ratio

    @classmethod
    def over(cls, low: float, high: float) -> Scale:
        """Return the scale on which a range is searched from 0 to 1.

        It is logarithmic if the lower end is > 0, else cubic.
        """
        if low > 0.0:
            return cls("logarithmic", low, high / low)
        return cls("cubic", low, high - low)

    def position(self, value: float) -> float:
        """Return the position of a value; minus infinity for 0 on a logarithmic scale."""
        if self.kind == "logarithmic":
            return math.log(value / self.origin) / math.log(self.size) if value > 0.0 else -math.inf
        share = (value - self.origin) / self.size
        return share if self.kind == "linear" else float(max(share, 0.0) ** (1.0 / 3.0))

    def value(self, position: float) -> float:
        """Return the value at a position."""
        if self.kind == "logarithmic":
            return float(self.origin * self.size ** min(position, _LARGEST))
        share = position if self.kind == "linear" else position**3
        return float(self.origin + self.size * share)

    def slope(self, position: float) -> float:
        """Return the derivative of the value with respect to the position."""
        if self.kind == "logarithmic":
            return self.value(position) * math.log(self.size)
        return self.size if self.kind == "linear" else 3.0 * self.size * position**2


#: Scale of a fitted number that is positive: its natural logarithm.
LOGARITHM = Scale("logarithmic", 1.0, math.e)


class Known(NamedTuple):
    """A value that is known from elsewhere, e.g. from scales."""

    value: float  # SI
    error: float  # standard error, SI


@dataclass(frozen=True)
class Input:
    """A number of a scene (or another single value) that a study varies; all numbers in SI units.

    It has ``values`` (of a grid or a catalogue), a ``distribution`` (frozen, of scipy.stats), or a
    range from ``low`` to ``high``.
    """

    name: str  # as given
    unit: str = ""
    values: tuple[Any, ...] = ()
    distribution: Any = None
    low: float = -math.inf
    high: float = math.inf
    scale: Scale = Scale()  # noqa: RUF009 - a tuple cannot be changed
    paths: tuple[str, ...] = ()  # in the scene; empty for an error of a sensor
    text: str = ""  # as the user gave it; empty for a default
    begin: float = math.nan  # value where a fit begins
    known: Known | None = None  # from elsewhere
    is_whole: bool = True  # the range is wide enough to see which loads depend on it

    def quantile(self, u: np.ndarray) -> np.ndarray:
        """Return the quantiles of the distribution at probabilities ``u``, with the shape of u."""
        tiny = np.finfo(float).eps / 2.0  # the quantiles at 0 and 1 may be infinite
        return np.asarray(self.distribution.ppf(np.clip(u, tiny, 1.0 - tiny)))

    def value(self, position: float) -> float:
        """Return the value at a position of the scale; of a catalogue, the item at 0 to 1."""
        if self.values:
            return float(self.values[min(int(position * len(self.values)), len(self.values) - 1)])
        return self.scale.value(position)

    def position(self, value: float) -> float:
        """Return the position of a value, or of the nearest value that the input may have."""
        if self.values:
            distance = [abs(each - value) for each in self.values]
            return (distance.index(min(distance)) + 0.5) / len(self.values)
        return self.scale.position(min(max(value, self.low), self.high))

    def slope(self, position: float) -> float:
        """Return the derivative of the value with respect to the position."""
        return self.scale.slope(position)

    @property
    def is_log(self) -> bool:
        """True if positions are logarithms."""
        return self.scale.kind == "logarithmic"

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit of the position."""
        return self.position(self.low), self.position(self.high)

    @property
    def prior(self) -> tuple[float, float] | None:
        """Position of the known value and its standard error; None if no value is known."""
        if self.known is None:
            return None
        centre = self.position(self.known.value)
        return centre, self.known.error / self.slope(centre)

    def has(self, value: float) -> bool:
        """Return True if a value is in the range or the catalogue."""
        return value in self.values if self.values else self.low <= value <= self.high

    def end_at(self, value: float) -> str:
        """Return ``"lower"`` or ``"upper"`` if a value is within 2 % of this end of the range.

        Empty otherwise, for a catalogue, and at a lower end of 0.
        """
        if self.values:
            return ""
        position = self.position(value)
        if position < _AT_END and self.low > 0.0:
            return "lower"
        return "upper" if position > 1.0 - _AT_END else ""

    def between(self, low: float, high: float) -> Input:
        """Return the input with a range, searched from position 0 to 1."""
        return dataclasses.replace(self, low=low, high=high, scale=Scale.over(low, high))


def typed_unit(given: Input) -> tuple[str, float]:
    """Return the unit in which an input was given, and the factor from SI to this unit.

    It is the SI unit if the input was given without one.
    """
    for text in re.split(rf"[,:()\[\]]|{_PLUS_MINUS.pattern}", given.text):
        with suppress(ValueError):  # the name of a distribution, or a list
            unit = split(text)[1]
            if unit and unit != "%":
                return unit, 1.0 / in_si(f"1 {unit}", given.unit)
    return given.unit, 1.0


def declaration_of(scene: Scene, name: str) -> Declared:
    """Return the declaration of a field of the scene or the approach.

    A short name has that of its first field.  SceneError if there is no such field, or if the field
    is not a single value.
    """
    path = paths.expanded(name)[0]
    owner, _, field = path.rpartition(".")
    part = Approach if owner == "approach" else type(paths.get(scene, owner) if owner else scene)
    what = declared(part).get(field) if issubclass(part, Checked) else None
    if what is None or dataclasses.is_dataclass(what.kind):
        near = paths.alike([*paths.ALIASES, *paths.field_names(scene), *APPROACH], name)
        raise SceneError(f"{name}: no number of {scene.name}; {paths.did_you_mean(near)}")
    if what.kind not in (float, int, str, bool):
        raise SceneError(f"{name}: must be a single value, is a list; change it with --set")
    return what


def read_input(
    scene: Scene,
    name: str,
    given: Any,
    forms: tuple[str, ...] = FORMS_OF_SWEEP,
    what: Declared | None = None,
) -> Input:
    """Return an input from its text, its values, or a frozen distribution of scipy.stats.

    ``name``: a field (``buffer.c_A``), a short name (``c_rr``), or a value of the approach
    (``approach.angle``).  ``forms``: those that the study accepts.  ``what``: declaration of a
    value that is no field of the scene.  If ``given`` is invalid, SceneError names the input and
    the valid values.
    """
    what = what or declaration_of(scene, name)
    plain = Input(name, what.unit, paths=paths.expanded(name))
    if hasattr(given, "ppf"):
        return dataclasses.replace(plain, distribution=_checked(given, what, name, shown(given)))
    if not isinstance(given, str):
        values = given if isinstance(given, Iterable) else (given,)
        return dataclasses.replace(plain, values=_accepted(what, name, list(values), shown(given)))
    plain = dataclasses.replace(plain, text=given.strip())
    form = _form_of(plain.text, what)
    if form not in forms:
        raise _must_be(plain, forms)
    if form == DRAWN:
        drawn = _distribution(plain, what, _nominal(scene, name))
        return dataclasses.replace(plain, distribution=_checked(drawn, what, name, plain.text))
    if form == KNOWN:
        return _known(plain, what, forms)
    if form == RANGE:
        low, high = _ends(plain, plain.text.split(":"), forms)
        for end in (low, high):
            accept(end, what, name)
        if not low < high:
            raise SceneError(f"{name} = {_brief(plain.text)}: must be LOW < HIGH")
        return plain.between(low, high)
    if form == GRID:
        return dataclasses.replace(plain, values=_grid(plain, what, forms))
    if plain.text.startswith("[") != plain.text.endswith("]"):
        raise _must_be(plain, forms)
    items = [item.strip() for item in plain.text.removeprefix("[").removesuffix("]").split(",")]
    is_plain = what.kind in (float, str)
    values = items if is_plain else [parse(item, name) for item in items]
    return dataclasses.replace(plain, values=_accepted(what, name, values, plain.text))


def is_drawn(text: str) -> bool:
    """Return True if the text of an input gives a distribution."""
    return bool(_CALL.fullmatch(text) or _PLUS_MINUS.search(text))


def _form_of(text: str, what: Declared) -> str:
    """Return the form of a text; that of a text or a truth value is always a list."""
    if is_drawn(text):
        return DRAWN if _CALL.fullmatch(text) else KNOWN
    if what.kind in (float, int):
        return {1: RANGE, 2: GRID}.get(text.count(":"), LIST)
    return LIST


def _must_be(given: Input, forms: tuple[str, ...], hint: str = "") -> SceneError:
    *first, final = forms
    words = f"{', '.join(first)} or {final}" if first else final
    return SceneError(
        f"{given.name} = {_brief(given.text)}: must be {words} in {given.unit or '1'}{hint}"
    )


def _accepted(what: Declared, name: str, values: list[Any], text: str) -> tuple[Any, ...]:
    if not 0 < len(values) <= MAX_VALUES:
        raise SceneError(f"{name} = {_brief(text)}: must be 1 to {MAX_VALUES} values")
    return tuple(accept(_plain(value), what, name) for value in values)


def _brief(text: str) -> str:
    """Return the text of a value, shortened to 200 characters for a message."""
    return text if len(text) <= 200 else f"{text[:200]}..."


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _ends(given: Input, texts: list[str], forms: tuple[str, ...]) -> list[float]:
    try:
        return [in_si(text, given.unit) for text in texts]
    except ValueError:
        raise _must_be(given, forms, max(map(comma_hint, texts), key=len)) from None


def _grid(given: Input, what: Declared, forms: tuple[str, ...]) -> tuple[Any, ...]:
    *ends, count = given.text.split(":")
    low, high = _ends(given, ends, forms)
    try:
        number = int(count)
    except ValueError:
        raise _must_be(given, forms) from None
    if not 1 <= number <= MAX_VALUES:
        raise SceneError(f"{given.name} = {_brief(given.text)}: COUNT must be 1 to {MAX_VALUES}")
    for end in (low, high)[:number]:
        # the ends must be finite, or the values between them would be NaN
        accept(end, what._replace(kind=float), given.name)
    return _accepted(what, given.name, np.linspace(low, high, number).tolist(), given.text)


def _known(given: Input, what: Declared, forms: tuple[str, ...]) -> Input:
    """Return an input of the form VALUE +- ERROR [UNIT]; the error may be in percent.

    If the study accepts distributions, it is a normal distribution.
    """
    try:
        value, error = (part.strip() for part in _PLUS_MINUS.split(given.text))
        number, unit = split(error)
        if unit == "%":
            centre = in_si(value, what.unit)
            spread = abs(centre) * float(number) / 100.0
        else:
            centre = in_si(value if split(value)[1] else f"{value} {unit}", what.unit)
            spread = in_si(error, what.unit)
    except ValueError:
        raise _must_be(given, (KNOWN,)) from None
    if not math.isfinite(spread):
        raise _must_be(given, (KNOWN,))
    found = dataclasses.replace(given, known=Known(accept(centre, what, given.name), spread))
    if DRAWN not in forms:
        return found
    from scipy import stats

    drawn = _checked(stats.norm(centre, spread), what, given.name, given.text)
    return dataclasses.replace(found, distribution=drawn)


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


def _distribution(given: Input, what: Declared, nominal: float) -> Any:
    from scipy import stats

    kind, _, inner = given.text[:-1].partition("(")
    kind, arguments = kind.strip(), inner.split(",")
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
        raise _must_be(given, (usage,)) from None


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


def _checked(distribution: Any, what: Declared, name: str, text: str) -> Any:
    """Return the distribution.

    SceneError unless its quartiles are finite and ascending, and some of its draws are allowed.
    """
    with np.errstate(all="ignore"):
        quartiles = distribution.ppf([0.25, 0.5, 0.75])
    if not (np.all(np.isfinite(quartiles)) and np.all(np.diff(quartiles) > 0.0)):
        why = " (a percentage of 0 is 0)" if "%" in text else ""
        raise SceneError(
            f"{name} = {_brief(text)}: must have a width > 0, bounds in ascending order{why}"
        )
    if isinstance(what.allowed, Range):
        below, above = distribution.cdf(what.allowed.low), distribution.sf(what.allowed.high)
        if below + above > 1.0 - _RARE:
            unit = f" {what.unit}" if what.unit not in ("", "1") else ""
            raise SceneError(
                f"{name} = {_brief(text)}: must have draws {what.allowed}{unit}, has none"
            )
    return distribution
