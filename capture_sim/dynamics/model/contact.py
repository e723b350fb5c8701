r"""Contact of the tip with a wall: normal force with hysteresis damping, and Coulomb friction.

    F = K delta^1.5 (1 + a delta' / v_0),   never below 0

The laws differ in the hysteresis factor ``a(e)`` only (``chi = a K / v_0``).  Between two
free bodies this force returns the restitution ``e_out`` with

    a (1 + e_out) = ln[(1 + a) / (1 - a e_out)]

independent of the masses, K and the exponent: divide the equation of the approach by that of the
penetration, ``m v dv = -K delta^n (1 + a v / v_0) d delta``, and integrate over the whole touch.

Friction: three laws regularise it at zero slip, one switches by events:

``tanh``
    mu F_n tanh(v / v_eps): smooth and fast; the tip creeps at about v_eps where it would stick.
``clamp``
    mu F_n v / v_eps up to v_eps, mu F_n beyond: for comparison with other engines; less accurate
    because of its corners.
``brown_mcphee``
    F_n (mu tanh 4x + (mu_s - mu) x / (x^2 / 4 + 3/4)^2), x = v / v_eps: the continuous law
    of Brown and McPhee (2016) without its viscous part; its peak, mu_s, lies at v_eps.
``coulomb``
    Coulomb's law by events: sliding in a fixed direction, or sticking, with the force that
    keeps the slip at zero and is at most mu_s F_n.  No creep and no v_eps; costs an event at
    each change and a second elimination while sticking.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from capture_sim.base.compiled.kernels import inline_kernel
from capture_sim.dynamics.model.trig import hyperbolic_tangent


def returned_restitution(a: float) -> float:
    """Return the restitution that results from the hysteresis factor ``a`` (>= 0).

    Solves a (1 + e) = ln[(1 + a) / (1 - a e)] for e; 1 for a = 0.
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
    """Return the hysteresis factor for an exact restitution ``e``; ValueError if e <= 0."""
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


#: a(e) of each law; sources in docs/model.md.
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

# laws of friction, by their name in a scene
NONE, TANH, BROWN_MCPHEE, COULOMB, CLAMP = range(5)
FRICTION_LAWS = {
    "none": NONE,
    "tanh": TANH,
    "clamp": CLAMP,
    "brown_mcphee": BROWN_MCPHEE,
    "coulomb": COULOMB,
}

#: Exponent of the penetration between a sphere and a plane (Hertz).
HERTZ = 1.5


@inline_kernel
def raised_depth(depth, exponent):
    """Return depth^exponent, for a depth above 0."""
    if exponent == HERTZ:
        return depth * math.sqrt(depth)  # a fifth of the cost of a power
    return depth**exponent


@inline_kernel
def normal_force(
    penetration: float, rate: float, K: float, exponent: float, chi: float
) -> tuple[float, float]:
    """Return the normal force and its elastic part, N.

    ``penetration`` delta, m; ``rate`` delta', m/s; ``K`` N/m^p and ``chi`` N s/m^(p + 1) with the
    exponent p.  Lankarani and Nikravesh (1990), eq. (1), with p = 1.5; it never pulls.
    """
    if penetration <= 0.0:
        return 0.0, 0.0
    shape = raised_depth(penetration, exponent)
    elastic = K * shape
    force = elastic + chi * shape * rate
    if force < 0.0:
        force = 0.0
    return force, elastic


@inline_kernel
def friction_coefficient(x, mu, mu_s, law):
    """Return friction force per normal force, with the sign of the slip.

    For the regularised laws; ``x`` is the slip over v_eps.
    """
    if law == BROWN_MCPHEE:
        shape = 0.25 * x * x + 0.75
        return mu * hyperbolic_tangent(4.0 * x) + (mu_s - mu) * x / (shape * shape)
    if law == CLAMP:
        return mu * min(1.0, max(-1.0, x))
    return mu * hyperbolic_tangent(x)
