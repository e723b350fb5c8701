"""Search for the zeros of a function of time, from values and slopes at the ends of an interval.

The kernels ask whether a function may fall below zero in an interval, and give the places at which
to evaluate it next.
"""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import kernel


@kernel
def cubic_minimum(g_a, d_a, g_b, d_b):
    """Return place and value of the minimum of a cubic between the ends of an interval.

    The cubic has the values ``g_a`` and ``g_b`` at the two ends, and there the slopes ``d_a`` and
    ``d_b``, in change per whole interval (Hermite).  The place is a fraction of the interval,
    0 < x < 1.  Without a minimum between the ends, it is -1 and the value is that of the lower end.
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
    """Return True if a function that starts at or above zero may fall below it in an interval.

    ``g_a``, ``g_b`` are the values at the ends, ``d_a``, ``d_b`` the slopes there, in change per
    whole interval.  It is judged by the cubic that these give, whose error is taken as at most
    ``margin`` * (|d_a| + |d_b| + |g_b - g_a|).
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
    """Return where to evaluate a function next whose zero lies in a bracket.

    The function is ``g_a`` > 0 at ``x_a`` and ``g_b`` <= 0 at ``x_b`` > ``x_a``.  The method is ITP
    (interpolate, truncate, project; Oliveira and Takahashi 2020, with kappa_2 = 2 and n_0 = 1): the
    zero of the secant, moved towards the middle of the bracket, and kept so near to the middle that
    the search needs at most one trial more than bisection.  For that, the caller passes as
    ``radius`` half the width of the first bracket, halved with each trial since.  Where ``g_a`` is
    not above zero or a value is not finite, the middle is returned.
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
