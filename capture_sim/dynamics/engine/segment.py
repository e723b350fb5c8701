"""A segment of the integrator: it is planned up to its first event and closed by applying it."""

from __future__ import annotations

from capture_sim.base.compiled.kernels import kernel
from capture_sim.dynamics.engine.consequences import apply_event
from capture_sim.dynamics.engine.events import (
    event_value,
    has_distance,
    hold_limits,
    is_held_at_rest,
    release_of,
    search_again,
    search_step,
)
from capture_sim.dynamics.engine.extremes import watch_extremes, watch_loads
from capture_sim.dynamics.engine.state import NO_EVENT, SMALLEST_STEP, Segment, StepStatus
from capture_sim.dynamics.engine.step_length import path_to_events, step_length
from capture_sim.dynamics.engine.steps import (
    advance_distances,
    make_dense,
    measure_distances,
    take_step,
)
from capture_sim.dynamics.engine.work import work_inside
from capture_sim.dynamics.model.contact import acts, contact_slope
from capture_sim.dynamics.model.equations import N_TOTAL, rate_of_change
from capture_sim.dynamics.model.observe import observe
from capture_sim.dynamics.samples import EventKind
from capture_sim.dynamics.solver.runge_kutta import dense

#: Maximum penetration as a share of R_t; if it is deeper, the tip's centre might pass the wall
#: within a step.
_MAX_DEPTH_SHARE = 0.75
#: Longest fixed step in contact: in rad of the contact's oscillation, and in time constants of its
#: damping.  At 2.78 time constants the fourth-order method is unstable.
_FIXED_ANGLE, _FIXED_DECAY = 1.5, 2.5
#: Largest number of events located within one fixed step, to limit its cost.
_MAX_SUBSTEPS = 8
#: Shares of the path to the next event: the largest path of an accepted step in which the tip
#: accelerates, and the path that the next trial aims at.
_MAX_OVERSHOOT, _RETRY_SHARE = 1.01, 0.9
#: If a step in contact has an event before the fraction _NEAR_END, the step is repeated with a
#: length of _PAST_EVENT times the event's fraction, because dense output inside a step is less
#: accurate than the end of a step.
_NEAR_END, _PAST_EVENT = 0.95, 1.02


@kernel
def begin_equations(w):
    """Evaluate the changed equations; return True if an event happens at the present time.

    The event is that the probe begins to slide, or that a vehicle at rest starts to move.
    """
    step, event, mode = w.step, w.event, w.system.mode
    rate_of_change(step.t0, w.stepper.y, w.stepper.K[0], w.system)
    step.equations_changed = 0
    if mode.held and not w.progress.released_at_t0:
        lower, upper = hold_limits(w.stepper.y, w.system)
        if not lower <= w.system.out.axial_force <= upper:
            step.h = 0.0
            step.t1 = step.t0
            event.kind, event.which = release_of(mode)
            return True
    if w.system.par.has_supports:
        # a change of forces may exceed the limit of the supports at once
        for which in range(2):
            resting = mode.rest_S if which == 0 else mode.rest_T
            hold = w.system.out.hold
            if resting and not is_held_at_rest(w.stepper.y, w.system.par, hold, which, 1.0):
                step.h = 0.0
                step.t1 = step.t0
                event.kind = EventKind.MOVING
                event.which = which
                return True
    return False


@kernel
def step_within_path(w):
    """Take a step so short that the tip cannot miss an event; return the StepStatus."""
    step, par = w.step, w.system.par
    if not step.start_measured:
        measure_distances(w, w.stepper.y)
        advance_distances(step)
    path = path_to_events(w)
    while True:
        status = take_step(w, step_length(w))
        if status != StepStatus.SERVED:
            return status
        # an accelerating tip moves farther than its speed at the start suggests
        moved = 0.5 * (step.start.tip_speed + step.end.tip_speed) * step.h
        if not moved > _MAX_OVERSHOOT * path:
            return StepStatus.SERVED
        if par.fixed_step > 0.0:
            return StepStatus.STEP_TOO_LONG
        w.totals.rejected += 1
        step.h_next = _RETRY_SHARE * step.h * path / moved


