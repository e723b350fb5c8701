r"""Laws of contact and of friction by their names in a scene.

A law of contact gives the hysteresis factor a(e) for a coefficient of restitution e.  With the
penetration delta, its rate delta', the elastic force f and the approach speed v_0, the speed at
the start of the touch, the normal force is

    F = f(delta) (1 + a delta' / v_0)

Two free bodies then separate with the restitution ``e_out`` that satisfies

    a (1 + e_out) = ln[(1 + a) / (1 - a e_out)]

independent of the masses and of f: divide the equation of the approach by that of the
penetration, ``m v dv = -f(delta) (1 + a v / v_0) d delta``, and integrate over the whole touch.
:mod:`capture_sim.dynamics.model.contact` has the forces.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum


class FrictionLaw(IntEnum):
    """Laws of friction; a scene writes their names in lower case, e.g. ``tanh``.

    The compiled equations of motion identify a law by its number.
    """

    TANH = 1
    CLAMP = 4
    BROWN_MCPHEE = 2
    COULOMB = 3
    NONE = 0


FRICTION_LAWS = tuple(law.name.lower() for law in FrictionLaw)


def returned_restitution(a: float) -> float:
    """Return the restitution that results from the hysteresis factor ``a`` (>= 0).

    It is the solution e of a (1 + e) = ln[(1 + a) / (1 - a e)], and 1 for a = 0.
    """
    # imported here: the import takes half a second, and only the exact law needs it
    from scipy.optimize import brentq

    if a <= 0.0:
        return 1.0
    # x = -ln(1 - a e) removes the pole at e = 1/a; the root is in an interval of length 1
    low = a - math.log1p(a)

    def residual(x: float) -> float:
        return low - x - math.expm1(-x)

    x = brentq(residual, low, low + 1.0, xtol=1e-15, rtol=1e-14)
    return float(-math.expm1(-x) / a)


def exact_factor(e: float) -> float:
    """Return the hysteresis factor with which a touch has exactly the restitution ``e``.

    It is the inverse of :func:`returned_restitution`, and 0 for e >= 1.  ValueError if e <= 0.
    """
    from scipy.optimize import brentq

    if e <= 0.0:
        raise ValueError("the exact law needs a restitution above 0")
    if e >= 1.0:
        return 0.0

    def residual(x: float) -> float:
        # x = -ln(1 - a e) removes the pole at a e = 1
        a = -math.expm1(-x) / e
        return a * (1.0 + e) - math.log1p(a) - x

    high = 1.0
    while residual(high) > 0.0:
        high *= 2.0
    low = high
    while residual(low) <= 0.0:
        low *= 0.5
        if low < 1e-12:
            return 0.0
    x = brentq(residual, low, high, xtol=1e-15, rtol=1e-14)
    return float(-math.expm1(-x) / e)


#: a(e) of each law; sources in docs/forces.md.
HYSTERESIS_FACTOR: dict[str, Callable[[float], float]] = {
    "lankarani_nikravesh": lambda e: 0.75 * (1.0 - e * e),
    "hunt_crossley": lambda e: 1.5 * (1.0 - e),
    "herbert_mcwhannell": lambda e: 6.0 * (1.0 - e) / ((2.0 * e - 1.0) ** 2 + 3.0),
    "lee_wang": lambda e: 0.75 * (1.0 - e),
    "gonthier": lambda e: (1.0 - e * e) / e,
    "zhiying_qishao": lambda e: 0.75 * (1.0 - e * e) * math.exp(2.0 * (1.0 - e)),
    "flores": lambda e: 8.0 * (1.0 - e) / (5.0 * e),
    "hu_guo": lambda e: 1.5 * (1.0 - e) / e,
    "carvalho_martins": lambda e: 1.5 * (1.0 - e) * (11.0 - e) / (1.0 + 9.0 * e),
    "exact": exact_factor,
}
CONTACT_LAWS = tuple(HYSTERESIS_FACTOR)
#: Laws whose hysteresis factor grows without bound as the restitution goes to 0.
NEED_POSITIVE_RESTITUTION = ("gonthier", "flores", "hu_guo", "exact")
