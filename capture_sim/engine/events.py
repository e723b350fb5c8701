"""The first event in a step: what an event is, where it may lie, and its place to rounding.

Guaranteed are the events with a distance that has a rate (touch, lift-off, latch, stops): the
step is kept so short near them that value and rate at its ends, and a cubic through them, show
every dip.  Conditions without a rate (stick and slip, a vehicle set moving or slowing down) are
looked for at the quarters and at the end of a step; one that comes and goes within a quarter is
passed over, and with it a change of force that the error control has found too small to matter.
A preloaded probe leaves its seat where the load on it, which has a rate by a small move along the
motion, reaches the preload: the cubic through load and rate decides whether a step is looked into.
"""

from __future__ import annotations

import math

from capture_sim.engine.state import NO_EVENT, NO_WALL
from capture_sim.engine.steps import SMALL_MOVE, distance_to_edge, move, state_inside
from capture_sim.kernels import kernel
from capture_sim.model.contact import COULOMB
from capture_sim.model.equations import (
    accelerate_sticking,
    balance,
    gap_and_rate,
    slip_acceleration,
    slip_of,
    tip_in_cone,
)
from capture_sim.model.supports import fastest_ball, load_factor
from capture_sim.model.trig import sine_cosine
from capture_sim.samples import EventKind
from capture_sim.solver.roots import cubic_minimum, may_cross

#: Of the size of its changes: how far the cubic of a function over a step may be off.
_CUBIC_OFF = 0.05
#: Likewise over a quarter of a step or less.
_CUBIC_OFF_INSIDE = 0.02
#: A fall whose slope stays within these shares of its mean has one root, near the chord's.
_STRAIGHT = (0.7, 1.3)
#: Rounding of a place in a step.
_ROUNDING = 4e-16
#: m, of a distance: by what the first correction of its place goes beyond zero.
_DISTANCE_ROUNDING = 3e-17
#: Newton's last step: below this share of the place the next one is below rounding.
_NEWTON_DONE = 1e-9
#: Of the scene's speed: slip below it is rounding's, without direction.
SLIP_FLOOR = 1e-10
#: Of v_eps: below it a vehicle may be put at rest; see docs/model.md, supports.
_REST_SPEED = 5.0
#: Of the way from an event to the end of a step taken again: how far before that end it is sought.
_NEARBY = 3.0
_NOWHERE = 2.0  # beyond every place in a step


@kernel
def stop_distance(y, par, side):
    """Return the probe's way to a stroke stop and its rate; ``side`` -1 compressed, +1."""
    end = par.stop_compressed if side < 0 else par.stop_extended
    return side * (end - (y[4] - par.h_0)), -side * y[12]


@kernel
def event_value(y, par, kind, which):
    """Return an event's function and its rate; it goes below zero when the event happens."""
    if kind == EventKind.STOP_HIT:
        return stop_distance(y, par, which)
    if kind == EventKind.STOP_LEFT:
        g, d = stop_distance(y, par, which)
        return -g, -d
    if kind == EventKind.SEATED:
        return par.h_0 - y[4], -y[12]
    px, py, wx, wy = tip_in_cone(y, par)
    if kind == EventKind.LATCHED:
        distance, d = distance_to_edge(px, py, wx, wy, par)
        return distance - par.latch_radius, d
    g, d, _, _ = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * which, par)
    if kind == EventKind.TOUCH:
        return g, d
    return -g, -d


@kernel
def value_inside(w, x, kind, which):
    """Return an event's function and its rate at a place of the present step."""
    state_inside(w, x)
    return event_value(w.y_x, w.system.par, kind, which)


@kernel
def refine(w, kind, which, x_a, x_b, x):
    """Return where an event's function passes zero between x_a (>= 0) and x_b (< 0).

    Newton's method from ``x``, bisecting where that would leave the bracket; to rounding.
    """
    for _ in range(80):
        g, d = value_inside(w, x, kind, which)
        if g >= 0.0:
            x_a = x
        else:
            x_b = x
        if x_b - x_a <= _ROUNDING * x_b:
            break
        step = 0.0
        if d != 0.0:
            step = -g / (d * w.step.h)
        trial = x + step
        if d == 0.0 or not (x_a < trial < x_b):
            trial = 0.5 * (x_a + x_b)
        elif abs(step) <= _NEWTON_DONE * x:
            # the error after this step is of the order of its square
            x = trial
            break
        x = trial
    # rounding may leave it a hair short: what has been left must not be met again at once
    nudge = 0.5 * _ROUNDING * x
    for _ in range(40):
        g, d = value_inside(w, x, kind, which)
        if d < 0.0:
            nudge = max(nudge, -(g + _DISTANCE_ROUNDING) / (d * w.step.h))
        if g < 0.0 or x + nudge >= x_b:
            return x
        x += nudge
        nudge *= 2.0
    return x


