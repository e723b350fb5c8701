r"""Equations of motion of the free phases: two vehicles, the buffer, contact, supports.

State ``y`` (25,): q (8,), v (8,), and nine integrals in time that nothing depends on:
what the axial damper, the torsional damper, the contact hysteresis of either wall, the
tip's friction, the supports and the latch have dissipated (J), and the normal impulse of
either wall (N s).

Kinetic energy with the hinge at a e(theta_S) and the tip at h e(theta_P) from it gives
the 5x5 block of the chaser.  Written in axes along and across the probe (u, w) it is an
arrow in (theta_P, h) on top of an arrow in theta_S, so it is solved by two eliminations
of one line each instead of a factorisation; docs/model.md derives it.
"""

from __future__ import annotations

import math

import numpy as np

from capture_sim.dynamics.cone import nearest_on_wall
from capture_sim.dynamics.contact_laws import normal_force
from capture_sim.dynamics.friction import friction_force
from capture_sim.dynamics.supports import rolling_wrench
from capture_sim.kernels import kernel

N_STATE = 16
N_TOTAL = 25
# places of the integrals in y
AXIAL, TORSION, HYSTERESIS, FRICTION, ROLLING, LATCH, IMPULSE = 16, 17, 18, 20, 21, 22, 23

#: What changes in the course of a run; the kernels read and write it.
MODE = np.dtype(
    [
        ("touching", "i8", (2,)),  # [+y wall, -y wall]
        ("chi", "f8", (2,)),  # hysteresis damping of the touch, N s/m^2.5
        ("latched", "i8"),
        ("latch_x", "f8"),  # where the tip was caught, target frame, m
        ("latch_y", "f8"),
        ("rest_S", "i8"),  # vehicle held by its supports
        ("rest_T", "i8"),
    ],
    align=True,
)


@kernel
def tip_in_cone(y, par):
    """Return the tip's centre in the target's frame and its velocity against it.

    Returns (px, py, wx, wy): position in the target's frame, m, and velocity of the
    centre relative to the target's material there, in the same axes, m/s.
    """
    cS, sS = math.cos(y[2]), math.sin(y[2])
    cP, sP = math.cos(y[3]), math.sin(y[3])
    cT, sT = math.cos(y[7]), math.sin(y[7])
    a, h = par.a, y[4]
    rx = y[0] + a * cS + h * cP - y[5]
    ry = y[1] + a * sS + h * sP - y[6]
    ux = y[8] - a * y[10] * sS + y[12] * cP - h * y[11] * sP - y[13]
    uy = y[9] + a * y[10] * cS + y[12] * sP + h * y[11] * cP - y[14]
    px = cT * rx + sT * ry
    py = cT * ry - sT * rx
    wx = cT * ux + sT * uy + y[15] * py
    wy = cT * uy - sT * ux - y[15] * px
    return px, py, wx, wy


@kernel
def wall_gap(px, py, wx, wy, side, par):
    """Return gap (m; negative is penetration), its rate (m/s) and the normal, target frame.

    ``side`` is +1 for the wall on +y, -1 for the other.
    """
    distance, n_u, n_Y = nearest_on_wall(
        -(px + par.L_T), side * py, par.R_c, par.L_c, par.cos_b, par.sin_b
    )
    nx = -n_u
    ny = side * n_Y
    return distance - par.R_t, nx * wx + ny * wy, nx, ny


@kernel
def tip_forces(y, par, mode, px, py, wx, wy, out):
    """Return force on the tip and torque about its centre, and the moment on the target.

    Returns (fx, fy, torque_tip, torque_target) with the force in the target's axes, N and
    N m.  ``out``, zero on entry, receives in its first eight places powers and forces:
    hysteresis of both walls, friction and latch (W), normal force of both walls (N),
    friction force of both walls (N).
    """
    fx = 0.0
    fy = 0.0
    tip = 0.0
    target = 0.0
    if mode.latched:
        fx = -par.k_L * (px - mode.latch_x) - par.c_L * wx
        fy = -par.k_L * (py - mode.latch_y) - par.c_L * wy
        out[3] = par.c_L * (wx * wx + wy * wy)
        target = -(px * fy - py * fx)
        return fx, fy, tip, target
    for i in range(2):
        if mode.touching[i]:
            gap, rate, nx, ny = wall_gap(px, py, wx, wy, 1.0 - 2.0 * i, par)
            force, elastic = normal_force(-gap, -rate, par.K, mode.chi[i])
            # the contact point lies on the wall, dist behind the tip's centre
            dist = gap + par.R_t
            slip = wy * nx - wx * ny - dist * (y[11] - y[15])
            rub = friction_force(force, slip, par.mu, par.v_eps_tip)
            gx = force * nx - rub * ny
            gy = force * ny + rub * nx
            fx += gx
            fy += gy
            tip -= dist * rub
            target -= (px - dist * nx) * gy - (py - dist * ny) * gx
            out[i] = -(force - elastic) * rate
            out[2] -= rub * slip
            out[4 + i] = force
            out[6 + i] = rub
    return fx, fy, tip, target


