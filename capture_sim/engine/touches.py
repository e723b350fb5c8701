"""Events as they are logged; the beginning and the end of a touch; the latch."""

from __future__ import annotations

import math

from capture_sim.engine.notebook import LATCHED, LIFT_OFF, TOUCH_BEGINS
from capture_sim.kernels import kernel
from capture_sim.model.equations import HYSTERESIS, IMPULSE, slip_of, tip_in_cone, wall_gap
from capture_sim.model.observe import elastic_contact_energy


@kernel
def log_event(events, run, kind, t, y, wall, value):
    """Append an event with the state ``y`` and an empty touch."""
    e = events[run.n_events]
    e.kind = kind
    e.t = t
    e.wall = wall
    e.value = value
    for i in range(8):
        e.q[i] = y[i]
        e.v[i] = y[8 + i]
    run.n_events += 1


@kernel
def end_touch(events, run, mode, t, y, i):
    """Close the touch of wall ``i`` and log it."""
    log_event(events, run, LIFT_OFF, t, y, 1 - 2 * i, run.touch_peak[i])
    touch = events[run.n_events - 1].touch
    touch.start = run.touch_start[i]
    touch.end = t
    touch.wall = 1 - 2 * i
    touch.approach_speed = run.touch_speed[i]
    touch.peak_force = run.touch_peak[i]
    touch.peak_time = run.touch_peak_time[i]
    touch.impulse = y[IMPULSE + i] - run.touch_impulse[i]
    touch.dissipated = y[HYSTERESIS + i] - run.touch_hysteresis[i]
    mode.touching[i] = 0
    if not mode.touching[1 - i]:
        # in free flight again, where the step was of this size
        run.h_next = max(run.h_next, 0.3 * run.h_free)


@kernel
def begin_touch(events, run, mode, par, t, y, i):
    """Latch the approach speed of wall ``i`` and switch its force on."""
    px, py, wx, wy = tip_in_cone(y, par)
    _, rate, _, _ = wall_gap(px, py, wx, wy, 1.0 - 2.0 * i, par)
    speed = max(-rate, 0.0)
    mode.touching[i] = 1
    mode.chi[i] = par.hysteresis * par.K / max(speed, par.v_0_floor)
    mode.sticking[i] = 0
    mode.direction[i] = 1.0 if slip_of(y, par, i) >= 0.0 else -1.0
    run.touches += 1
    run.touch_start[i] = t
    run.touch_speed[i] = speed
    run.touch_peak[i] = 0.0
    run.touch_peak_time[i] = t
    run.touch_impulse[i] = y[IMPULSE + i]
    run.touch_hysteresis[i] = y[HYSTERESIS + i]
    run.force[i] = 0.0
    run.force_rate[i] = 1.0
    log_event(events, run, TOUCH_BEGINS, t, y, 1 - 2 * i, speed)
    # a Hertz impact at this speed of the probe alone lasts about as long as this touch
    v = max(speed, par.v_0_floor)
    depth = (1.25 * par.m_P * v * v / par.K) ** 0.4
    # F ~ delta^1.5 costs a step from 0 its order: its error grows as h^3.5
    share = min(0.15, 0.05 * (1e8 * par.rtol) ** (1.0 / 3.5))
    run.h_free = run.h_next
    run.h_next = min(run.h_next, share * depth / v)


@kernel
def latch_tip(par, run, mode, events, t, y):
    """Close the latches: the tip is held where it is, the walls let go."""
    px, py, wx, wy = tip_in_cone(y, par)
    for i in range(2):
        if mode.touching[i]:
            gap, _, _, _ = wall_gap(px, py, wx, wy, 1.0 - 2.0 * i, par)
            run.lost_latch += elastic_contact_energy(gap, par.K)
            end_touch(events, run, mode, t, y, i)
    mode.latched = 1
    mode.latch_x = px
    mode.latch_y = py
    run.t_stop = min(run.t_stop, t + par.after_latch)
    log_event(events, run, LATCHED, t, y, 0, math.hypot(px + par.L_T, py))
