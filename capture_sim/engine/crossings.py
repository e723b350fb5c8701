"""Where an event function passes zero within a step, to rounding."""

from __future__ import annotations

from capture_sim.engine.distances import distances, stop_distance
from capture_sim.kernels import kernel
from capture_sim.model.equations import N_STATE
from capture_sim.solver.roots import cubic_minimum
from capture_sim.solver.runge_kutta import dense

# event functions that a step is searched for
GAP, DEPTH, LATCH_DISTANCE, STOP_GAP, STOP_DEPTH = range(5)


@kernel
def event_value(y, par, kind, i):
    """Return an event function and its rate; it goes below zero when the event happens."""
    if kind == STOP_GAP:
        return stop_distance(y, par, i)
    if kind == STOP_DEPTH:
        g, d = stop_distance(y, par, i)
        return -g, -d
    g0, d0, g1, d1, g2, d2, _ = distances(y, par)
    if kind == LATCH_DISTANCE:
        return g2, d2
    if i == 1:
        g0, d0 = g1, d1
    if kind == GAP:
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
