"""The run as one compiled loop: stretches of motion between located events.

A *stretch* is a piece of motion under one set of equations: on the rail (closed form) or
one step of the integrator.  Samples are read from the stretch they fall into; a stretch
is cut where an event is located in it, and the event's consequences are drawn at the cut.
Nothing depends on where samples are asked for, so any cutting of the sample times into
calls gives the same bits.
"""

from __future__ import annotations

import math

import numpy as np

from capture_sim.dynamics.contact_laws import normal_force
from capture_sim.dynamics.equations import (
    HYSTERESIS,
    IMPULSE,
    N_STATE,
    N_TOTAL,
    NORMAL,
    ROLLING,
    RUB,
    STOP,
    accelerate,
    accelerate_sticking,
    rate_of_change,
    slip_acceleration,
    slip_of,
    stiff_directions,
    tip_in_cone,
    wall_gap,
)
from capture_sim.dynamics.friction import COULOMB
from capture_sim.dynamics.observation import (
    elastic_contact_energy,
    kinetic_energy,
    observe,
    speed_travel,
)
from capture_sim.dynamics.supports import fastest_ball, load_factor
from capture_sim.dynamics.trig import sine_cosine
from capture_sim.integration.explicit import dense, make_stepper, next_factor
from capture_sim.integration.implicit import C as STAGE_TIMES
from capture_sim.integration.implicit import factor_systems, make_implicit
from capture_sim.integration.roots import cubic_minimum, may_cross
from capture_sim.kernels import entry_kernel, kernel
from capture_sim.samples import TOUCH

#: The states and the energies count in the error, the impulses do not.
N_WATCHED = STOP + 1

try_step, prepare_dense = make_stepper(rate_of_change, N_STATE, N_TOTAL, N_WATCHED)
derivatives, solve_step = make_implicit(rate_of_change, stiff_directions)

#: Where a run stands; the loop's own notebook.
RUN = np.dtype(
    [
        ("t0", "f8"),  # start of the present stretch
        ("t1", "f8"),  # its end
        ("h", "f8"),  # full length of the integrator's step it was cut from
        ("stretch", "i8"),  # NONE, RAIL or STEP
        ("pending", "i8"),  # event at its end, -1 for none
        ("pending_wall", "i8"),
        ("dense_ready", "i8"),
        ("fresh", "i8"),  # equations have changed: K[0] is stale
        ("h_next", "f8"),
        ("h_free", "f8"),  # next step before the last touch began
        ("error", "f8"),
        ("stiff", "i8"),  # the implicit method is at work
        ("held_back", "i8"),  # explicit steps in a row that only the contact kept short
        ("h_stiff", "f8"),  # next implicit step; the last one; the one that is factorised
        ("h_last", "f8"),
        ("h_factored", "f8"),
        ("derived", "i8"),  # the derivatives belong to this touch
        ("on_rail", "i8"),
        ("taut", "i8"),
        ("travel", "f8"),  # along the rail at t0
        ("speed", "f8"),  # along the rail at t0
        ("acceleration", "f8"),
        ("t_stop", "f8"),
        ("done", "i8"),
        ("steps", "i8"),
        ("rejected", "i8"),
        ("evaluations", "i8"),
        ("pile", "i8"),  # events in a row without progress
        ("energy_0", "f8"),
        ("lost_landing", "f8"),
        ("lost_latch", "f8"),
        ("touches", "i8"),
        ("touch_start", "f8", (2,)),
        ("touch_speed", "f8", (2,)),
        ("touch_peak", "f8", (2,)),
        ("touch_peak_time", "f8", (2,)),
        ("touch_impulse", "f8", (2,)),  # the integrals when it began
        ("touch_hysteresis", "f8", (2,)),
        ("force", "f8", (2,)),  # normal force at t0, and its rate
        ("force_rate", "f8", (2,)),
        ("gap", "f8", (3,)),  # at t0: of both walls and to the latch, m
        ("gap_rate", "f8", (3,)),
        ("tip_speed", "f8"),  # at t0: of the tip against the target, m/s
        ("measured", "i8"),  # the gaps belong to t0
        ("slow", "i8", (2,)),  # chaser, target: too slow to become slow again
        ("substeps", "i8"),  # events located within one fixed step
        ("n_events", "i8"),
        ("n_trace", "i8"),
    ],
    align=True,
)

EVENT = np.dtype(
    [
        ("kind", "i8"),
        ("t", "f8"),
        ("wall", "i8"),
        ("value", "f8"),
        ("q", "f8", (8,)),
        ("v", "f8", (8,)),
        ("touch", TOUCH),
    ],
    align=True,
)

NONE, RAIL, STEP = 0, 1, 2
RELEASE, LANDED, RAIL_END, TOUCH_BEGINS, LIFT_OFF, AT_REST, MOVING, LATCHED, END = range(9)
STOP_HIT, STOP_LEFT, STICK, SLIP = range(9, 13)
SLOW = 13  # a vehicle is slow enough to be held by its supports: rest, if they can
NO_EVENT = -1

