"""Sine and cosine of one angle together, inlined into the kernels.

The argument is reduced to a quarter turn by Cody and Waite's method and put into the
minimax polynomials of fdlibm (Sun Microsystems, 1993: k_sin.c, k_cos.c), which are good
to less than one unit in the last place; calls to the C library would cost more than the
rest of a free-flight evaluation.
"""

from __future__ import annotations

import math

from capture_sim.kernels import inline_kernel

_TWO_OVER_PI = 6.36619772367581382433e-01
_HALF_PI_HEAD = 1.57079632673412561417e00  # 33 bits: a small multiple is exact
_HALF_PI_TAIL = 6.07710050650619224932e-11
_LARGEST = 1e5  # rad; beyond it the reduction would lose digits


@inline_kernel
def sine_cosine(angle):
    """Return (sin, cos) of an angle, rad."""
    if not abs(angle) < _LARGEST:
        return math.sin(angle), math.cos(angle)
    turns = math.floor(angle * _TWO_OVER_PI + 0.5)
    x = angle - turns * _HALF_PI_HEAD - turns * _HALF_PI_TAIL
    z = x * x
    s = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
    s = 2.75573137070700676789e-06 + z * s
    s = -1.98412698298579493134e-04 + z * s
    s = 8.33333333332248946124e-03 + z * s
    s = -1.66666666666666324348e-01 + z * s
    s = x + x * z * s
    c = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11
    c = -2.75573143513906633035e-07 + z * c
    c = 2.48015872894767294178e-05 + z * c
    c = -1.38888888888741095749e-03 + z * c
    c = 4.16666666666666019037e-02 + z * c
    half = 0.5 * z
    top = 1.0 - half
    c = top + (((1.0 - top) - half) + z * z * c)
    quarter = int(turns) & 3
    if quarter & 1:
        s, c = c, s
    if quarter & 2:
        s = -s
    if (quarter + 1) & 2:
        c = -c
    return s, c
