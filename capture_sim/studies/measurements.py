"""What can be measured on a bench, as time series of their own rates.

From a recording of a real bench, of the nodes, or from a simulation: comparison and
identification need nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

_CHASER, _TARGET = slice(0, 3), slice(5, 8)


class Series(NamedTuple):
    """One measured thing over time."""

    t: np.ndarray  # (n,), s, ascending
    values: np.ndarray  # (n,) or (n, m), SI units

    @property
    def interval(self) -> float:
        """Median interval of the samples, s; 0 for fewer than two."""
        return float(np.median(np.diff(self.t))) if self.t.size > 1 else 0.0


class Part(NamedTuple):
    """One number of a series: its label behind the series' name, and how it is displayed.

    ``noise`` is the least that is believed of a sensor, SI: rounding and what none betters.
    """

    label: str
    unit: str
    factor: float
    noise: float


_POSE = (Part("x", "mm", 1e3, 1e-6), Part("y", "mm", 1e3, 1e-6), Part("theta", "mrad", 1e3, 1e-6))
#: What is compared and fitted, by series.  The sampled force is not: touches are in its place.
PARTS = {
    "chaser": _POSE,
    "target": _POSE,
    "stroke": (Part("", "mm", 1e3, 1e-7),),
    "torsion": (Part("", "mrad", 1e3, 1e-7),),
}

_NOTHING = Series(np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Measurements:
    """Time series of a run; one that was not measured is empty."""

    chaser: Series = _NOTHING  # poses in the world (n, 3): x m, y m, theta rad
    target: Series = _NOTHING
    stroke: Series = _NOTHING  # h - rest length, m
    torsion: Series = _NOTHING  # theta_P - theta_S, rad
    force: Series = _NOTHING  # magnitude on the tip, N

    def items(self) -> list[tuple[str, Series]]:
        """Return name and series of all that was measured."""
        named = [(f.name, getattr(self, f.name)) for f in fields(self)]
        return [(name, series) for name, series in named if series.t.size]

    def shifted(self, by: float) -> Measurements:
        """Return the same with all times later by so much, s."""
        return Measurements(**{n: Series(s.t + by, s.values) for n, s in self.items()})


def measured_in(samples: np.ndarray) -> Measurements:
    """Return what perfect sensors would measure in samples, (n,) of dtype SAMPLE."""
    t, q = samples["t"], samples["q"]
    force = samples["contact_force"] + samples["latch_force"]
    return Measurements(
        chaser=Series(t, q[:, _CHASER]),
        target=Series(t, q[:, _TARGET]),
        stroke=Series(t, samples["axial_stroke"]),
        torsion=Series(t, samples["torsion"]),
        force=Series(t, np.hypot(force[:, 0], force[:, 1])),
    )
