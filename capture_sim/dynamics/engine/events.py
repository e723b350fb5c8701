"""The first event in a step: its definition, its search, and its time to round-off.

Every touch, lift-off, latch and stop event is found, because each has a distance with a known rate.
Near such an event the step is so short that the cubic through value and rate at both ends shows
every minimum.  Conditions without a rate (stick and slip, a vehicle that starts to move or slows
down) are checked at the quarters and the end of a step.  A condition that is met only within a
quarter is missed; this changes the forces by less than the error control permits.

A probe that is held by its seat or by friction begins to slide when the load reaches a limit.  The
rate of the load is a difference quotient along the motion.  The step is searched if the cubic
through load and rate may reach the limit.
"""

from __future__ import annotations

import math

import numpy as np

from capture_sim.base.compiled.kernels import inline_kernel, kernel
from capture_sim.dynamics.engine.state import NO_EVENT, NO_WALL
from capture_sim.dynamics.engine.steps import SMALL_MOVE, distance_to_edge, move_along, state_inside
from capture_sim.dynamics.model.contact import acts
from capture_sim.dynamics.model.equations import (
    Hold,
    axial_force,
    gap_and_rate,
    slip_acceleration,
    slip_of,
    solve_accelerations,
    solve_sticking,
    stop_force,
    tip_in_cone,
)
from capture_sim.dynamics.model.supports import fastest_ball, is_held, load_factor
from capture_sim.dynamics.model.trig import sine_cosine
from capture_sim.dynamics.samples import EventKind
from capture_sim.dynamics.solver.roots import cubic_minimum, itp_trial, may_cross
from capture_sim.scene.laws import FrictionLaw

#: Error of a function's cubic over a step, as a share of the function's changes.
_CUBIC_ERROR = 0.05
#: Error of a function's cubic over a quarter of a step or less, as the same share.
_CUBIC_ERROR_INSIDE = 0.02
#: A function whose slopes at both ends are within these shares of its mean slope has one root, near
#: the root of the chord.
_STRAIGHT_SLOPES = (0.7, 1.3)
#: Round-off of a fraction of the step.
_ROUNDING = 4e-16
#: Distance below zero at which the first correction for round-off aims, m.
_DISTANCE_ROUNDING = 3e-17
#: Newton's method ends with a correction below this share of the fraction: the next correction
#: would be round-off.
_NEWTON_DONE = 1e-9
#: Share of the scene's speed scale; a smaller slip is round-off and has no direction.
SLIP_FLOOR = 1e-10
#: Number of the buffer's slide where stick and slip are handled; 0 and 1 are the walls.
SLIDE = np.int64(2)
#: Rest speed as a multiple of v_eps; a slower vehicle may be put at rest, see docs/model.md,
#: supports.
_REST_SPEED = 5.0
#: The bracket of the event in a repeated step is this many times its expected distance to the end.
_BRACKET_FACTOR = 3.0
#: Smallest fraction of the step at which a function that rises from zero is evaluated.
_SHORTEST_RISE = 1e-15
#: Accuracy to which the zero of a margin is located, as a share of the step.
_MARGIN_WIDTH = 1e-15
_NO_CROSSING = 2.0  # beyond the end of the step


@kernel
def stop_distance(y, par, side):
    """Return the distance to a stroke stop (-1 compressed, +1 extended), m, and its rate, m/s."""
    end = par.stop_compressed if side < 0 else par.stop_extended
    return side * (end - (y[4] - par.h_0)), -side * y[12]


@inline_kernel
def has_distance(kind):
    """Return True if a kind of event has a distance with a rate, see :func:`event_value`."""
    is_vehicle = kind == EventKind.MOVING or kind == EventKind.AT_REST
    is_slip = kind == EventKind.STICK or kind == EventKind.SLIP
    return not (is_vehicle or is_slip or kind == EventKind.UNSEATED)


@kernel
def event_value(y, par, kind, which):
    """Return an event's function and its rate; the event happens when it falls below zero."""
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
    """Return an event's function and its rate at the fraction ``x`` of the present step."""
    y = w.scratch.sought
    state_inside(w, x, y)
    return event_value(y, w.system.par, kind, which)