# how the loop ended
SERVED, EVENTS_FULL, NOT_FINITE, STEP_TOO_SMALL, TOO_MANY_STEPS, PILE_UP = range(6)
TIP_THROUGH_WALL, PROBE_IN_HINGE, STEP_TOO_LONG = 6, 7, 8

# event functions that a step is searched for
_GAP, _DEPTH, _LATCH_DISTANCE, _STOP_GAP, _STOP_DEPTH = range(5)

_EVENT_ROOM = 8  # events that one stretch may cause
_SMALLEST_STEP = 1e-15  # s; below it t + h stands still for runs of minutes
_REST_SPEED = 5.0  # of v_eps: see docs/model.md, supports
_HELD_SHARE = 0.6  # of the longest step in contact
_HELD_BACK = 3  # explicit steps that only the contact kept short, before implicit ones
_WORTH = 2.0  # explicit steps that an implicit one must span to be worth its cost
_PATIENCE = 20  # explicit steps after an event has shown up, before they are tried again
_CONTACT_ANGLE = 5.0  # rad of the contact's oscillation that a step may span
_DEEPEST = 0.75  # of R_t: beyond it the tip's centre might pass a wall within a step
# share of the supports' limit below which a slow vehicle is put at rest: at it, the smoothed
# resistance would let it creep at _REST_SPEED v_eps, r / sqrt(1 - r^2) = 5
_REST_SHARE = 0.98
_SLIP_FLOOR = 1e-10  # of the scene's speed: slip below it is rounding's, without direction
_FIXED_ANGLE = 1.5  # rad of the contact's oscillation that a fixed step may span
_MOST_SUBSTEPS = 8  # events located within one fixed step: bounds its cost


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
def distances(y, par):
    """Return gaps and their rates: +y wall, -y wall, latch; and the tip's speed; m and m/s."""
    px, py, wx, wy = tip_in_cone(y, par)
    g0, d0, _, _ = wall_gap(px, py, wx, wy, 1.0, par)
    g1, d1, _, _ = wall_gap(px, py, wx, wy, -1.0, par)
    g2 = 1.0
    d2 = 0.0
    if par.has_latch:
        ux = px + par.L_T
        distance = math.sqrt(ux * ux + py * py)
        g2 = distance - par.latch_radius
        if distance > 0.0:
            d2 = (ux * wx + py * wy) / distance
    return g0, d0, g1, d1, g2, d2, math.sqrt(wx * wx + wy * wy)


@kernel
def remember_distances(run, near):
    """Keep the distances at the start of the next stretch."""
    run.gap[0] = near[0]
    run.gap_rate[0] = near[1]
    run.gap[1] = near[2]
    run.gap_rate[1] = near[3]
    run.gap[2] = near[4]
    run.gap_rate[2] = near[5]
    run.tip_speed = near[6]
    run.measured = 1


@kernel
def stop_distance(y, par, side):
    """Return the probe's way to a stroke stop and its rate; ``side`` -1 compressed, +1."""
    end = par.stop_compressed if side < 0 else par.stop_extended
    return side * (end - (y[4] - par.h_0)), -side * y[12]


@kernel
def event_value(y, par, kind, i):
    """Return an event function and its rate; it goes below zero when the event happens."""
    if kind == _STOP_GAP:
        return stop_distance(y, par, i)
    if kind == _STOP_DEPTH:
        g, d = stop_distance(y, par, i)
        return -g, -d
    g0, d0, g1, d1, g2, d2, _ = distances(y, par)
    if kind == _LATCH_DISTANCE:
        return g2, d2
    if i == 1:
        g0, d0 = g1, d1
    if kind == _GAP:
        return g0, d0
    return -g0, -d0


@kernel
def refine(y, F, rows, h, y_x, par, kind, i, x_a, x_b, x):
    """Return where an event function passes zero between x_a (>= 0) and x_b (< 0).

    Newton's method from ``x``, bisecting where that would leave the bracket; to rounding.
    """
    for _ in range(80):
        dense(y, F, rows, x, y_x, N_STATE)
        g, d = event_value(y_x, par, kind, i)
        if g >= 0.0:
            x_a = x
        else:
            x_b = x
        if x_b - x_a <= 4e-16 * x_b:
            break
        step = 0.0
        if d != 0.0:
            step = -g / (d * h)
        trial = x + step
        if d == 0.0 or not (x_a < trial < x_b):
            trial = 0.5 * (x_a + x_b)
        elif abs(step) <= 1e-9 * x:
            # the error after this step is of the order of its square
            x = trial
            break
        x = trial
    # rounding may leave it a hair short: what has been left must not be met again at once
    nudge = 2e-16 * x
    for _ in range(40):
        dense(y, F, rows, x, y_x, N_STATE)
        g, _ = event_value(y_x, par, kind, i)
        if g < 0.0 or x + nudge >= x_b:
            return x
        x += nudge
        nudge *= 2.0
    return x


