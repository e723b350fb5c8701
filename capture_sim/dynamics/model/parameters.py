"""Parameters of a scene as one record for the kernels, in SI units."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from capture_sim.dynamics.model.contact import (
    CONTACT,
    measured_law,
    power_law,
)
from capture_sim.dynamics.model.force_table import FORCE_TABLE, force_table
from capture_sim.dynamics.model.supports import BALLS, ball_rows
from capture_sim.scene.ball_loads import LOADS, loads
from capture_sim.scene.cache import depends_on
from capture_sim.scene.launch_plan import resistance
from capture_sim.scene.laws import HYSTERESIS_FACTOR, FrictionLaw
from capture_sim.scene.parts import Scene

#: Constants of a run; the kernels only read them.
PARAMETERS = np.dtype(
    [
        ("m_S", "f8"),
        ("I_S", "f8"),
        ("m_C", "f8"),
        ("m_P", "f8"),
        ("m_T", "f8"),
        ("I_T", "f8"),
        ("m_total", "f8"),  # chaser, cylinder and probe
        ("inverse_m_total", "f8"),
        ("inverse_m_SC", "f8"),  # 1 / (m_S + m_C)
        ("inverse_m_P", "f8"),
        ("inverse_m_T", "f8"),
        ("inverse_I_T", "f8"),
        ("a", "f8"),
        ("first_moment_0", "f8"),  # m_C l_C - m_P d: first moment about the hinge at h = 0
        ("hinge_inertia_0", "f8"),  # I_C + m_C l_C^2 + I_P: about the hinge, without probe's m r^2
        ("d", "f8"),  # distance from the probe's centre of mass to the tip's centre
        ("k_A", "f8"),
        ("c_A", "f8"),
        ("k_T", "f8"),
        ("c_T", "f8"),
        ("has_shaped_buffer", "i8"),  # 1 if a field from here to force_table is not that of a
        # linear buffer
        ("k_A3", "f8"),
        ("c_A2", "f8"),
        ("c_A_rebound", "f8"),
        ("k_T3", "f8"),
        ("c_T2", "f8"),
        ("preload", "f8"),  # above 0: the probe has a seat at h_0
        ("slide_friction", "f8"),  # of the probe in its slide, N
        ("force_table", FORCE_TABLE),
        ("h_0", "f8"),
        ("R_t", "f8"),
        ("L_T", "f8"),
        ("R_c", "f8"),
        ("L_c", "f8"),
        ("cos_b", "f8"),
        ("sin_b", "f8"),
        ("contact", CONTACT),  # elastic force of the walls
        ("chi", "f8"),  # hysteresis damping of every touch, N s/m^(exponent + 1); 0: from a(e)
        ("hysteresis", "f8"),  # a(e)
        ("v_0_floor", "f8"),
        ("mu", "f8"),
        ("mu_s", "f8"),
        ("friction_law", "i8"),
        ("inverse_v_eps", "f8"),  # s/m
        ("has_supports", "i8"),
        ("v_eps_ball", "f8"),
        ("balls_S", "f8", BALLS),  # rows: x, y, limit c_rr N
        ("balls_T", "f8", BALLS),
        ("has_latch", "i8"),
        ("latch_radius", "f8"),
        ("k_L", "f8"),
        ("c_L", "f8"),
        ("has_stops", "i8"),
        ("stop_compressed", "f8"),  # stroke at which each stop is met, m
        ("stop_extended", "f8"),  # inf: none
        ("k_stop", "f8"),
        ("c_stop", "f8"),
        ("rail_length", "f8"),
        ("rail_x", "f8"),  # direction
        ("rail_y", "f8"),
        ("rolling_limit_S", "f8"),  # c_rr times the chaser's weight, N
        ("m_hanging", "f8"),
        ("pulley_mass", "f8"),  # I_p / r^2
        ("drop_height", "f8"),
        ("gravity", "f8"),
        ("is_pulled", "i8"),  # or a vehicle is pulled by a cable, or has drag
        ("pull_x", "f8"),  # acceleration of gravity along the floor, m/s^2
        ("pull_y", "f8"),
        ("cable_S", "f8", (2,)),  # force on the chaser, x and y, N
        ("cable_T", "f8", (2,)),
        ("drag_S", "f8"),  # N s/m
        ("drag_T", "f8"),
        ("rail_resistance", "f8"),  # to the chaser's motion on the rail, with the pulls, N
        ("t_end", "f8"),
        ("after_latch", "f8"),  # inf: run to t_end
        ("rtol", "f8"),
        ("length_scale", "f8"),
        ("speed_scale", "f8"),
        ("max_steps", "i8"),
        ("fixed_step", "f8"),  # 0: chosen by the error
    ],
    align=True,
)


@depends_on("chaser", "cylinder", "probe", "target")
def _bodies(scene: Scene) -> dict[str, Any]:
    cylinder, probe, target = scene.cylinder, scene.probe, scene.target
    l_C = -cylinder.length / 2.0
    return {
        "m_S": scene.chaser.mass,
        "I_S": scene.chaser.inertia,
        "m_T": target.mass,
        "I_T": target.inertia,
        "m_C": cylinder.mass,
        "m_P": probe.mass,
        "m_total": scene.chaser_total_mass,
        "inverse_m_total": 1.0 / scene.chaser_total_mass,
        "inverse_m_SC": 1.0 / (scene.chaser.mass + cylinder.mass),
        "inverse_m_P": 1.0 / probe.mass,
        "inverse_m_T": 1.0 / target.mass,
        "inverse_I_T": 1.0 / target.inertia,
        "d": probe.com_offset,
        "first_moment_0": cylinder.mass * l_C - probe.mass * probe.com_offset,
        "hinge_inertia_0": cylinder.inertia + cylinder.mass * l_C**2 + probe.inertia,
    }


@depends_on("buffer", "probe")
def _buffer(scene: Scene) -> dict[str, Any]:
    buffer = scene.buffer
    linear = ("k_A", "c_A", "k_T", "c_T")
    shaped = ("k_A3", "c_A2", "k_T3", "c_T2")
    p = {name: getattr(buffer, name) for name in (*linear, *shaped)}
    p["preload"], p["slide_friction"] = buffer.seat_force, buffer.friction
    p["a"], p["h_0"] = buffer.hinge_offset, scene.rest_length
    p["c_A_rebound"] = buffer.c_A if buffer.c_A_rebound is None else buffer.c_A_rebound
    p["has_shaped_buffer"] = (
        buffer.force_table is not None
        or p["c_A_rebound"] != p["c_A"]
        or any(p[name] > 0.0 for name in (*shaped, "preload", "slide_friction"))
    )
    return p


@depends_on("cone")
def _cone(scene: Scene) -> dict[str, Any]:
    R_c, L_c, cos_b, sin_b = scene.cone.wall
    return {"L_T": scene.cone.L_T, "R_c": R_c, "L_c": L_c, "cos_b": cos_b, "sin_b": sin_b}


@depends_on("contact", "probe")
def _contact(scene: Scene) -> dict[str, Any]:
    contact, R_t = scene.contact, scene.probe.tip_radius
    hysteresis = contact.hysteresis_factor
    if hysteresis is None:
        hysteresis = HYSTERESIS_FACTOR[contact.law](contact.restitution)
    return {
        "R_t": R_t,
        "length_scale": R_t,
        "hysteresis": hysteresis,
        "v_0_floor": contact.min_approach_speed,
    }


@depends_on("friction")
def _friction(scene: Scene) -> dict[str, Any]:
    friction = scene.friction
    mu = friction.mu if friction.law != "none" else 0.0
    return {
        "mu": mu,
        "mu_s": mu if friction.mu_s is None else friction.mu_s,
        "friction_law": FrictionLaw[friction.law.upper()],
        "inverse_v_eps": 1.0 / friction.slip_regularization_speed,
    }


@depends_on(*LOADS, "supports")
def _supports(scene: Scene) -> dict[str, Any]:
    if scene.supports is None:
        return {}
    p: dict[str, Any] = {"has_supports": 1}
    p["v_eps_ball"] = scene.supports.rolling_regularization_speed
    for vehicle, name in (("chaser", "balls_S"), ("target", "balls_T")):
        support = getattr(scene.supports, vehicle)
        limits = (support.c_rr * loads(scene, vehicle)).tolist()
        p[name] = ball_rows(support.balls, limits)
    p["rolling_limit_S"] = sum(p["balls_S"][2])
    return p


@depends_on("latch", "stops")
def _latch_and_stops(scene: Scene) -> dict[str, Any]:
    p: dict[str, Any] = {}
    if scene.latch is not None:
        p["has_latch"] = 1
        p["latch_radius"] = scene.latch.radius
        p["k_L"], p["c_L"] = scene.latch.stiffness, scene.latch.damping
    if scene.stops is not None:
        p["has_stops"] = 1
        p["stop_compressed"] = -scene.stops.compression
        p["stop_extended"] = math.inf
        if scene.stops.extension is not None:
            p["stop_extended"] = scene.stops.extension
        p["k_stop"], p["c_stop"] = scene.stops.stiffness, scene.stops.damping
    return p


@depends_on("initial.chaser.theta", "rail", "string")
def _launch(scene: Scene) -> dict[str, Any]:
    heading, string = scene.initial.chaser.theta, scene.string
    return {
        "rail_x": math.cos(heading),
        "rail_y": math.sin(heading),
        "rail_length": scene.rail.length if scene.rail is not None else 0.0,
        "pulley_mass": 0 if string is None else string.pulley_mass,
    }


@depends_on("run")
def _run(scene: Scene) -> dict[str, Any]:
    run = scene.run
    return {
        "t_end": run.t_end,
        "after_latch": math.inf if run.after_latch is None else run.after_latch,
        "rtol": run.rtol,
        "max_steps": run.max_steps,
        "fixed_step": run.step if run.method == "rk4" else 0.0,
    }


#: Functions that return the groups of parameters; each names the fields that it depends on.
_GROUPS = (
    *(_bodies, _buffer, _cone, _contact, _friction, _supports, _latch_and_stops, _launch, _run),
)
_ZEROS: dict[str, Any] = dict.fromkeys(PARAMETERS.names or (), 0)


def pack(
    scene: Scene, hanging_mass: float, drop_height: float, impact_speed: float = 0.0
) -> np.ndarray:
    """Return the parameters of a scene and its launch, (1,) of dtype PARAMETERS.

    The launch has a hanging mass (kg) and a drop height (m).  ``impact_speed`` (m/s) is the planned
    impact speed, for the error scale.
    """
    # all fields are written at once: one by one they need four times as long
    p = _ZEROS.copy()
    for group in _GROUPS:
        p.update(group(scene))
    p["gravity"] = scene.gravity
    p["rail_resistance"] = p["rolling_limit_S"]
    chaser, target = scene.chaser, scene.target
    if any((scene.floor.tilt_x, scene.floor.tilt_y, *chaser.besides, *target.besides)):
        p["is_pulled"], (p["pull_x"], p["pull_y"]) = 1, scene.pull
        p["cable_S"], p["drag_S"] = (chaser.cable_x, chaser.cable_y), chaser.drag
        p["cable_T"], p["drag_T"] = (target.cable_x, target.cable_y), target.drag
        p["rail_resistance"] = resistance(scene)
    p["m_hanging"], p["drop_height"] = hanging_mass, drop_height
    p["speed_scale"] = speed_scale(scene, impact_speed)
    record = np.array([tuple(p.values())], PARAMETERS)
    if scene.buffer.force_table is not None:
        record["force_table"] = force_table(scene.buffer.force_table)
    record["contact"] = contact_law(scene)
    return record


def contact_law(scene: Scene) -> np.ndarray:
    """Return the (1,) record of a scene's walls, of dtype CONTACT."""
    contact = scene.contact
    if contact.force_table is not None:
        return measured_law(contact.force_table)
    return power_law(scene.contact_stiffness, contact.exponent)