@kernel
def refine(w, kind, which, x_a, x_b, x):
    """Return the fraction of the step at which an event's function falls below zero, or 2.

    The function is >= 0 at the fraction ``x_a`` and < 0 at ``x_b``.  Newton's method starts from
    ``x``, is replaced by bisection where it would leave the bracket, and ends at round-off.  The
    result is 2 if the function rises at ``x_b``: then only round-off puts it below zero.
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
            # the error after this step is of the order of the step squared
            x = trial
            break
        x = trial
    # at the result the function must be negative and falling; otherwise this event or its
    # opposite would follow at once
    nudge = 0.5 * _ROUNDING * x
    for _ in range(60):
        g, d = value_inside(w, x, kind, which)
        if d < 0.0:
            if g < 0.0:
                return x
            nudge = max(nudge, -(g + _DISTANCE_ROUNDING) / (d * w.step.h))
        if x + nudge >= x_b:
            break
        x += nudge
        nudge *= 2.0
    g, d = value_inside(w, x_b, kind, which)
    return x_b if d < 0.0 else _NO_CROSSING


@kernel
def leave_zero(w, kind, which, low, g_low, high, g_high, d_high):
    """Return a fraction of the step at which a function that rises from zero is above zero.

    Just after an event, the opposite event has such a function.  It rises from zero at the fraction
    ``low`` and is below zero at ``high``.  Returns the fraction, the value there, and a later
    fraction at which the function is below zero.  If no value above zero is found, the rise is less
    than round-off.  Then the value is 0, and both fractions are the first fraction found at which
    the function falls again.  They are 2 if it never falls: then it is below zero by round-off.
    """
    falls = high if d_high < 0.0 or g_high < g_low else _NO_CROSSING
    trial = high
    while trial - low > _SHORTEST_RISE:
        later = trial
        trial = low + 0.5 * (trial - low)
        g, d = value_inside(w, trial, kind, which)
        if g > 0.0:
            return trial, g, later
        if d < 0.0:
            falls = trial
    return falls, 0.0, falls


@kernel
def first_crossing(w, kind, which):
    """Return the fraction (0..1) of a step where an event's function first falls below zero, or 2.

    The root of a nearly straight function is located directly.  Otherwise the step is searched
    quarter by quarter, at the minimum of the cubic through value and slope at both ends of each.
    """
    h, par = w.step.h, w.system.par
    number = kind.value  # as in an event that was found: compiled once
    x_a = 0.0
    g_a, d_a = event_value(w.stepper.y, par, number, which)
    is_inside = kind == EventKind.LATCHED and g_a < 0.0  # the tip starts inside, at rest or leaving
    if (g_a <= 0.0 and d_a < 0.0) or is_inside:
        return 0.0
    g_b, d_b = event_value(w.stepper.y_new, par, number, which)
    fall = (g_a - g_b) / h
    low, high = _STRAIGHT_SLOPES
    if g_a > 0.0 > g_b and low * fall < min(-d_a, -d_b) and max(-d_a, -d_b) < high * fall:
        return refine(w, number, which, 0.0, 1.0, g_a / (g_a - g_b))
    for quarter in range(4):
        x_b = 0.25 * (quarter + 1)
        g_b, d_b = value_inside(w, x_b, number, which)
        # after an event the function rises from zero, and may be below zero by round-off
        low_a, low_g, low_d = x_a, max(g_a, 0.0), d_a
        high_b, high_g, high_d = x_b, g_b, d_b
        for _ in range(6):
            if high_g < 0.0:
                break
            width = high_b - low_a
            x_dip, dip = cubic_minimum(low_g, low_d * h * width, high_g, high_d * h * width)
            slack = _CUBIC_ERROR_INSIDE * h * width * (abs(low_d) + abs(high_d))
            if x_dip < 0.0 or dip > slack:
                break
            x_m = low_a + x_dip * width
            g_m, d_m = value_inside(w, x_m, number, which)
            if g_m >= 0.0 and d_m < 0.0:
                low_a, low_g, low_d = x_m, g_m, d_m
            else:
                high_b, high_g, high_d = x_m, g_m, d_m
        if high_g < 0.0:
            # the bracket must start above zero
            x = _NO_CROSSING
            if low_g == 0.0:
                low_a, low_g, high_b = leave_zero(
                    w, kind, which, low_a, min(g_a, 0.0), high_b, high_g, high_d
                )
                x = low_a
            if low_g > 0.0:
                start = 0.5 * (low_a + high_b)
                if low_d < 0.0:
                    start = low_a + (high_b - low_a) * low_g / (low_g - high_g)
                x = refine(w, number, which, low_a, high_b, start)
            if x <= 1.0:
                return x
        x_a, g_a, d_a = x_b, g_b, d_b
    return _NO_CROSSING


@kernel
def excess_speed(y, par, which, factor):
    """Return the speed of a vehicle minus ``factor`` times the rest speed, m/s.

    The speed is that of the fastest ball.  Far above the rest speed, the result is a lower limit.
    """
    limit = factor * _REST_SPEED * par.v_eps_ball
    first, heading, balls = (8, 2, par.balls_S) if which == 0 else (13, 7, par.balls_T)
    vx, vy, omega = y[first], y[first + 1], y[first + 2]
    # lower limit of the first ball's speed, which needs no sines
    turning = abs(omega) * (abs(balls[0, 0]) + abs(balls[1, 0]))
    above = max(abs(vx), abs(vy)) - limit - turning
    if above > 0.0:
        return above
    s, c = sine_cosine(y[heading])
    return fastest_ball(vx, vy, omega, c, s, balls) - limit


@kernel
def is_slow(y, par, which, factor):
    """Return True if a vehicle is slower than ``factor`` times the rest speed."""
    return excess_speed(y, par, which, factor) < 0.0


@inline_kernel
def load_of_vehicle(y, par, hold, which):
    """Return the wrench of a vehicle at rest on its supports, its heading and its balls.

    They are the arguments of :func:`load_factor`: fx, fy, torque, cosine and sine of the heading,
    balls.  ``hold`` (6,) is the load at ``y``, see ``OUT``.
    """
    if which == 0:
        s, c = sine_cosine(y[2])
        return hold[0], hold[1], hold[2], c, s, par.balls_S
    s, c = sine_cosine(y[7])
    return hold[3], hold[4], hold[5], c, s, par.balls_T


@kernel
def is_held_at_rest(y, par, hold, which, share):
    """Return True if the supports hold a vehicle at rest with at most ``share`` of their limit."""
    fx, fy, torque, c, s, balls = load_of_vehicle(y, par, hold, which)
    return is_held(fx, fy, torque, c, s, balls, share)


@kernel
def forward_slip(y, system, i):
    """Return the slip speed in the present direction of sliding, plus the slip floor, m/s.

    ``i`` is the wall on which the tip slides, or SLIDE for the probe in its slide.
    """
    par, mode = system.par, system.mode
    if i == SLIDE:
        forward = y[12] * mode.slide_direction
    else:
        forward = slip_of(y, par, i) * mode.touch[i].direction
    return forward + SLIP_FLOOR * par.speed_scale


@kernel
def forward_slip_rate(y, f, system, i):
    """Return the time derivative of :func:`forward_slip` for accelerations f[8:16], m/s^2."""
    par, mode = system.par, system.mode
    if i == SLIDE:
        return f[12] * mode.slide_direction
    return slip_acceleration(y, f, par, i) * mode.touch[i].direction


@kernel
def unused_friction(y, system, i):
    """Return the limit of static friction of a sticking tip minus the force needed to hold it, N.

    ``i`` is the wall.
    """
    out = system.out
    solve_sticking(y, system.spare[0], system)
    return system.par.mu_s * out.normal[i] - abs(out.friction_force[i])


@inline_kernel
def is_sticking_tip(mode, i):
    """Return True if the tip sticks on wall ``i``; False for SLIDE (a sticking probe is held)."""
    return i != SLIDE and mode.touch[i].sticking == 1


@kernel
def slip_margin(y, system, i):
    """Return the margin before sliding in the present direction ends, or before sticking ends.

    While sliding, it is a speed (m/s), see :func:`forward_slip`; while sticking, a force (N), see
    :func:`unused_friction`.  A margin of 0 or below means that sliding or sticking has ended.
    """
    if is_sticking_tip(system.mode, i):
        return unused_friction(y, system, i)
    return forward_slip(y, system, i)


@kernel
def held_load(y, system):
    """Return the axial force of a held probe, N."""
    solve_accelerations(y, system.spare[0], system)
    return system.out.axial_force


@kernel
def hold_limits(y, system):
    """Return the limits of the axial force between which seat and friction hold a probe, N.

    Below the first limit the probe slides outwards, above the second limit inwards.  On a seat the
    first limit is minus infinity, because the seat prevents outward motion.
    """
    par, mode = system.par, system.mode
    stroke = y[4] - par.h_0
    load, _ = axial_force(stroke, 0.0, 0.0, par)
    if mode.stop:
        push, _ = stop_force(stroke, 0.0, mode.stop, par)
        load += push
    lower = -math.inf if mode.held == Hold.SEAT else load - par.slide_friction
    return lower, load + par.slide_friction


@kernel
def measure_hold(w):
    """Write the axial force of a held probe and its rate at both ends of the step."""
    step, stepper, system = w.step, w.stepper, w.system
    load, rate, mode = step.hold_load, step.hold_load_rate, system.mode
    load[0] = held_load(stepper.y, system)
    load[1] = held_load(stepper.y_new, system)
    if mode.touch[0].on or mode.touch[1].on or mode.latched:
        small, moved = SMALL_MOVE * step.h, w.scratch.moved
        move_along(stepper.y, stepper.K[0], small, 0, moved)
        rate[0] = (held_load(moved, system) - load[0]) / small
        move_along(stepper.y_new, stepper.K[stepper.stages], -small, 0, moved)
        rate[1] = (load[1] - held_load(moved, system)) / small
    else:
        rate[0] = rate[1] = (load[1] - load[0]) / step.h


@kernel
def limit_passed_by(w, side, limit):
    """Return a fraction (0..1) of the step by which a held probe's load has passed a limit, or 2.

    ``side`` is +1 for the upper limit (N) and -1 for the lower limit.  ``limit`` is ``side`` times
    the limit.
    """
    step = w.step
    start, end = limit - side * step.hold_load[0], limit - side * step.hold_load[1]
    if start <= 0.0 and w.progress.released_at_t0:
        # held again at the same time: the excess load is round-off
        return _NO_CROSSING
    rate_a = -side * step.h * step.hold_load_rate[0]
    rate_b = -side * step.h * step.hold_load_rate[1]
    if end > 0.0 and not may_cross(max(start, 0.0), rate_a, end, rate_b, _CUBIC_ERROR):
        return _NO_CROSSING
    x_dip, _ = cubic_minimum(start, rate_a, end, rate_b)
    earliest = 1.0 if end <= 0.0 else _NO_CROSSING
    y = w.scratch.sought
    for k in range(4):
        x = 0.25 * (k + 1) if k < 3 else x_dip
        if 0.0 < x < earliest:
            state_inside(w, x, y)
            if side * held_load(y, w.system) >= limit:
                earliest = x
    return earliest


@kernel
def hold_lost_by(w):
    """Return a fraction (0..1) of the step by which the probe is no longer held; 2 if none."""
    lower, upper = hold_limits(w.stepper.y, w.system)
    x = limit_passed_by(w, 1.0, upper)
    if w.system.mode.held == Hold.FRICTION:
        x = min(x, limit_passed_by(w, -1.0, -lower))
    return x


@inline_kernel
def release_of(mode):
    """Return the event by which a probe that is held in its slide begins to move: kind, ``which``.

    The probe is held on its seat by the preload (UNSEATED, no wall), or by friction (SLIP, SLIDE).
    """
    if mode.held == Hold.SEAT:
        return EventKind.UNSEATED, NO_WALL
    return EventKind.SLIP, SLIDE


@kernel
def margin(y, system, kind, which):
    """Return the margin of an event without a rate: above 0 before the event, 0 when it happens.

    The margin is continuous.  The events are MOVING, AT_REST, STICK, UNSEATED and the SLIP of a
    probe.
    """
    if kind == EventKind.UNSEATED or kind == EventKind.SLIP:
        load = held_load(y, system)
        lower, upper = hold_limits(y, system)
        return min(upper - load, load - lower)
    if kind == EventKind.MOVING:
        solve_accelerations(y, system.spare[0], system)
        fx, fy, torque, c, s, balls = load_of_vehicle(y, system.par, system.out.hold, which)
        return 1.0 - load_factor(fx, fy, torque, c, s, balls)
    if kind == EventKind.AT_REST:
        return excess_speed(y, system.par, which, 1.0)
    return slip_margin(y, system, which)


@kernel
def locate_zero(w, kind, which, x_b):
    """Return the fraction of the step at which a margin reaches 0, to round-off.

    At ``x_b`` the margin is 0 or below.  The method of Oliveira and Takahashi (2020) needs no
    slope; it uses secants and needs at most one trial more than bisection.  It falls back to
    bisection while the margin is not above 0 at the start, e.g. the slip just after a change.
    """
    y = w.scratch.sought
    x_a, g_a = 0.0, margin(w.stepper.y, w.system, kind, which)
    state_inside(w, x_b, y)
    g_b = min(margin(y, w.system, kind, which), 0.0)
    radius = 0.5 * x_b
    while x_b - x_a > _MARGIN_WIDTH:
        x = itp_trial(x_a, g_a, x_b, g_b, radius)
        radius *= 0.5
        state_inside(w, x, y)
        g = margin(y, w.system, kind, which)
        if g > 0.0:
            x_a, g_a = x, g
        else:
            x_b, g_b = x, g
    return x_b


@kernel
def slip_changed_by(w, i):
    """Return a fraction (0..1) of the step by which sliding or sticking has ended; 2 if none.

    ``i`` is the wall that the tip touches, or SLIDE for a sliding probe.

    Slip may reverse twice within a step, and the holding force may oscillate.  Both are therefore
    also checked inside the step; while sliding, only if the cubic of the slip may cross zero.
    """
    system, stepper = w.system, w.stepper
    if slip_margin(stepper.y_new, system, i) <= 0.0:
        return 1.0
    x_dip = -1.0
    if not is_sticking_tip(system.mode, i):
        start = max(forward_slip(stepper.y, system, i), 0.0)
        end = forward_slip(stepper.y_new, system, i)
        rate_a = w.step.h * forward_slip_rate(stepper.y, stepper.K[0], system, i)
        rate_b = w.step.h * forward_slip_rate(stepper.y_new, stepper.K[stepper.stages], system, i)
        if not may_cross(start, rate_a, end, rate_b, _CUBIC_ERROR):
            return _NO_CROSSING
        x_dip, _ = cubic_minimum(start, rate_a, end, rate_b)
    earliest, y = _NO_CROSSING, w.scratch.sought
    for k in range(4):
        x = 0.25 * (k + 1) if k < 3 else x_dip
        if 0.0 < x < earliest:
            state_inside(w, x, y)
            if slip_margin(y, system, i) <= 0.0:
                earliest = x
    return earliest


@kernel
def keep_earliest(w, x, kind, which):
    """Keep an event at the fraction ``x`` of the step if it is the earliest so far."""
    event = w.event
    if x < event.x:
        event.x = x
        event.kind = kind
        event.which = which


@kernel
def keep_margin(w, kind, which, x):
    """Keep an event whose margin is 0 or below at the fraction ``x``, 2 if it is nowhere."""
    if x <= 1.0:
        keep_earliest(w, locate_zero(w, kind, which, x), kind, which)


@kernel
def search_walls(w):
    """Keep the first touch, lift-off, and end of sticking or sliding at the walls."""
    start, end, mode, h = w.step.start, w.step.end, w.system.mode, w.step.h
    for i in range(2):
        kind = EventKind.LIFT_OFF if mode.touch[i].on else EventKind.TOUCH
        sign = -1.0 if mode.touch[i].on else 1.0
        g_a, d_a = max(sign * start.gap[i], 0.0), sign * start.gap_rate[i]
        g_b, d_b = sign * end.gap[i], sign * end.gap_rate[i]
        if may_cross(g_a, d_a * h, g_b, d_b * h, _CUBIC_ERROR):
            keep_earliest(w, first_crossing(w, kind, i), kind, i)
    if w.system.par.friction_law == FrictionLaw.COULOMB:
        for i in range(2):
            if mode.touch[i].on:
                keep_margin(w, EventKind.STICK, i, slip_changed_by(w, i))


@kernel
def search_latch(w):
    """Keep the closing of the latch."""
    start, end, h = w.step.start, w.step.end, w.step.h
    rate_a, rate_b = start.gap_rate[2] * h, end.gap_rate[2] * h
    if may_cross(start.gap[2], rate_a, end.gap[2], rate_b, _CUBIC_ERROR):
        x = first_crossing(w, EventKind.LATCHED, NO_WALL)
        keep_earliest(w, x, EventKind.LATCHED, NO_WALL)


@kernel
def search_stops(w):
    """Keep the first meeting with a stop of the stroke, or its end."""
    par, mode, h = w.system.par, w.system.mode, w.step.h
    for side in (-1, 1):
        if mode.stop == -side or (side > 0 and par.stop_extended == math.inf):
            continue
        kind = EventKind.STOP_LEFT if mode.stop == side else EventKind.STOP_HIT
        g_a, d_a = event_value(w.stepper.y, par, kind.value, side)
        g_b, d_b = event_value(w.stepper.y_new, par, kind.value, side)
        if may_cross(max(g_a, 0.0), d_a * h, g_b, d_b * h, _CUBIC_ERROR):
            keep_earliest(w, first_crossing(w, kind, side), kind, side)


@kernel
def search_slide(w):
    """Keep the first begin or end of the probe's motion in its slide, seated or by friction."""
    par, mode, h = w.system.par, w.system.mode, w.step.h
    if mode.held:
        measure_hold(w)
        kind, place = release_of(mode)
        keep_margin(w, kind, place, hold_lost_by(w))
        return
    if par.slide_friction > 0.0:
        keep_margin(w, EventKind.STICK, SLIDE, slip_changed_by(w, SLIDE))
    if par.preload > 0.0:
        kind = EventKind.SEATED
        g_a, d_a = event_value(w.stepper.y, par, kind.value, NO_WALL)
        g_b, d_b = event_value(w.stepper.y_new, par, kind.value, NO_WALL)
        # just after the probe has left its seat, its stroke grows as t^3: a minimum of the cubic
        # below zero is not real
        has_just_left = g_a <= 0.0 and d_a == 0.0
        if g_b < 0.0 or (not has_just_left and may_cross(g_a, d_a * h, g_b, d_b * h, _CUBIC_ERROR)):
            keep_earliest(w, first_crossing(w, kind, NO_WALL), kind, NO_WALL)