@kernel
def first_crossing(y, y_new, F, rows, h, y_x, par, kind, i):
    """Return the first place (0..1) in a step where an event function goes below zero; 2 if none.

    One that falls nearly straight is followed down at once.  Else the step is looked at in
    quarters; in each, the cubic through value and slope of both ends points to where a dip
    would be.
    """
    x_a = 0.0
    g_a, d_a = event_value(y, par, kind, i)
    if g_a <= 0.0 and d_a < 0.0:
        return 0.0
    g_a = max(g_a, 0.0)
    g_b, d_b = event_value(y_new, par, kind, i)
    fall = (g_a - g_b) / h
    if g_a > 0.0 > g_b and 0.7 * fall < min(-d_a, -d_b) and max(-d_a, -d_b) < 1.3 * fall:
        start = g_a / (g_a - g_b)
        return refine(y, F, rows, h, y_x, par, kind, i, 0.0, 1.0, start)
    for quarter in range(4):
        x_b = 0.25 * (quarter + 1)
        dense(y, F, rows, x_b, y_x, N_STATE)
        g_b, d_b = event_value(y_x, par, kind, i)
        low_a, low_g, low_d = x_a, g_a, d_a
        high_b, high_g, high_d = x_b, g_b, d_b
        for _ in range(6):
            if high_g < 0.0:
                break
            width = high_b - low_a
            place, low = cubic_minimum(low_g, low_d * h * width, high_g, high_d * h * width)
            slack = 0.02 * h * width * (abs(low_d) + abs(high_d))
            if place < 0.0 or low > slack:
                break
            x_m = low_a + place * width
            dense(y, F, rows, x_m, y_x, N_STATE)
            g_m, d_m = event_value(y_x, par, kind, i)
            if g_m < 0.0 or d_m < 0.0:
                if g_m < 0.0:
                    high_b, high_g, high_d = x_m, g_m, d_m
                else:
                    low_a, low_g, low_d = x_m, g_m, d_m
            else:
                high_b, high_g, high_d = x_m, g_m, d_m
        if high_g < 0.0:
            # the bracket must start above zero: what has just been left starts at it and rises
            if low_g == 0.0 or low_d > 0.0:
                trial = low_a + 0.5 * (high_b - low_a)
                for _ in range(60):
                    dense(y, F, rows, trial, y_x, N_STATE)
                    g_t, _ = event_value(y_x, par, kind, i)
                    if g_t > low_g:
                        break
                    high_b = trial
                    trial = low_a + 0.5 * (trial - low_a)
                if trial - low_a < 1e-15:
                    return low_a
                low_a, low_g = trial, g_t
            start = 0.5 * (low_a + high_b)
            if low_d < 0.0:
                start = low_a + (high_b - low_a) * low_g / (low_g - high_g)
            return refine(y, F, rows, h, y_x, par, kind, i, low_a, high_b, start)
        x_a, g_a, d_a = x_b, g_b, d_b
    return 2.0


@kernel
def is_slow(y, par, which, times):
    """Tell whether a vehicle is below ``times`` the speed at which it may be put at rest."""
    if which == 0:
        s, c = sine_cosine(y[2])
        speed = fastest_ball(y[8], y[9], y[10], c, s, par.balls_S)
    else:
        s, c = sine_cosine(y[7])
        speed = fastest_ball(y[13], y[14], y[15], c, s, par.balls_T)
    return speed < times * _REST_SPEED * par.v_eps_ball


@kernel
def ratio_of_limit(y, par, mode, f, scratch, which):
    """Return which share of its supports' limit a vehicle needs to stand still."""
    if mode.sticking[0] or mode.sticking[1]:
        sx, sy, sm, tx, ty, tm = accelerate_sticking(y, par, mode, f, scratch)
    else:
        sx, sy, sm, tx, ty, tm = accelerate(y, par, mode, f, scratch)
    if which == 0:
        s, c = sine_cosine(y[2])
        return load_factor(sx, sy, sm, c, s, par.balls_S)
    s, c = sine_cosine(y[7])
    return load_factor(tx, ty, tm, c, s, par.balls_T)


@kernel
def slip_margin(y, par, mode, f, scratch, i):
    """Return how far the tip on wall ``i`` is from changing between sticking and sliding.

    Sliding: the slip in its direction, m/s.  Sticking: the force that is left, N.
    """
    if not mode.sticking[i]:
        return slip_of(y, par, i) * mode.direction[i] + _SLIP_FLOOR * par.speed_scale
    accelerate_sticking(y, par, mode, f, scratch)
    return par.mu_s * scratch[NORMAL + i] - abs(scratch[RUB + i])


@kernel
def has_turned(y, par, mode, f, scratch, event, which):
    """Tell whether one of the conditions without a rate holds: MOVING, SLOW or STICK."""
    if event == MOVING:
        return ratio_of_limit(y, par, mode, f, scratch, which) > 1.0
    if event == SLOW:
        return is_slow(y, par, which, 1.0)
    return slip_margin(y, par, mode, f, scratch, which) <= 0.0


