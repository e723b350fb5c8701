r"""Equations of motion of the free phases: two vehicles, the buffer, contact, supports.

State ``y`` (26,): q (8,), v (8,), and ten time integrals that do not affect the motion: the
energies (J) dissipated by the axial damper, the torsional damper, the contact hysteresis of each
wall, the tip's friction, the supports, the latch and the stroke stops (with the seat), and the
normal impulse of each wall (N s).

The 5x5 mass matrix of the chaser follows from the kinetic energy, with the hinge at a e(theta_S)
from the chaser's centre of mass and the tip at h e(theta_P) from the hinge.  In axes along and
across the probe (u, w), the matrix is an arrow matrix in (theta_P, h), and the remaining block is
an arrow matrix in theta_S.  Two short eliminations therefore replace a factorisation; docs/model.md
derives them.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from capture_sim.base.compiled.kernels import inline_kernel, kernel, records
from capture_sim.dynamics.model.contact import friction_coefficient, normal_force
from capture_sim.dynamics.model.force_table import tabulated_spring
from capture_sim.dynamics.model.parameters import PARAMETERS
from capture_sim.dynamics.model.supports import rolling_wrench
from capture_sim.dynamics.model.trig import sine_cosine, sines_cosines
from capture_sim.scene.geometry import nearest_on_wall, tip_motion, wall_curvature
from capture_sim.scene.laws import FrictionLaw

#: Entries of y: 8 coordinates and 8 rates; and the total with the integrals of the energy ledger
#: and of the impulses.
N_STATE = 16
N_TOTAL = 26
# indices of the integrals in y; the integrals up to STOP are energies
AXIAL, TORSION, HYSTERESIS, FRICTION, ROLLING, LATCH, STOP, IMPULSE = 16, 17, 18, 20, 21, 22, 23, 24

#: The present touch of a wall; all fields are zero between touches.
WALL_TOUCH = np.dtype(
    [
        ("on", "i8"),
        ("chi", "f8"),  # hysteresis damping, N s/m^2.5
        ("sticking", "i8"),  # law "coulomb": slip held at zero
        ("direction", "f8"),  # law "coulomb": sign of the slip while sliding
        ("depth", "f8"),  # penetration for the error scale, m: predicted, or the largest so far
        ("start", "f8"),  # s
        ("approach_speed", "f8"),  # m/s
        ("largest_rate", "f8"),  # largest rate of penetration so far, m/s
        ("peak_force", "f8"),  # N, so far
        ("peak_time", "f8"),  # s
        ("impulse_0", "f8"),  # impulse integral at the start of the touch, N s
        ("dissipated_0", "f8"),  # hysteresis integral at the start of the touch, J
    ],
    align=True,
)


class Hold(IntEnum):
    """Cause that holds the probe at rest in its slide."""

    NONE = 0
    SEAT = 1  # the preload presses it on its seat, at h = h_0; friction adds to the hold
    FRICTION = 2


#: Record without a touch, assigned when a touch begins or ends, so that no field of an earlier
#: touch remains.
NO_TOUCH = np.zeros(1, WALL_TOUCH)

#: State of a run besides ``y``; the kernels read and write it.
MODE = np.dtype(
    [
        ("touch", WALL_TOUCH, (2,)),  # +y wall, -y wall
        ("latched", "i8"),
        ("latch_x", "f8"),  # position of the tip when the latch closed, target frame, m
        ("latch_y", "f8"),
        ("stop", "i8"),  # stroke stop in touch: -1 compressed, +1 extended, 0 none
        ("held", "i8"),  # a Hold; unless NONE, the probe moves with the cylinder and h is constant
        ("slide_direction", "f8"),  # sign of h' that friction in the slide opposes; 0: no friction
        ("rest_S", "i8"),  # chaser at rest on its supports
        ("rest_T", "i8"),  # target at rest on its supports
        ("driven", "i8"),  # an external wrench acts on the tip until the latch closes
        ("wrench", "f8", (3,)),  # target's axes, at the tip's centre: N, N, N m
        ("thrusting", "i8"),  # external wrenches act on the vehicles
        ("thrust", "f8", (6,)),  # N, N, N m, each in its vehicle's axes: chaser, then target
    ],
    align=True,
)

#: Results of an evaluation besides the accelerations.
OUT = np.dtype(
    [
        ("axial_force", "f8"),  # on the probe, of spring, damper, friction, stop, seat; outwards, N
        ("axial", "f8"),  # from here to "stop": dissipated powers, W
        ("torsion", "f8"),
        ("hysteresis", "f8", (2,)),
        ("friction", "f8"),
        ("rolling", "f8"),
        ("latch", "f8"),
        ("stop", "f8"),
        ("normal", "f8", (2,)),  # forces of both walls, N
        ("friction_force", "f8", (2,)),
        ("tip", "f8", (4,)),  # see tip_in_cone; written if a force acts on the tip
        ("hold", "f8", (6,)),  # load on supports at rest: Fx, Fy (N), M (N m); chaser, then target
    ],
    align=True,
)

#: Record that the equations of motion read and write in addition to state and derivative.
SYSTEM = np.dtype(
    [
        ("par", PARAMETERS),
        ("mode", MODE),
        ("out", OUT),
        ("spare", "f8", (1, N_TOTAL)),  # derivative, when only OUT of an evaluation is needed
        ("evaluations", "i8"),  # number of evaluations of the equations of motion so far
    ],
    align=True,
)


def make_system(parameters: np.ndarray) -> np.ndarray:
    """Return the (1,) record for the kernels, of dtype SYSTEM, with a scene's parameters.

    The bench is in free flight and the buffer is at rest.
    """
    system = np.zeros(1, SYSTEM)
    system["par"] = parameters
    system["mode"]["held"] = hold_at_rest(parameters[0])
    return records(system)


def hold_at_rest(parameters: np.void) -> Hold:
    """Return the cause that holds the probe of a buffer at its rest length."""
    if parameters["preload"] > 0.0:
        return Hold.SEAT
    return Hold.FRICTION if parameters["slide_friction"] > 0.0 else Hold.NONE


@inline_kernel
def turned(x, y, s, c):
    """Return the vector (x, y) rotated by an angle with sine ``s`` and cosine ``c``.

    This turns components in a body's axes into components in the world's axes.
    """
    return c * x - s * y, s * x + c * y


@inline_kernel
def tip_in_cone(y, par):
    """Return the position of the tip's centre in the target's frame, and its relative velocity.

    Returns (px, py, wx, wy): position in the target's frame, m, and velocity of the
    centre relative to the target's material there, in the same axes, m/s.
    """
    sS, cS, sP, cP, sT, cT = sines_cosines(y[2], y[3], y[7])
    return tip_motion(y, par.a, sS, cS, sP, cP, sT, cT)


@inline_kernel
def gap_and_rate(px, py, wx, wy, side, par):
    """Return the gap (m; negative: penetration), its rate (m/s) and the wall's normal (x, y).

    The normal is in the target's frame.  ``side`` is +1 for the +y wall, -1 for the -y wall.
    """
    distance, n_u, n_Y = nearest_on_wall(
        -(px + par.L_T), side * py, par.R_c, par.L_c, par.cos_b, par.sin_b
    )
    nx = -n_u
    ny = side * n_Y
    return distance - par.R_t, nx * wx + ny * wy, nx, ny


@inline_kernel
def slip_speed(gap, nx, ny, wx, wy, spin, par):
    """Return the tip's slip at the contact point along the tangent, m/s.

    The tangent is the normal turned by +90 degrees; ``spin`` is the angular velocity of the probe
    relative to the target, rad/s.
    """
    return wy * nx - wx * ny - (gap + par.R_t) * spin


@inline_kernel
def tip_forces(y, system, px, py, wx, wy):
    """Return the force on the tip, the torque about its centre, and the moment on the target.

    Returns (fx, fy, torque_tip, torque_target) with the force in the target's axes, N and
    N m.  ``system.out`` receives the powers of hysteresis, friction and latch (W) and the
    forces of both walls (N).  If the tip sticks, ``out.friction_force`` must contain the holding
    force on entry.
    """
    par, mode, out = system.par, system.mode, system.out
    fx = 0.0
    fy = 0.0
    tip = 0.0
    target = 0.0
    if mode.driven and not mode.latched:
        fx, fy, tip = mode.wrench[0], mode.wrench[1], mode.wrench[2]
        target = -(px * fy - py * fx) - tip
    if mode.latched:
        gx = -par.k_L * (px - mode.latch_x) - par.c_L * wx
        gy = -par.k_L * (py - mode.latch_y) - par.c_L * wy
        out.latch = par.c_L * (wx * wx + wy * wy)
        target -= px * gy - py * gx
        return fx + gx, fy + gy, tip, target
    for i in range(2):
        touch = mode.touch[i]
        if touch.on:
            gap, rate, nx, ny = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * i, par)
            force, elastic = normal_force(-gap, -rate, touch.chi, par.contact)
            slip = slip_speed(gap, nx, ny, wx, wy, y[11] - y[15], par)
            if par.friction_law == FrictionLaw.COULOMB:
                sliding = -par.mu * force * touch.direction
                friction = out.friction_force[i] if touch.sticking else sliding
            else:
                friction = -force * friction_coefficient(
                    slip * par.inverse_v_eps, par.mu, par.mu_s, par.friction_law
                )
            # the contact point is on the wall, at this distance from the tip's centre
            dist = gap + par.R_t
            gx = force * nx - friction * ny
            gy = force * ny + friction * nx
            fx += gx
            fy += gy
            tip -= dist * friction
            target -= (px - dist * nx) * gy - (py - dist * ny) * gx
            out.hysteresis[i] = -(force - elastic) * rate
            out.friction -= friction * slip
            out.normal[i] = force
            out.friction_force[i] = friction
    return fx, fy, tip, target


@inline_kernel
def chaser_inertia(sD, cD, coupled, held, par):
    """Return the reduced inertias that :func:`chaser_accelerations` needs.

    theta_P is eliminated, and h as well unless the probe is ``held``.  ``coupled`` is the mass
    that the elimination of theta_P subtracts from the total mass across the probe, kg.
    """
    a, m_along, m_free, inverse_u = par.a, par.m_C, par.m_P, par.inverse_m_SC
    m_CP = par.m_C + par.m_P
    if held:
        m_along, m_free, inverse_u = m_CP, 0.0, par.inverse_m_total
    S_w = par.m_total - coupled
    S_uS = m_along * a * sD
    S_wS = a * cD * (m_CP - coupled)
    S_S = par.I_S + a * a * (m_CP - cD * cD * coupled - m_free * sD * sD)
    inverse_w = 1.0 / S_w
    e_u = S_uS * inverse_u
    e_w = S_wS * inverse_w
    return inverse_u, inverse_w, 1.0 / (S_S - e_u * S_uS - e_w * S_wS), e_u, e_w


@inline_kernel
def chaser_accelerations(reduced_u, reduced_w, reduced_S, inertia):
    """Return the chaser's accelerations along and across the probe (m/s^2) and about z (rad/s^2).

    The right-hand sides must be reduced by the same eliminations as ``inertia``, the result of
    :func:`chaser_inertia`.
    """
    inverse_u, inverse_w, inverse_S, e_u, e_w = inertia
    alpha = (reduced_S - e_u * reduced_u - e_w * reduced_w) * inverse_S
    return reduced_u * inverse_u - e_u * alpha, reduced_w * inverse_w - e_w * alpha, alpha


@kernel
def arrest_probe(y, par):
    """Bring the probe to rest in its slide by an axial impulse; return the energy lost, J.

    Only the chaser's bodies take part in the impact.  Contact, friction, latch and supports exert
    finite forces, which have no impulse.
    """
    sS, cS = sine_cosine(y[2])
    sP, cP = sine_cosine(y[3])
    cD = cP * cS + sP * sS
    sD = sP * cS - cP * sS
    a, r = par.a, y[4] - par.d
    moment = par.first_moment_0 + par.m_P * y[4]
    ratio = moment / (par.hinge_inertia_0 + par.m_P * r * r)
    # changes of the rates by an impulse of 1 N s on the probe, outwards
    chaser = chaser_inertia(sD, cD, moment * ratio, False, par)
    along, across, turn = chaser_accelerations(-1.0, 0.0, -a * sD, chaser)
    rate = par.inverse_m_P - along - a * sD * turn
    impulse = -y[12] / rate
    lost = 0.5 * y[12] * y[12] / rate
    y[8] += impulse * (along * cP - across * sP)
    y[9] += impulse * (along * sP + across * cP)
    y[10] += impulse * turn
    y[11] -= impulse * ratio * (across + a * cD * turn)
    y[12] = 0.0
    return lost


@kernel
def accelerate(y, f, system):
    """Write accelerations into f[8:16], and powers and forces into ``system.out``.

    ``out.hold`` receives the load that the supports must balance to keep each vehicle at rest.  Its
    moment is about the body's centre of mass.
    """
    par, mode, out = system.par, system.mode, system.out
    system.evaluations += 1
    omega, spin, rate = y[10], y[11], y[12]
    h = y[4]
    sS, cS, sP, cP, sT, cT = sines_cosines(y[2], y[3], y[7])
    cD = cP * cS + sP * sS
    sD = sP * cS - cP * sS
    a = par.a
    m_P = par.m_P
    r = h - par.d
    moment = par.first_moment_0 + m_P * h
    inertia = par.hinge_inertia_0 + m_P * r * r
    inverse_P = 1.0 / inertia
    # divisions and roots are slow: those that do not depend on the forces come first
    ratio = moment * inverse_P
    chaser = chaser_inertia(sD, cD, moment * ratio, mode.held, par)
    contact = mode.latched or mode.touch[0].on or mode.touch[1].on or mode.driven
    rolling_S = (0.0, 0.0, 0.0, 0.0)
    rolling_T = (0.0, 0.0, 0.0, 0.0)
    if par.has_supports:
        if not mode.rest_S:
            rolling_S = rolling_wrench(y[8], y[9], omega, cS, sS, par.balls_S, par.v_eps_ball)
        if not mode.rest_T:
            rolling_T = rolling_wrench(y[13], y[14], y[15], cT, sT, par.balls_T, par.v_eps_ball)
    out.rolling = rolling_S[3] + rolling_T[3]

    f_u = 0.0
    f_w = 0.0
    tip = 0.0
    gx = 0.0
    gy = 0.0
    target = 0.0
    out.hysteresis[0] = 0.0
    out.hysteresis[1] = 0.0
    out.friction = 0.0
    out.latch = 0.0
    out.normal[0] = 0.0
    out.normal[1] = 0.0
    out.stop = 0.0
    if contact:
        px, py, wx, wy = tip_motion(y, a, sS, cS, sP, cP, sT, cT)
        out.tip[0] = px
        out.tip[1] = py
        out.tip[2] = wx
        out.tip[3] = wy
        fx, fy, tip, target = tip_forces(y, system, px, py, wx, wy)
        gx = cT * fx - sT * fy
        gy = sT * fx + cT * fy
        f_u = gx * cP + gy * sP
        f_w = gy * cP - gx * sP

    axial, out.axial = axial_force(h - par.h_0, rate, mode.slide_direction, par)
    if mode.stop:
        push, lost = stop_force(h - par.h_0, rate, mode.stop, par)
        axial += push
        out.stop = lost
    out.axial_force = axial
    twist = spin - omega
    torque, out.torsion = hinge_torque(y[3] - y[2], twist, par)

    # velocity terms, then right-hand sides, along (u) and across (w) the probe
    m_CP = par.m_C + m_P
    w2 = a * omega * omega
    s2 = spin * spin
    coriolis = 2.0 * m_P * rate * spin
    R_u = f_u + m_CP * w2 * cD + moment * s2
    R_w = f_w - m_CP * w2 * sD - coriolis
    pull_u = 0.0
    pull_w = 0.0
    if par.is_pulled:
        pull_u = par.pull_x * cP + par.pull_y * sP
        pull_w = par.pull_y * cP - par.pull_x * sP
        R_u += m_CP * pull_u
        R_w += m_CP * pull_w
    R_S = a * (sD * R_u + cD * R_w) - torque
    R_P = h * f_w + tip + torque - moment * w2 * sD - coriolis * r
    R_h = f_u + axial + m_P * (w2 * cD + r * s2)
    if par.is_pulled:
        R_P += moment * pull_w
        R_h += m_P * pull_u
    if mode.held:
        # h has no equation of its own: forces along the probe act on the cylinder
        out.axial_force = axial - R_h
        R_h = 0.0

    reduced_u = R_u - R_h
    reduced_w = R_w - ratio * R_P
    reduced_S = R_S - a * (cD * ratio * R_P + sD * R_h)
    if par.is_pulled:
        reduced_u += par.m_S * pull_u
        reduced_w += par.m_S * pull_w
        gx -= par.m_T * par.pull_x + par.cable_T[0] - par.drag_T * y[13]
        gy -= par.m_T * par.pull_y + par.cable_T[1] - par.drag_T * y[14]
        fx = par.cable_S[0] - par.drag_S * y[8]
        fy = par.cable_S[1] - par.drag_S * y[9]
        reduced_u += fx * cP + fy * sP
        reduced_w += fy * cP - fx * sP
        out.rolling += par.drag_S * (y[8] * y[8] + y[9] * y[9])
        out.rolling += par.drag_T * (y[13] * y[13] + y[14] * y[14])
    if mode.thrusting:
        tx, ty = turned(mode.thrust[0], mode.thrust[1], sS, cS)
        reduced_u += tx * cP + ty * sP
        reduced_w += ty * cP - tx * sP
        reduced_S += mode.thrust[2]
        tx, ty = turned(mode.thrust[3], mode.thrust[4], sT, cT)
        gx -= tx
        gy -= ty
        target += mode.thrust[5]
    hold_x = reduced_u * cP - reduced_w * sP
    hold_y = reduced_u * sP + reduced_w * cP
    hold_m = reduced_S

    if mode.rest_S:
        acc_x = 0.0
        acc_y = 0.0
        alpha = 0.0
        acc_P = R_P * inverse_P
        acc_h = R_h * par.inverse_m_P  # 0 while the probe is held
    else:
        qx, qy, qm, _ = rolling_S
        reduced_u += qx * cP + qy * sP
        reduced_w += qy * cP - qx * sP
        reduced_S += qm
        acc_u, acc_w, alpha = chaser_accelerations(reduced_u, reduced_w, reduced_S, chaser)
        acc_x = acc_u * cP - acc_w * sP
        acc_y = acc_u * sP + acc_w * cP
        acc_P = (R_P - moment * (acc_w + a * cD * alpha)) * inverse_P
        along = acc_u + a * sD * alpha
        acc_h = R_h * par.inverse_m_P - along
        if mode.held:
            acc_h = 0.0
            out.axial_force += m_P * along
    f[8] = acc_x
    f[9] = acc_y
    f[10] = alpha
    f[11] = acc_P
    f[12] = acc_h
    if mode.rest_T:
        f[13] = f[14] = f[15] = 0.0
    else:
        qx, qy, qm, _ = rolling_T
        f[13] = (qx - gx) * par.inverse_m_T
        f[14] = (qy - gy) * par.inverse_m_T
        f[15] = (target + qm) * par.inverse_I_T
    if par.has_supports:
        out.hold[0] = hold_x
        out.hold[1] = hold_y
        out.hold[2] = hold_m
        out.hold[3] = -gx
        out.hold[4] = -gy
        out.hold[5] = target


@inline_kernel
def spring_and_damper(x, rate, k, k_3, c, c_2, par):
    """Return the force of a spring (k, cubic k_3) and of a damper (c, quadratic c_2).

    For a deflection ``x`` (m or rad) and its rate; the forces (N or N m) have their sign.
    """
    spring = k * x
    damper = c * rate
    if par.has_shaped_buffer:
        spring += k_3 * x * x * x
        damper += c_2 * rate * abs(rate)
    return spring, damper


@inline_kernel
def spring_and_damper_rate(x, rate, acceleration, k, k_3, c, c_2, par):
    """Return the time derivative of the sum of both results of :func:`spring_and_damper`."""
    total = k * rate + c * acceleration
    if par.has_shaped_buffer:
        total += 3.0 * k_3 * x * x * rate + 2.0 * c_2 * abs(rate) * acceleration
    return total


@inline_kernel
def axial_force(stroke, rate, direction, par):
    """Return the axial force of spring, damper and friction on the probe, N, and a power, W.

    The power is that dissipated by the damper.  Friction in the slide opposes ``direction``, the
    sign of the stroke rate, which is 0 for a probe at rest.  The force of the seat is not included.
    """
    c = par.c_A_rebound if rate > 0.0 else par.c_A
    spring, damper = spring_and_damper(stroke, rate, par.k_A, par.k_A3, c, par.c_A2, par)
    if par.has_shaped_buffer:
        spring += par.slide_friction * direction
        if par.force_table.count:
            force, _, _ = tabulated_spring(-stroke, par.force_table)
            spring -= force
    return par.preload - spring - damper, damper * rate


@inline_kernel
def axial_force_rate(stroke, rate, acceleration, par):
    """Return the time derivative of the force of :func:`axial_force`, N/s.

    ``acceleration`` is d(rate)/dt, m/s^2.
    """
    c = par.c_A_rebound if rate > 0.0 else par.c_A
    total = spring_and_damper_rate(stroke, rate, acceleration, par.k_A, par.k_A3, c, par.c_A2, par)
    if par.has_shaped_buffer and par.force_table.count:
        _, stiffness, _ = tabulated_spring(-stroke, par.force_table)
        total += stiffness * rate
    return -total


@inline_kernel
def hinge_torque(torsion, twist, par):
    """Return the hinge torque of torsional spring and damper, N m, and the power dissipated, W.

    ``torsion`` is theta_P - theta_S, rad; ``twist`` is its rate, rad/s.  The torque acts on the
    cylinder.
    """
    spring, damper = spring_and_damper(torsion, twist, par.k_T, par.k_T3, par.c_T, par.c_T2, par)
    return -spring - damper, damper * twist


@inline_kernel
def hinge_torque_rate(torsion, twist, acceleration, par):
    """Return the time derivative of the torque of :func:`hinge_torque`, N m/s.

    ``acceleration`` is d(twist)/dt, rad/s^2.
    """
    return -spring_and_damper_rate(
        torsion, twist, acceleration, par.k_T, par.k_T3, par.c_T, par.c_T2, par
    )


@inline_kernel
def buffer_energy(stroke, torsion, par):
    """Return the elastic energies of the axial and the torsional spring, J.

    The energy of a preloaded spring is 0 at its seat.
    """
    axial = 0.5 * par.k_A * stroke * stroke
    turning = 0.5 * par.k_T * torsion * torsion
    if par.has_shaped_buffer:
        axial += 0.25 * par.k_A3 * stroke**4 - par.preload * stroke
        if par.force_table.count:
            _, _, energy = tabulated_spring(-stroke, par.force_table)
            axial += energy
        turning += 0.25 * par.k_T3 * torsion**4
    return axial, turning


@inline_kernel
def stop_energy(stroke, stop, par):
    """Return the elastic energy of a stroke stop, J; ``stop`` as in :func:`stop_force`."""
    if stop == 0:
        return 0.0
    end = par.stop_compressed if stop < 0 else par.stop_extended
    beyond = max(stop * (stroke - end), 0.0)
    return 0.5 * par.k_stop * beyond * beyond


@inline_kernel
def latch_energy(px, py, mode, par):
    """Return the elastic energy of the latch, J, with the tip's centre at (px, py)."""
    if not mode.latched:
        return 0.0
    dx = px - mode.latch_x
    dy = py - mode.latch_y
    return 0.5 * par.k_L * (dx * dx + dy * dy)


