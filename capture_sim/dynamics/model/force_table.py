r"""Measured force curve of an axial spring or a wall: a monotone cubic through its points.

Between two points the force is the cubic of Fritsch and Carlson (1980) with the slopes of Fritsch
and Butland (1984), as SciPy's ``PchipInterpolator`` computes them: it rises where the points rise,
and its slope is continuous.  Beyond the last point it continues along its slope there.  The energy
is the integral of the cubics, in closed form.  At a point that is listed twice the curve has a
kink, because the cubics on both sides are then computed separately.

Without a preload a spring also acts outwards, with the mirrored curve F(-s) = -F(s).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from capture_sim.base.compiled.kernels import kernel
from capture_sim.scene.parts import MAX_TABLE_POINTS

#: Bisections between two points in the search for a depth; it is for step sizes only.
_HALVINGS = 20

#: Cubics of a table: force = force + u (slope + u (bend + u twist)) with the distance u from a
#: point's stroke.  The force of a spring is that above the force at rest.
FORCE_TABLE = np.dtype(
    [
        ("count", "i8"),  # of the points; 0: no table
        ("stroke", "f8", (MAX_TABLE_POINTS,)),  # m
        ("force", "f8", (MAX_TABLE_POINTS,)),  # N
        ("slope", "f8", (MAX_TABLE_POINTS,)),  # N/m
        ("bend", "f8", (MAX_TABLE_POINTS,)),  # N/m^2; 0 at the last point
        ("twist", "f8", (MAX_TABLE_POINTS,)),  # N/m^3; 0 at the last point
        ("energy", "f8", (MAX_TABLE_POINTS,)),  # J, from stroke 0 to the point
        ("largest_slope", "f8"),  # N/m
    ],
    align=True,
)


@lru_cache(maxsize=8)
def force_table(points: tuple[tuple[float, float], ...], *, is_spring: bool = True) -> np.ndarray:
    """Return the (1,) record of a table of strokes (m, rising from 0) and forces (N).

    For a spring, the record has the forces minus the force at rest (the preload).  Without a
    preload its curve is mirrored, so that the slope at rest is that of the mirrored curve.
    """
    strokes, forces = np.array(points).T
    above = forces - forces[0] if is_spring else forces
    is_mirrored = is_spring and forces[0] == 0.0
    kinks = np.flatnonzero(np.diff(strokes) == 0.0) + 1
    pieces = zip(np.split(strokes, kinks), np.split(above, kinks), strict=True)
    curves = [_cubics(*piece, is_mirrored and k == 0) for k, piece in enumerate(pieces)]
    twist, bend, slope = (np.concatenate(rows) for rows in zip(*curves, strict=True))
    strokes, above = np.delete(strokes, kinks), np.delete(above, kinks)
    n, width = len(strokes), np.diff(strokes)
    at_end = slope[-1] + width[-1] * (2.0 * bend[-1] + 3.0 * width[-1] * twist[-1])
    parts = above[:-1] + width * (slope / 2.0 + width * (bend / 3.0 + width * twist / 4.0))
    record = np.zeros(1, FORCE_TABLE)
    record["count"] = n
    record["stroke"][0, :n], record["force"][0, :n] = strokes, above
    record["slope"][0, :n] = np.append(slope, at_end)
    record["bend"][0, : n - 1], record["twist"][0, : n - 1] = bend, twist
    record["energy"][0, 1:n] = np.cumsum(width * parts)
    with np.errstate(divide="ignore", invalid="ignore"):
        top = np.clip(np.nan_to_num(-bend / (3.0 * twist)), 0.0, width)
    steepest = slope + top * (2.0 * bend + 3.0 * top * twist)
    record["largest_slope"] = max(np.abs(steepest).max(), np.abs(record["slope"]).max())
    record.flags.writeable = False
    return record


def _cubics(
    strokes: np.ndarray, above: np.ndarray, is_mirrored: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coefficients of the cubic in each interval: cubic, quadratic, linear, (n - 1,)."""
    # imported here: only scenes with a table need it
    from scipy.interpolate import PchipInterpolator

    first = 0
    if is_mirrored:
        # the slope at rest is that of the mirrored curve
        first = len(strokes) - 1
        strokes = np.concatenate([-strokes[:0:-1], strokes])
        above = np.concatenate([-above[:0:-1], above])
    twist, bend, slope, _ = (row[first:] for row in PchipInterpolator(strokes, above).c)
    return twist, bend, slope


@kernel
def tabulated_spring(stroke, table):
    """Return force (N), stiffness (N/m) and energy (J) of a table at a stroke.

    Outwards, ``stroke`` < 0, the force is that of the mirrored curve.
    """
    size = abs(stroke)
    low, high = 0, table.count
    while high - low > 1:
        middle = (low + high) // 2
        if table.stroke[middle] <= size:
            low = middle
        else:
            high = middle
    u = size - table.stroke[low]
    at_point, slope, bend, twist = (
        table.force[low],
        table.slope[low],
        table.bend[low],
        table.twist[low],
    )
    force = at_point + u * (slope + u * (bend + u * twist))
    stiffness = slope + u * (2.0 * bend + 3.0 * u * twist)
    energy = table.energy[low] + u * (
        at_point + u * (slope / 2.0 + u * (bend / 3.0 + u * twist / 4.0))
    )
    return (force if stroke > 0.0 else -force), stiffness, energy


@kernel
def tabulated_depth(energy, table):
    """Return the stroke (m, above 0) at which the tabulated spring has stored an energy (J)."""
    k = table.count - 1
    while k > 0 and table.energy[k] > energy:
        k -= 1
    left = energy - table.energy[k]
    force, slope = table.force[k], table.slope[k]
    if k == table.count - 1:
        return table.stroke[k] + 2.0 * left / (
            force + math.sqrt(force * force + 2.0 * slope * left)
        )
    low, high = table.stroke[k], table.stroke[k + 1]
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        _, _, stored = tabulated_spring(middle, table)
        if stored < energy:
            low = middle
        else:
            high = middle
    return high