@kernel
def when_it_turns(y, F, rows, y_x, par, mode, f, scratch, event, which, x_b):
    """Return the place before ``x_b``, where it holds, at which such a condition comes to hold.

    By bisection: it has just been left (sliding starts at slip zero) as often as not.
    """
    x_a = 0.0
    while x_b - x_a > 1e-15:
        x = 0.5 * (x_a + x_b)
        dense(y, F, rows, x, y_x, N_STATE)
        if has_turned(y_x, par, mode, f, scratch, event, which):
            x_b = x
        else:
            x_a = x
    return x_b


@kernel
def where_slip_changes(par, run, mode, pair, y, y_new, y_s, y_x, K, F, scratch, i):
    """Return a place (0..1) in the step by which the slip margin of wall ``i`` is used up; 2: none.

    A tip may reverse twice within a step, and the force that holds it may swing: it is
    looked at inside the step too, while sliding only where the slip's rates allow a dip.
    """
    end = slip_margin(y_new, par, mode, y_x, scratch, i)
    if end <= 0.0:
        return 1.0
    stages = pair[5]
    place = -1.0
    if not mode.sticking[i]:
        width = mode.direction[i] * run.h
        trial = scratch[32:48]
        start = max(slip_margin(y, par, mode, y_x, scratch, i), 0.0)
        rate_a = width * slip_acceleration(y, K[0], par, i, trial)
        rate_b = width * slip_acceleration(y_new, K[stages], par, i, trial)
        if not may_cross(start, rate_a, end, rate_b, 0.05):
            return 2.0
        place, _ = cubic_minimum(start, rate_a, end, rate_b)
    make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
    rows = pair[4].shape[0]
    found = 2.0
    for k in range(4):
        x = 0.25 * (k + 1) if k < 3 else place
        if 0.0 < x < found:
            dense(y, F, rows, x, y_x, N_STATE)
            if slip_margin(y_x, par, mode, y_s, scratch, i) <= 0.0:
                found = x
    return found


@kernel
def change_slip(par, run, mode, events, t, y, f, scratch, i):
    """Let the tip on wall ``i`` stick if friction can hold it, else slide the way it must."""
    was = mode.sticking[i]
    mode.sticking[i] = 1
    accelerate_sticking(y, par, mode, f, scratch)
    needed = scratch[RUB + i]
    if not was and abs(needed) < par.mu_s * scratch[NORMAL + i]:
        log_event(events, run, STICK, t, y, 1 - 2 * i, needed)
        return
    mode.sticking[i] = 0
    # friction opposes the motion that it could not prevent
    mode.direction[i] = 1.0 if needed < 0.0 else -1.0
    log_event(events, run, SLIP, t, y, 1 - 2 * i, needed)


@kernel
def force_at(y, par, mode, i):
    """Return the normal force on the tip from wall ``i``, N."""
    px, py, wx, wy = tip_in_cone(y, par)
    gap, rate, _, _ = wall_gap(px, py, wx, wy, 1.0 - 2.0 * i, par)
    force, _ = normal_force(-gap, -rate, par.K, mode.chi[i])
    return force


@kernel
def force_inside(y, F, rows, x, y_x, par, mode, i):
    """Return the normal force of wall ``i`` at the fraction ``x`` of the present step, N."""
    dense(y, F, rows, x, y_x, N_STATE)
    return force_at(y_x, par, mode, i)


@kernel
def peak_in_stretch(y, F, rows, y_x, par, mode, i, x_end):
    """Return place and value of the largest normal force of wall ``i`` up to ``x_end``."""
    golden = 0.6180339887498949
    a, b = 0.0, x_end
    x1 = b - golden * (b - a)
    x2 = a + golden * (b - a)
    f1 = force_inside(y, F, rows, x1, y_x, par, mode, i)
    f2 = force_inside(y, F, rows, x2, y_x, par, mode, i)
    while b - a > 0.05 * x_end:
        if f1 < f2:
            a, x1, f1 = x1, x2, f2
            x2 = a + golden * (b - a)
            f2 = force_inside(y, F, rows, x2, y_x, par, mode, i)
        else:
            b, x2, f2 = x2, x1, f1
            x1 = b - golden * (b - a)
            f1 = force_inside(y, F, rows, x1, y_x, par, mode, i)
    x, f = (x1, f1) if f1 > f2 else (x2, f2)
    # then parabolas through three places, ever closer
    width = 0.5 * (b - a)
    for _ in range(5):
        width = min(width, x, x_end - x)
        if width < 1e-6 * x_end:
            break
        left = force_inside(y, F, rows, x - width, y_x, par, mode, i)
        right = force_inside(y, F, rows, x + width, y_x, par, mode, i)
        bend = left - 2.0 * f + right
        shift = 0.5 * (left - right) / bend if bend < 0.0 else math.copysign(1.0, right - left)
        trial = x + width * min(1.0, max(-1.0, shift))
        top = force_inside(y, F, rows, trial, y_x, par, mode, i)
        if top > f:
            x, f = trial, top
        if abs(shift) < 1.0:
            width *= 0.1
            if abs(shift) < 0.1 and width < 1e-3 * x_end:
                break
    return x, f


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