@inline_kernel
def stop_force(stroke, rate, stop, par):
    """Return the force of a stroke stop on the probe, N, and the power that it dissipates, W.

    ``stop`` is -1 at the compressed end, +1 at the extended end.  The elastic force continues
    smoothly beyond the end of the touch, so that this end can be located.  A stop with a damper
    never pulls.
    """
    end = par.stop_compressed if stop < 0 else par.stop_extended
    elastic = par.k_stop * stop * (stroke - end)
    push = elastic + par.c_stop * stop * rate
    if par.c_stop > 0.0 and push < 0.0:
        push = 0.0
    return -stop * push, (push - elastic) * stop * rate


@kernel
def slip_of(y, par, i):
    """Return the slip of the tip on wall ``i`` (0: +y, 1: -y), m/s; linear in the rates."""
    px, py, wx, wy = tip_in_cone(y, par)
    gap, _, nx, ny = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * i, par)
    return slip_speed(gap, nx, ny, wx, wy, y[11] - y[15], par)


@inline_kernel
def tip_and_acceleration(y, f, par):
    """Return the result of :func:`tip_in_cone` and the tip's acceleration in the target's frame.

    ``f[8:16]`` are the accelerations of the coordinates.  Units are m, m/s and m/s^2.
    """
    sS, cS, sP, cP, sT, cT = sines_cosines(y[2], y[3], y[7])
    px, py, wx, wy = tip_motion(y, par.a, sS, cS, sP, cP, sT, cT)
    h, omega, spin, turn = y[4], y[10], y[11], y[15]
    along = f[12] - h * spin * spin
    across = h * f[11] + 2.0 * y[12] * spin
    ux = f[8] - par.a * (f[10] * sS + omega * omega * cS) + along * cP - across * sP - f[13]
    uy = f[9] + par.a * (f[10] * cS - omega * omega * sS) + along * sP + across * cP - f[14]
    ax = cT * ux + sT * uy + 2.0 * turn * wy + turn * turn * px + f[15] * py
    ay = cT * uy - sT * ux - 2.0 * turn * wx + turn * turn * py - f[15] * px
    return px, py, wx, wy, ax, ay


