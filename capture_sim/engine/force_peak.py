"""The peak of a touch's force, found inside the step where it lies."""

from __future__ import annotations

import math

from capture_sim.engine.steps import make_dense
from capture_sim.kernels import kernel
from capture_sim.model.contact_laws import normal_force
from capture_sim.model.equations import IMPULSE, N_STATE, tip_in_cone, wall_gap
from capture_sim.solver.roots import cubic_minimum
from capture_sim.solver.runge_kutta import dense


@kernel
def force_at(y, par, mode, i):
    """Return the normal force on the tip from wall ``i``, N."""
    px, py, wx, wy = tip_in_cone(y, par)
    gap, rate, _, _ = wall_gap(px, py, wx, wy, 1.0 - 2.0 * i, par)
    force, _ = normal_force(-gap, -rate, par.K, mode.chi[i])
    return force


@kernel
def force_inside(y, F, rows, x, y_x, par, mode, i):
    """Return the normal force of wall ``i`` at the fraction ``x`` of the present step, N."""
    dense(y, F, rows, x, y_x, N_STATE)
    return force_at(y_x, par, mode, i)


@kernel
def peak_in_stretch(y, F, rows, y_x, par, mode, i, x_end):
    """Return place and value of the largest normal force of wall ``i`` up to ``x_end``."""
    golden = 0.6180339887498949
    a, b = 0.0, x_end
    x1 = b - golden * (b - a)
    x2 = a + golden * (b - a)
    f1 = force_inside(y, F, rows, x1, y_x, par, mode, i)
    f2 = force_inside(y, F, rows, x2, y_x, par, mode, i)
    while b - a > 0.05 * x_end:
        if f1 < f2:
            a, x1, f1 = x1, x2, f2
            x2 = a + golden * (b - a)
            f2 = force_inside(y, F, rows, x2, y_x, par, mode, i)
        else:
            b, x2, f2 = x2, x1, f1
            x1 = b - golden * (b - a)
            f1 = force_inside(y, F, rows, x1, y_x, par, mode, i)
    x, f = (x1, f1) if f1 > f2 else (x2, f2)
    # then parabolas through three places, ever closer
    width = 0.5 * (b - a)
    for _ in range(5):
        width = min(width, x, x_end - x)
        if width < 1e-6 * x_end:
            break
        left = force_inside(y, F, rows, x - width, y_x, par, mode, i)
        right = force_inside(y, F, rows, x + width, y_x, par, mode, i)
        bend = left - 2.0 * f + right
        shift = 0.5 * (left - right) / bend if bend < 0.0 else math.copysign(1.0, right - left)
        trial = x + width * min(1.0, max(-1.0, shift))
        top = force_inside(y, F, rows, trial, y_x, par, mode, i)
        if top > f:
            x, f = trial, top
        if abs(shift) < 1.0:
            width *= 0.1
            if abs(shift) < 0.1 and width < 1e-3 * x_end:
                break
    return x, f


@kernel
def watch_force(par, run, mode, pair, y, y_s, y_x, K, F, scratch, y_end, x_end):
    """Keep each touch's peak of force, found inside the stretch where it lies."""
    rows = pair[4].shape[0]
    stages = pair[5]
    small = 1e-4 * run.h
    for k in range(N_STATE):
        y_s[k] = y_end[k] + small * K[stages, k]
    for i in range(2):
        if not mode.touching[i]:
            continue
        # a whole step's last evaluation has the force; one cut short ends with the touch, or
        # is to be looked through anyway
        force = K[stages, IMPULSE + i] if x_end == 1.0 else force_at(y_end, par, mode, i)
        # rate by a small move along the flow: it only decides where to look
        rate = (force_at(y_s, par, mode, i) - force) / small if x_end == 1.0 else -1.0
        if run.force_rate[i] > 0.0 and rate < 0.0:
            width = x_end * run.h
            place, low = cubic_minimum(
                -run.force[i], -run.force_rate[i] * width, -force, -rate * width
            )
            if x_end != 1.0 or (place >= 0.0 and -low > 0.98 * run.touch_peak[i]):
                make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
                x, peak = peak_in_stretch(y, F, rows, y_x, par, mode, i, x_end)
                if peak > run.touch_peak[i]:
                    run.touch_peak[i] = peak
                    run.touch_peak_time[i] = run.t0 + x * run.h
        if force > run.touch_peak[i]:
            run.touch_peak[i] = force
            run.touch_peak_time[i] = run.t1
        run.force[i] = force
        run.force_rate[i] = rate