@kernel
def may_rest(y, y_x, f, par, mode, scratch, which):
    """Tell whether the supports could hold a vehicle if it stood still here."""
    for i in range(N_STATE):
        y_x[i] = y[i]
    first = 8 if which == 0 else 13
    for i in range(first, first + 3):
        y_x[i] = 0.0
    return ratio_of_limit(y_x, par, mode, f, scratch, which) < _REST_SHARE


@kernel
def stop_vehicle(par, run, mode, events, t, y, which):
    """Put a vehicle at rest on its supports; what speed it had left goes to them."""
    before = kinetic_energy(y, par)
    first = 8 if which == 0 else 13
    for i in range(first, first + 3):
        y[i] = 0.0
    y[ROLLING] += before - kinetic_energy(y, par)
    if which == 0:
        mode.rest_S = 1
    else:
        mode.rest_T = 1
    run.fresh = 1
    log_event(events, run, AT_REST, t, y, which + 1, 0.0)


@kernel
def make_dense(par, run, mode, pair, y, y_s, K, F, scratch):
    """Prepare the dense output of the present step, once."""
    if not run.dense_ready:
        prepare_dense(par, mode, scratch, pair, run.t0, y, run.h, K, y_s, F)
        run.dense_ready = 1


@kernel
def way_to_events(par, run, mode):
    """Return how far the tip may move in the present step without leaping over an event, m.

    A distance changes no faster than the tip moves: away from the walls (and the latch) the
    step ends short of them, near them it is so short that gap and rate show every dip.
    """
    way = math.inf
    if mode.latched:
        return way
    near = 0.25 * par.R_t
    for i in range(2):
        way = min(way, max(run.gap[i] - near, near))
    if par.has_latch:
        near = 0.25 * par.latch_radius
        way = min(way, max(run.gap[2] - near, near))
    return way


@kernel
def step_length(par, run, mode):
    """Return the length of the next step and whether its error decides."""
    if par.fixed_step == 0.0:
        h = min(run.h_next, 1.01 * (run.t_stop - run.t0))
        if run.tip_speed > 0.0:
            h = min(h, way_to_events(par, run, mode) / run.tip_speed)
        for i in range(2):
            if mode.touching[i] and run.gap[i] < 0.0:
                # less than a period of the contact: a longer step may be right at its end and
                # far off in between, where samples and events are read
                stiffness = 1.5 * par.K * math.sqrt(-run.gap[i])
                longest = _CONTACT_ANGLE * math.sqrt(par.m_P / stiffness)
                if h > _HELD_SHARE * longest:
                    # an explicit step of this size is kept short by its stability
                    run.held_back += 1
                    h = min(h, longest)
                elif h < 0.3 * longest:
                    run.held_back = min(run.held_back, 0)
        return h
    # to the next multiple of the fixed step; what an event has cut off is caught up
    n = math.floor(run.t0 / par.fixed_step + 1.0 + 1e-9)
    if run.substeps == 0 or n * par.fixed_step - run.t0 > 0.999 * par.fixed_step:
        run.substeps = 0
    return n * par.fixed_step - run.t0


@kernel
def take_implicit_step(par, run, mode, y, y_new, y_s, K, F, weights, scratch, stages, work):
    """Take one accepted step of the implicit method; returns whether it could."""
    Z = work[8]
    h = min(run.h_stiff, 1.01 * (run.t_stop - run.t0))
    guess = run.h_last > 0.0
    fresh = False
    for _ in range(20):
        if not run.derived:
            run.evaluations += derivatives(
                par, mode, scratch, run.t0, y, K[0], y_s, 1e-10, 1e-7, work
            )
            run.derived = 1
            run.h_factored = 0.0
            fresh = True
        if h != run.h_factored:
            if not factor_systems(h, work):
                return False
            run.h_factored = h
        # first guess: the last step's cubic carried on, or the motion now
        for k in range(3):
            if guess:
                x = 1.0 + STAGE_TIMES[k] * h / run.h_last
                for i in range(N_STATE):
                    Z[k, i] = x * (F[0, i] + (1.0 - x) * (F[1, i] + x * F[2, i])) - F[0, i]
            else:
                tau = STAGE_TIMES[k] * h
                for i in range(8):
                    Z[k, i] = tau * (y[8 + i] + 0.5 * tau * K[0, 8 + i])
                    Z[k, 8 + i] = tau * K[0, 8 + i]
        iterations, rate, error = solve_step(
            par, mode, scratch, run.t0, y, K[0], h, y_s, y_new, K[stages], weights, work, F
        )
        run.evaluations += 3 * max(iterations, 1) + 1
        guess = False
        if iterations < 0:
            run.rejected += 1
            if fresh:
                h *= 0.3
            run.derived = 0
            run.h_last = 0.0
            continue
        # rounding in the linear systems must not move a vehicle that its supports hold
        for which in range(2):
            if (mode.rest_S if which == 0 else mode.rest_T) == 1:
                for i in range(5 * which, 5 * which + 3):
                    for j in (i, 8 + i):
                        y_new[j] = y[j]
                        K[stages, j] = 0.0
                        for k in range(F.shape[0]):
                            F[k, j] = 0.0
        factor = min(4.0, max(0.2, 0.85 * error**-0.25)) if error > 0.0 else 4.0
        if error > 1.0:
            run.rejected += 1
            h *= factor
            continue
        run.h_last = h
        run.h_stiff = h * factor
        if iterations > 3 or rate > 0.1:
            run.derived = 0
        run.steps += 1
        run.pending = NO_EVENT
        run.h = h
        run.t1 = run.t0 + h
        run.dense_ready = 1
        run.error = 1e-4
        return True
    return False


