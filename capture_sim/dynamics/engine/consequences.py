"""Application of an event to the bench's state, for each kind of event; it is then logged."""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import kernel
from capture_sim.dynamics.engine.events import (
    SLIDE,
    SLIP_FLOOR,
    held_load,
    hold_limits,
    is_held_at_rest,
    is_slow,
)
from capture_sim.dynamics.engine.state import NO_EVENT
from capture_sim.dynamics.engine.step_length import raise_speed_scale
from capture_sim.dynamics.model.contact import (
    damping_of_touch,
    elastic_contact_energy,
    expected_depth,
    normal_force,
)
from capture_sim.dynamics.model.equations import (
    HYSTERESIS,
    IMPULSE,
    N_STATE,
    NO_TOUCH,
    ROLLING,
    STOP,
    Hold,
    arrest_probe,
    gap_and_rate,
    slip_of,
    solve_accelerations,
    solve_sticking,
    tip_in_cone,
)
from capture_sim.dynamics.model.observe import kinetic_energy, mechanical_energy
from capture_sim.dynamics.samples import EventKind
from capture_sim.scene.laws import FrictionLaw

#: A slow vehicle is put at rest if its load is below this share r of the supports' limit.  At this
#: load, the smoothed resistance would let the vehicle creep at 5 v_eps: r / sqrt(1 - r^2) = 5.
_REST_SHARE = 0.98
#: First step of a touch, as a share of the time to the peak penetration: 5 % at an rtol of 1e-8,
#: at most 15 %.  F ~ delta^1.5 lowers the order of a step that starts at delta = 0: its error grows
#: as h^3.5.
_FIRST_SHARE, _LARGEST_SHARE, _ORDER_OF_FIRST = 0.05, 0.15, 3.5
_SHARE_RTOL = 1e-8
#: First step after a touch, as a share of the step before the touch.
_FREE_SHARE = 0.3
#: Multiple of the rest speed above which a vehicle no longer counts as slow.  It is above 1, so
#: that round-off does not make the vehicle slow again at once.
_LEFT_SLOW = 2.0
#: Multiple of the slip floor; a faster slip has reversed before its event was applied.
_LATE_SLIP = 2.0


@kernel
def log_event(w, kind):
    """Append an event at the present time and state to the log; return its record.

    The caller sets ``which`` and ``value``, which are 0.
    """
    progress, y = w.progress, w.stepper.y
    e = w.log[progress.n_log]
    e.kind = kind
    e.t = w.step.t0
    e.which = 0
    e.value = 0.0
    for i in range(8):
        e.q[i] = y[i]
        e.v[i] = y[8 + i]
    progress.n_log += 1
    return e


@kernel
def end_touch(w, i):
    """End the touch of wall ``i`` and log it."""
    step, mode, y = w.step, w.system.mode, w.stepper.y
    touch = mode.touch[i]
    e = log_event(w, EventKind.LIFT_OFF)
    e.which = 1 - 2 * i
    e.value = touch.peak_force
    logged = e.touch
    logged.start = touch.start
    logged.end = step.t0
    logged.wall = 1 - 2 * i
    logged.approach_speed = touch.approach_speed
    logged.peak_force = touch.peak_force
    logged.peak_time = touch.peak_time
    logged.impulse = y[IMPULSE + i] - touch.impulse_0
    logged.dissipated = y[HYSTERESIS + i] - touch.dissipated_0
    logged.rate_ratio = touch.largest_rate / max(touch.approach_speed, w.system.par.v_0_floor)
    mode.touch[i] = NO_TOUCH[0]
    if not mode.touch[1 - i].on:
        # free flight resumes: start from the step size that it had before the touch
        step.h_next = max(step.h_next, _FREE_SHARE * step.h_before_touch)


@kernel
def begin_touch(w, i):
    """Begin a touch of wall ``i``: store the approach speed, switch the force on and log it."""
    step, mode, par, y = w.step, w.system.mode, w.system.par, w.stepper.y
    px, py, wx, wy = tip_in_cone(y, par)
    _, rate, _, _ = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * i, par)
    speed = max(-rate, 0.0)
    mode.touch[i] = NO_TOUCH[0]
    touch = mode.touch[i]
    touch.on = 1
    touch.chi = par.chi
    if par.chi == 0.0:
        touch.chi = damping_of_touch(par.hysteresis, max(speed, par.v_0_floor), par.contact)
    touch.direction = 1.0 if slip_of(y, par, i) >= 0.0 else -1.0
    touch.start = step.t0
    touch.approach_speed = speed
    touch.largest_rate = speed
    touch.peak_time = step.t0
    touch.impulse_0 = y[IMPULSE + i]
    touch.dissipated_0 = y[HYSTERESIS + i]
    raise_speed_scale(w)
    w.totals.touches += 1
    e = log_event(w, EventKind.TOUCH)
    e.which = 1 - 2 * i
    e.value = speed
    # this touch lasts about as long as an elastic impact of the probe alone at this speed
    v = max(speed, par.v_0_floor)
    penetration = expected_depth(par.m_P, v, par.contact)
    tighter = (par.rtol / _SHARE_RTOL) ** (1.0 / _ORDER_OF_FIRST)
    touch.depth = penetration
    step.h_before_touch = step.h_next
    share = min(_LARGEST_SHARE, _FIRST_SHARE * tighter)
    step.h_next = min(step.h_next, share * penetration / v)


