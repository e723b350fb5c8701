"""Cubic look-ahead for event functions of which value and slope are known at two points."""

from __future__ import annotations

import math

from capture_sim.kernels import kernel


@kernel
def cubic_minimum(g_a, d_a, g_b, d_b):
    """Return place (0..1) and value of the interior minimum of the Hermite cubic.

    ``d`` are slopes per unit of the interval.  Without an interior minimum the place is
    -1 and the value that of the lower end.
    """
    c2 = 3.0 * (g_b - g_a) - 2.0 * d_a - d_b
    c3 = d_a + d_b - 2.0 * (g_b - g_a)
    # slope d_a + 2 c2 x + 3 c3 x^2 = 0 where the curvature 2 c2 + 6 c3 x > 0
    square = c2 * c2 - 3.0 * c3 * d_a
    if square > 0.0:
        denominator = c2 + math.sqrt(square)
        x = -1.0
        if denominator > 0.0:
            x = -d_a / denominator
        elif c3 != 0.0:
            x = (-c2 + math.sqrt(square)) / (3.0 * c3)
        if 0.0 < x < 1.0:
            return x, g_a + x * (d_a + x * (c2 + x * c3))
    return -1.0, min(g_a, g_b)


@kernel
def may_cross(g_a, d_a, g_b, d_b, margin):
    """Return whether a function that starts at or above zero may go below within the interval.

    The cubic through both ends is trusted up to ``margin`` times the size of its changes.
    """
    if g_b < 0.0:
        return True
    changes = abs(d_a) + abs(d_b)
    # no cubic dips below its ends by more than 4/27 of its slopes
    if min(g_a, g_b) > (0.25 + margin) * changes + margin * abs(g_b - g_a):
        return False
    place, low = cubic_minimum(g_a, d_a, g_b, d_b)
    slack = margin * (changes + abs(g_b - g_a))
    if place >= 0.0:
        return low < slack
    # no dip between the ends: only one that the cubic cannot see matters
    return min(g_a, g_b) < 0.1 * slack and g_a > 0.0
