"""One accepted step, its dense output, and how long it may be."""

from __future__ import annotations

import math

from capture_sim.engine.state import N_WATCHED, NO_EVENT, SMALLEST_STEP, Status
from capture_sim.kernels import kernel
from capture_sim.model.equations import N_STATE, N_TOTAL, rate_of_change, tip_in_cone, wall_gap
from capture_sim.solver.runge_kutta import OVERFLOW, dense, make_stepper, next_factor

#: rad of the contact's oscillation that a step may span, less than a period: a longer step may be
#: right at its end and far off in between, where samples and events are read.
_CONTACT_ANGLE = 5.0
#: Of the way to the end of the run: the last step is cut there, so that no sliver is left over.
_BEYOND_END = 1.01
#: Of the tip's radius, or the latch's: closer than this to a wall, a step is no longer than it.
_NEAR = 0.25
#: A multiple of the fixed step is reached to this share of it, whatever rounding does to the time.
_ON_GRID = 1e-9
#: From this share of a fixed step on it is a whole one, not what an event has left of one.
_WHOLE = 0.999

try_step, prepare_dense = make_stepper(rate_of_change, N_STATE, N_TOTAL, N_WATCHED)


@kernel
def state_inside(w, x):
    """Write the state (16,) at the fraction ``x`` of the present step into ``w.y_x``."""
    make_dense(w)
    dense(w.step, x, w.y_x, N_STATE)


@kernel
def make_dense(w):
    """Prepare the dense output of the present step, once."""
    if not w.run.dense_ready:
        prepare_dense(w.system, w.step, w.run.t0, w.run.h)
        w.run.dense_ready = 1


@kernel
def distances(y, par):
    """Return gaps and their rates: +y wall, -y wall, latch; and the tip's speed; m and m/s.

    Without a latch its radius is 0, so that its gap is the distance to the centre of BE.
    """
    px, py, wx, wy = tip_in_cone(y, par)
    g0, d0, _, _ = wall_gap(px, py, wx, wy, 1.0, par)
    g1, d1, _, _ = wall_gap(px, py, wx, wy, -1.0, par)
    ux = px + par.L_T
    distance = math.sqrt(ux * ux + py * py)
    d2 = 0.0
    if distance > 0.0:
        d2 = (ux * wx + py * wy) / distance
    return g0, d0, g1, d1, distance - par.latch_radius, d2, math.sqrt(wx * wx + wy * wy)


@kernel
def measure(w, y):
    """Keep the distances at the end of the present step, or at ``y``, as the next segment's."""
    run, gap, rate = w.run, w.run.next_gap, w.run.next_gap_rate
    gap[0], rate[0], gap[1], rate[1], gap[2], rate[2], run.next_tip_speed = distances(
        y, w.system.par
    )


@kernel
def advance_distances(run):
    """Make the distances of the next segment those of the present one."""
    for i in range(3):
        run.gap[i] = run.next_gap[i]
        run.gap_rate[i] = run.next_gap_rate[i]
    run.tip_speed = run.next_tip_speed
    run.measured = 1


@kernel
def way_to_events(w):
    """Return how far the tip may move in the present step without leaping over an event, m.

    A distance changes no faster than the tip moves: away from the walls (and the latch) the
    step ends short of them, near them it is so short that gap and rate show every dip.
    """
    par, run = w.system.par, w.run
    way = math.inf
    if w.system.mode.latched:
        return way
    near = _NEAR * par.R_t
    for i in range(2):
        way = min(way, max(run.gap[i] - near, near))
    if par.has_latch:
        near = _NEAR * par.latch_radius
        way = min(way, max(run.gap[2] - near, near))
    return way


@kernel
def step_length(w):
    """Return the length of the next step at most, s."""
    par, run = w.system.par, w.run
    if par.fixed_step > 0.0:
        # to the next multiple of the fixed step; what an event has cut off is caught up
        left = math.floor(run.t0 / par.fixed_step + 1.0 + _ON_GRID) * par.fixed_step - run.t0
        if run.substeps == 0 or left > _WHOLE * par.fixed_step:
            run.substeps = 0
        return left
    h = min(run.h_next, _BEYOND_END * (run.t_stop - run.t0))
    if run.tip_speed > 0.0:
        h = min(h, way_to_events(w) / run.tip_speed)
    for i in range(2):
        if w.system.mode.touching[i] and run.gap[i] < 0.0:
            stiffness = 1.5 * par.K * math.sqrt(-run.gap[i])
            h = min(h, _CONTACT_ANGLE * math.sqrt(par.m_P / stiffness))
    return h


@kernel
def take_step(w, h):
    """Take one accepted step of at most ``h`` and measure at its end; returns the Status."""
    par, run, step = w.system.par, w.run, w.step
    run.dense_ready = 0
    run.pending = NO_EVENT
    while True:
        if h < SMALLEST_STEP:
            if run.t_stop - run.t0 >= SMALLEST_STEP and par.fixed_step == 0.0:
                return Status.STEP_TOO_SMALL
            h = SMALLEST_STEP
        error = try_step(w.system, step, run.t0, h)
        run.evaluations += step.stages
        if par.fixed_step > 0.0:
            total = 0.0
            for i in range(N_STATE):
                total += step.y_new[i]
            if not math.isfinite(total):
                return Status.NOT_FINITE
            break
        factor = next_factor(error, run.error, step.order)
        if error <= 1.0:
            run.error = error
            run.h_next = h * factor
            break
        run.rejected += 1
        if not error < OVERFLOW:
            for i in range(N_STATE):
                if not (math.isfinite(step.K[0, i]) and math.isfinite(step.y[i])):
                    return Status.NOT_FINITE
            # a NaN is NaN under a zero weight too: no stage may keep one
            for j in range(1, step.total_stages):
                for i in range(N_TOTAL):
                    step.K[j, i] = 0.0
        h *= min(factor, 1.0)
    run.steps += 1
    run.h = h
    run.t1 = run.t0 + h
    measure(w, step.y_new)
    return Status.TOO_MANY_STEPS if run.steps + run.rejected > par.max_steps else Status.SERVED
