"""Motion on the rail, in closed form."""

from __future__ import annotations

import math

from capture_sim.engine.consequences import log_event
from capture_sim.engine.extremes import watch_rail
from capture_sim.engine.state import NO_EVENT, Segment
from capture_sim.kernels import kernel
from capture_sim.model.equations import N_TOTAL, ROLLING
from capture_sim.model.observe import speed_travel
from capture_sim.samples import EventKind


@kernel
def plan_rail(w):
    """Set up the present segment on the rail: constant acceleration until the next event."""
    run, par = w.run, w.system.par
    run.segment = Segment.RAIL
    run.pending = NO_EVENT
    event = EventKind.LANDED if run.taut else EventKind.RAIL_END
    if run.taut:
        pull = par.m_hanging * par.gravity - par.rolling_limit_S
        run.acceleration = pull / (par.m_total + par.m_hanging + par.pulley_mass)
        if run.speed == 0.0 and pull <= 0.0:
            run.acceleration = 0.0
        goal = par.drop_height - run.travel
    else:
        run.acceleration = -par.rolling_limit_S / par.m_total if run.speed > 0.0 else 0.0
        goal = par.rail_length - run.travel
    run.t1 = math.inf
    square = run.speed * run.speed + 2.0 * run.acceleration * goal
    if goal <= 0.0:
        run.t1 = run.t0
        run.pending = event
    elif square > 0.0 and run.speed + math.sqrt(square) > 0.0:
        run.t1 = run.t0 + 2.0 * goal / (run.speed + math.sqrt(square))
        run.pending = event
    elif run.acceleration < 0.0:
        # comes to rest on the rail before the goal
        run.t1 = run.t0 - run.speed / run.acceleration
        run.pending = EventKind.AT_REST
    if run.t1 > run.t_stop:
        run.t1 = run.t_stop
        run.pending = EventKind.END


@kernel
def rail_state(w, t):
    """Write the state on the rail at ``t`` into ``w.y_x``: the buffer rides along at rest."""
    run, par, y, y_x = w.run, w.system.par, w.step.y, w.y_x
    along = speed_travel(run, t)
    speed = run.speed + run.acceleration * (t - run.t0)
    for i in range(N_TOTAL):
        y_x[i] = y[i]
    y_x[0] = y[0] + along * par.rail_x
    y_x[1] = y[1] + along * par.rail_y
    y_x[8] = speed * par.rail_x
    y_x[9] = speed * par.rail_y
    y_x[ROLLING] = y[ROLLING] + (par.rolling_limit_S * along if speed > 0.0 or along > 0.0 else 0.0)


@kernel
def close_rail(w):
    """Move to the end of a segment on the rail and draw the consequences."""
    run, par, mode, y = w.run, w.system.par, w.system.mode, w.step.y
    t = run.t1
    rail_state(w, t)
    watch_rail(w, w.y_x)
    run.travel += speed_travel(run, t)
    run.speed += run.acceleration * (t - run.t0)
    for i in range(N_TOTAL):
        y[i] = w.y_x[i]
    run.t0 = t
    if run.pending == EventKind.LANDED:
        run.travel = par.drop_height
        run.lost_landing += 0.5 * (par.m_hanging + par.pulley_mass) * run.speed * run.speed
        run.taut = 0
        log_event(w, EventKind.LANDED).value = run.speed
    elif run.pending == EventKind.RAIL_END:
        run.on_rail = 0
        run.fresh = 1
        log_event(w, EventKind.RAIL_END).value = run.speed
    elif run.pending == EventKind.AT_REST:
        run.speed = 0.0
        y[8] = 0.0
        y[9] = 0.0
        mode.rest_S = 1
        log_event(w, EventKind.AT_REST).wall = 1
