"""Sine and cosine of one angle together, and the hyperbolic tangent, inlined into the kernels.

For sine and cosine, an angle above an eighth of a turn is first reduced by the method of Cody and
Waite.  The minimax polynomials of fdlibm (Sun Microsystems, 1993: k_sin.c, k_cos.c) then have an
error of less than one unit in the last place.  Calls to the C library would cost more than the rest
of an evaluation in free flight.  The hyperbolic tangent is a Pade approximant near zero and
1 - 2 / (exp(2x) + 1) beyond; its error is at most four units in the last place.
"""

from __future__ import annotations

import math

import numpy as np

from capture_sim.base.compiled.kernels import inline_kernel, kernel

#: Reduction of an angle to an eighth of a turn (Cody and Waite 1980).
_TWO_OVER_PI = 6.36619772367581382433e-01
_EIGHTH = 0.785398163397448  # rad
_HALF_PI_HEAD = 1.57079632673412561417e00  # 33 bits: a small multiple is exact
_HALF_PI_TAIL = 6.07710050650619224932e-11
_LARGEST = 1e5  # rad; beyond it the reduction would lose digits

#: Reduction of an exponent to half of ln 2, in the same way.
_LOG2_E = 1.44269504088896338700e00
_LN2_HEAD = 6.93147180369123816490e-01  # 32 bits: a small multiple is exact
_LN2_TAIL = 1.90821492927058770002e-10
_POWERS_OF_2 = 2.0 ** np.arange(64)


#: Coefficients of the sine's powers 3 to 13 and of the cosine's powers 4 to 14 (fdlibm).
_SINE = (
    *(-1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04),
    *(2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10),
)
_COSINE = (
    *(4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05),
    *(-2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11),
)


@inline_kernel
def _polynomials(x):
    """Return (sin, cos) of an angle (rad) below an eighth turn."""
    # in pairs of terms: half as long a chain of dependent operations
    z = x * x
    w = z * z
    a, b = _SINE, _COSINE
    s = (a[0] + z * a[1]) + w * ((a[2] + z * a[3]) + w * (a[4] + z * a[5]))
    c = (b[0] + z * b[1]) + w * ((b[2] + z * b[3]) + w * (b[4] + z * b[5]))
    half = 0.5 * z
    top = 1.0 - half
    return x + x * z * s, top + (((1.0 - top) - half) + w * c)


@inline_kernel
def sine_cosine(angle):
    """Return (sin, cos) of an angle, rad."""
    x = angle
    turns = 0.0
    if not abs(angle) < _EIGHTH:
        if not abs(angle) < _LARGEST:
            return math.sin(angle), math.cos(angle)
        turns = math.floor(angle * _TWO_OVER_PI + 0.5)
        x = angle - turns * _HALF_PI_HEAD - turns * _HALF_PI_TAIL
    s, c = _polynomials(x)
    if turns == 0.0:
        return s, c
    quarter = int(turns) & 3
    if quarter & 1:
        s, c = c, s
    if quarter & 2:
        s = -s
    if (quarter + 1) & 2:
        c = -c
    return s, c


@kernel
def sines_cosines(a, b, c):
    """Return (sin a, cos a, sin b, cos b, sin c, cos c) of three angles, rad."""
    s_a, c_a = sine_cosine(a)
    s_b, c_b = sine_cosine(b)
    s_c, c_c = sine_cosine(c)
    return s_a, c_a, s_b, c_b, s_c, c_c


@inline_kernel
def wrapped_angle(angle):
    """Return an angle wrapped to -pi to pi, rad; an angle in that range is returned unchanged."""
    if not abs(angle) > math.pi:
        return angle
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@inline_kernel
def hyperbolic_tangent(x):
    """Return tanh(x)."""
    size = abs(x)
    if size < 0.45:
        z = x * x
        # Pade [7/6]; its error at 0.45 is 5e-17 of the value
        top = 135135.0 + z * (17325.0 + z * (378.0 + z))
        bottom = 135135.0 + z * (62370.0 + z * (3150.0 + z * 28.0))
        return x * top / bottom
    if size > 20.0:
        # 1 to the last bit; NaN fails all comparisons and is returned below
        return math.copysign(1.0, x)
    y = 2.0 * size
    if not y < 42.0:
        return x
    n = math.floor(y * _LOG2_E + 0.5)
    r = y - n * _LN2_HEAD - n * _LN2_TAIL
    # exp(r), |r| < 0.35, by Taylor's series to r^12 / 12!
    r2 = r * r
    r4 = r2 * r2
    low = (1.0 + r) + r2 * (1.0 / 2.0 + r * (1.0 / 6.0))
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + r2 * (1.0 / 720.0 + r * (1.0 / 5040.0))
    high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + r2 * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    power = low + r4 * (middle + r4 * (high + r4 * (1.0 / 479001600.0)))
    value = 1.0 - 2.0 / (power * _POWERS_OF_2[int(n)] + 1.0)
    return value if x > 0.0 else -value
