"""The loop over segments and samples, with the entries that Python calls."""

from __future__ import annotations

from capture_sim.base.compiled.kernels import entry_kernel, kernel
from capture_sim.dynamics.engine.consequences import end_touch, log_event
from capture_sim.dynamics.engine.extremes import begin_extremes
from capture_sim.dynamics.engine.rail import close_rail, plan_rail, rail_state
from capture_sim.dynamics.engine.segment import close_step, plan_step
from capture_sim.dynamics.engine.state import LOG_ROOM, Segment, StepStatus
from capture_sim.dynamics.engine.step_length import raise_speed_scale
from capture_sim.dynamics.engine.steps import make_dense
from capture_sim.dynamics.engine.work import work_inside
from capture_sim.dynamics.model.equations import N_STATE, N_TOTAL, rate_of_change
from capture_sim.dynamics.model.observe import floor_work, observe
from capture_sim.dynamics.samples import EventKind
from capture_sim.dynamics.solver.runge_kutta import dense

#: Largest number of log entries of one segment.
_SEGMENT_EVENTS = 8
#: Events in a row at one time; more stop the run.
_MAX_EVENTS_AT_T0 = 100
#: Steps of one call, about 50 ms, so that Ctrl-C is answered.
_STEPS_PER_CALL = 20_000
#: Share of the energy at the release; a smaller dissipation is round-off error.
_ENERGY_ROUNDING = 1e-15
#: Largest energy residual of a run with fixed steps, as a share of the energy of its bodies.
_MAX_RESIDUAL = 0.02


@kernel
def begin(w):
    """Store the energy at the release, and prepare error control and extremes for a new run.

    Dissipated energies are not controlled more accurately than the round-off of this energy.
    """
    totals, weights, s = w.totals, w.stepper.weights, w.sample
    observe(w.step.t0, w.stepper.y, w, s)
    totals.floor_0 = floor_work(w.stepper.y, w.system.par)
    totals.energy_0 = (
        s.kinetic + s.elastic_axial + s.elastic_torsion + s.elastic_contact + s.elastic_latch
    )
    rounding = _ENERGY_ROUNDING * totals.energy_0
    for i in range(N_STATE, weights.shape[0]):
        if rounding * weights[i] > 1.0:
            weights[i] = 1.0 / rounding
    begin_extremes(w)
    w.progress.begun = 1


@kernel
def end_run(w):
    """End the present touches and log the end of the run."""
    for i in range(2):
        if w.system.mode.touch[i].on:
            end_touch(w, i)
    log_event(w, EventKind.END)
    w.progress.done = 1
    w.step.segment = Segment.NONE


@kernel
def keeps_energy(w):
    """Return False if the energies of a run with fixed steps do not balance at its end.

    The steps were then too long.  The sample at the end of the run is left in ``w.sample``.
    """
    par, totals, s = w.system.par, w.totals, w.sample
    if par.fixed_step == 0.0:
        return True
    observe(w.step.t0, w.stepper.y, w, s)
    supplied = totals.energy_0 + s.work_string + abs(s.work_thrust) + abs(s.work_floor)
    supplied -= totals.lost_landing
    return abs(s.energy_residual) <= _MAX_RESIDUAL * supplied


@kernel
def sample_at(w, t, sample):
    """Write the sample of the present segment at the time ``t`` (s) into ``sample``."""
    step, stepper, y = w.step, w.stepper, w.scratch.sampled
    if step.segment == Segment.RAIL:
        rail_state(w, t, y)
    elif step.h == 0.0:
        for i in range(N_TOTAL):
            y[i] = stepper.y[i]
    else:
        make_dense(w)
        dense(stepper, (t - step.t0) / step.h, y, N_TOTAL)
    observe(t, y, w, sample)
    acts = w.system.mode.thrusting or w.system.mode.driven
    if acts and step.segment == Segment.STEP:
        work = work_inside(w, (t - step.t0) / step.h if step.h > 0.0 else 0.0, y)
        sample.work_thrust += work
        sample.energy_residual -= work


@entry_kernel
def advance(workspaces, times, samples, trace):
    """Run until all ``times`` (s) are sampled, the run has ended, or the call must be repeated.

    It must be repeated (status INTERRUPTED) after 20 000 steps, and if the event log or ``trace``
    is full.  ``trace`` receives a sample at the end of each step in contact, unless it is empty.
    Returns the number of samples written into ``samples``; ``progress.status`` has the StepStatus.
    """
    w = workspaces[0]
    step, progress, totals = w.step, w.progress, w.totals
    if not progress.begun:
        begin(w)
    raise_speed_scale(w)
    last_step = totals.steps + _STEPS_PER_CALL
    k = 0
    while k < times.shape[0]:
        if step.segment != Segment.NONE and times[k] <= step.t1:
            sample_at(w, times[k], samples[k])
            k += 1
            continue
        if progress.done:
            break
        if progress.n_log + _SEGMENT_EVENTS > LOG_ROOM or totals.steps >= last_step:
            progress.status = StepStatus.INTERRUPTED
            return k
        if trace.shape[0] > 0 and progress.n_trace == trace.shape[0]:
            progress.status = StepStatus.INTERRUPTED
            return k
        if step.segment == Segment.RAIL:
            close_rail(w)
        elif step.segment == Segment.STEP:
            latched = w.system.mode.latched
            close_step(w, trace)
            if w.system.mode.latched != latched:
                begin_extremes(w)
        if step.segment != Segment.NONE and w.event.kind == EventKind.END:
            if w.system.mode.driven or step.t0 < progress.t_end:
                step.segment = Segment.NONE  # until the next wrench
                break
            end_run(w)
            if not keeps_energy(w):
                progress.status = StepStatus.ENERGY_LOST
                return k
            break
        if progress.events_at_t0 > _MAX_EVENTS_AT_T0:
            progress.status = StepStatus.PILE_UP
            observe(step.t0, w.stepper.y, w, w.sample)
            return k
        if w.rail.on:
            plan_rail(w)
        else:
            status = plan_step(w)
            if status != StepStatus.SERVED:
                step.segment = Segment.NONE
                progress.status = status
                observe(step.t0, w.stepper.y, w, w.sample)
                return k
    progress.status = StepStatus.SERVED
    return k


@entry_kernel
def evaluate(systems, y, f):
    """Write the time derivative of the state ``y`` into ``f``, for use by other integrators."""
    rate_of_change(0.0, y, f, systems[0])
