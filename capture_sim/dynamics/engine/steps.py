"""One accepted step, its dense output and the distances at its ends."""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import inline_kernel, kernel
from capture_sim.dynamics.engine.state import N_WATCHED, NO_EVENT, SMALLEST_STEP, StepStatus
from capture_sim.dynamics.engine.step_length import (
    OVERFLOW,
    contact_share,
    next_factor,
    update_depths,
)
from capture_sim.dynamics.model.equations import (
    N_STATE,
    N_TOTAL,
    gap_and_rate,
    rate_of_change,
    tip_in_cone,
)
from capture_sim.dynamics.solver.runge_kutta import (
    dense,
    dense_entry,
    make_stepper,
)

#: Share of the step over which difference quotients along the motion are taken.
SMALL_MOVE = 1e-4
try_step, prepare_dense = make_stepper(rate_of_change, N_STATE, N_TOTAL, N_WATCHED)


@kernel
def state_inside(w, x, y):
    """Write the state (16,) at the fraction ``x`` of the present step into ``y``."""
    make_dense(w)
    dense(w.stepper, x, y, N_STATE)


@kernel
def entry_inside(w, x, i):
    """Return entry ``i`` of the state at the fraction ``x`` of the present step."""
    make_dense(w)
    return dense_entry(w.stepper, x, i)


@kernel
def move_along(y, f, t, first, moved):
    """Write the state after a short time ``t`` (s) into ``moved``, from entry ``first`` on.

    ``f`` is the time derivative of the state ``y``.
    """
    for i in range(first, N_STATE):
        moved[i] = y[i] + t * f[i]


@kernel
def make_dense(w):
    """Prepare the dense output of the present step, unless that has been done."""
    if not w.step.dense_ready:
        prepare_dense(w.system, w.stepper, w.step.t0, w.step.h)
        w.step.dense_ready = 1


@inline_kernel
def distance_to_edge(px, py, wx, wy, par):
    """Return the distance of the tip's centre to the centre of BE, m, and its rate, m/s."""
    ux = px + par.L_T
    distance = math.sqrt(ux * ux + py * py)
    rate = 0.0
    if distance > 0.0:
        rate = (ux * wx + py * wy) / distance
    return distance, rate


@inline_kernel
def write_distances(w, px, py, wx, wy):
    """Write the distances of the tip at the end of the present step.

    They are those to the two walls, infinite for a latched tip, and to the circle around the centre
    of BE in which the latch closes.  Without a latch the radius of this circle is 0.
    """
    par, end = w.system.par, w.step.end
    gap, rate = end.gap, end.gap_rate
    if w.system.mode.latched:
        gap[0] = gap[1] = math.inf
        rate[0] = rate[1] = 0.0
    else:
        gap[0], rate[0], _, _ = gap_and_rate(px, py, wx, wy, 1.0, par)
        gap[1], rate[1], _, _ = gap_and_rate(px, py, wx, wy, -1.0, par)
    distance, rate[2] = distance_to_edge(px, py, wx, wy, par)
    gap[2] = distance - par.latch_radius
    tip = end.tip
    tip[0] = px
    tip[1] = py
    tip[2] = wx
    tip[3] = wy
    end.tip_speed = math.sqrt(wx * wx + wy * wy)


@kernel
def measure_distances(w, y):
    """Write the distances at ``y`` as the distances at the end of the present step."""
    px, py, wx, wy = tip_in_cone(y, w.system.par)
    write_distances(w, px, py, wx, wy)


@kernel
def measure_new_state(w):
    """Write the distances at ``stepper.y_new``, where the equations have just been evaluated."""
    mode, tip = w.system.mode, w.system.out.tip
    if mode.latched or mode.touch[0].on or mode.touch[1].on:
        write_distances(w, tip[0], tip[1], tip[2], tip[3])
    else:
        measure_distances(w, w.stepper.y_new)


@kernel
def advance_distances(step):
    """Copy the distances at the end of the step to the start of the next one."""
    for i in range(3):
        step.start.gap[i] = step.end.gap[i]
        step.start.gap_rate[i] = step.end.gap_rate[i]
    for i in range(4):
        step.start.tip[i] = step.end.tip[i]
    step.start.tip_speed = step.end.tip_speed
    step.start_measured = 1


@kernel
def take_step(w, h):
    """Take an accepted step of at most ``h`` (s) and write the distances at its end.

    Returns the StepStatus.
    """
    par, step, stepper, totals = w.system.par, w.step, w.stepper, w.totals
    step.dense_ready = 0
    w.event.kind = NO_EVENT
    update_depths(w)
    while True:
        if h < SMALLEST_STEP:
            if w.progress.t_stop - step.t0 >= SMALLEST_STEP and par.fixed_step == 0.0:
                return StepStatus.STEP_TOO_SMALL
            h = SMALLEST_STEP
        error = try_step(w.system, stepper, step.t0, h)
        if par.fixed_step > 0.0:
            total = 0.0
            for i in range(N_STATE):
                total += stepper.y_new[i]
            if not math.isfinite(total):
                return StepStatus.NOT_FINITE
            break
        error *= contact_share(w)
        factor = next_factor(error, step.error, stepper.order)
        if error <= 1.0:
            step.error = error
            step.h_next = h * factor
            break
        totals.rejected += 1
        if not error < OVERFLOW:
            for i in range(N_STATE):
                if not (math.isfinite(stepper.K[0, i]) and math.isfinite(stepper.y[i])):
                    return StepStatus.NOT_FINITE
            # NaN times a zero weight is NaN: no stage may keep one
            for j in range(1, stepper.total_stages):
                for i in range(N_TOTAL):
                    stepper.K[j, i] = 0.0
        h *= min(factor, 1.0)
    totals.steps += 1
    step.h = h
    step.t1 = step.t0 + h
    measure_new_state(w)
    if par.has_supports:
        for i in range(6):
            step.hold[i] = w.system.out.hold[i]
    if totals.steps + totals.rejected > par.max_steps:
        return StepStatus.TOO_MANY_STEPS
    return StepStatus.SERVED
