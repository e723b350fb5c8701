"""What follows from an event: touches, slip, rest, stops, the latch; and its entry in the log."""

from __future__ import annotations

import math

from capture_sim.engine.events import is_slow, ratio_of_limit
from capture_sim.engine.state import NO_EVENT
from capture_sim.kernels import kernel
from capture_sim.model.equations import (
    HYSTERESIS,
    IMPULSE,
    N_STATE,
    ROLLING,
    accelerate_sticking,
    slip_of,
    tip_in_cone,
    wall_gap,
)
from capture_sim.model.observe import elastic_contact_energy, kinetic_energy
from capture_sim.samples import EventKind

#: Share of the supports' limit below which a slow vehicle is put at rest: at it, the smoothed
#: resistance would let it creep at 5 v_eps, r / sqrt(1 - r^2) = 5.
_REST_SHARE = 0.98
#: Of the time to the deepest penetration: the first step of a touch.  F ~ delta^1.5 costs a step
#: from 0 its order, its error grows as h^3.5, so at an rtol of 1e-8 it takes 5 %, at most 15 %.
_FIRST_SHARE, _LARGEST_SHARE, _ORDER_OF_FIRST = 0.05, 0.15, 3.5
_SHARE_RTOL = 1e-8
#: Of the step before the touch: the first one after it, in free flight again.
_FREE_SHARE = 0.3
#: A vehicle has left the slow speeds at this many times their limit: rounding must not make it
#: slow again at once.
_LEFT_SLOW = 2.0


@kernel
def log_event(w, kind):
    """Append an event at the present time and state; return its record, for wall and value."""
    run, y = w.run, w.step.y
    e = w.events[run.n_events]
    e.kind = kind
    e.t = run.t0
    e.wall = 0
    e.value = 0.0
    for i in range(8):
        e.q[i] = y[i]
        e.v[i] = y[8 + i]
    run.n_events += 1
    return e


@kernel
def end_touch(w, i):
    """Close the touch of wall ``i`` and log it."""
    run, mode, y = w.run, w.system.mode, w.step.y
    e = log_event(w, EventKind.LIFT_OFF)
    e.wall = 1 - 2 * i
    e.value = run.touch_peak[i]
    touch = e.touch
    touch.start = run.touch_start[i]
    touch.end = run.t0
    touch.wall = 1 - 2 * i
    touch.approach_speed = run.touch_speed[i]
    touch.peak_force = run.touch_peak[i]
    touch.peak_time = run.touch_peak_time[i]
    touch.impulse = y[IMPULSE + i] - run.touch_impulse[i]
    touch.dissipated = y[HYSTERESIS + i] - run.touch_hysteresis[i]
    touch.rate_ratio = run.touch_rate[i] / max(run.touch_speed[i], w.system.par.v_0_floor)
    mode.touching[i] = 0
    if not mode.touching[1 - i]:
        # in free flight again, where the step was of this size
        run.h_next = max(run.h_next, _FREE_SHARE * run.h_free)


@kernel
def begin_touch(w, i):
    """Latch the approach speed of wall ``i`` and switch its force on."""
    run, mode, par, y = w.run, w.system.mode, w.system.par, w.step.y
    px, py, wx, wy = tip_in_cone(y, par)
    _, rate, _, _ = wall_gap(px, py, wx, wy, 1.0 - 2.0 * i, par)
    speed = max(-rate, 0.0)
    mode.touching[i] = 1
    mode.chi[i] = par.hysteresis * par.K / max(speed, par.v_0_floor)
    mode.sticking[i] = 0
    mode.direction[i] = 1.0 if slip_of(y, par, i) >= 0.0 else -1.0
    run.touches += 1
    run.touch_start[i] = run.t0
    run.touch_speed[i] = speed
    run.touch_rate[i] = speed
    run.touch_peak[i] = 0.0
    run.touch_peak_time[i] = run.t0
    run.touch_impulse[i] = y[IMPULSE + i]
    run.touch_hysteresis[i] = y[HYSTERESIS + i]
    run.force[i] = 0.0
    run.force_rate[i] = 1.0
    e = log_event(w, EventKind.TOUCH)
    e.wall = 1 - 2 * i
    e.value = speed
    # a Hertz impact at this speed of the probe alone lasts about as long as this touch
    v = max(speed, par.v_0_floor)
    penetration = (1.25 * par.m_P * v * v / par.K) ** 0.4
    tighter = (par.rtol / _SHARE_RTOL) ** (1.0 / _ORDER_OF_FIRST)
    run.h_free = run.h_next
    run.h_next = min(run.h_next, min(_LARGEST_SHARE, _FIRST_SHARE * tighter) * penetration / v)