@kernel
def gap_acceleration(y, f, par, i):
    """Return d2(gap)/dt2 at wall ``i`` for accelerations f[8:16], m/s^2."""
    px, py, wx, wy, ax, ay = tip_and_acceleration(y, f, par)
    side = 1.0 - 2.0 * i
    gap, _, nx, ny = gap_and_rate(px, py, wx, wy, side, par)
    across = wy * nx - wx * ny
    curvature = wall_curvature(
        -(px + par.L_T), side * py, gap + par.R_t, par.R_c, par.L_c, par.cos_b, par.sin_b
    )
    return nx * ax + ny * ay + curvature * across * across


@kernel
def slip_acceleration(y, f, par, i):
    """Return d(slip)/dt on wall ``i``, m/s^2; it is linear in the accelerations f[8:16]."""
    px, py, wx, wy, ax, ay = tip_and_acceleration(y, f, par)
    side = 1.0 - 2.0 * i
    gap, rate, nx, ny = gap_and_rate(px, py, wx, wy, side, par)
    across = wy * nx - wx * ny
    dist = gap + par.R_t
    curvature = wall_curvature(
        -(px + par.L_T), side * py, dist, par.R_c, par.L_c, par.cos_b, par.sin_b
    )
    turning = rate * (y[11] - y[15]) + dist * (f[11] - f[15])
    return ay * nx - ax * ny - curvature * across * rate - turning


