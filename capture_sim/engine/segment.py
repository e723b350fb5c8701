"""A segment of the integrator: planned up to its first event, then closed with what follows."""

from __future__ import annotations

import math

from capture_sim.engine.consequences import draw_consequences
from capture_sim.engine.events import ratio_of_limit, search_step
from capture_sim.engine.extremes import measure_force, watch_extremes, watch_force
from capture_sim.engine.state import NO_EVENT, SMALLEST_STEP, Segment, Status
from capture_sim.engine.steps import (
    advance_distances,
    make_dense,
    measure,
    step_length,
    take_step,
    way_to_events,
)
from capture_sim.kernels import kernel
from capture_sim.model.equations import N_TOTAL, rate_of_change
from capture_sim.model.observe import observe
from capture_sim.samples import EventKind
from capture_sim.solver.runge_kutta import dense

#: Of R_t: deeper in a wall the tip's centre might pass it within a step.
_DEEPEST = 0.75
#: rad of the contact's oscillation that a fixed step may span.
_FIXED_ANGLE = 1.5
#: Events located within one fixed step: bounds its cost.
_MOST_SUBSTEPS = 8
#: Of the way to the next event: so far a step may go that has gathered speed; and how far the
#: next trial goes.
_FARTHER, _SHORTER = 1.01, 0.9
#: An event before this place of a long step in contact is located anew, at the end of a step that
#: goes to just behind it: dense output inside the step is less exact than its end.
_NEAR_END, _BEHIND = 0.95, 1.02


@kernel
def begin_equations(w):
    """Evaluate equations that have changed; True if a vehicle is torn loose at once by them."""
    run, mode = w.run, w.system.mode
    rate_of_change(run.t0, w.step.y, w.step.K[0], w.system)
    run.evaluations += 1
    run.fresh = 0
    measure_force(w)
    if w.system.par.has_supports:
        # a change of forces may ask more of the supports at once than they can hold
        for which in range(2):
            resting = mode.rest_S if which == 0 else mode.rest_T
            if resting and ratio_of_limit(w.step.y, w.system, which) > 1.0:
                run.h = 0.0
                run.t1 = run.t0
                run.pending = EventKind.MOVING
                run.pending_wall = which
                return True
    return False


@kernel
def step_within_way(w):
    """Take a step in which the tip does not leap over an event; returns the Status."""
    run, par = w.run, w.system.par
    if not run.measured:
        measure(w, w.step.y)
        advance_distances(run)
    way = way_to_events(w)
    while True:
        status = take_step(w, step_length(w))
        if status != Status.SERVED:
            return status
        # a tip that gathers speed makes more way than it seemed at the start
        made = 0.5 * (run.tip_speed + run.next_tip_speed) * run.h
        if not made > _FARTHER * way:
            return Status.SERVED
        if par.fixed_step > 0.0:
            return Status.STEP_TOO_LONG
        run.rejected += 1
        run.h_next = _SHORTER * run.h * way / made


@kernel
def is_resolved(w):
    """Return whether a fixed step resolves the contacts at its end."""
    par, mode = w.system.par, w.system.mode
    for i in range(2):
        stiffness = 1.5 * par.K * math.sqrt(max(-w.run.next_gap[i], 0.0))
        if mode.touching[i] and par.fixed_step**2 * stiffness > _FIXED_ANGLE**2 * par.m_P:
            return False
    return True


@kernel
def end_segment(w):
    """Set the end of the segment: at the first event, the end of the run, or of the step.

    Returns the Status by the state there, which goes to ``w.y_end``.
    """
    run, par, step = w.run, w.system.par, w.step
    if run.cut <= 1.0:
        if par.fixed_step > 0.0:
            run.substeps += 1
            if run.substeps > _MOST_SUBSTEPS:
                # bounded cost comes first: this event waits for the end of the step
                run.cut = 1.0
        run.t1 = run.t0 + run.cut * run.h
    if run.t1 >= run.t_stop:
        run.t1 = run.t_stop
        run.pending = EventKind.END
    run.x_end = 1.0
    if run.t1 < run.t0 + run.h:
        run.x_end = (run.t1 - run.t0) / run.h
        make_dense(w)
        dense(step, run.x_end, w.y_end, N_TOTAL)
    else:
        for i in range(N_TOTAL):
            w.y_end[i] = step.y_new[i]
    if run.pending != NO_EVENT:
        measure(w, w.y_end)
    if not w.system.mode.latched and min(run.next_gap[0], run.next_gap[1]) < -_DEEPEST * par.R_t:
        return Status.TIP_THROUGH_WALL
    if w.y_end[4] <= par.R_t:
        return Status.PROBE_IN_HINGE
    return Status.SERVED


@kernel
def plan_step(w):
    """Take one accepted step of the integrator and cut it at the first event in it.

    Returns the Status.
    """
    run, par, mode, step = w.run, w.system.par, w.system.mode, w.step
    run.segment = Segment.STEP
    if run.fresh:
        if begin_equations(w):
            return Status.SERVED
    else:
        for i in range(N_TOTAL):
            step.K[0, i] = step.K[step.stages, i]
    status = step_within_way(w)
    if status != Status.SERVED:
        return status
    if par.fixed_step > 0.0 and not is_resolved(w):
        return Status.STEP_TOO_LONG
    search_step(w)
    in_contact = mode.touching[0] or mode.touching[1] or mode.stop or mode.latched
    if run.cut < _NEAR_END and par.fixed_step == 0.0 and in_contact:
        h = min(_BEHIND * run.cut * run.h, run.h)
        if h > SMALLEST_STEP:
            h_next = run.h_next
            status = take_step(w, h)
            if status != Status.SERVED:
                return status
            if run.h == h:
                run.h_next = h_next
            search_step(w)
    return end_segment(w)


@kernel
def close_step(w, trace):
    """Move to the end of an integrator's segment and draw the consequences.

    In contact the state there goes into ``trace``, if that has room at all.
    """
    run, mode, step = w.run, w.system.mode, w.step
    if run.h > 0.0:
        if mode.touching[0] or mode.touching[1]:
            watch_force(w)
        watch_extremes(w)
        for i in range(N_TOTAL):
            step.y[i] = w.y_end[i]
        if run.x_end < 1.0:
            run.fresh = 1
        advance_distances(run)
    run.pile = 0 if run.t1 > run.t0 + SMALLEST_STEP else run.pile + 1
    run.t0 = run.t1
    if trace.shape[0] > 0 and (mode.touching[0] or mode.touching[1]):
        observe(run.t0, step.y, w.system, run, trace[run.n_trace])
        run.n_trace += 1
    draw_consequences(w)
