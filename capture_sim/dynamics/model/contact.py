r"""Contact of the tip with a wall: normal force with hysteresis damping, and Coulomb friction.

    F = f(delta) (1 + a delta' / v_0),   never below 0

The elastic force f is K delta^p or a measured curve, stored in a record of dtype CONTACT.  Only
this module reads that record.  Other modules call its functions for force, rate of the force,
slope, energy and expected depth.

``a`` is the hysteresis factor of the contact law (:mod:`capture_sim.scene.laws`); chi = a K / v_0.

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
from capture_sim.scene.laws import FrictionLaw
from capture_sim.scene.parts import HERTZ

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
    """Return True if the walls act, i.e. unless a scene has switched them off (stiffness 0)."""
    return contact.stiffness > 0.0


@kernel
def _other_shape(depth, contact):
    """Return the elastic force divided by the stiffness, of a contact law other than Hertz's.

    ``depth`` is above 0.
    """
    if contact.table.count:
        force, _, _ = tabulated_spring(depth, contact.table)
        return force
    return depth**contact.exponent


@inline_kernel
def shape_at(depth, contact):
    """Return the elastic force divided by the stiffness, at a ``depth`` above 0."""
    if contact.exponent == HERTZ:
        return depth * math.sqrt(depth)  # a fifth of the cost of a power
    return _other_shape(depth, contact)


@inline_kernel
def normal_force(penetration, rate, chi, contact):
    """Return the normal force and its elastic part, N.

    ``penetration`` is delta (m) and ``rate`` delta' (m/s).  ``chi`` is the result of
    :func:`damping_of_touch`.  With Hertz's exponent the force is that of Lankarani and Nikravesh
    (1990), eq. (1), but it never pulls.
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
    """Return the elastic energy of a contact at a depth of ``-gap``, J; 0 for a positive gap."""
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
    """Return the damping factor chi = a K / v_0 of a touch.

    ``a`` is the hysteresis factor of the contact law and ``speed`` is the approach speed v_0, m/s.
    """
    return a * contact.stiffness / speed


@inline_kernel
def friction_coefficient(x, mu, mu_s, law):
    """Return friction force divided by normal force, with the sign of the slip.

    ``law`` is one of the regularised friction laws; ``x`` is the slip speed divided by v_eps.
    """
    if law == FrictionLaw.BROWN_MCPHEE:
        shape = 0.25 * x * x + 0.75
        return mu * hyperbolic_tangent(4.0 * x) + (mu_s - mu) * x / (shape * shape)
    if law == FrictionLaw.CLAMP:
        return mu * min(1.0, max(-1.0, x))
    return mu * hyperbolic_tangent(x)