#: Rate at which the round-off drift of a sticking tip is corrected, 1/s.
_DRIFT_CORRECTION_RATE = 1e3
#: Walls; typed, as each literal would be compiled as a case of its own.
_PLUS_Y, _MINUS_Y = np.int64(0), np.int64(1)


@inline_kernel
def _corrected_slip_rate(y, f, system, i):
    """Return d(slip)/dt on wall ``i`` plus the correction of round-off drift, m/s^2."""
    return slip_acceleration(y, f, system.par, i) + _DRIFT_CORRECTION_RATE * slip_of(
        y, system.par, i
    )


@kernel
def solve_sticking(y, f, system):
    """Write the accelerations with the friction forces that hold the tip on sticking walls.

    The accelerations are linear in the friction forces.  One evaluation with zero forces and one
    with a unit force at each sticking wall give the linear equations for these forces.
    """
    mode, out = system.mode, system.out
    out.friction_force[0] = 0.0
    out.friction_force[1] = 0.0
    accelerate(y, f, system)
    sticking_0, sticking_1 = mode.touch[0].sticking, mode.touch[1].sticking
    b0 = 0.0
    b1 = 0.0
    if sticking_0:
        b0 = _corrected_slip_rate(y, f, system, _PLUS_Y)
    if sticking_1:
        b1 = _corrected_slip_rate(y, f, system, _MINUS_Y)
    a00 = 1.0
    a01 = 0.0
    a10 = 0.0
    a11 = 1.0
    if sticking_0:
        out.friction_force[0] = 1.0
        out.friction_force[1] = 0.0
        accelerate(y, f, system)
        a00 = _corrected_slip_rate(y, f, system, _PLUS_Y) - b0
        if sticking_1:
            a10 = _corrected_slip_rate(y, f, system, _MINUS_Y) - b1
    if sticking_1:
        out.friction_force[0] = 0.0
        out.friction_force[1] = 1.0
        accelerate(y, f, system)
        a11 = _corrected_slip_rate(y, f, system, _MINUS_Y) - b1
        if sticking_0:
            a01 = _corrected_slip_rate(y, f, system, _PLUS_Y) - b0
    determinant = a00 * a11 - a01 * a10
    out.friction_force[0] = -(b0 * a11 - b1 * a01) / determinant
    out.friction_force[1] = -(b1 * a00 - b0 * a10) / determinant
    accelerate(y, f, system)


@kernel
def solve_accelerations(y, f, system):
    """Write the accelerations f[8:16] and ``system.out``, with or without sticking walls."""
    if system.mode.touch[0].sticking or system.mode.touch[1].sticking:
        solve_sticking(y, f, system)
    else:
        accelerate(y, f, system)


@kernel
def rate_of_change(t, y, f, system):
    """Write dy/dt (26,) of the free phases into ``f``."""
    for i in range(8):
        f[i] = y[8 + i]
    solve_accelerations(y, f, system)
    out = system.out
    f[AXIAL] = out.axial
    f[TORSION] = out.torsion
    f[HYSTERESIS] = out.hysteresis[0]
    f[HYSTERESIS + 1] = out.hysteresis[1]
    f[FRICTION] = out.friction
    f[ROLLING] = out.rolling
    f[LATCH] = out.latch
    f[STOP] = out.stop
    f[IMPULSE] = out.normal[0]
    f[IMPULSE + 1] = out.normal[1]
