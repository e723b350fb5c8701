"""One accepted step, its dense output, and how long it may be."""

from __future__ import annotations

import math

from capture_sim.engine.state import N_WATCHED, NO_EVENT, SMALLEST_STEP, Status
from capture_sim.kernels import inline_kernel, kernel
from capture_sim.model.equations import (
    N_STATE,
    N_TOTAL,
    gap_and_rate,
    rate_of_change,
    tip_in_cone,
)
from capture_sim.solver.runge_kutta import OVERFLOW, dense, make_stepper, next_factor

#: rad of the contact's oscillation that a step may span, less than a period: a longer step may be
#: right at its end and far off in between, where samples and events are read.
_CONTACT_ANGLE = 5.0
#: rad of the probe's oscillation on the axial spring that a step may span where there are stops:
#: the cubic through stroke and rate at its ends shows when one is met.
_STROKE_ANGLE = 2.0
#: Of the penetration: the error allowed for a step in contact; with more, forces have no meaning.
_DEPTH_SHARE = 0.03
#: Of the time to the end of a touch at the present rate: a step that would reach this far ends a
#: little past it where the error of that is below a share of the allowed one, else before.
_NEARLY, _PAST_END, _TOWARDS_END, _END_ERROR = 0.8, 1.02, 0.6, 0.3
#: Of the way to the end of the run: the last step is cut there, so that no sliver is left over.
_BEYOND_END = 1.01
#: Of the tip's radius, or the latch's: closer than this to a wall, a step is no longer than it.
_NEAR = 0.25
#: Of the step: a move along the motion that shows a rate.
SMALL_MOVE = 1e-4
#: A multiple of the fixed step is reached to this share of it, whatever rounding does to the time.
_ON_GRID = 1e-9
#: From this share of a fixed step on it is a whole one, not what an event has left of one.
_WHOLE = 0.999

try_step, prepare_dense = make_stepper(rate_of_change, N_STATE, N_TOTAL, N_WATCHED)


@kernel
def state_inside(w, x):
    """Write the state (16,) at the fraction ``x`` of the present step into ``w.y_x``."""
    make_dense(w)
    dense(w.stepper, x, w.y_x, N_STATE)


@kernel
def move(y, f, t, first, moved):
    """Write coordinates and rates from ``first`` on after a small time ``t``, by their rates."""
    for i in range(first, N_STATE):
        moved[i] = y[i] + t * f[i]


@kernel
def make_dense(w):
    """Prepare the dense output of the present step, once."""
    if not w.step.dense_ready:
        prepare_dense(w.system, w.stepper, w.step.t0, w.step.h)
        w.step.dense_ready = 1


@inline_kernel
def distance_to_edge(px, py, wx, wy, par):
    """Return the distance of the tip's centre to that of BE, m, and its rate, m/s."""
    ux = px + par.L_T
    distance = math.sqrt(ux * ux + py * py)
    rate = 0.0
    if distance > 0.0:
        rate = (ux * wx + py * wy) / distance
    return distance, rate


