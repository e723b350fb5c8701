"""Where functions of time pass zero: cubics through values and slopes, and secants."""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import kernel


@kernel
def cubic_minimum(g_a, d_a, g_b, d_b):
    """Return fraction (0..1) and value of the interior minimum of the Hermite cubic.

    ``g`` are values and ``d`` slopes per interval at both ends.  Without an interior minimum, the
    fraction is -1 and the value that of the lower end.
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
    """Return True if a function that starts at or above zero may fall below within the interval.

    The error of the cubic through both ends is at most ``margin`` times its changes.
    """
    if g_b < 0.0:
        return True
    changes = abs(d_a) + abs(d_b)
    # no cubic dips below its ends by more than 4/27 of its slopes
    if min(g_a, g_b) > (0.25 + margin) * changes + margin * abs(g_b - g_a):
        return False
    x_dip, dip = cubic_minimum(g_a, d_a, g_b, d_b)
    slack = margin * (changes + abs(g_b - g_a))
    if x_dip >= 0.0:
        return dip < slack
    # no dip of the cubic: the function itself may dip within the slack
    return min(g_a, g_b) < 0.1 * slack and g_a > 0.0


#: Parameter of :func:`itp_trial`, of the size of 1 / (first bracket); (4) and (5) of its authors.
_ITP_SHIFT = 0.2


@kernel
def itp_trial(x_a, g_a, x_b, g_b, radius):
    """Return the next trial in a bracket: g_a > 0 at x_a, g_b <= 0 at x_b > x_a.

    Interpolate, truncate, project (Oliveira and Takahashi 2020, with kappa_2 = 2 and n_0 = 1):
    the secant's zero, moved towards the middle, and kept so near to it that no more trials are
    needed than by bisection, and one.  ``radius`` is half the first bracket, halved with each
    trial.
    """
    middle, width = 0.5 * (x_a + x_b), x_b - x_a
    if not (g_a > 0.0 and math.isfinite(g_a - g_b)):
        return middle
    x = (g_b * x_a - g_a * x_b) / (g_b - g_a)
    away, shift = middle - x, _ITP_SHIFT * width * width
    if shift >= abs(away):
        return middle
    x += math.copysign(shift, away)
    reach = max(2.0 * radius - 0.5 * width, 0.0)
    if abs(x - middle) > reach:
        x = middle - math.copysign(reach, away)
    return x
