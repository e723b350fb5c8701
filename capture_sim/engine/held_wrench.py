"""Motion with a wrench on the tip from outside the model, held over a step.

For hardware in the loop: no walls, no events, steps of fixed length.
"""

from __future__ import annotations

from capture_sim.kernels import entry_kernel, kernel
from capture_sim.model.equations import N_TOTAL, accelerate, rate_of_change, tip_in_cone
from capture_sim.model.observe import kinetic_energy
from capture_sim.model.trig import sine_cosine

#: The state of the free phases and, behind it, the work of the wrench, J.
N_LOOP = N_TOTAL + 1
WORK = N_TOTAL


@kernel
def _rate(y, f, system):
    rate_of_change(0.0, y, f, system)
    f[WORK] = system.out.driven


@kernel
def _hold(system, fx, fy, torque):
    system.mode.driven = 1
    system.mode.wrench[0] = fx
    system.mode.wrench[1] = fy
    system.mode.wrench[2] = torque


@entry_kernel
def step_with_wrench(systems, y, stages, h, n, fx, fy, torque):
    """Go ``n`` steps of ``h`` (s) by the classical Runge-Kutta method, the wrench held.

    ``y`` (27,) is changed; ``stages`` (5, 27) is overwritten.  The wrench on the tip is in the
    target's axes.
    """
    system = systems[0]
    _hold(system, fx, fy, torque)
    trial = stages[4]
    for _ in range(n):
        _rate(y, stages[0], system)
        for stage in range(1, 4):
            share = h if stage == 3 else 0.5 * h
            for i in range(y.shape[0]):
                trial[i] = y[i] + share * stages[stage - 1, i]
            _rate(trial, stages[stage], system)
        for i in range(y.shape[0]):
            slope = stages[0, i] + 2.0 * (stages[1, i] + stages[2, i]) + stages[3, i]
            y[i] += h / 6.0 * slope


@entry_kernel
def tip_state(systems, y):
    """Return the tip in the target's frame: x, y (m), heading, and their rates against it."""
    px, py, wx, wy = tip_in_cone(y, systems[0].par)
    return px, py, y[3] - y[7], wx, wy, y[11] - y[15]


@entry_kernel
def stored_energy(systems, y):
    """Return kinetic energy and that of the buffer's springs, J."""
    p = systems[0].par
    stroke, torsion = y[4] - p.h_0, y[3] - y[2]
    return kinetic_energy(y, p) + 0.5 * p.k_A * stroke * stroke + 0.5 * p.k_T * torsion * torsion


@entry_kernel
def mobility(systems, y, stages, nx, ny):
    """Return how the tip yields to a unit force along a normal (target's axes), 1/kg.

    The acceleration of the tip against the target along the normal, for as much as the force
    adds to it; its reciprocal is the effective mass of a contact there.
    """
    system = systems[0]
    _hold(system, 0.0, 0.0, 0.0)
    accelerate(y, stages[0], system)
    _hold(system, nx, ny, 0.0)
    accelerate(y, stages[1], system)
    f = stages[2]
    for i in range(8, 16):
        f[i] = stages[1, i] - stages[0, i]
    p = system.par
    sT, cT = sine_cosine(y[7])
    sS, cS = sine_cosine(y[2])
    sP, cP = sine_cosine(y[3])
    rx = y[0] + p.a * cS + y[4] * cP - y[5]
    ry = y[1] + p.a * sS + y[4] * sP - y[6]
    ux = f[8] - p.a * f[10] * sS + f[12] * cP - y[4] * f[11] * sP - f[13] + f[15] * ry
    uy = f[9] + p.a * f[10] * cS + f[12] * sP + y[4] * f[11] * cP - f[14] - f[15] * rx
    return ux * (cT * nx - sT * ny) + uy * (sT * nx + cT * ny)
