"""Two runs compared in time, aligned at their first contacts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from capture_sim.studies.measurements import PARTS, Measurements, Part, Series
from capture_sim.studies.touches import TICK

#: Samples that two series must have in common to be compared.
LEAST = 4


class Gap(NamedTuple):
    """By how much a measured number of two runs differs, second run less first."""

    series: str  # a field of Measurements
    part: Part  # of it
    rms: float  # SI units
    largest: float  # SI units
    at: float  # when it is largest, s after the first contact
    begin: float  # first sample that was compared, s after the first contact
    end: float  # last one


def overlap(
    a: Series, b: Series, contact_a: float, contact_b: float, window: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return when both series were sampled, (n,), s after the first contacts, and counts (2,).

    The counts are the samples of each in the interval that both hold.  The times are those of the
    series with fewer of them: the other one is finer, and interpolated.
    """
    mine, theirs = a.t - contact_a, b.t - contact_b
    begin = max(0.0, mine[0], theirs[0]) - TICK
    end = min(window, mine[-1], theirs[-1]) + TICK
    inside = [t[(t >= begin) & (t <= end)] for t in (mine, theirs)]
    counts = np.array([len(t) for t in inside])
    return inside[int(np.argmin(counts))], counts


def gaps(
    a: Measurements, b: Measurements, contact_a: float, contact_b: float, window: float
) -> list[Gap]:
    """Return by how much two runs differ after their first contacts, ``b`` less ``a``.

    Poses count from where they were at the first contact: two benches need not share an
    origin, and the approach is a matter of the launch.  What has fewer than LEAST samples in
    common is left out, and so is the force.  Times are in s, the window after the first contact.
    """
    found = []
    for name, parts in PARTS.items():
        one, two = getattr(a, name), getattr(b, name)
        if not one.t.size or not two.t.size:
            continue
        t, _ = overlap(one, two, contact_a, contact_b, window)
        if t.size < LEAST:
            continue
        for k, part in enumerate(parts):
            difference, offset = np.zeros(t.size), 0.0
            for sign, series, contact in ((-1.0, one, contact_a), (1.0, two, contact_b)):
                values = series.values if len(parts) == 1 else series.values[:, k]
                if part.label == "theta":  # a quaternion does not count whole turns
                    values = np.unwrap(values)
                difference += sign * np.interp(t, series.t - contact, values)
                offset += sign * float(np.interp(0.0, series.t - contact, values))
            if len(parts) > 1:
                difference -= offset
            worst = int(np.argmax(np.abs(difference)))
            rms = float(np.sqrt(np.mean(difference**2)))
            extreme = float(difference[worst]), float(t[worst])
            found.append(Gap(name, part, rms, *extreme, float(t[0]), float(t[-1])))
    return found