@kernel
def take_step(par, run, mode, pair, y, y_new, y_s, e_5, e_3, K, weights, scratch, h):
    """Take one accepted step of at most ``h``; returns the loop's status."""
    stages = pair[5]
    run.dense_ready = 0
    run.pending = NO_EVENT
    while True:
        if h < _SMALLEST_STEP:
            if run.t_stop - run.t0 >= _SMALLEST_STEP and par.fixed_step == 0.0:
                return STEP_TOO_SMALL
            h = _SMALLEST_STEP
        error = try_step(par, mode, scratch, pair, run.t0, y, h, K, y_s, e_5, e_3, y_new, weights)
        run.evaluations += stages
        if par.fixed_step > 0.0:
            total = 0.0
            for i in range(N_STATE):
                total += y_new[i]
            if not math.isfinite(total):
                return NOT_FINITE
            break
        factor = next_factor(error, run.error, pair[6])
        if error <= 1.0:
            run.error = error
            run.h_next = h * factor
            break
        run.rejected += 1
        if not error < 1e300:
            for i in range(N_STATE):
                if not (math.isfinite(K[0, i]) and math.isfinite(y[i])):
                    return NOT_FINITE
            # what is not a number must not come back by way of a zero weight
            for j in range(1, K.shape[0]):
                for i in range(N_TOTAL):
                    K[j, i] = 0.0
        h *= min(factor, 1.0)
    run.steps += 1
    run.h = h
    run.t1 = run.t0 + h
    return TOO_MANY_STEPS if run.steps > par.max_steps else SERVED


@kernel
def cut_at(run, x, event, wall, cut):
    """Keep the earliest event of a step; returns its place."""
    if x >= cut:
        return cut
    run.pending = event
    run.pending_wall = wall
    return x


@kernel
def search_step(par, run, mode, pair, y, y_new, near, y_s, y_x, K, F, scratch):
    """Return the place (0..1) of the first event in the step from y to y_new; 2 if none.

    ``near`` are the distances at y_new.
    """
    rows = pair[4].shape[0]
    h = run.h
    cut = 2.0
    g0, d0, g1, d1, g2, d2, _ = near
    if not mode.latched:
        for i in range(2):
            g, d = (g0, d0) if i == 0 else (g1, d1)
            sign = -1.0 if mode.touching[i] else 1.0
            start = max(sign * run.gap[i], 0.0)
            if may_cross(start, sign * run.gap_rate[i] * h, sign * g, sign * d * h, 0.05):
                make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
                kind = _DEPTH if mode.touching[i] else _GAP
                x = first_crossing(y, y_new, F, rows, h, y_x, par, kind, i)
                event = LIFT_OFF if mode.touching[i] else TOUCH_BEGINS
                cut = cut_at(run, x, event, i, cut)
        if par.has_latch and may_cross(run.gap[2], run.gap_rate[2] * h, g2, d2 * h, 0.05):
            make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
            x = first_crossing(y, y_new, F, rows, h, y_x, par, _LATCH_DISTANCE, 0)
            cut = cut_at(run, x, LATCHED, 0, cut)
        if par.friction_law == COULOMB:
            for i in range(2):
                if mode.touching[i]:
                    x = where_slip_changes(
                        par, run, mode, pair, y, y_new, y_s, y_x, K, F, scratch, i
                    )
                    if x <= 1.0:
                        make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
                        x = when_it_turns(y, F, rows, y_x, par, mode, y_s, scratch, STICK, i, x)
                        cut = cut_at(run, x, STICK, i, cut)
    if par.has_stops:
        for side in (-1, 1):
            if mode.stop == -side:
                continue
            kind = _STOP_DEPTH if mode.stop == side else _STOP_GAP
            g_a, d_a = event_value(y, par, kind, side)
            g_b, d_b = event_value(y_new, par, kind, side)
            if may_cross(max(g_a, 0.0), d_a * h, g_b, d_b * h, 0.05):
                make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
                x = first_crossing(y, y_new, F, rows, h, y_x, par, kind, side)
                event = STOP_LEFT if mode.stop == side else STOP_HIT
                cut = cut_at(run, x, event, side, cut)
    if par.has_supports:
        for which in range(2):
            resting = mode.rest_S if which == 0 else mode.rest_T
            if resting and ratio_of_limit(y_new, par, mode, y_x, scratch, which) > 1.0:
                make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
                x = when_it_turns(y, F, rows, y_x, par, mode, y_s, scratch, MOVING, which, 1.0)
                cut = cut_at(run, x, MOVING, which, cut)
            if not (resting or run.slow[which]) and is_slow(y_new, par, which, 1.0):
                make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
                x = when_it_turns(y, F, rows, y_x, par, mode, y_s, scratch, SLOW, which, 1.0)
                cut = cut_at(run, x, SLOW, which, cut)
    return cut