@kernel
def first_crossing(w, kind, which):
    """Return the first place (0..1) in a step where an event's function goes below zero; 2 if none.

    One that falls nearly straight is followed down at once.  Else the step is looked at in
    quarters; in each, the cubic through value and slope of both ends points to where a dip
    would be.
    """
    h, par = w.step.h, w.system.par
    x_a = 0.0
    g_a, d_a = event_value(w.stepper.y, par, kind, which)
    if g_a <= 0.0 and d_a < 0.0:
        return 0.0
    g_a = max(g_a, 0.0)
    g_b, d_b = event_value(w.stepper.y_new, par, kind, which)
    fall = (g_a - g_b) / h
    least, most = _STRAIGHT
    if g_a > 0.0 > g_b and least * fall < min(-d_a, -d_b) and max(-d_a, -d_b) < most * fall:
        return refine(w, kind, which, 0.0, 1.0, g_a / (g_a - g_b))
    for quarter in range(4):
        x_b = 0.25 * (quarter + 1)
        g_b, d_b = value_inside(w, x_b, kind, which)
        low_a, low_g, low_d = x_a, g_a, d_a
        high_b, high_g, high_d = x_b, g_b, d_b
        for _ in range(6):
            if high_g < 0.0:
                break
            width = high_b - low_a
            place, low = cubic_minimum(low_g, low_d * h * width, high_g, high_d * h * width)
            slack = _CUBIC_OFF_INSIDE * h * width * (abs(low_d) + abs(high_d))
            if place < 0.0 or low > slack:
                break
            x_m = low_a + place * width
            g_m, d_m = value_inside(w, x_m, kind, which)
            if g_m >= 0.0 and d_m < 0.0:
                low_a, low_g, low_d = x_m, g_m, d_m
            else:
                high_b, high_g, high_d = x_m, g_m, d_m
        if high_g < 0.0:
            # the bracket must start above zero: what has just been left starts at it and rises
            if low_g == 0.0:
                trial = low_a + 0.5 * (high_b - low_a)
                for _ in range(60):
                    g_t, _ = value_inside(w, trial, kind, which)
                    if g_t > 0.0:
                        break
                    high_b = trial
                    trial = low_a + 0.5 * (trial - low_a)
                if trial - low_a < 1e-15:
                    return low_a
                low_a, low_g = trial, g_t
            start = 0.5 * (low_a + high_b)
            if low_d < 0.0:
                start = low_a + (high_b - low_a) * low_g / (low_g - high_g)
            return refine(w, kind, which, low_a, high_b, start)
        x_a, g_a, d_a = x_b, g_b, d_b
    return _NOWHERE


@kernel
def is_slow(y, par, which, times):
    """Return whether a vehicle is below ``times`` the speed at which it may be put at rest."""
    limit = times * _REST_SPEED * par.v_eps_ball
    first, heading, balls = (8, 2, par.balls_S) if which == 0 else (13, 7, par.balls_T)
    vx, vy, omega = y[first], y[first + 1], y[first + 2]
    # the first ball's speed at least, without sines
    turning = abs(omega) * (abs(balls[0, 0]) + abs(balls[0, 1]))
    if max(abs(vx), abs(vy)) > limit + turning:
        return False
    s, c = sine_cosine(y[heading])
    return fastest_ball(vx, vy, omega, c, s, balls) < limit


@kernel
def ratio_of_limit(y, par, hold, which):
    """Return which share of its supports' limit a vehicle needs to stay at rest.

    ``hold`` (6,) is what the supports must hold at ``y``, see ``OUT``.
    """
    if which == 0:
        s, c = sine_cosine(y[2])
        return load_factor(hold[0], hold[1], hold[2], c, s, par.balls_S)
    s, c = sine_cosine(y[7])
    return load_factor(hold[3], hold[4], hold[5], c, s, par.balls_T)


@kernel
def slip_margin(y, system, i):
    """Return how far the tip on wall ``i`` is from changing between sticking and sliding.

    Sliding: the slip in its direction, m/s.  Sticking: the force that is left, N.
    """
    par, mode, out = system.par, system.mode, system.out
    if not mode.touch[i].sticking:
        return slip_of(y, par, i) * mode.touch[i].direction + SLIP_FLOOR * par.speed_scale
    accelerate_sticking(y, system.spare[0], system)
    return par.mu_s * out.normal[i] - abs(out.friction_force[i])


