"""The loop over stretches and samples: what Python calls."""

from __future__ import annotations

from capture_sim.engine.notebook import END, EVENTS_FULL, NONE, PILE_UP, RAIL, SERVED, STEP
from capture_sim.engine.rail import close_rail_stretch, plan_rail_stretch, rail_state
from capture_sim.engine.steps import make_dense
from capture_sim.engine.stretches import close_step, plan_step
from capture_sim.engine.touches import end_touch, log_event
from capture_sim.kernels import entry_kernel
from capture_sim.model.equations import N_TOTAL, rate_of_change
from capture_sim.model.observe import observe
from capture_sim.solver.runge_kutta import dense

_EVENT_ROOM = 8  # events that one stretch may cause


@entry_kernel
def advance(
    parameters,
    modes,
    runs,
    pair,
    y,
    y_new,
    y_s,
    y_x,
    y_end,
    e_5,
    e_3,
    K,
    F,
    weights,
    scratch,
    work,
    times,
    samples,
    events,
    trace,
):
    """Run until all ``times`` are sampled, the run is over, or the room for events is used up.

    ``trace`` takes samples as well, at the ends of the steps in contact; without any room it
    takes none and costs nothing.

    Returns
    -------
    (status, served)
        One of SERVED, EVENTS_FULL and the reasons to stop after them; and how many samples were
        written.
    """
    par = parameters[0]
    mode = modes[0]
    run = runs[0]
    rows = pair[4].shape[0]
    k = 0
    while k < times.shape[0]:
        if run.stretch != NONE and times[k] <= run.t1:
            if run.stretch == RAIL:
                rail_state(par, run, times[k], y, y_x)
            elif run.h == 0.0:
                for i in range(N_TOTAL):
                    y_x[i] = y[i]
            else:
                make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
                dense(y, F, rows, (times[k] - run.t0) / run.h, y_x, N_TOTAL)
            observe(times[k], y_x, par, mode, run, scratch, samples[k])
            k += 1
            continue
        if run.done:
            break
        if run.n_events + _EVENT_ROOM > events.shape[0]:
            return EVENTS_FULL, k
        if trace.shape[0] > 0 and run.n_trace == trace.shape[0]:
            return EVENTS_FULL, k
        if run.stretch == RAIL:
            close_rail_stretch(par, run, mode, events, y, y_x)
        elif run.stretch == STEP:
            close_step(
                par, run, mode, pair, events, trace, y, y_new, y_s, y_x, y_end, K, F, scratch
            )
        if run.stretch != NONE and run.pending == END:
            for i in range(2):
                if mode.touching[i]:
                    end_touch(events, run, mode, run.t0, y, i)
            log_event(events, run, END, run.t0, y, 0, 0.0)
            run.done = 1
            run.stretch = NONE
            break
        if run.pile > 100:
            return PILE_UP, k
        if run.on_rail:
            plan_rail_stretch(par, run)
        else:
            status = plan_step(
                par, run, mode, pair, y, y_new, y_s, y_x, e_5, e_3, K, F, weights, scratch, work
            )
            if status != SERVED:
                run.stretch = NONE
                return status, k
    return SERVED, k


@entry_kernel
def energy_at_release(parameters, modes, runs, y, scratch, samples):
    """Return the energy that the ledger starts from, J."""
    observe(0.0, y, parameters[0], modes[0], runs[0], scratch, samples[0])
    s = samples[0]
    return s.kinetic + s.elastic_axial + s.elastic_torsion + s.elastic_contact + s.elastic_latch


@entry_kernel
def evaluate(parameters, modes, y, f, scratch):
    """Evaluate the equations of motion once, for benchmarks and other integrators."""
    rate_of_change(0.0, y, f, parameters[0], modes[0], scratch)
