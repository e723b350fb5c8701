"""The first event in a step."""

from __future__ import annotations

from capture_sim.engine.crossings import (
    DEPTH,
    GAP,
    LATCH_DISTANCE,
    STOP_DEPTH,
    STOP_GAP,
    event_value,
    first_crossing,
)
from capture_sim.engine.notebook import (
    LATCHED,
    LIFT_OFF,
    MOVING,
    SLOW,
    STICK,
    STOP_HIT,
    STOP_LEFT,
    TOUCH_BEGINS,
)
from capture_sim.engine.rest import is_slow, ratio_of_limit
from capture_sim.engine.slip import slip_margin
from capture_sim.engine.steps import make_dense
from capture_sim.kernels import kernel
from capture_sim.model.equations import N_STATE, slip_acceleration
from capture_sim.model.friction import COULOMB
from capture_sim.solver.roots import cubic_minimum, may_cross
from capture_sim.solver.runge_kutta import dense


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
                kind = DEPTH if mode.touching[i] else GAP
                x = first_crossing(y, y_new, F, rows, h, y_x, par, kind, i)
                event = LIFT_OFF if mode.touching[i] else TOUCH_BEGINS
                cut = cut_at(run, x, event, i, cut)
        if par.has_latch and may_cross(run.gap[2], run.gap_rate[2] * h, g2, d2 * h, 0.05):
            make_dense(par, run, mode, pair, y, y_s, K, F, scratch)
            x = first_crossing(y, y_new, F, rows, h, y_x, par, LATCH_DISTANCE, 0)
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
            kind = STOP_DEPTH if mode.stop == side else STOP_GAP
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