@kernel
def seat_load(y, system):
    """Return the axial force of a seated probe, N; above the preload it leaves its seat."""
    balance(y, system.spare[0], system)
    return system.out.axial_force


@kernel
def measure_seat(w):
    """Write a seated probe's load and its rate at both ends of the step."""
    step, stepper, system = w.step, w.stepper, w.system
    load, rate, mode = step.seat_load, step.seat_load_rate, system.mode
    load[0] = seat_load(stepper.y, system)
    load[1] = seat_load(stepper.y_new, system)
    if mode.touch[0].on or mode.touch[1].on or mode.latched:
        small, near = SMALL_MOVE * step.h, stepper.y_stage
        move(stepper.y, stepper.K[0], small, 0, near)
        rate[0] = (seat_load(near, system) - load[0]) / small
        move(stepper.y_new, stepper.K[stepper.stages], -small, 0, near)
        rate[1] = (load[1] - seat_load(near, system)) / small
    else:
        rate[0] = rate[1] = (load[1] - load[0]) / step.h


@kernel
def where_seat_is_left(w):
    """Return a place (0..1) in the step by which a probe has left its seat; 2: none."""
    step, preload = w.step, w.system.par.preload
    start, end = preload - step.seat_load[0], preload - step.seat_load[1]
    if start <= 0.0 and w.progress.unseated_at_t0:
        # seated again at once: what lifts it is rounding's
        return _NOWHERE
    rate_a, rate_b = -step.h * step.seat_load_rate[0], -step.h * step.seat_load_rate[1]
    if end > 0.0 and not may_cross(max(start, 0.0), rate_a, end, rate_b, _CUBIC_OFF):
        return _NOWHERE
    place, _ = cubic_minimum(start, rate_a, end, rate_b)
    earliest = 1.0 if end <= 0.0 else _NOWHERE
    for k in range(4):
        x = 0.25 * (k + 1) if k < 3 else place
        if 0.0 < x < earliest:
            state_inside(w, x)
            if seat_load(w.y_x, w.system) >= preload:
                earliest = x
    return earliest


@kernel
def holds(y, system, kind, which):
    """Return whether a condition without a rate holds: MOVING, AT_REST, STICK or UNSEATED."""
    if kind == EventKind.UNSEATED:
        return seat_load(y, system) >= system.par.preload
    if kind == EventKind.MOVING:
        balance(y, system.spare[0], system)
        return ratio_of_limit(y, system.par, system.out.hold, which) > 1.0
    if kind == EventKind.AT_REST:
        return is_slow(y, system.par, which, 1.0)
    return slip_margin(y, system, which) <= 0.0


@kernel
def first_holding(w, kind, which, x_b):
    """Return the place before ``x_b``, where it holds, at which such a condition comes to hold.

    By bisection: it has just been left (sliding starts at slip zero) as often as not.
    """
    x_a = 0.0
    while x_b - x_a > 1e-15:
        x = 0.5 * (x_a + x_b)
        state_inside(w, x)
        if holds(w.y_x, w.system, kind, which):
            x_b = x
        else:
            x_a = x
    return x_b


@kernel
def where_slip_changes(w, i):
    """Return a place (0..1) in the step by which the slip margin of wall ``i`` is used up; 2: none.

    A tip may reverse twice within a step, and the force that holds it may swing: it is
    looked at inside the step too, while sliding only where the slip's rates allow a dip.
    """
    system, stepper = w.system, w.stepper
    end = slip_margin(stepper.y_new, system, i)
    if end <= 0.0:
        return 1.0
    place = -1.0
    if not system.mode.touch[i].sticking:
        width = system.mode.touch[i].direction * w.step.h
        start = max(slip_margin(stepper.y, system, i), 0.0)
        rate_a = width * slip_acceleration(stepper.y, stepper.K[0], system.par, i)
        rate_b = width * slip_acceleration(stepper.y_new, stepper.K[stepper.stages], system.par, i)
        if not may_cross(start, rate_a, end, rate_b, _CUBIC_OFF):
            return _NOWHERE
        place, _ = cubic_minimum(start, rate_a, end, rate_b)
    found = _NOWHERE
    for k in range(4):
        x = 0.25 * (k + 1) if k < 3 else place
        if 0.0 < x < found:
            state_inside(w, x)
            if slip_margin(w.y_x, system, i) <= 0.0:
                found = x
    return found


