"""A stretch of the integrator: planned up to its first event, then closed with what follows."""

from __future__ import annotations

import math

from capture_sim.engine.distances import distances, remember_distances, way_to_events
from capture_sim.engine.force_peak import watch_force
from capture_sim.engine.notebook import (
    END,
    LATCHED,
    LIFT_OFF,
    MOVING,
    NO_EVENT,
    PROBE_IN_HINGE,
    SERVED,
    SLOW,
    SMALLEST_STEP,
    STEP,
    STEP_TOO_LONG,
    STICK,
    STOP_HIT,
    STOP_LEFT,
    TIP_THROUGH_WALL,
    TOUCH_BEGINS,
)
from capture_sim.engine.rest import is_slow, may_rest, ratio_of_limit, stop_vehicle
from capture_sim.engine.search import search_step
from capture_sim.engine.slip import change_slip
from capture_sim.engine.steps import make_dense, step_length, take_implicit_step, take_step
from capture_sim.engine.touches import begin_touch, end_touch, latch_tip, log_event
from capture_sim.kernels import kernel
from capture_sim.model.equations import N_TOTAL, rate_of_change
from capture_sim.model.observe import observe
from capture_sim.solver.runge_kutta import dense

_HELD_BACK = 3  # explicit steps that only the contact kept short, before implicit ones
_WORTH = 2.0  # explicit steps that an implicit one must span to be worth its cost
_PATIENCE = 20  # explicit steps after an event has shown up, before they are tried again
_DEEPEST = 0.75  # of R_t: beyond it the tip's centre might pass a wall within a step
_FIXED_ANGLE = 1.5  # rad of the contact's oscillation that a fixed step may span
_MOST_SUBSTEPS = 8  # events located within one fixed step: bounds its cost


@kernel
def plan_step(par, run, mode, pair, y, y_new, y_s, y_x, e_5, e_3, K, F, weights, scratch, work):
    """Take one accepted step of the integrator and cut it at the first event in it.

    Returns the loop's status; SERVED if all is well.
    """
    stages = pair[5]
    run.stretch = STEP
    if run.fresh:
        rate_of_change(run.t0, y, K[0], par, mode, scratch)
        run.evaluations += 1
        run.fresh = 0
        run.stiff = 0
        run.held_back = 0
        if par.has_supports:
            # a change of forces may ask more of the supports at once than they can hold
            for which in range(2):
                resting = mode.rest_S if which == 0 else mode.rest_T
                if resting and ratio_of_limit(y, par, mode, K[1], scratch, which) > 1.0:
                    run.h = 0.0
                    run.t1 = run.t0
                    run.pending = MOVING
                    run.pending_wall = which
                    return SERVED
    else:
        for i in range(N_TOTAL):
            K[0, i] = K[stages, i]
    if not run.measured:
        remember_distances(run, distances(y, par))
    way = way_to_events(par, run, mode)
    smooth = False
    if run.stiff and run.h_last > 0.0 and run.h_stiff < _WORTH * run.h_next:
        # the force changes too fast for steps that would pay
        run.stiff = 0
        run.held_back = -_PATIENCE
    if run.stiff:
        smooth = take_implicit_step(
            par, run, mode, y, y_new, y_s, K, F, weights, scratch, stages, work
        )
        near = distances(y_new, par)
        if not smooth or 0.5 * (run.tip_speed + near[6]) * run.h > 1.01 * way:
            smooth = False
            run.stiff = 0
            run.held_back = -_PATIENCE
    while not smooth:
        h = step_length(par, run, mode)
        status = take_step(par, run, mode, pair, y, y_new, y_s, e_5, e_3, K, weights, scratch, h)
        if status != SERVED:
            return status
        # a tip that gathers speed makes more way than it seemed at the start
        near = distances(y_new, par)
        made = 0.5 * (run.tip_speed + near[6]) * run.h
        if not made > 1.01 * way:
            break
        if par.fixed_step > 0.0:
            return STEP_TOO_LONG
        run.rejected += 1
        run.h_next = 0.9 * run.h * way / made

    if par.implicit and not smooth and run.held_back >= _HELD_BACK:
        run.stiff = 1
        run.h_stiff = run.h
        run.h_last = 0.0
        run.derived = 0
    if par.fixed_step > 0.0:
        for i in range(2):
            stiffness = 1.5 * par.K * math.sqrt(max(-near[2 * i], 0.0))
            if mode.touching[i] and par.fixed_step**2 * stiffness > _FIXED_ANGLE**2 * par.m_P:
                return STEP_TOO_LONG

    cut = search_step(par, run, mode, pair, y, y_new, near, y_s, y_x, K, F, scratch)
    if cut < 1.0 and smooth:
        # an event ends the smooth stretch: back to short steps, for some while
        run.stiff = 0
        run.held_back = -_PATIENCE
        h = step_length(par, run, mode)
        status = take_step(par, run, mode, pair, y, y_new, y_s, e_5, e_3, K, weights, scratch, h)
        if status != SERVED:
            return status
        near = distances(y_new, par)
        cut = search_step(par, run, mode, pair, y, y_new, near, y_s, y_x, K, F, scratch)
    in_contact = mode.touching[0] or mode.touching[1] or mode.stop or mode.latched
    if cut < 0.95 and par.fixed_step == 0.0 and in_contact:
        # dense output inside a long step in contact is less exact than the step's end: take
        # a real step to just behind the event and look again, now near its end
        h = min(1.02 * cut * run.h, run.h)
        if h > SMALLEST_STEP:
            h_next = run.h_next
            status = take_step(
                par, run, mode, pair, y, y_new, y_s, e_5, e_3, K, weights, scratch, h
            )
            if status != SERVED:
                return status
            if run.h == h:
                run.h_next = h_next
            near = distances(y_new, par)
            cut = search_step(par, run, mode, pair, y, y_new, near, y_s, y_x, K, F, scratch)
    h = run.h
    if not mode.latched and min(near[0], near[2]) < -_DEEPEST * par.R_t:
        return TIP_THROUGH_WALL
    if y_new[4] <= par.R_t:
        return PROBE_IN_HINGE
    if cut <= 1.0:
        if par.fixed_step > 0.0:
            run.substeps += 1
            if run.substeps > _MOST_SUBSTEPS:
                # bounded cost comes first: this event waits for the end of the step
                cut = 1.0
        run.t1 = run.t0 + cut * h
    if run.t1 >= run.t_stop:
        run.t1 = run.t_stop
        run.pending = END
    elif cut > 1.0:
        remember_distances(run, near)
        return SERVED
    run.measured = 0
    return SERVED


