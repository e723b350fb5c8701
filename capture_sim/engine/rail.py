"""Motion on the rail, in closed form."""

from __future__ import annotations

import math

from capture_sim.engine.notebook import AT_REST, END, LANDED, NO_EVENT, RAIL, RAIL_END
from capture_sim.engine.touches import log_event
from capture_sim.kernels import kernel
from capture_sim.model.equations import ROLLING
from capture_sim.model.observe import speed_travel


@kernel
def plan_rail_stretch(par, run):
    """Set up the present stretch on the rail: constant acceleration until the next event."""
    run.stretch = RAIL
    run.pending = NO_EVENT
    if run.taut:
        pull = par.m_hanging * par.gravity - par.rolling_limit_S
        run.acceleration = pull / (par.m_total + par.m_hanging + par.pulley_mass)
        if run.speed == 0.0 and pull <= 0.0:
            run.acceleration = 0.0
        goal, event = par.drop_height - run.travel, LANDED
    else:
        run.acceleration = -par.rolling_limit_S / par.m_total if run.speed > 0.0 else 0.0
        goal, event = par.rail_length - run.travel, RAIL_END
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
        run.pending = AT_REST
    if run.t1 > run.t_stop:
        run.t1 = run.t_stop
        run.pending = END


@kernel
def rail_state(par, run, t, y, y_x):
    """Write the state on the rail at ``t`` into ``y_x``: the buffer rides along at rest."""
    along = speed_travel(run, t)
    speed = run.speed + run.acceleration * (t - run.t0)
    for i in range(y.shape[0]):
        y_x[i] = y[i]
    y_x[0] = y[0] + along * par.rail_x
    y_x[1] = y[1] + along * par.rail_y
    y_x[8] = speed * par.rail_x
    y_x[9] = speed * par.rail_y
    y_x[ROLLING] = y[ROLLING] + (par.rolling_limit_S * along if speed > 0.0 or along > 0.0 else 0.0)


@kernel
def close_rail_stretch(par, run, mode, events, y, y_x):
    """Move to the end of a stretch on the rail and draw the consequences."""
    t = run.t1
    rail_state(par, run, t, y, y_x)
    run.travel += speed_travel(run, t)
    run.speed += run.acceleration * (t - run.t0)
    if run.pending == LANDED:
        run.travel = par.drop_height
    for i in range(y.shape[0]):
        y[i] = y_x[i]
    run.t0 = t
    if run.pending == LANDED:
        run.lost_landing += 0.5 * (par.m_hanging + par.pulley_mass) * run.speed * run.speed
        run.taut = 0
        log_event(events, run, LANDED, t, y, 0, run.speed)
    elif run.pending == RAIL_END:
        run.on_rail = 0
        run.fresh = 1
        log_event(events, run, RAIL_END, t, y, 0, run.speed)
    elif run.pending == AT_REST:
        run.speed = 0.0
        y[8] = 0.0
        y[9] = 0.0
        mode.rest_S = 1
        log_event(events, run, AT_REST, t, y, 1, 0.0)
