"""Time series of a run; each has the values of one quantity from one source."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

#: Columns of q and v.
_CHASER, _TARGET = slice(0, 3), slice(5, 8)
_THETA_S, _THETA_P, _H = 2, 3, 4
_EMPTY = np.zeros(0)

#: Source of the series of exact samples: the topic that carries them.
STATE = "bench/state"


class Series(NamedTuple):
    """Time series of one quantity from one source, with one value at each time.

    Angles are continuous, without jumps of a whole turn.  ``arrival`` is in the order of ``t``, so
    it descends where a message overtook an earlier one.
    """

    t: np.ndarray  # (n,), s since the release, ascending
    values: np.ndarray  # (n,) or (n, m), SI units
    arrival: np.ndarray = _EMPTY  # (n,), s since the release by the recorder's clock, or (0,)

    @property
    def interval(self) -> float:
        """Median interval of the samples, s; 0 for fewer than two."""
        return float(np.median(np.diff(self.t))) if self.t.size > 1 else 0.0

    @property
    def rate(self) -> float:
        """Sample rate by the median interval, Hz; 0 for fewer than two samples."""
        return 1.0 / self.interval if self.interval else 0.0


NO_SERIES = Series(_EMPTY, _EMPTY)


def in_order(
    t: np.ndarray, values: np.ndarray, arrival: np.ndarray = _EMPTY, angle: int | None = None
) -> Series:
    """Return the values of messages as a series, sorted by time.

    ``t`` (n,), ``values`` (n,) or (n, m) and ``arrival`` (n,) are in the order in which the
    messages arrived.  Messages with values that are not finite are left out.  Of several messages
    with one time, the first to arrive counts.  ``angle`` is the column of an angle, which is
    unwrapped; None if there is none.
    """
    is_finite = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    t, first = np.unique(t[is_finite], return_index=True)
    values = values[is_finite][first]
    if angle is not None:
        values = values.copy()
        values[:, angle] = np.unwrap(values[:, angle])
    return Series(t, values, arrival[is_finite][first] if arrival.size else arrival)


def at_rate(t: np.ndarray, rate: float) -> np.ndarray:
    """Return a mask, (n,) bool, of the times (n,), s, that are on the grid of a rate, Hz.

    The grid starts at the first time; the tolerance is 1e-6 s.
    """
    number = (t - t[:1]) * rate
    return np.asarray(np.abs(number - np.rint(number)) < 1e-6 * rate)


#: Series by quantity and source; a topic is decoded when one of its series is used.
SeriesBySource = Mapping[str, Mapping[str, Series]]

#: Functions that compute the series of a quantity from samples, as a perfect sensor measures it.
_IN_SAMPLES: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "chaser": lambda s: s["q"][:, _CHASER],
    "chaser_rate": lambda s: s["v"][:, _CHASER],
    "target": lambda s: s["q"][:, _TARGET],
    "target_rate": lambda s: s["v"][:, _TARGET],
    "stroke": lambda s: s["axial_stroke"],
    "torsion": lambda s: s["torsion"],
    "stroke_rate": lambda s: s["v"][:, _H],
    "torsion_rate": lambda s: s["v"][:, _THETA_P] - s["v"][:, _THETA_S],
    "force": lambda s: np.hypot(*(s["contact_force"] + s["latch_force"]).T),
    "distance": lambda s: s["tip_distance"],
}
#: Quantities that :func:`series_in` returns.
QUANTITIES = tuple(_IN_SAMPLES)


def series_in(samples: np.ndarray) -> dict[str, Series]:
    """Return the series that samples, (n,) of dtype SAMPLE, contain, by quantity.

    The quantities are those of :data:`QUANTITIES`, in SI units.
    """
    t = samples["t"]
    return {name: Series(t, values(samples)) for name, values in _IN_SAMPLES.items()}


class SeriesPart(NamedTuple):
    """One component of a series: its label, and its unit and factor from SI for display.

    ``noise`` is the smallest standard deviation that comparisons and fits assume for a sensor, SI.
    """

    label: str
    unit: str
    factor: float
    noise: float


#: The components of a pose.
_POSE = (
    SeriesPart("x", "mm", 1e3, 1e-6),
    SeriesPart("y", "mm", 1e3, 1e-6),
    SeriesPart("theta", "mrad", 1e3, 1e-6),
)
#: The components that are compared and fitted, by quantity.  Instead of a force, its touches are.
PARTS = {
    "chaser": _POSE,
    "target": _POSE,
    "stroke": (SeriesPart("", "mm", 1e3, 1e-7),),
    "torsion": (SeriesPart("", "mrad", 1e3, 1e-7),),
}