@kernel
def close_step(par, run, mode, pair, events, trace, y, y_new, y_s, y_x, y_end, K, F, scratch):
    """Move to the end of an integrator's stretch and draw the consequences.

    In contact the state there goes into ``trace``, if that has room at all.
    """
    rows = pair[4].shape[0]
    x_end = 1.0
    if run.h > 0.0:
        if run.t1 < run.t0 + run.h:
            x_end = (run.t1 - run.t0) / run.h
            make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
            dense(y, F, rows, x_end, y_end, N_TOTAL)
            run.fresh = 1
        else:
            for i in range(N_TOTAL):
                y_end[i] = y_new[i]
        if mode.touching[0] or mode.touching[1]:
            watch_force(par, run, mode, pair, y, y_s, y_x, K, F, scratch, y_end, x_end)
        for i in range(N_TOTAL):
            y[i] = y_end[i]
    if run.t1 > run.t0 + SMALLEST_STEP:
        run.pile = 0
    else:
        run.pile += 1
    t = run.t1
    run.t0 = t
    if trace.shape[0] > 0 and (mode.touching[0] or mode.touching[1]):
        observe(t, y, par, mode, run, scratch, trace[run.n_trace])
        run.n_trace += 1
    which = run.pending_wall
    if par.has_supports:
        for vehicle in range(2):
            # left only well above: rounding must not make it slow again at once
            run.slow[vehicle] = is_slow(y, par, vehicle, 2.0 if run.slow[vehicle] else 1.0)
    if run.pending == NO_EVENT:
        if par.has_supports:
            for vehicle in range(2):
                resting = mode.rest_S if vehicle == 0 else mode.rest_T
                if (
                    not resting
                    and is_slow(y, par, vehicle, 1.0)
                    and may_rest(y, y_x, y_s, par, mode, scratch, vehicle)
                ):
                    stop_vehicle(par, run, mode, events, t, y, vehicle)
                    run.measured = 0
        return
    run.fresh = 1
    if run.pending == SLOW:
        run.slow[which] = 1
        if may_rest(y, y_x, y_s, par, mode, scratch, which):
            stop_vehicle(par, run, mode, events, t, y, which)
    elif run.pending == TOUCH_BEGINS:
        begin_touch(events, run, mode, par, t, y, which)
    elif run.pending == LIFT_OFF:
        end_touch(events, run, mode, t, y, which)
    elif run.pending == STICK:
        change_slip(par, run, mode, events, t, y, y_x, scratch, which)
    elif run.pending == STOP_HIT:
        mode.stop = which
        log_event(events, run, STOP_HIT, t, y, which, y[12])
    elif run.pending == STOP_LEFT:
        mode.stop = 0
        log_event(events, run, STOP_LEFT, t, y, which, y[12])
    elif run.pending == MOVING:
        if which == 0:
            mode.rest_S = 0
        else:
            mode.rest_T = 0
        log_event(events, run, MOVING, t, y, which + 1, 0.0)
    elif run.pending == LATCHED:
        latch_tip(par, run, mode, events, t, y)