#: Lower limit of the speed scale of free vehicles, m/s; round-off of positions (1e-17 m) over the
#: duration of a touch (seconds, at such speeds) is far smaller.
_MIN_SPEED = 1e-8
#: Lower limit of the speed scale of vehicles on supports, m/s.  Rolling resistance may accelerate
#: vehicles relative to each other that have no relative speed at the release.
_MIN_SPEED_ON_FLOOR = 1e-3


def speed_scale(scene: Scene, impact_speed: float) -> float:
    """Return the speed scale of the error control, m/s.

    It is the largest of the relative speed at the release, the speed at the impact, and the speeds
    of the tip and of line BE due to the vehicles' rotation.
    """
    c, t = scene.initial.chaser, scene.initial.target
    if scene.string is None:
        # the planned speed is in the world frame, and lower than at the release
        impact_speed = 0.0
    elif scene.string.impact_speed is not None:
        impact_speed = scene.string.impact_speed
    return max(
        _MIN_SPEED if scene.supports is None else _MIN_SPEED_ON_FLOOR,
        math.hypot(c.vx - t.vx, c.vy - t.vy),
        impact_speed,
        abs(c.omega) * (scene.buffer.hinge_offset + scene.rest_length),
        abs(t.omega) * (scene.cone.L_T + scene.cone.R_c),
    )