@kernel
def is_resolved(w):
    """Return True if a fixed step resolves the contacts at its end."""
    par, mode = w.system.par, w.system.mode
    for i in range(2):
        depth = -w.step.end.gap[i]
        if not mode.touch[i].on or depth <= 0.0:
            continue
        stiffness, damping = contact_slope(depth, mode.touch[i].chi, par.contact)
        if par.fixed_step**2 * stiffness > _FIXED_ANGLE**2 * par.m_P:
            return False
        if par.fixed_step * damping > _FIXED_DECAY * par.m_P:
            return False
    return True


@kernel
def end_segment(w):
    """Set the end of the segment: the first event, the end of the run, or the end of the step.

    Writes the state at this end into ``w.y_end``; returns the StepStatus.
    """
    step, event, par, stepper = w.step, w.event, w.system.par, w.stepper
    if event.x <= 1.0:
        if par.fixed_step > 0.0:
            step.substeps += 1
            if step.substeps > _MAX_SUBSTEPS:
                # applied at the end of the step instead, if the distance is still negative
                event.x = 1.0
                if has_distance(event.kind):
                    value, _ = event_value(stepper.y_new, par, event.kind, event.which)
                    if value >= 0.0:
                        event.kind = NO_EVENT
        step.t1 = step.t0 + event.x * step.h
    if step.t1 >= w.progress.t_stop:
        step.t1 = w.progress.t_stop
        event.kind = EventKind.END
    step.x_end = 1.0
    if step.t1 < step.t0 + step.h:
        step.x_end = (step.t1 - step.t0) / step.h
        make_dense(w)
        dense(stepper, step.x_end, w.y_end, N_TOTAL)
    else:
        for i in range(N_TOTAL):
            w.y_end[i] = stepper.y_new[i]
    if event.kind != NO_EVENT:
        measure_distances(w, w.y_end)
    if (
        acts(par.contact)
        and not w.system.mode.latched
        and min(step.end.gap[0], step.end.gap[1]) < -_MAX_DEPTH_SHARE * par.R_t
    ):
        return StepStatus.TIP_THROUGH_WALL
    if w.y_end[4] <= par.R_t:
        return StepStatus.PROBE_IN_HINGE
    return StepStatus.SERVED


@kernel
def plan_step(w):
    """Take one accepted step of the integrator and end the segment at the first event in it.

    Returns the StepStatus.
    """
    step, stepper, event = w.step, w.stepper, w.event
    par, mode = w.system.par, w.system.mode
    step.segment = Segment.STEP
    if step.equations_changed:
        step.loads_kept = 0
        if begin_equations(w):
            return StepStatus.SERVED
    else:
        for i in range(N_TOTAL):
            stepper.K[0, i] = stepper.K[stepper.stages, i]
    status = step_within_path(w)
    if status != StepStatus.SERVED:
        return status
    if par.fixed_step > 0.0 and not is_resolved(w):
        return StepStatus.STEP_TOO_LONG
    search_step(w)
    in_contact = mode.touch[0].on or mode.touch[1].on or mode.stop or mode.latched
    if event.x < _NEAR_END and par.fixed_step == 0.0 and in_contact:
        h = min(_PAST_EVENT * event.x * step.h, step.h)
        if h > SMALLEST_STEP:
            h_next, kind, which = step.h_next, event.kind, event.which
            status = take_step(w, h)
            if status != StepStatus.SERVED:
                return status
            if step.h == h:
                step.h_next = h_next
                search_again(w, kind, which, 1.0 / _PAST_EVENT)
            else:
                search_step(w)
    return end_segment(w)


@kernel
def close_step(w, trace):
    """Move to the end of a segment of the integrator and apply its event.

    In contact, the sample at this end is appended to ``trace``, unless ``trace`` is empty.
    """
    step, stepper, progress, mode = w.step, w.stepper, w.progress, w.system.mode
    if step.h > 0.0:
        if step.t1 > step.t0:
            watch_extremes(w)
            watch_loads(w)
            if mode.thrusting or mode.driven:
                w.totals.work_thrust += work_inside(w, step.x_end, w.y_end)
        for i in range(N_TOTAL):
            stepper.y[i] = w.y_end[i]
        if step.x_end < 1.0:
            step.equations_changed = 1
        advance_distances(step)
    if step.t1 > step.t0 + SMALLEST_STEP:
        progress.events_at_t0 = progress.released_at_t0 = 0
    else:
        progress.events_at_t0 += 1
    step.t0 = step.t1
    if trace.shape[0] > 0 and (mode.touch[0].on or mode.touch[1].on):
        observe(step.t0, stepper.y, w, trace[progress.n_trace])
        progress.n_trace += 1
    apply_event(w)
