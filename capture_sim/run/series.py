"""Time series of a run: of one quantity from one source each."""

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
    """Values of one quantity from one source, each time once.

    Angles count whole turns.  ``arrival`` has the same order as ``t``, so messages that overtook
    each other have descending arrivals.
    """

    t: np.ndarray  # (n,), s since the release, ascending
    values: np.ndarray  # (n,) or (n, m), SI units
    arrival: np.ndarray = _EMPTY  # (n,), s since the release by the recorder's clock; (0,) without

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
    """Return messages in the order of their arrival, (n,) or (n, m), as a series.

    Values that are not finite are left out; of equal times the first message counts.  ``angle`` is
    the column of an angle, which is unwrapped.
    """
    is_finite = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    t, first = np.unique(t[is_finite], return_index=True)
    values = values[is_finite][first]
    if angle is not None:
        values = values.copy()
        values[:, angle] = np.unwrap(values[:, angle])
    return Series(t, values, arrival[is_finite][first] if arrival.size else arrival)


def at_rate(t: np.ndarray, rate: float) -> np.ndarray:
    """Return which times (n,), s, are on the grid of a rate, Hz, from the first; (n,) bool."""
    number = (t - t[:1]) * rate
    return np.asarray(np.abs(number - np.rint(number)) < 1e-6 * rate)


#: Series by quantity and source; a topic is decoded when one of its series is used.
SeriesBySource = Mapping[str, Mapping[str, Series]]

#: Series that samples have, as perfect sensors would measure them.
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
#: Quantities of those series.
QUANTITIES = tuple(_IN_SAMPLES)


def series_in(samples: np.ndarray) -> dict[str, Series]:
    """Return the series of samples, (n,) of dtype SAMPLE, by quantity."""
    t = samples["t"]
    return {name: Series(t, values(samples)) for name, values in _IN_SAMPLES.items()}


class SeriesPart(NamedTuple):
    """One number of a series: its label after the series' name, and how it is displayed.

    ``noise`` is the smallest standard deviation that is assumed of a sensor, SI.
    """

    label: str
    unit: str
    factor: float
    noise: float


#: The numbers of a pose; the noise is the least that a comparison takes for one.
_POSE = (
    SeriesPart("x", "mm", 1e3, 1e-6),
    SeriesPart("y", "mm", 1e3, 1e-6),
    SeriesPart("theta", "mrad", 1e3, 1e-6),
)
#: The numbers that are compared and fitted, by series.  In place of a sampled force, touches are.
PARTS = {
    "chaser": _POSE,
    "target": _POSE,
    "stroke": (SeriesPart("", "mm", 1e3, 1e-7),),
    "torsion": (SeriesPart("", "mrad", 1e3, 1e-7),),
}