@kernel
def search_supports(w):
    """Keep the first moment at which a vehicle on balls comes to rest or begins to move."""
    par, mode, slow = w.system.par, w.system.mode, w.progress.slow
    for which in range(2):
        resting = mode.rest_S if which == 0 else mode.rest_T
        if resting and not is_held_at_rest(w.stepper.y_new, par, w.step.hold, which, 1.0):
            keep_margin(w, EventKind.MOVING, which, 1.0)
        if not (resting or slow[which]) and is_slow(w.stepper.y_new, par, which, 1.0):
            keep_margin(w, EventKind.AT_REST, which, 1.0)


@kernel
def search_step(w):
    """Find the first event in the step and write it to ``w.event``."""
    par, mode, event = w.system.par, w.system.mode, w.event
    event.x = _NO_CROSSING
    event.kind = NO_EVENT
    if not mode.latched and acts(par.contact):
        search_walls(w)
    if par.has_latch and not mode.latched:
        search_latch(w)
    if par.has_stops:
        search_stops(w)
    search_slide(w)
    if par.has_supports:
        search_supports(w)


@kernel
def search_again(w, kind, which, x):
    """Find the first event in a repeated step, which ends just after the event found before.

    That event, of ``kind`` and ``which``, is expected near the fraction ``x``.  If it is not there,
    the entire step is searched.
    """
    event, par = w.event, w.system.par
    x_a = 1.0 - _BRACKET_FACTOR * (1.0 - x)
    if has_distance(kind):
        g_b, _ = event_value(w.stepper.y_new, par, kind, which)
        if g_b < 0.0:
            g_a, _ = value_inside(w, x_a, kind, which)
            if g_a > 0.0:
                x = refine(w, kind, which, x_a, 1.0, x)
                if x <= 1.0:
                    event.x = x
                    event.kind = kind
                    event.which = which
                    return
    search_step(w)
