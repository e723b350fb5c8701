"""Stiffness of a scene: the shortest time constant of its springs and dampers."""

from __future__ import annotations

import math

import numpy as np

from capture_sim.base.compiled.kernels import plain
from capture_sim.dynamics.model.contact import contact_slope

_contact_slope = plain(contact_slope)
#: Fields that a contact's stiffness is computed from; only one of these texts is printed.
_TABLE, _GIVEN, _MATERIALS = (
    "contact.force_table",
    "contact.stiffness",
    "contact.tip.E, contact.wall.E",
)


def stiffest_part(
    par: np.void,
    penetration: float = 0.0,
    chi: float = 0.0,
    force: float = 0.0,
    y: np.ndarray | None = None,
    given_stiffness: bool = False,
) -> tuple[str, float] | None:
    """Return the part with the shortest time constant, its fields in parentheses, and that time, s.

    Returns None if there are no springs and dampers.  The time constant of a spring k with a mass m
    is sqrt(m / k), that of a damper c is m / c.  Steps of an explicit method cannot be much longer.
    ``penetration`` (m), ``chi`` (N s/m^(exponent + 1)) and ``force`` (N) are those of the contact.
    Without the state ``y`` the buffer is at rest.  ``given_stiffness`` is True if the scene sets
    ``contact.stiffness``; it only selects the field that is named.
    """
    stroke = rate = torsion = twist = 0.0
    if y is not None:
        stroke, rate = float(y[4] - par["h_0"]), abs(float(y[12]))
        torsion, twist = float(y[3] - y[2]), abs(float(y[11] - y[10]))
    slope = damping = 0.0
    if penetration > 0.0:
        law = np.array([par["contact"]]).view(np.recarray)[0]
        slope, damping = _contact_slope(penetration, chi, law)
    source = _TABLE if par["contact"]["table"]["count"] else _MATERIALS
    source = _GIVEN if given_stiffness else source
    m = float(par["m_P"])
    inertia = float(par["hinge_inertia_0"] + m * (par["h_0"] - par["d"]) ** 2)
    springs = {
        f"contact (probe.density, {source})": (m, slope),
        "axial spring (probe.density, buffer.k_A)": (m, par["k_A"]),
        "progressive axial spring (probe.density, buffer.k_A3)": (m, 3.0 * par["k_A3"] * stroke**2),
        "tabulated axial spring (probe.density, buffer.force_table)": (
            m,
            par["force_table"]["largest_slope"],
        ),
        "torsional spring (probe.density, cylinder.mass, buffer.k_T)": (inertia, par["k_T"]),
        "progressive torsional spring (probe.density, cylinder.mass, buffer.k_T3)": (
            inertia,
            3.0 * par["k_T3"] * torsion**2,
        ),
        "stroke stops (probe.density, stops.stiffness)": (m, par["k_stop"]),
        "latch (probe.density, latch.stiffness)": (m, par["k_L"]),
    }
    dampers = {
        "contact's damping (contact.law, contact.restitution)": (m, damping),
        "axial damper (probe.density, buffer.c_A)": (m, par["c_A"]),
        "axial damper outwards (probe.density, buffer.c_A_rebound)": (m, par["c_A_rebound"]),
        "axial orifice (probe.density, buffer.c_A2)": (m, 2.0 * par["c_A2"] * rate),
        "torsional orifice (probe.density, cylinder.mass, buffer.c_T2)": (
            inertia,
            2.0 * par["c_T2"] * twist,
        ),
        "torsional damper (probe.density, cylinder.mass, buffer.c_T)": (inertia, par["c_T"]),
        "stroke stops (probe.density, stops.damping)": (m, par["c_stop"]),
        "latch (probe.density, latch.damping)": (m, par["c_L"]),
        "friction of the tip (friction.slip_regularization_speed)": (
            m,
            par["mu"] * force * par["inverse_v_eps"],
        ),
    }
    if par["has_supports"]:
        for name, mass, balls in (("chaser", "m_total", "balls_S"), ("target", "m_T", "balls_T")):
            limit = par[balls][2].sum() / par["v_eps_ball"]
            dampers[f"rolling resistance of the {name} (supports.rolling_regularization_speed)"] = (
                float(par[mass]),
                limit,
            )
    times = {name: math.sqrt(mass / k) for name, (mass, k) in springs.items() if k > 0.0}
    times |= {name: float(mass / c) for name, (mass, c) in dampers.items() if c > 0.0}
    return min(times.items(), key=lambda item: item[1], default=None)