@kernel
def plan_step(par, run, mode, pair, y, y_new, y_s, y_x, e_5, e_3, K, F, weights, scratch, work):
    """Take one accepted step of the integrator and cut it at the first event in it.

    Returns the loop's status; SERVED if all is well.
    """
    stages = pair[5]
    run.stretch = STEP
    if run.fresh:
        rate_of_change(run.t0, y, K[0], par, mode, scratch)
        run.evaluations += 1
        run.fresh = 0
        run.stiff = 0
        run.held_back = 0
        if par.has_supports:
            # a change of forces may ask more of the supports at once than they can hold
            for which in range(2):
                resting = mode.rest_S if which == 0 else mode.rest_T
                if resting and ratio_of_limit(y, par, mode, K[1], scratch, which) > 1.0:
                    run.h = 0.0
                    run.t1 = run.t0
                    run.pending = MOVING
                    run.pending_wall = which
                    return SERVED
    else:
        for i in range(N_TOTAL):
            K[0, i] = K[stages, i]
    if not run.measured:
        remember_distances(run, distances(y, par))
    way = way_to_events(par, run, mode)
    smooth = False
    if run.stiff and run.h_last > 0.0 and run.h_stiff < _WORTH * run.h_next:
        # the force changes too fast for steps that would pay
        run.stiff = 0
        run.held_back = -_PATIENCE
    if run.stiff:
        smooth = take_implicit_step(
            par, run, mode, y, y_new, y_s, K, F, weights, scratch, stages, work
        )
        near = distances(y_new, par)
        if not smooth or 0.5 * (run.tip_speed + near[6]) * run.h > 1.01 * way:
            smooth = False
            run.stiff = 0
            run.held_back = -_PATIENCE
    while not smooth:
        h = step_length(par, run, mode)
        status = take_step(par, run, mode, pair, y, y_new, y_s, e_5, e_3, K, weights, scratch, h)
        if status != SERVED:
            return status
        # a tip that gathers speed makes more way than it seemed at the start
        near = distances(y_new, par)
        made = 0.5 * (run.tip_speed + near[6]) * run.h
        if not made > 1.01 * way:
            break
        if par.fixed_step > 0.0:
            return STEP_TOO_LONG
        run.rejected += 1
        run.h_next = 0.9 * run.h * way / made

    if par.implicit and not smooth and run.held_back >= _HELD_BACK:
        run.stiff = 1
        run.h_stiff = run.h
        run.h_last = 0.0
        run.derived = 0
    if par.fixed_step > 0.0:
        for i in range(2):
            stiffness = 1.5 * par.K * math.sqrt(max(-near[2 * i], 0.0))
            if mode.touching[i] and par.fixed_step**2 * stiffness > _FIXED_ANGLE**2 * par.m_P:
                return STEP_TOO_LONG

    cut = search_step(par, run, mode, pair, y, y_new, near, y_s, y_x, K, F, scratch)
    if cut < 1.0 and smooth:
        # an event ends the smooth stretch: back to short steps, for some while
        run.stiff = 0
        run.held_back = -_PATIENCE
        h = step_length(par, run, mode)
        status = take_step(par, run, mode, pair, y, y_new, y_s, e_5, e_3, K, weights, scratch, h)
        if status != SERVED:
            return status
        near = distances(y_new, par)
        cut = search_step(par, run, mode, pair, y, y_new, near, y_s, y_x, K, F, scratch)
    in_contact = mode.touching[0] or mode.touching[1] or mode.stop or mode.latched
    if cut < 0.95 and par.fixed_step == 0.0 and in_contact:
        # dense output inside a long step in contact is less exact than the step's end: take
        # a real step to just behind the event and look again, now near its end
        h = min(1.02 * cut * run.h, run.h)
        if h > _SMALLEST_STEP:
            h_next = run.h_next
            status = take_step(
                par, run, mode, pair, y, y_new, y_s, e_5, e_3, K, weights, scratch, h
            )
            if status != SERVED:
                return status
            if run.h == h:
                run.h_next = h_next
            near = distances(y_new, par)
            cut = search_step(par, run, mode, pair, y, y_new, near, y_s, y_x, K, F, scratch)
    h = run.h
    if not mode.latched and min(near[0], near[2]) < -_DEEPEST * par.R_t:
        return TIP_THROUGH_WALL
    if y_new[4] <= par.R_t:
        return PROBE_IN_HINGE
    if cut <= 1.0:
        if par.fixed_step > 0.0:
            run.substeps += 1
            if run.substeps > _MOST_SUBSTEPS:
                # bounded cost comes first: this event waits for the end of the step
                cut = 1.0
        run.t1 = run.t0 + cut * h
    if run.t1 >= run.t_stop:
        run.t1 = run.t_stop
        run.pending = END
    elif cut > 1.0:
        remember_distances(run, near)
        return SERVED
    run.measured = 0
    return SERVED