@kernel
def change_slip(w, i):
    """Let the tip on wall ``i`` stick if friction can hold it, else slide the way it must."""
    mode, out = w.system.mode, w.system.out
    was = mode.sticking[i]
    mode.sticking[i] = 1
    accelerate_sticking(w.step.y, w.system.spare[0], w.system)
    needed = out.rub[i]
    if not was and abs(needed) < w.system.par.mu_s * out.normal[i]:
        e = log_event(w, EventKind.STICK)
    else:
        mode.sticking[i] = 0
        # friction opposes the motion that it could not prevent
        mode.direction[i] = 1.0 if needed < 0.0 else -1.0
        e = log_event(w, EventKind.SLIP)
    e.wall = 1 - 2 * i
    e.value = needed


@kernel
def may_rest(w, which):
    """Return whether the supports could hold a vehicle if it stood still here."""
    for i in range(N_STATE):
        w.y_x[i] = w.step.y[i]
    first = 8 if which == 0 else 13
    for i in range(first, first + 3):
        w.y_x[i] = 0.0
    return ratio_of_limit(w.y_x, w.system, which) < _REST_SHARE


@kernel
def stop_vehicle(w, which):
    """Put a vehicle at rest if its supports can hold it; what speed it had left goes to them."""
    if not may_rest(w, which):
        return
    y, mode = w.step.y, w.system.mode
    before = kinetic_energy(y, w.system.par)
    first = 8 if which == 0 else 13
    for i in range(first, first + 3):
        y[i] = 0.0
    y[ROLLING] += before - kinetic_energy(y, w.system.par)
    if which == 0:
        mode.rest_S = 1
    else:
        mode.rest_T = 1
    w.run.fresh = 1
    w.run.measured = 0
    log_event(w, EventKind.AT_REST).wall = which + 1


@kernel
def latch_tip(w):
    """Close the latches: the tip is held where it is, the walls let go."""
    run, mode, par, y = w.run, w.system.mode, w.system.par, w.step.y
    px, py, wx, wy = tip_in_cone(y, par)
    for i in range(2):
        if mode.touching[i]:
            gap, _, _, _ = wall_gap(px, py, wx, wy, 1.0 - 2.0 * i, par)
            run.lost_latch += elastic_contact_energy(gap, par.K)
            end_touch(w, i)
    mode.latched = 1
    mode.latch_x = px
    mode.latch_y = py
    run.t_stop = min(run.t_stop, run.t0 + par.after_latch)
    log_event(w, EventKind.LATCHED).value = math.hypot(px + par.L_T, py)


@kernel
def draw_consequences(w):
    """Do what the event at the end of a step asks for; the state is the one there."""
    run, mode, y = w.run, w.system.mode, w.step.y
    pending, which = run.pending, run.pending_wall
    if w.system.par.has_supports:
        for vehicle in range(2):
            times = _LEFT_SLOW if run.slow[vehicle] else 1.0
            run.slow[vehicle] = is_slow(y, w.system.par, vehicle, times)
            resting = mode.rest_S if vehicle == 0 else mode.rest_T
            if pending == NO_EVENT and not resting and is_slow(y, w.system.par, vehicle, 1.0):
                stop_vehicle(w, vehicle)
    if pending == NO_EVENT:
        return
    run.fresh = 1
    if pending == EventKind.TOUCH:
        begin_touch(w, which)
    elif pending == EventKind.LIFT_OFF:
        end_touch(w, which)
    elif pending == EventKind.STICK:
        change_slip(w, which)
    elif pending == EventKind.AT_REST:
        run.slow[which] = 1
        stop_vehicle(w, which)
    elif pending == EventKind.MOVING:
        if which == 0:
            mode.rest_S = 0
        else:
            mode.rest_T = 0
        log_event(w, EventKind.MOVING).wall = which + 1
    elif pending == EventKind.LATCHED:
        latch_tip(w)
    elif pending == EventKind.STOP_HIT or pending == EventKind.STOP_LEFT:
        e = log_event(w, EventKind.STOP_HIT)
        e.kind = pending
        e.wall = which
        e.value = y[12]
        mode.stop = which if pending == EventKind.STOP_HIT else 0
