"""One accepted step: its length, its dense output and the distances at its ends."""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import inline_kernel, kernel
from capture_sim.dynamics.engine.state import N_WATCHED, NO_EVENT, SMALLEST_STEP, Status
from capture_sim.dynamics.model.contact import contact_slope, normal_force
from capture_sim.dynamics.model.equations import (
    N_STATE,
    N_TOTAL,
    gap_and_rate,
    rate_of_change,
    tip_in_cone,
)
from capture_sim.dynamics.solver.runge_kutta import (
    OVERFLOW,
    dense,
    dense_entry,
    make_stepper,
    next_factor,
)

#: Longest step in contact, rad of the contact's oscillation, less than a period: a longer step may
#: be accurate at its end but not in between, where samples and events are read.
_CONTACT_ANGLE = 5.0
#: Longest step with stops, a seat, friction in the slide or a table of forces, rad of the probe's
#: oscillation on the axial spring: the cubic through stroke and rate at the ends of a shorter step
#: shows every stop that is hit, and no steep part of the table is stepped over.
_STROKE_ANGLE = 2.0
#: Permitted error of a step in contact, as a share of the penetration.
_DEPTH_SHARE = 0.03
#: Shares of the time to the end of a touch at the present rate.  A step that would go beyond
#: _NEARLY ends at _PAST_END if the error of crossing the end is below _END_ERROR of the permitted
#: one, else at _TOWARDS_END.
_NEARLY, _PAST_END, _TOWARDS_END, _END_ERROR = 0.8, 1.02, 0.6, 0.3
#: Share of the time to the end of the run: a step goes a little past it and is cut there.
_RUN_END_REACH = 1.01
#: Share of the tip's or the latch's radius: the longest path of the tip in a step near a wall.
_NEAR = 0.25
#: Share of the step, for difference quotients along the motion.
SMALL_MOVE = 1e-4
#: Share of the fixed step: a time this close to a multiple of it counts as that multiple.
_GRID_TOLERANCE = 1e-9
#: Share of the fixed step: a longer step is a full one, not the rest after an event.
_FULL_STEP_SHARE = 0.999

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
    """Write the state, from entry ``first`` on, after a short time ``t`` (s) into ``moved``."""
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
    """Return the distance of the tip's centre to the centre of BE, m, and its rate, m/s."""
    ux = px + par.L_T
    distance = math.sqrt(ux * ux + py * py)
    rate = 0.0
    if distance > 0.0:
        rate = (ux * wx + py * wy) / distance
    return distance, rate


@inline_kernel
def write_distances(w, px, py, wx, wy):
    """Write the distances at the end of the present step; a latched tip has none to the walls.

    Without a latch its radius is 0, so its gap is the distance to the centre of BE.
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
def path_to_events(w):
    """Return the longest path of the tip in the present step that cannot miss an event, m.

    A distance changes no faster than the tip moves.  Far from the walls and the latch, the step
    ends before them; near them it is so short that gap and rate at its ends show every dip.
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
    """Return the upper limit of the next step, s."""
    par, step = w.system.par, w.step
    if par.fixed_step > 0.0:
        # to the next multiple of the fixed step, also after an event
        multiple = math.floor(step.t0 / par.fixed_step + 1.0 + _GRID_TOLERANCE)
        left = multiple * par.fixed_step - step.t0
        if left > _FULL_STEP_SHARE * par.fixed_step:
            step.substeps = 0
        return left
    h = min(step.h_next, _RUN_END_REACH * (w.progress.t_stop - step.t0))
    if step.start.tip_speed > 0.0:
        h = min(h, path_to_events(w) / step.start.tip_speed)
    has_end = par.has_stops or par.preload > 0.0 or par.slide_friction > 0.0
    if (has_end or par.force_table.count > 0) and not w.system.mode.held:
        # the spring is stiffest at a stop
        stroke = max(-par.stop_compressed, abs(w.stepper.y[4] - par.h_0))
        if par.stop_extended < math.inf:
            stroke = max(stroke, par.stop_extended)
        stiffness = par.k_A + 3.0 * par.k_A3 * stroke * stroke + par.force_table.largest_slope
        if stiffness > 0.0:
            h = min(h, _STROKE_ANGLE * math.sqrt(par.m_P / stiffness))
    for i in range(2):
        touch, depth = w.system.mode.touch[i], -step.start.gap[i]
        if touch.on and depth > 0.0:
            stiffness, damping = contact_slope(depth, touch.chi, par.contact)
            rate = max(math.sqrt(stiffness / par.m_P), damping / par.m_P)
            if rate > 0.0:
                h = min(h, _CONTACT_ANGLE / rate)
            opening = step.start.gap_rate[i]
            if opening * h > _NEARLY * depth:
                # F ~ t^1.5 at the end of a touch: a step across it errs by about F t^2 / m_P
                left = depth / opening
                allowed = min(par.rtol * par.length_scale, _DEPTH_SHARE * touch.depth)
                _, elastic = normal_force(depth, 0.0, 0.0, par.contact)
                is_small = elastic * left * left < _END_ERROR * allowed * par.m_P
                h = min(h, (_PAST_END if is_small else _TOWARDS_END) * left)
    return h


@kernel
def update_depths(w):
    """Keep the largest penetration of each touch at the start of a step, for the error scale."""
    for i in range(2):
        touch = w.system.mode.touch[i]
        if touch.on:
            touch.depth = max(touch.depth, -w.step.start.gap[i])


@kernel
def contact_share(w):
    """Return the factor on the error of a step in contact, above 1 for a small penetration."""
    par, share = w.system.par, 1.0
    for i in range(2):
        touch = w.system.mode.touch[i]
        if touch.on:
            share = max(share, par.rtol * par.length_scale / (_DEPTH_SHARE * touch.depth))
    return share


@kernel
def take_step(w, h):
    """Take an accepted step of at most ``h`` (s) and write the distances at its end.

    Returns the Status.
    """
    par, step, stepper, totals = w.system.par, w.step, w.stepper, w.totals
    step.dense_ready = 0
    w.event.kind = NO_EVENT
    update_depths(w)
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
        return Status.TOO_MANY_STEPS
    return Status.SERVED
