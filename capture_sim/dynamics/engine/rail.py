"""Motion on the rail, in closed form."""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import kernel
from capture_sim.dynamics.engine.consequences import log_event
from capture_sim.dynamics.engine.extremes import watch_rail
from capture_sim.dynamics.engine.state import NO_EVENT, Segment
from capture_sim.dynamics.model.equations import N_TOTAL, ROLLING
from capture_sim.dynamics.model.observe import rail_travel
from capture_sim.dynamics.samples import EventKind
from capture_sim.scene.launch_motion import (
    coasting_acceleration,
    pulled_acceleration,
    speed_at,
    stop_time,
    time_after,
)


@kernel
def moving_mass(w):
    """Return the mass that moves with the chaser on the rail, kg."""
    par = w.system.par
    return par.m_total + (par.m_hanging + par.pulley_mass if w.rail.taut else 0.0)


@kernel
def plan_rail(w):
    """Plan a segment on the rail, of constant forces and drag, until the next event."""
    step, rail, event, par = w.step, w.rail, w.event, w.system.par
    step.segment = Segment.RAIL
    event.kind = NO_EVENT
    next_event = EventKind.LANDED if rail.taut else EventKind.RAIL_END
    rail.damping = par.drag_S / moving_mass(w)
    if rail.taut:
        rail.acceleration = pulled_acceleration(
            par.m_hanging, par.gravity, par.rail_resistance, par.m_total, par.pulley_mass
        )
        if rail.speed == 0.0 and rail.acceleration < 0.0:
            rail.acceleration = 0.0
        goal = par.drop_height - rail.travel
    else:
        rail.acceleration = 0.0
        if rail.speed > 0.0:
            rail.acceleration = coasting_acceleration(par.rail_resistance, par.m_total)
        goal = par.rail_length - rail.travel
    step.t1 = math.inf
    lasts = time_after(rail.speed, rail.acceleration, rail.damping, goal)
    if goal <= 0.0:
        step.t1 = step.t0
        event.kind = next_event
    elif lasts < math.inf:
        step.t1 = step.t0 + lasts
        event.kind = next_event
    elif rail.acceleration < 0.0:
        # comes to rest on the rail before the goal
        step.t1 = step.t0 + stop_time(rail.speed, rail.acceleration, rail.damping)
        event.kind = EventKind.AT_REST
    if step.t1 > w.progress.t_stop:
        step.t1 = w.progress.t_stop
        event.kind = EventKind.END


@kernel
def rail_state(w, t, y_t):
    """Write the state on the rail at ``t`` (s) into ``y_t``: the buffer rides along at rest."""
    rail, par, y = w.rail, w.system.par, w.stepper.y
    along = rail_travel(w, t)
    speed = speed_at(rail.speed, rail.acceleration, rail.damping, t - w.step.t0)
    for i in range(N_TOTAL):
        y_t[i] = y[i]
    y_t[0] = y[0] + along * par.rail_x
    y_t[1] = y[1] + along * par.rail_y
    y_t[8] = speed * par.rail_x
    y_t[9] = speed * par.rail_y
    y_t[ROLLING] = y[ROLLING] + (par.rolling_limit_S * along if speed > 0.0 or along > 0.0 else 0.0)
    if rail.damping > 0.0:  # what the constant forces do, and no body has
        gained = 0.5 * (speed - rail.speed) * (speed + rail.speed)
        y_t[ROLLING] += moving_mass(w) * (rail.acceleration * along - gained)


@kernel
def close_rail(w):
    """Move to the end of a segment on the rail and apply its event."""
    step, rail, event = w.step, w.rail, w.event
    par, mode, y = w.system.par, w.system.mode, w.stepper.y
    t = step.t1
    y_t = w.scratch.on_rail
    rail_state(w, t, y_t)
    watch_rail(w, y_t)
    rail.travel += rail_travel(w, t)
    rail.speed = speed_at(rail.speed, rail.acceleration, rail.damping, t - step.t0)
    for i in range(N_TOTAL):
        y[i] = y_t[i]
    step.t0 = t
    if event.kind == EventKind.LANDED:
        rail.travel = par.drop_height
        w.totals.lost_landing += 0.5 * (par.m_hanging + par.pulley_mass) * rail.speed * rail.speed
        rail.taut = 0
        log_event(w, EventKind.LANDED).value = rail.speed
    elif event.kind == EventKind.RAIL_END:
        rail.on = 0
        step.equations_changed = 1
        log_event(w, EventKind.RAIL_END).value = rail.speed
    elif event.kind == EventKind.AT_REST:
        rail.speed = 0.0
        y[8] = 0.0
        y[9] = 0.0
        mode.rest_S = 1
        log_event(w, EventKind.AT_REST).which = 1