@kernel
def note_event(w, x, kind, which):
    """Keep the earliest event of a step."""
    event = w.event
    if x < event.place:
        event.place = x
        event.kind = kind
        event.which = which


@kernel
def search_step(w):
    """Find the first event in the step and write it to ``w.event``."""
    step, event, slow = w.step, w.event, w.progress.slow
    start, end = step.start, step.end
    par, mode = w.system.par, w.system.mode
    h = step.h
    event.place = _NOWHERE
    event.kind = NO_EVENT
    if not mode.latched:
        for i in range(2):
            kind = EventKind.LIFT_OFF if mode.touch[i].on else EventKind.TOUCH
            sign = -1.0 if mode.touch[i].on else 1.0
            g_a, d_a = max(sign * start.gap[i], 0.0), sign * start.gap_rate[i]
            g_b, d_b = sign * end.gap[i], sign * end.gap_rate[i]
            if may_cross(g_a, d_a * h, g_b, d_b * h, _CUBIC_OFF):
                note_event(w, first_crossing(w, kind, i), kind, i)
        if par.has_latch and may_cross(
            start.gap[2], start.gap_rate[2] * h, end.gap[2], end.gap_rate[2] * h, _CUBIC_OFF
        ):
            note_event(w, first_crossing(w, EventKind.LATCHED, NO_WALL), EventKind.LATCHED, NO_WALL)
        if par.friction_law == COULOMB:
            for i in range(2):
                if mode.touch[i].on:
                    x = where_slip_changes(w, i)
                    if x <= 1.0:
                        x = first_holding(w, EventKind.STICK, i, x)
                        note_event(w, x, EventKind.STICK, i)
    if par.has_stops:
        for side in (-1, 1):
            if mode.stop == -side or (side > 0 and par.stop_extended == math.inf):
                continue
            kind = EventKind.STOP_LEFT if mode.stop == side else EventKind.STOP_HIT
            g_a, d_a = event_value(w.stepper.y, par, kind, side)
            g_b, d_b = event_value(w.stepper.y_new, par, kind, side)
            if may_cross(max(g_a, 0.0), d_a * h, g_b, d_b * h, _CUBIC_OFF):
                note_event(w, first_crossing(w, kind, side), kind, side)
    if mode.seated:
        measure_seat(w)
        x = where_seat_is_left(w)
        if x <= 1.0:
            x = first_holding(w, EventKind.UNSEATED, NO_WALL, x)
            note_event(w, x, EventKind.UNSEATED, NO_WALL)
    elif par.preload > 0.0:
        kind = EventKind.SEATED
        g_a, d_a = event_value(w.stepper.y, par, kind, NO_WALL)
        g_b, d_b = event_value(w.stepper.y_new, par, kind, NO_WALL)
        # a probe that has just left its seat goes as t^3: the dip of a cubic is the cubic's then
        has_just_left = g_a <= 0.0 and d_a == 0.0
        if g_b < 0.0 or (not has_just_left and may_cross(g_a, d_a * h, g_b, d_b * h, _CUBIC_OFF)):
            note_event(w, first_crossing(w, kind, NO_WALL), kind, NO_WALL)
    if par.has_supports:
        for which in range(2):
            resting = mode.rest_S if which == 0 else mode.rest_T
            if resting and ratio_of_limit(w.stepper.y_new, par, step.hold, which) > 1.0:
                x = first_holding(w, EventKind.MOVING, which, 1.0)
                note_event(w, x, EventKind.MOVING, which)
            if not (resting or slow[which]) and is_slow(w.stepper.y_new, par, which, 1.0):
                x = first_holding(w, EventKind.AT_REST, which, 1.0)
                note_event(w, x, EventKind.AT_REST, which)


@kernel
def search_again(w, kind, which, x):
    """Find the first event in a step taken again, to just past the one that was found before.

    That one is near ``x``; where it is not, all of the step is searched.
    """
    event, par = w.event, w.system.par
    x_a = 1.0 - _NEARBY * (1.0 - x)
    has_distance = kind != EventKind.STICK and kind != EventKind.MOVING
    if has_distance and kind != EventKind.AT_REST and kind != EventKind.UNSEATED:
        g_b, _ = event_value(w.stepper.y_new, par, kind, which)
        if g_b < 0.0:
            g_a, _ = value_inside(w, x_a, kind, which)
            if g_a > 0.0:
                event.place = refine(w, kind, which, x_a, 1.0, x)
                event.kind = kind
                event.which = which
                return
    search_step(w)