@kernel
def change_slip(w, i):
    """End sticking or sliding of the tip on wall ``i``, and log what follows.

    A sticking tip slides.  A sliding one sticks if friction can hold it, else it slides the other
    way.
    """
    mode, out, par = w.system.mode, w.system.out, w.system.par
    touch = mode.touch[i]
    was_sticking = touch.sticking
    slip = slip_of(w.stepper.y, par, i)
    touch.sticking = 1
    solve_sticking(w.stepper.y, w.system.spare[0], w.system)
    needed = out.friction_force[i]
    # a fixed step may apply the event late: the tip then already slides in the other direction
    slides = not was_sticking and abs(slip) > _LATE_SLIP * SLIP_FLOOR * par.speed_scale
    if not (was_sticking or slides) and abs(needed) < par.mu_s * out.normal[i]:
        e = log_event(w, EventKind.STICK)
    else:
        touch.sticking = 0
        # the slip is opposite to the friction force that could not hold the tip
        forward = slip > 0.0 if slides else needed < 0.0
        touch.direction = 1.0 if forward else -1.0
        e = log_event(w, EventKind.SLIP)
    e.which = 1 - 2 * i
    e.value = needed


@kernel
def may_rest(w, which):
    """Return True if the supports could hold a vehicle at rest in the present position."""
    y = w.scratch.halted
    for i in range(N_STATE):
        y[i] = w.stepper.y[i]
    first = 8 if which == 0 else 13
    for i in range(first, first + 3):
        y[i] = 0.0
    solve_accelerations(y, w.system.spare[0], w.system)
    return is_held_at_rest(y, w.system.par, w.system.out.hold, which, _REST_SHARE)


@kernel
def stop_vehicle(w, which):
    """Put a vehicle at rest if its supports can hold it; they dissipate its kinetic energy."""
    if not may_rest(w, which):
        return
    y, mode = w.stepper.y, w.system.mode
    before = kinetic_energy(y, w.system.par)
    first = 8 if which == 0 else 13
    for i in range(first, first + 3):
        y[i] = 0.0
    y[ROLLING] += before - kinetic_energy(y, w.system.par)
    if which == 0:
        mode.rest_S = 1
    else:
        mode.rest_T = 1
    w.step.equations_changed = 1
    w.step.start_measured = 0
    log_event(w, EventKind.AT_REST).which = which + 1


@kernel
def latch_tip(w):
    """Close the latch at the present position of the tip; the walls then no longer act."""
    progress, mode, par, y = w.progress, w.system.mode, w.system.par, w.stepper.y
    px, py, wx, wy = tip_in_cone(y, par)
    for i in range(2):
        if mode.touch[i].on:
            gap, _, _, _ = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * i, par)
            w.totals.lost_latch += elastic_contact_energy(gap, par.contact)
            end_touch(w, i)
    mode.latched = 1
    w.step.start_measured = 0
    mode.latch_x = px
    mode.latch_y = py
    progress.t_end = min(progress.t_end, w.step.t0 + par.after_latch)
    progress.t_stop = min(progress.t_stop, progress.t_end)
    log_event(w, EventKind.LATCHED).value = math.hypot(px + par.L_T, py)


@kernel
def follow_jump(w, i):
    """Update the touch of wall ``i`` after a jump of the velocities.

    A finite friction force cannot prevent slip during a jump.
    """
    step, par, y = w.step, w.system.par, w.stepper.y
    touch = w.system.mode.touch[i]
    px, py, wx, wy = tip_in_cone(y, par)
    gap, rate, _, _ = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * i, par)
    touch.largest_rate = max(touch.largest_rate, -rate)
    force, _ = normal_force(-gap, -rate, touch.chi, par.contact)
    if force > touch.peak_force:
        touch.peak_force = force
        touch.peak_time = step.t0
    slip = slip_of(y, par, i)
    if par.friction_law != FrictionLaw.COULOMB or abs(slip) <= SLIP_FLOOR * par.speed_scale:
        return
    if touch.sticking or slip * touch.direction < 0.0:
        touch.sticking = 0
        touch.direction = 1.0 if slip > 0.0 else -1.0
        e = log_event(w, EventKind.SLIP)
        e.which = 1 - 2 * i
        e.value = math.inf


@kernel
def end_slide(w):
    """Add the energy that friction in the slide dissipated since the probe began to slide."""
    mode, totals, y = w.system.mode, w.totals, w.stepper.y
    slid = mode.slide_direction * (y[4] - totals.slide_from)
    totals.lost_slide += w.system.par.slide_friction * slid
    mode.slide_direction = 0.0


