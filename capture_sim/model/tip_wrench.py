"""A wrench on the tip that comes from outside the model, held over a step.

The accelerations are linear in the forces: those without contact come from
:func:`capture_sim.model.equations.accelerate`, what the wrench adds from here, by the
same elimination.  So the equations of motion know nothing of it, and a run without it
pays nothing.
"""

from __future__ import annotations

from capture_sim.kernels import entry_kernel, kernel
from capture_sim.model.equations import N_TOTAL, rate_of_change, tip_in_cone
from capture_sim.model.observe import kinetic_energy
from capture_sim.model.trig import sine_cosine

#: The state of the free phases and, behind it, the work of the wrench, J.
N_LOOP = N_TOTAL + 1
WORK = N_TOTAL


@kernel
def add_tip_wrench(y, par, f, gx, gy, torque):
    """Add to f[8:16] the accelerations by a force on the tip's centre and a torque on it.

    ``gx, gy`` in N, world axes; ``torque`` in N m, on the probe.  The target gets the
    opposite at the same place.
    """
    sS, cS = sine_cosine(y[2])
    sP, cP = sine_cosine(y[3])
    cD = cP * cS + sP * sS
    sD = sP * cS - cP * sS
    a, h, m_P = par.a, y[4], par.m_P
    r = h - par.d
    moment = par.first_moment_0 + m_P * h
    inverse_P = 1.0 / (par.hinge_inertia_0 + m_P * r * r)
    ratio = moment * inverse_P
    m_CP = par.m_C + m_P
    u = gx * cP + gy * sP
    w = gy * cP - gx * sP
    R_P = h * w + torque
    # along the probe the force goes into the probe itself, not into the hinge
    r_w = w - ratio * R_P
    r_S = a * cD * r_w
    coupled = moment * ratio
    S_w = par.m_total - coupled
    S_uS = par.m_C * a * sD
    S_wS = a * cD * (m_CP - coupled)
    S_S = par.I_S + a * a * (m_CP - cD * cD * coupled - m_P * sD * sD)
    e_u = S_uS * par.inverse_m_SC
    e_w = S_wS / S_w
    alpha = (r_S - e_w * r_w) / (S_S - e_u * S_uS - e_w * S_wS)
    acc_u = -e_u * alpha
    acc_w = r_w / S_w - e_w * alpha
    f[8] += acc_u * cP - acc_w * sP
    f[9] += acc_u * sP + acc_w * cP
    f[10] += alpha
    f[11] += (R_P - moment * (acc_w + a * cD * alpha)) * inverse_P
    f[12] += u * par.inverse_m_P - acc_u - a * sD * alpha
    rx = y[0] + a * cS + h * cP - y[5]
    ry = y[1] + a * sS + h * sP - y[6]
    f[13] -= gx * par.inverse_m_T
    f[14] -= gy * par.inverse_m_T
    f[15] -= (rx * gy - ry * gx + torque) * par.inverse_I_T


@kernel
def _rate(y, f, par, mode, out, fx, fy, torque):
    rate_of_change(0.0, y, f, par, mode, out)
    sT, cT = sine_cosine(y[7])
    add_tip_wrench(y, par, f, cT * fx - sT * fy, sT * fx + cT * fy, torque)
    _, _, wx, wy = tip_in_cone(y, par)
    f[WORK] = fx * wx + fy * wy + torque * (y[11] - y[15])


@entry_kernel
def step_with_wrench(par, mode, y, work, scratch, h, n, fx, fy, torque):
    """Go ``n`` steps of ``h`` (s) by the classical Runge-Kutta method, the wrench held.

    ``y`` (27,) is changed; ``work`` (5, 27) and ``scratch`` (48,) are overwritten.  The
    wrench on the tip is in the target's axes.
    """
    p, m = par[0], mode[0]
    trial = work[4]
    for _ in range(n):
        _rate(y, work[0], p, m, scratch, fx, fy, torque)
        for stage in range(1, 4):
            share = h if stage == 3 else 0.5 * h
            for i in range(y.shape[0]):
                trial[i] = y[i] + share * work[stage - 1, i]
            _rate(trial, work[stage], p, m, scratch, fx, fy, torque)
        for i in range(y.shape[0]):
            y[i] += h / 6.0 * (work[0, i] + 2.0 * (work[1, i] + work[2, i]) + work[3, i])


@entry_kernel
def tip_state(par, y):
    """Return the tip in the target's frame: x, y (m), heading, and their rates against it."""
    px, py, wx, wy = tip_in_cone(y, par[0])
    return px, py, y[3] - y[7], wx, wy, y[11] - y[15]


@entry_kernel
def stored_energy(par, y):
    """Return kinetic energy and that of the buffer's springs, J."""
    p = par[0]
    stroke, torsion = y[4] - p.h_0, y[3] - y[2]
    return kinetic_energy(y, p) + 0.5 * p.k_A * stroke * stroke + 0.5 * p.k_T * torsion * torsion


@entry_kernel
def mobility(par, y, f, nx, ny):
    """Return how the tip yields to a unit force along a normal (target's axes), 1/kg.

    The acceleration of the tip against the target along the normal; its reciprocal is the
    effective mass of a contact there.
    """
    p = par[0]
    for i in range(16):
        f[i] = 0.0
    sT, cT = sine_cosine(y[7])
    gx, gy = cT * nx - sT * ny, sT * nx + cT * ny
    add_tip_wrench(y, p, f, gx, gy, 0.0)
    sS, cS = sine_cosine(y[2])
    sP, cP = sine_cosine(y[3])
    rx = y[0] + p.a * cS + y[4] * cP - y[5]
    ry = y[1] + p.a * sS + y[4] * sP - y[6]
    ux = f[8] - p.a * f[10] * sS + f[12] * cP - y[4] * f[11] * sP - f[13] + f[15] * ry
    uy = f[9] + p.a * f[10] * cS + f[12] * sP + y[4] * f[11] * cP - f[14] - f[15] * rx
    return ux * gx + uy * gy
