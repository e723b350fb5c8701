"""A scene's numbers as one record for the kernels, SI units."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from capture_sim.model.contact import FRICTION_LAWS, HERTZ, HYSTERESIS_FACTOR
from capture_sim.model.force_table import FORCE_TABLE, force_table
from capture_sim.model.supports import ball_loads
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
        ("hinge_inertia_0", "f8"),  # I_C + m_C l_C^2 + I_P: about the hinge, probe's m r^2 apart
        ("d", "f8"),  # probe's centre of mass behind the tip's centre
        ("k_A", "f8"),
        ("c_A", "f8"),
        ("k_T", "f8"),
        ("c_T", "f8"),
        ("has_shaped_buffer", "i8"),  # any of the following differs from a linear buffer
        ("k_A3", "f8"),
        ("c_A2", "f8"),
        ("c_A_rebound", "f8"),
        ("k_T3", "f8"),
        ("c_T2", "f8"),
        ("preload", "f8"),  # above 0: the probe has a seat at h_0
        ("force_table", FORCE_TABLE),
        ("h_0", "f8"),
        ("R_t", "f8"),
        ("L_T", "f8"),
        ("R_c", "f8"),
        ("L_c", "f8"),
        ("cos_b", "f8"),
        ("sin_b", "f8"),
        ("K", "f8"),  # N/m^exponent; 0: the walls do not act
        ("exponent", "f8"),  # of the penetration
        ("chi", "f8"),  # hysteresis damping of every touch, N s/m^(exponent + 1); 0: from a(e)
        ("hysteresis", "f8"),  # a(e)
        ("v_0_floor", "f8"),
        ("mu", "f8"),
        ("mu_s", "f8"),
        ("friction_law", "i8"),
        ("inverse_v_eps", "f8"),  # s/m
        ("has_supports", "i8"),
        ("v_eps_ball", "f8"),
        ("balls_S", "f8", (3, 3)),  # x, y, limit c_rr N
        ("balls_T", "f8", (3, 3)),
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


def chaser_com_offset(scene: Scene) -> float:
    """Return the distance from the body's centre of mass forward to the whole chaser's, m."""
    cylinder = scene.buffer.hinge_offset - scene.cylinder.length / 2.0
    probe = scene.buffer.hinge_offset + scene.rest_length - scene.probe.com_offset
    moment = scene.cylinder.mass * cylinder + scene.probe.mass * probe
    return moment / scene.chaser_total_mass


def loads(scene: Scene, vehicle: str) -> np.ndarray:
    """Return the loads (3,) of the balls under ``"chaser"`` or ``"target"``, N.

    The buffer is at rest; the loads are not updated with its stroke, which changes them little.
    """
    assert scene.supports is not None
    if vehicle == "chaser":
        support, mass, com_offset = (
            scene.supports.chaser,
            scene.chaser_total_mass,
            chaser_com_offset(scene),
        )
    else:
        support, mass, com_offset = scene.supports.target, scene.target.mass, 0.0
    return _cached_loads(support.balls, mass * scene.gravity, com_offset)


@lru_cache(maxsize=8)
def _cached_loads(
    balls: tuple[tuple[float, float], ...], weight: float, com_offset: float
) -> np.ndarray:
    # needed twice per scene, and equal in most runs of a study
    load = ball_loads(np.array(balls), weight, com_offset, 0.0)
    load.flags.writeable = False
    return load


def pack(
    scene: Scene, hanging_mass: float, drop_height: float, impact_speed: float = 0.0
) -> np.ndarray:
    """Return the (1,) record of a scene with the launch's hanging mass (kg) and drop height (m).

    ``impact_speed`` (m/s) is that of the launch plan, for the error scale.
    """
    # written into the record at once: its fields one by one take four times as long
    p: dict[str, Any] = dict.fromkeys(PARAMETERS.names or (), 0)
    l_C = -scene.cylinder.length / 2.0
    p["m_S"], p["I_S"] = scene.chaser.mass, scene.chaser.inertia
    p["m_T"], p["I_T"] = scene.target.mass, scene.target.inertia
    p["m_C"], p["m_P"] = scene.cylinder.mass, scene.probe.mass
    p["m_total"] = scene.chaser_total_mass
    p["inverse_m_total"] = 1.0 / scene.chaser_total_mass
    p["inverse_m_SC"] = 1.0 / (scene.chaser.mass + scene.cylinder.mass)
    p["inverse_m_P"], p["inverse_m_T"] = 1.0 / scene.probe.mass, 1.0 / scene.target.mass
    p["inverse_I_T"] = 1.0 / scene.target.inertia
    p["a"], p["d"] = scene.buffer.hinge_offset, scene.probe.com_offset
    p["first_moment_0"] = scene.cylinder.mass * l_C - scene.probe.mass * scene.probe.com_offset
    p["hinge_inertia_0"] = (
        scene.cylinder.inertia + scene.cylinder.mass * l_C**2 + scene.probe.inertia
    )
    buffer = scene.buffer
    for name in ("k_A", "c_A", "k_T", "c_T", "k_A3", "c_A2", "k_T3", "c_T2"):
        p[name] = getattr(buffer, name)
    p["preload"] = buffer.seat_force
    p["c_A_rebound"] = buffer.c_A if buffer.c_A_rebound is None else buffer.c_A_rebound
    p["has_shaped_buffer"] = (
        buffer.force_table is not None
        or p["c_A_rebound"] != p["c_A"]
        or any(p[name] > 0.0 for name in ("k_A3", "c_A2", "k_T3", "c_T2", "preload"))
    )
    p["h_0"], p["R_t"] = scene.rest_length, scene.probe.tip_radius
    p["L_T"] = scene.cone.L_T
    p["R_c"], p["L_c"], p["cos_b"], p["sin_b"] = scene.cone.wall
    p["K"], p["exponent"] = scene.contact_stiffness, HERTZ
    p["hysteresis"] = scene.contact.hysteresis_factor
    if scene.contact.hysteresis_factor is None:
        p["hysteresis"] = HYSTERESIS_FACTOR[scene.contact.law](scene.contact.restitution)
    p["v_0_floor"] = scene.contact.min_approach_speed
    p["mu"] = scene.friction.mu if scene.friction.law != "none" else 0.0
    p["mu_s"] = p["mu"] if scene.friction.mu_s is None else scene.friction.mu_s
    p["friction_law"] = FRICTION_LAWS[scene.friction.law]
    p["inverse_v_eps"] = 1.0 / scene.friction.slip_regularization_speed
    p["gravity"] = scene.gravity
    if scene.supports is not None:
        p["has_supports"] = 1
        p["v_eps_ball"] = scene.supports.rolling_regularization_speed
        for vehicle, name in (("chaser", "balls_S"), ("target", "balls_T")):
            support = getattr(scene.supports, vehicle)
            limits = (support.c_rr * loads(scene, vehicle)).tolist()
            p[name] = [(x, y, limit) for (x, y), limit in zip(support.balls, limits, strict=True)]
        p["rolling_limit_S"] = sum(limit for _, _, limit in p["balls_S"])
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
    heading = scene.initial.chaser.theta
    p["rail_x"], p["rail_y"] = math.cos(heading), math.sin(heading)
    p["rail_length"] = scene.rail.length if scene.rail is not None else 0.0
    p["m_hanging"], p["drop_height"] = hanging_mass, drop_height
    if scene.string is not None:
        p["pulley_mass"] = scene.string.pulley_inertia / scene.string.pulley_radius**2
    p["t_end"] = scene.run.t_end
    p["after_latch"] = math.inf if scene.run.after_latch is None else scene.run.after_latch
    p["rtol"] = scene.run.rtol
    p["length_scale"] = scene.probe.tip_radius
    p["speed_scale"] = speed_scale(scene, impact_speed)
    p["max_steps"] = scene.run.max_steps
    p["fixed_step"] = scene.run.step if scene.run.method == "rk4" else 0.0
    record = np.array([tuple(p.values())], PARAMETERS)
    if buffer.force_table is not None:
        record["force_table"] = force_table(buffer.force_table)
    return record


#: Lower limit of the speed scale of free vehicles, m/s; round-off of positions (1e-17 m) over the
#: duration of a touch (seconds, at such speeds) is far smaller.
_MIN_SPEED = 1e-8
#: The same on supports, whose resistance may accelerate vehicles that have no relative speed at the
#: release.
_MIN_SPEED_ON_FLOOR = 1e-3


def speed_scale(scene: Scene, impact_speed: float) -> float:
    """Return the speed scale of the error control, m/s.

    It is the largest of the relative speeds at the release and at the impact, and of the speeds of
    tip and line BE due to the vehicles' spins.
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