@kernel
def accelerate(y, par, mode, f, out):
    """Write accelerations into f[8:16]; return what the supports must hold.

    Returns (Fx, Fy, M of the chaser; Fx, Fy, M of the target): the generalised forces on
    the vehicles, supports apart, as they would act on a vehicle standing still.  They
    are what the supports must balance to keep it there, N and N m about the body's
    centre of mass.
    """
    omega, spin, rate = y[10], y[11], y[12]
    h = y[4]
    cS, sS = math.cos(y[2]), math.sin(y[2])
    cP, sP = math.cos(y[3]), math.sin(y[3])
    cT, sT = math.cos(y[7]), math.sin(y[7])
    cD = cP * cS + sP * sS
    sD = sP * cS - cP * sS
    a = par.a
    m_P = par.m_P
    r = h - par.d
    moment = par.first_moment_0 + m_P * h
    inertia = par.hinge_inertia_0 + m_P * r * r

    f_u = 0.0
    f_w = 0.0
    tip = 0.0
    gx = 0.0
    gy = 0.0
    target = 0.0
    for i in range(11):
        out[i] = 0.0
    if mode.latched or mode.touching[0] or mode.touching[1]:
        rx = y[0] + a * cS + h * cP - y[5]
        ry = y[1] + a * sS + h * sP - y[6]
        ux = y[8] - a * omega * sS + rate * cP - h * spin * sP - y[13]
        uy = y[9] + a * omega * cS + rate * sP + h * spin * cP - y[14]
        px = cT * rx + sT * ry
        py = cT * ry - sT * rx
        wx = cT * ux + sT * uy + y[15] * py
        wy = cT * uy - sT * ux - y[15] * px
        fx, fy, tip, target = tip_forces(y, par, mode, px, py, wx, wy, out)
        gx = cT * fx - sT * fy
        gy = sT * fx + cT * fy
        f_u = gx * cP + gy * sP
        f_w = gy * cP - gx * sP

    axial = -par.k_A * (h - par.h_0) - par.c_A * rate
    twist = spin - omega
    torque = -par.k_T * (y[3] - y[2]) - par.c_T * twist

    # velocity terms, then right-hand sides, along (u) and across (w) the probe
    m_CP = par.m_C + m_P
    w2 = a * omega * omega
    s2 = spin * spin
    coriolis = 2.0 * m_P * rate * spin
    b_u = -m_CP * w2 * cD - moment * s2
    b_w = m_CP * w2 * sD + coriolis
    R_u = f_u - b_u
    R_w = f_w - b_w
    R_S = a * (sD * R_u + cD * R_w) - torque
    R_P = h * f_w + tip + torque - moment * w2 * sD - coriolis * r
    R_h = f_u + axial + m_P * (w2 * cD + r * s2)

    ratio = moment / inertia
    r_u = R_u - R_h
    r_w = R_w - ratio * R_P
    r_S = R_S - a * (cD * ratio * R_P + sD * R_h)
    hold_x = r_u * cP - r_w * sP
    hold_y = r_u * sP + r_w * cP
    hold_m = r_S

    if mode.rest_S:
        f[8] = 0.0
        f[9] = 0.0
        f[10] = 0.0
        f[11] = R_P / inertia
        f[12] = R_h / m_P
    else:
        if par.has_supports:
            qx, qy, qm, lost = rolling_wrench(
                y[8], y[9], omega, cS, sS, par.balls_S, par.v_eps_ball
            )
            r_u += qx * cP + qy * sP
            r_w += qy * cP - qx * sP
            r_S += qm
            out[8] += lost
        S_u = par.m_S + par.m_C
        S_w = par.m_total - moment * ratio
        S_uS = par.m_C * a * sD
        S_wS = a * cD * (m_CP - moment * ratio)
        S_S = par.I_S + a * a * (m_CP - cD * cD * moment * ratio - m_P * sD * sD)
        e_u = S_uS / S_u
        e_w = S_wS / S_w
        alpha = (r_S - e_u * r_u - e_w * r_w) / (S_S - e_u * S_uS - e_w * S_wS)
        acc_u = r_u / S_u - e_u * alpha
        acc_w = r_w / S_w - e_w * alpha
        f[8] = acc_u * cP - acc_w * sP
        f[9] = acc_u * sP + acc_w * cP
        f[10] = alpha
        f[11] = (R_P - moment * (acc_w + a * cD * alpha)) / inertia
        f[12] = R_h / m_P - acc_u - a * sD * alpha

    if mode.rest_T:
        f[13] = 0.0
        f[14] = 0.0
        f[15] = 0.0
    else:
        tx = -gx
        ty = -gy
        tm = target
        if par.has_supports:
            qx, qy, qm, lost = rolling_wrench(
                y[13], y[14], y[15], cT, sT, par.balls_T, par.v_eps_ball
            )
            tx += qx
            ty += qy
            tm += qm
            out[8] += lost
        f[13] = tx / par.m_T
        f[14] = ty / par.m_T
        f[15] = tm / par.I_T
    out[9] = par.c_A * rate * rate
    out[10] = par.c_T * twist * twist
    return hold_x, hold_y, hold_m, -gx, -gy, target


@kernel
def rate_of_change(t, y, f, par, mode, out):
    """Write dy/dt (25,) of the free phases into ``f``; ``out`` (11,) is scratch."""
    for i in range(8):
        f[i] = y[8 + i]
    accelerate(y, par, mode, f, out)
    f[16] = out[9]
    f[17] = out[10]
    f[18] = out[0]
    f[19] = out[1]
    f[20] = out[2]
    f[21] = out[8]
    f[22] = out[3]
    f[23] = out[4]
    f[24] = out[5]