@inline_kernel
def write_distances(w, px, py, wx, wy):
    """Write the distances of the end of the present step: of a latched tip none to the walls.

    Without a latch its radius is 0, so that its gap is the distance to the centre of BE.
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
def measure(w, y):
    """Measure the distances at ``y`` as those at the end of the present step."""
    px, py, wx, wy = tip_in_cone(y, w.system.par)
    write_distances(w, px, py, wx, wy)


@kernel
def measure_new(w):
    """Measure the distances at the new state, which has just been evaluated."""
    mode, tip = w.system.mode, w.system.out.tip
    if mode.latched or mode.touch[0].on or mode.touch[1].on:
        write_distances(w, tip[0], tip[1], tip[2], tip[3])
    else:
        measure(w, w.stepper.y_new)


@kernel
def advance_distances(step):
    """Make the distances of the next segment those of the present one."""
    for i in range(3):
        step.start.gap[i] = step.end.gap[i]
        step.start.gap_rate[i] = step.end.gap_rate[i]
    for i in range(4):
        step.start.tip[i] = step.end.tip[i]
    step.start.tip_speed = step.end.tip_speed
    step.start_measured = 1


@kernel
def path_to_events(w):
    """Return how far the tip may move in the present step without leaping over an event, m.

    A distance changes no faster than the tip moves: away from the walls (and the latch) the
    step ends short of them, near them it is so short that gap and rate show every dip.
    """
    par, start = w.system.par, w.step.start
    path = math.inf
    if w.system.mode.latched:
        return path
    near = _NEAR * par.R_t
    for i in range(2):
        path = min(path, max(start.gap[i] - near, near))
    if par.has_latch:
        near = _NEAR * par.latch_radius
        path = min(path, max(start.gap[2] - near, near))
    return path


@kernel
def step_length(w):
    """Return the length of the next step at most, s."""
    par, step = w.system.par, w.step
    if par.fixed_step > 0.0:
        # to the next multiple of the fixed step; what an event has cut off is caught up
        left = math.floor(step.t0 / par.fixed_step + 1.0 + _ON_GRID) * par.fixed_step - step.t0
        if step.substeps == 0 or left > _WHOLE * par.fixed_step:
            step.substeps = 0
        return left
    h = min(step.h_next, _BEYOND_END * (w.progress.t_stop - step.t0))
    if step.start.tip_speed > 0.0:
        h = min(h, path_to_events(w) / step.start.tip_speed)
    if (par.has_stops or par.preload > 0.0) and not w.system.mode.seated:
        # the spring is stiffest at a stop
        stroke = max(-par.stop_compressed, abs(w.stepper.y[4] - par.h_0))
        if par.stop_extended < math.inf:
            stroke = max(stroke, par.stop_extended)
        stiffness = par.k_A + 3.0 * par.k_A3 * stroke * stroke
        if stiffness > 0.0:
            h = min(h, _STROKE_ANGLE * math.sqrt(par.m_P / stiffness))
    for i in range(2):
        touch, depth = w.system.mode.touch[i], -step.start.gap[i]
        if touch.on and depth > 0.0:
            root = math.sqrt(depth)
            rate = max(math.sqrt(1.5 * par.K * root / par.m_P), touch.chi * depth * root / par.m_P)
            h = min(h, _CONTACT_ANGLE / rate)
            opening = step.start.gap_rate[i]
            if opening * h > _NEARLY * depth:
                # F ~ t^1.5 at the end of a touch: a step across it errs by about F t^2 / m_P
                left = depth / opening
                allowed = min(par.rtol * par.length_scale, _DEPTH_SHARE * touch.depth)
                is_small = par.K * depth * root * left * left < _END_ERROR * allowed * par.m_P
                h = min(h, (_PAST_END if is_small else _TOWARDS_END) * left)
    return h


@kernel
def contact_share(w):
    """Return by what the error of a step counts more in contact, where it is close to the depth."""
    par, share = w.system.par, 1.0
    for i in range(2):
        touch = w.system.mode.touch[i]
        if touch.on:
            touch.depth = max(touch.depth, -w.step.start.gap[i])
            share = max(share, par.rtol * par.length_scale / (_DEPTH_SHARE * touch.depth))
    return share


@kernel
def take_step(w, h):
    """Take one accepted step of at most ``h`` and measure at its end; returns the Status."""
    par, step, stepper, totals = w.system.par, w.step, w.stepper, w.totals
    step.dense_ready = 0
    w.event.kind = NO_EVENT
    while True:
        if h < SMALLEST_STEP:
            if w.progress.t_stop - step.t0 >= SMALLEST_STEP and par.fixed_step == 0.0:
                return Status.STEP_TOO_SMALL
            h = SMALLEST_STEP
        error = try_step(w.system, stepper, step.t0, h)
        if par.fixed_step > 0.0:
            total = 0.0
            for i in range(N_STATE):
                total += stepper.y_new[i]
            if not math.isfinite(total):
                return Status.NOT_FINITE
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
                    return Status.NOT_FINITE
            # a NaN is NaN under a zero weight too: no stage may keep one
            for j in range(1, stepper.total_stages):
                for i in range(N_TOTAL):
                    stepper.K[j, i] = 0.0
        h *= min(factor, 1.0)
    totals.steps += 1
    step.h = h
    step.t1 = step.t0 + h
    measure_new(w)
    if par.has_supports:
        for i in range(6):
            step.hold[i] = w.system.out.hold[i]
    if totals.steps + totals.rejected > par.max_steps:
        return Status.TOO_MANY_STEPS
    return Status.SERVED
