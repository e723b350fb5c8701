"""The loop over segments and samples: what Python calls."""

from __future__ import annotations

from capture_sim.engine.consequences import end_touch, log_event
from capture_sim.engine.extremes import begin_extremes
from capture_sim.engine.rail import close_rail, plan_rail, rail_state
from capture_sim.engine.segment import close_step, plan_step
from capture_sim.engine.state import EVENT_ROOM, Segment, Status
from capture_sim.engine.steps import make_dense
from capture_sim.kernels import entry_kernel, kernel
from capture_sim.model.equations import N_STATE, N_TOTAL, rate_of_change
from capture_sim.model.observe import observe
from capture_sim.samples import EventKind
from capture_sim.solver.runge_kutta import dense

#: Events that one segment may cause.
_SEGMENT_EVENTS = 8
#: Events in a row without progress.
_MOST_PILED_UP = 100
#: Steps after which a call comes back, so that Ctrl-C is answered: some 50 ms.
_STEPS_PER_CALL = 20_000
#: Of the energy at release: less dissipation is rounding's, not to be taken for an error.
_ENERGY_ROUNDING = 1e-15


@kernel
def begin(w):
    """Set the energy that the ledger starts from, and what is dissipated within its rounding."""
    run, weights, s = w.run, w.step.weights, w.sample
    observe(run.t0, w.step.y, w.system, run, s)
    run.energy_0 = (
        s.kinetic + s.elastic_axial + s.elastic_torsion + s.elastic_contact + s.elastic_latch
    )
    rounding = _ENERGY_ROUNDING * run.energy_0
    for i in range(N_STATE, weights.shape[0]):
        if rounding * weights[i] > 1.0:
            weights[i] = 1.0 / rounding
    begin_extremes(w)
    run.begun = 1


@kernel
def end_run(w):
    """Close the touches that are still on and log the end."""
    for i in range(2):
        if w.system.mode.touching[i]:
            end_touch(w, i)
    log_event(w, EventKind.END)
    w.run.done = 1
    w.run.segment = Segment.NONE


@kernel
def sample_at(w, t, sample):
    """Sample the present segment at ``t``."""
    run, step, y_x = w.run, w.step, w.y_x
    if run.segment == Segment.RAIL:
        rail_state(w, t)
    elif run.h == 0.0:
        for i in range(N_TOTAL):
            y_x[i] = step.y[i]
    else:
        make_dense(w)
        dense(step, (t - run.t0) / run.h, y_x, N_TOTAL)
    observe(t, y_x, w.system, run, sample)


@entry_kernel
def advance(workspaces, times, samples, trace):
    """Run until all ``times`` are sampled or the run is over, as far as one call goes.

    ``trace`` takes samples as well, at the ends of the steps in contact; without any room it
    takes none and costs nothing.

    Returns how many samples were written; ``run.status`` says how it ended.
    """
    w = workspaces[0]
    run = w.run
    if not run.begun:
        begin(w)
    last_step = run.steps + _STEPS_PER_CALL
    k = 0
    while k < times.shape[0]:
        if run.segment != Segment.NONE and times[k] <= run.t1:
            sample_at(w, times[k], samples[k])
            k += 1
            continue
        if run.done:
            break
        if run.n_events + _SEGMENT_EVENTS > EVENT_ROOM or run.steps >= last_step:
            run.status = Status.INTERRUPTED
            return k
        if trace.shape[0] > 0 and run.n_trace == trace.shape[0]:
            run.status = Status.INTERRUPTED
            return k
        if run.segment == Segment.RAIL:
            close_rail(w)
        elif run.segment == Segment.STEP:
            latched = w.system.mode.latched
            close_step(w, trace)
            if w.system.mode.latched != latched:
                begin_extremes(w)
        if run.segment != Segment.NONE and run.pending == EventKind.END:
            end_run(w)
            break
        if run.pile > _MOST_PILED_UP:
            run.status = Status.PILE_UP
            return k
        if run.on_rail:
            plan_rail(w)
        else:
            status = plan_step(w)
            if status != Status.SERVED:
                run.segment = Segment.NONE
                run.status = status
                observe(run.t0, w.step.y, w.system, run, w.sample)
                return k
    run.status = Status.SERVED
    return k


@entry_kernel
def evaluate(systems, y, f):
    """Evaluate the equations of motion once, for benchmarks and other integrators."""
    rate_of_change(0.0, y, f, systems[0])