@kernel
def watch_force(par, run, mode, pair, y, y_s, y_x, K, F, scratch, y_end, x_end):
    """Keep each touch's peak of force, found inside the stretch where it lies."""
    rows = pair[4].shape[0]
    stages = pair[5]
    small = 1e-4 * run.h
    for k in range(N_STATE):
        y_s[k] = y_end[k] + small * K[stages, k]
    for i in range(2):
        if not mode.touching[i]:
            continue
        # a whole step's last evaluation has the force; one cut short ends with the touch, or
        # is to be looked through anyway
        force = K[stages, IMPULSE + i] if x_end == 1.0 else force_at(y_end, par, mode, i)
        # rate by a small move along the flow: it only decides where to look
        rate = (force_at(y_s, par, mode, i) - force) / small if x_end == 1.0 else -1.0
        if run.force_rate[i] > 0.0 and rate < 0.0:
            width = x_end * run.h
            place, low = cubic_minimum(
                -run.force[i], -run.force_rate[i] * width, -force, -rate * width
            )
            if x_end != 1.0 or (place >= 0.0 and -low > 0.98 * run.touch_peak[i]):
                make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
                x, peak = peak_in_stretch(y, F, rows, y_x, par, mode, i, x_end)
                if peak > run.touch_peak[i]:
                    run.touch_peak[i] = peak
                    run.touch_peak_time[i] = run.t0 + x * run.h
        if force > run.touch_peak[i]:
            run.touch_peak[i] = force
            run.touch_peak_time[i] = run.t1
        run.force[i] = force
        run.force_rate[i] = rate


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


@kernel
def close_step(par, run, mode, pair, events, trace, y, y_new, y_s, y_x, y_end, K, F, scratch):
    """Move to the end of an integrator's stretch and draw the consequences.

    In contact the state there goes into ``trace``, if that has room at all.
    """
    rows = pair[4].shape[0]
    x_end = 1.0
    if run.h > 0.0:
        if run.t1 < run.t0 + run.h:
            x_end = (run.t1 - run.t0) / run.h
            make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
            dense(y, F, rows, x_end, y_end, N_TOTAL)
            run.fresh = 1
        else:
            for i in range(N_TOTAL):
                y_end[i] = y_new[i]
        if mode.touching[0] or mode.touching[1]:
            watch_force(par, run, mode, pair, y, y_s, y_x, K, F, scratch, y_end, x_end)
        for i in range(N_TOTAL):
            y[i] = y_end[i]
    if run.t1 > run.t0 + _SMALLEST_STEP:
        run.pile = 0
    else:
        run.pile += 1
    t = run.t1
    run.t0 = t
    if trace.shape[0] > 0 and (mode.touching[0] or mode.touching[1]):
        observe(t, y, par, mode, run, scratch, trace[run.n_trace])
        run.n_trace += 1
    which = run.pending_wall
    if par.has_supports:
        for vehicle in range(2):
            # left only well above: rounding must not make it slow again at once
            run.slow[vehicle] = is_slow(y, par, vehicle, 2.0 if run.slow[vehicle] else 1.0)
    if run.pending == NO_EVENT:
        if par.has_supports:
            for vehicle in range(2):
                resting = mode.rest_S if vehicle == 0 else mode.rest_T
                if (
                    not resting
                    and is_slow(y, par, vehicle, 1.0)
                    and may_rest(y, y_x, y_s, par, mode, scratch, vehicle)
                ):
                    stop_vehicle(par, run, mode, events, t, y, vehicle)
                    run.measured = 0
        return
    run.fresh = 1
    if run.pending == SLOW:
        run.slow[which] = 1
        if may_rest(y, y_x, y_s, par, mode, scratch, which):
            stop_vehicle(par, run, mode, events, t, y, which)
    elif run.pending == TOUCH_BEGINS:
        begin_touch(events, run, mode, par, t, y, which)
    elif run.pending == LIFT_OFF:
        end_touch(events, run, mode, t, y, which)
    elif run.pending == STICK:
        change_slip(par, run, mode, events, t, y, y_x, scratch, which)
    elif run.pending == STOP_HIT:
        mode.stop = which
        log_event(events, run, STOP_HIT, t, y, which, y[12])
    elif run.pending == STOP_LEFT:
        mode.stop = 0
        log_event(events, run, STOP_LEFT, t, y, which, y[12])
    elif run.pending == MOVING:
        if which == 0:
            mode.rest_S = 0
        else:
            mode.rest_T = 0
        log_event(events, run, MOVING, t, y, which + 1, 0.0)
    elif run.pending == LATCHED:
        latch_tip(par, run, mode, events, t, y)


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
