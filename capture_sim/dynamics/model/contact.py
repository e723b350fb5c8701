r"""Contact of the tip with a wall: normal force with hysteresis damping, and Coulomb friction.

    F = f(delta) (1 + a delta' / v_0),   never below 0

The elastic force f is K delta^p, or a measured curve; a record of CONTACT has it.  Only this module
reads that record: others call its force, rate of the force, slope, energy and expected depth.

The laws differ in the hysteresis factor ``a(e)`` only (``chi = a K / v_0``).  Between two
free bodies this force returns the restitution ``e_out`` with

    a (1 + e_out) = ln[(1 + a) / (1 - a e_out)]

independent of the masses and of f: divide the equation of the approach by that of the
penetration, ``m v dv = -f(delta) (1 + a v / v_0) d delta``, and integrate over the whole touch.

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
from functools import lru_cache

import numpy as np

from capture_sim.base.compiled.kernels import inline_kernel, kernel
from capture_sim.dynamics.model.force_table import (
    FORCE_TABLE,
    force_table,
    tabulated_depth,
    tabulated_spring,
)
from capture_sim.dynamics.model.trig import hyperbolic_tangent
from capture_sim.scene.parts import HERTZ


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

# laws of friction, by their name in a scene
NONE, TANH, BROWN_MCPHEE, COULOMB, CLAMP = range(5)
FRICTION_LAWS = {
    "none": NONE,
    "tanh": TANH,
    "clamp": CLAMP,
    "brown_mcphee": BROWN_MCPHEE,
    "coulomb": COULOMB,
}

#: A wall's elastic force, ``stiffness`` times its shape: the depth to the power of ``exponent``,
#: or the curve of ``table`` where that has points.
CONTACT = np.dtype(
    [
        ("stiffness", "f8"),  # K, N/m^exponent; 1 with a table; 0: the walls do not act
        ("exponent", "f8"),  # p of the penetration; 0 with a table
        ("table", FORCE_TABLE),
    ],
    align=True,
)


@lru_cache(maxsize=8)
def power_law(stiffness: float, exponent: float) -> np.ndarray:
    """Return the (1,) record of the elastic force K delta^p, with K in N/m^p."""
    record = np.zeros(1, CONTACT)
    record["stiffness"], record["exponent"] = stiffness, exponent
    record.flags.writeable = False
    return record


@lru_cache(maxsize=8)
def measured_law(points: tuple[tuple[float, float], ...]) -> np.ndarray:
    """Return the (1,) record of the elastic force through points of depth (m) and force (N)."""
    record = np.zeros(1, CONTACT)
    record["stiffness"] = 1.0
    record["table"] = force_table(points, is_spring=False)
    record.flags.writeable = False
    return record


@inline_kernel
def acts(contact):
    """Return True unless the walls are switched off."""
    return contact.stiffness > 0.0


@kernel
def _other_shape(depth, contact):
    """Return the shape of a force that is not Hertz's, for a depth above 0."""
    if contact.table.count:
        force, _, _ = tabulated_spring(depth, contact.table)
        return force
    return depth**contact.exponent


@inline_kernel
def shape_at(depth, contact):
    """Return the elastic force per stiffness, for a depth above 0."""
    if contact.exponent == HERTZ:
        return depth * math.sqrt(depth)  # a fifth of the cost of a power
    return _other_shape(depth, contact)


@inline_kernel
def normal_force(penetration, rate, chi, contact):
    """Return the normal force and its elastic part, N.

    ``penetration`` delta, m; ``rate`` delta', m/s; ``chi``, the damping per shape, of
    :func:`damping_of_touch`.  With Hertz's exponent, Lankarani and Nikravesh (1990), eq. (1); it
    never pulls.
    """
    if penetration <= 0.0:
        return 0.0, 0.0
    shape = shape_at(penetration, contact)
    elastic = contact.stiffness * shape
    force = elastic + chi * shape * rate
    if force < 0.0:
        force = 0.0
    return force, elastic


@kernel
def normal_force_and_rate(depth, rate, acceleration, chi, contact):
    """Return the normal force (N) and its rate (N/s) for a penetration and its derivatives."""
    force, _ = normal_force(depth, rate, chi, contact)
    if force <= 0.0:
        return 0.0, 0.0
    K = contact.stiffness
    if contact.table.count:
        shape, slope, _ = tabulated_spring(depth, contact.table)
        return force, slope * rate * (K + chi * rate) + chi * shape * acceleration
    change = contact.exponent * rate * (K + chi * rate) + chi * depth * acceleration
    return force, shape_at(depth, contact) / depth * change


@kernel
def contact_slope(depth, chi, contact):
    """Return the slope of the elastic force (N/m) and the damping (N s/m), for a depth above 0."""
    if contact.table.count:
        shape, slope, _ = tabulated_spring(depth, contact.table)
        return contact.stiffness * slope, chi * shape
    shape = shape_at(depth, contact)
    return contact.exponent * contact.stiffness * shape / depth, chi * shape


@inline_kernel
def elastic_contact_energy(gap, contact):
    """Return the elastic energy of a contact, J, of a depth -gap."""
    if gap >= 0.0:
        return 0.0
    if contact.table.count:
        _, _, energy = tabulated_spring(-gap, contact.table)
        return energy
    return -contact.stiffness * gap * shape_at(-gap, contact) / (contact.exponent + 1.0)


@kernel
def expected_depth(mass, speed, contact):
    """Return the largest depth (m) of an elastic impact of a mass (kg) at a speed (m/s)."""
    if contact.table.count:
        return tabulated_depth(0.5 * mass * speed * speed, contact.table)
    power = contact.exponent + 1.0
    return (0.5 * power * mass * speed * speed / contact.stiffness) ** (1.0 / power)


@inline_kernel
def damping_of_touch(a, speed, contact):
    """Return ``chi`` of a touch with the hysteresis factor ``a`` at an approach speed (m/s)."""
    return a * contact.stiffness / speed


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