@kernel
def begin_slide(w, direction):
    """Set the probe sliding; friction opposes ``direction``, +1 outwards or -1 inwards."""
    w.system.mode.held = Hold.NONE
    w.totals.slide_from = w.stepper.y[4]
    if w.system.par.slide_friction > 0.0:
        w.system.mode.slide_direction = direction


@kernel
def turn_slide(w):
    """Hold the probe, whose slip has ended, if friction can hold it; otherwise set it sliding."""
    mode, par, y = w.system.mode, w.system.par, w.stepper.y
    end_slide(w)
    # a fixed step may apply the event late: the probe then already slides in the other direction
    if par.fixed_step > 0.0 and abs(y[12]) > _LATE_SLIP * SLIP_FLOOR * par.speed_scale:
        begin_slide(w, math.copysign(1.0, y[12]))
        log_event(w, EventKind.SLIP).value = par.slide_friction
        return
    if mode.rest_S:
        y[12] = 0.0
    else:
        w.totals.lost_slide += arrest_probe(y, par)
    w.step.start_measured = 0
    mode.held = Hold.FRICTION
    load = held_load(y, w.system)
    lower, upper = hold_limits(y, w.system)
    needed = load - 0.5 * (lower + upper)
    if lower < load < upper:
        log_event(w, EventKind.STICK).value = needed
    else:
        begin_slide(w, 1.0 if needed < 0.0 else -1.0)
        log_event(w, EventKind.SLIP).value = needed


@kernel
def release_probe(w):
    """Set a held probe sliding, in the direction in which its load exceeds the holding force."""
    y, kind = w.stepper.y, EventKind.UNSEATED
    load = held_load(y, w.system)
    lower, upper = hold_limits(y, w.system)
    value, direction = upper, -1.0
    if w.system.mode.held == Hold.FRICTION:
        kind, value = EventKind.SLIP, load - 0.5 * (lower + upper)
        direction = 1.0 if value < 0.0 else -1.0
    begin_slide(w, direction)
    w.progress.released_at_t0 = 1
    log_event(w, kind).value = value


@kernel
def seat_probe(w):
    """Bring the probe to rest on its seat; if the chaser was at rest, the impact moves it."""
    mode, par, y = w.system.mode, w.system.par, w.stepper.y
    log_event(w, EventKind.SEATED).value = y[12]
    end_slide(w)
    if par.fixed_step > 0.0:
        # the event may be applied late, with the probe beyond its seat
        before = mechanical_energy(y, w.system)
        y[4] = par.h_0
        y[STOP] += before - mechanical_energy(y, w.system)
        w.step.start_measured = 0
    y[4] = par.h_0
    mode.held = Hold.SEAT
    if y[12] == 0.0:
        return
    y[STOP] += arrest_probe(y, par)
    w.step.start_measured = 0
    for i in range(2):
        if mode.touch[i].on:
            follow_jump(w, i)
    if mode.rest_S:
        mode.rest_S = 0
        log_event(w, EventKind.MOVING).which = 1


@kernel
def apply_event(w):
    """Apply the event of the segment; the state is already that at the event."""
    mode, y, slow = w.system.mode, w.stepper.y, w.progress.slow
    kind, which = w.event.kind, w.event.which
    if w.system.par.has_supports:
        for vehicle in range(2):
            factor = _LEFT_SLOW if slow[vehicle] else 1.0
            slow[vehicle] = is_slow(y, w.system.par, vehicle, factor)
            resting = mode.rest_S if vehicle == 0 else mode.rest_T
            if kind == NO_EVENT and not resting and is_slow(y, w.system.par, vehicle, 1.0):
                stop_vehicle(w, vehicle)
    if kind == NO_EVENT:
        return
    w.step.equations_changed = 1
    if kind == EventKind.TOUCH:
        begin_touch(w, which)
    elif kind == EventKind.LIFT_OFF:
        end_touch(w, which)
    elif kind == EventKind.STICK and which == SLIDE:
        turn_slide(w)
    elif kind == EventKind.STICK:
        change_slip(w, which)
    elif kind == EventKind.AT_REST:
        slow[which] = 1
        stop_vehicle(w, which)
    elif kind == EventKind.MOVING:
        if which == 0:
            mode.rest_S = 0
        else:
            mode.rest_T = 0
        log_event(w, EventKind.MOVING).which = which + 1
    elif kind == EventKind.LATCHED:
        latch_tip(w)
    elif kind == EventKind.STOP_HIT or kind == EventKind.STOP_LEFT:
        e = log_event(w, EventKind.STOP_HIT)
        e.kind = kind
        e.which = which
        e.value = y[12]
        mode.stop = which if kind == EventKind.STOP_HIT else 0
    elif kind == EventKind.SEATED:
        seat_probe(w)
    elif kind == EventKind.UNSEATED or kind == EventKind.SLIP:
        release_probe(w)
