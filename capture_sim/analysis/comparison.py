"""Two runs held against each other in time, aligned at their first contacts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture_sim.analysis.measurements import Measurements


@dataclass(frozen=True)
class Gap:
    """How far a measured thing of two runs is apart.

    Attributes
    ----------
    name
        Field of :class:`~.measurements.Measurements`, a pose's part behind a dot.
    rms, largest
        SI units.
    at
        When it is largest, s after the first contact.
    """

    name: str
    rms: float
    largest: float
    at: float


_PARTS = {"chaser": ("x", "y", "theta"), "target": ("x", "y", "theta")}


def gaps(
    a: Measurements, b: Measurements, contact_a: float, contact_b: float, window: float
) -> list[Gap]:
    """Return how far two runs are apart round their first contacts.

    Poses count from where they were at the first contact: two benches need not share an
    origin, and the approach is a matter of the launch.

    Parameters
    ----------
    a, b
        What was measured.
    contact_a, contact_b
        Their first contacts, s.
    window
        s after the first contact that are compared.
    """
    found = []
    there = dict(b.shifted(-contact_b).items())
    for name, mine in a.shifted(-contact_a).items():
        theirs = there.get(name)
        if theirs is None:
            continue
        inside = (mine.t >= max(0.0, theirs.t[0])) & (mine.t <= min(window, theirs.t[-1]))
        t = mine.t[inside]
        if not t.size:
            continue
        for part, label in enumerate(_PARTS.get(name, ("",))):
            x = mine.values if mine.values.ndim == 1 else mine.values[:, part]
            y = theirs.values if theirs.values.ndim == 1 else theirs.values[:, part]
            difference = x[inside] - np.interp(t, theirs.t, y)
            if name in _PARTS:
                difference -= np.interp(0.0, mine.t, x) - np.interp(0.0, theirs.t, y)
            worst = int(np.argmax(np.abs(difference)))
            found.append(
                Gap(
                    f"{name}.{label}" if label else name,
                    float(np.sqrt(np.mean(difference**2))),
                    float(difference[worst]),
                    float(t[worst]),
                )
            )
    return found
