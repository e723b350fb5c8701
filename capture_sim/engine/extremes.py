"""Loads: largest forces, strokes and penetrations, and the closest approach, inside the steps.

A quantity with its rate at both ends of a segment can hold a larger value in between only where
the cubic through them has a maximum there; that place is then searched on the dense output.  So
what is found depends neither on where samples are asked for nor, but for the error of the run
itself, on where the steps end.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from capture_sim.engine.events import seat_load
from capture_sim.engine.steps import SMALL_MOVE, distances, move, state_inside
from capture_sim.kernels import kernel
from capture_sim.model.contact import normal_force
from capture_sim.model.equations import (
    axial_force,
    gap_acceleration,
    gap_and_rate,
    hinge_torque,
    stop_force,
    tip_in_cone,
)
from capture_sim.samples import EXTREME_NAMES
from capture_sim.solver.roots import cubic_minimum

_GOLDEN = 0.6180339887498949
#: Of the segment: how far from the best of some places the largest value may lie, where golden
#: sections give way to parabolas, and how near these go.
_BRACKET, _PARABOLAS, _NEAREST = 0.25, 0.05, 1e-6
#: Of the sum of both slopes: no cubic rises above its ends by more than 4/27 of it; and by how
#: much the quantity may rise above the cubic.
_CUBIC_RISE, _ABOVE_CUBIC = 0.25, 0.02
#: Of the rates at a touch's ends and middle: how much larger one inside may be.
_RATE_RISE = 1.0


class Watched(IntEnum):
    """A quantity whose largest value is searched, with a side where there are two."""

    STROKE = 0  # -1 inwards, +1 outwards
    TORSION = 1  # either sense
    NEARNESS = 2  # minus the distance of the tip to the centre of BE
    PENETRATION = 3  # of the wall on that side
    PENETRATION_RATE = 4
    NORMAL_FORCE = 5
    BUFFER_FORCE = 6  # of spring, damper, stop and seat; -1 pulling, +1 pushing the probe out
    BUFFER_TORQUE = 7  # either sense
    LATCH_FORCE = 8


STROKE_IN, STROKE_OUT, TORSION, BUFFER_FORCE, BUFFER_TORQUE = (
    np.int64(EXTREME_NAMES.index(name))
    for name in ("axial_stroke_in", "axial_stroke_out", "torsion", "buffer_force", "buffer_torque")
)
NORMAL_FORCE_PLUS_Y, LATCH_FORCE, PENETRATION, TIP_DISTANCE = (
    np.int64(EXTREME_NAMES.index(name))
    for name in ("normal_force_plus_y", "latch_force", "penetration", "tip_distance")
)


@kernel
def buffer_force_at(y, system):
    """Return the force of the axial spring, its damper, a stop and the seat on the probe, N."""
    par, stop = system.par, system.mode.stop
    if system.mode.seated:
        return seat_load(y, system)
    stroke, rate = y[4] - par.h_0, y[12]
    force, _ = axial_force(stroke, rate, par)
    if stop:
        push, _ = stop_force(stroke, rate, stop, par)
        force += push
    return force


@kernel
def buffer_torque_at(y, par):
    """Return the torque of the torsional spring and its damper on the cylinder, N m."""
    torque, _ = hinge_torque(y[3] - y[2], y[11] - y[10], par)
    return torque


@kernel
def latch_force_at(y, system):
    """Return the magnitude of the latch's force on the tip, N."""
    par, mode = system.par, system.mode
    px, py, wx, wy = tip_in_cone(y, par)
    return math.hypot(
        par.k_L * (px - mode.latch_x) + par.c_L * wx, par.k_L * (py - mode.latch_y) + par.c_L * wy
    )


@kernel
def value_at(w, x, quantity, side):
    """Return a quantity at the fraction ``x`` of the present step."""
    state_inside(w, x)
    y, par = w.y_x, w.system.par
    if quantity == Watched.BUFFER_FORCE:
        return side * buffer_force_at(y, w.system)
    if quantity == Watched.BUFFER_TORQUE:
        return side * buffer_torque_at(y, par)
    if quantity == Watched.LATCH_FORCE:
        return latch_force_at(y, w.system)
    if quantity == Watched.STROKE:
        return side * (y[4] - par.h_0)
    if quantity == Watched.TORSION:
        return side * (y[3] - y[2])
    px, py, wx, wy = tip_in_cone(y, par)
    if quantity == Watched.NEARNESS:
        return -math.hypot(px + par.L_T, py)
    gap, rate, _, _ = gap_and_rate(px, py, wx, wy, side, par)
    if quantity == Watched.PENETRATION:
        return -gap
    if quantity == Watched.PENETRATION_RATE:
        return -rate
    force, _ = normal_force(-gap, -rate, par.K, w.system.mode.touch[0 if side > 0 else 1].chi)
    return force


@kernel
def largest_inside(w, quantity, side, x):
    """Return place and value of a quantity's largest value within the present segment.

    It is near ``x``, or near one of the segment's quarters.
    """
    x_end = w.step.x_end
    f = value_at(w, x, quantity, side)
    for quarter in range(1, 4):
        x1 = 0.25 * quarter * x_end
        f1 = value_at(w, x1, quantity, side)
        if f1 > f:
            x, f = x1, f1
    a, b = max(0.0, x - _BRACKET * x_end), min(x_end, x + _BRACKET * x_end)
    x1 = b - _GOLDEN * (b - a)
    x2 = a + _GOLDEN * (b - a)
    f1 = value_at(w, x1, quantity, side)
    f2 = value_at(w, x2, quantity, side)
    while b - a > _PARABOLAS * x_end:
        if f1 < f2:
            a, x1, f1 = x1, x2, f2
            x2 = a + _GOLDEN * (b - a)
            f2 = value_at(w, x2, quantity, side)
        else:
            b, x2, f2 = x2, x1, f1
            x1 = b - _GOLDEN * (b - a)
            f1 = value_at(w, x1, quantity, side)
    x, f = (x1, f1) if f1 > f2 else (x2, f2)
    # then parabolas through three places, ever closer
    width = 0.5 * (b - a)
    for _ in range(5):
        width = min(width, x, x_end - x)
        if width < _NEAREST * x_end:
            break
        left = value_at(w, x - width, quantity, side)
        right = value_at(w, x + width, quantity, side)
        bend = left - 2.0 * f + right
        shift = 0.5 * (left - right) / bend if bend < 0.0 else math.copysign(1.0, right - left)
        trial = x + width * min(1.0, max(-1.0, shift))
        top = value_at(w, trial, quantity, side)
        if top > f:
            x, f = trial, top
        if abs(shift) < 1.0:
            width *= 0.1
            if abs(shift) < 0.1 and width < 1e-3 * x_end:
                break
    return x, f


@kernel
def keep(totals, row, slot, value, t):
    """Keep a value that is larger than the largest so far."""
    if value > totals.extreme[row, slot]:
        totals.extreme[row, slot] = value
        totals.extreme_time[row, slot] = t


@kernel
def rise_inside(w, quantity, side, largest, v_a, d_a, v_b, d_b):
    """Return place and value of a maximum above ``largest`` inside a segment; -1 if there is none.

    Values and rates are those at the segment's ends.
    """
    width = w.step.x_end * w.step.h
    changes = width * (abs(d_a) + abs(d_b))
    if max(v_a, v_b) + _CUBIC_RISE * changes <= largest:
        return -1.0, largest
    place, low = cubic_minimum(-v_a, -d_a * width, -v_b, -d_b * width)
    if place < 0.0 or -low + _ABOVE_CUBIC * changes <= largest:
        return -1.0, largest
    x, value = largest_inside(w, quantity, side, place * w.step.x_end)
    if value > largest:
        return x, value
    return -1.0, largest


@kernel
def watch(w, quantity, side, slot, v_a, d_a, v_b, d_b):
    """Keep a quantity's largest value over a segment; values and rates are those at its ends."""
    step, totals, row = w.step, w.totals, w.system.mode.latched
    keep(totals, row, slot, v_b, step.t1)
    x, value = rise_inside(w, quantity, side, totals.extreme[row, slot], v_a, d_a, v_b, d_b)
    if x >= 0.0:
        keep(totals, row, slot, value, step.t0 + x * step.h)


@kernel
def watch_extremes(w):
    """Keep strokes, torsion, nearest distance and those of the touches of the segment that ends."""
    start, end = w.step.start, w.step.end
    mode, par = w.system.mode, w.system.par
    a, b = w.stepper.y, w.y_end
    for side in (-1.0, 1.0):
        slot = STROKE_IN if side < 0.0 else STROKE_OUT
        s_a, s_b = side * (a[4] - par.h_0), side * (b[4] - par.h_0)
        watch(w, Watched.STROKE, side, slot, s_a, side * a[12], s_b, side * b[12])
        t_a, t_b = side * (a[3] - a[2]), side * (b[3] - b[2])
        r_a, r_b = side * (a[11] - a[10]), side * (b[11] - b[10])
        watch(w, Watched.TORSION, side, TORSION, t_a, r_a, t_b, r_b)
    d_a, d_b = start.gap[2] + par.latch_radius, end.gap[2] + par.latch_radius
    watch(w, Watched.NEARNESS, 0.0, TIP_DISTANCE, -d_a, -start.gap_rate[2], -d_b, -end.gap_rate[2])
    for i in range(2):
        if mode.touch[i].on:
            watch_touch(w, i)


@kernel
def force_and_rate(depth, rate, acceleration, K, chi):
    """Return the normal force (N) and its rate (N/s) by the penetration and its derivatives."""
    force, _ = normal_force(depth, rate, K, chi)
    if force <= 0.0:
        return 0.0, 0.0
    root = math.sqrt(depth)
    return force, root * (1.5 * rate * (K + chi * rate) + chi * depth * acceleration)


@kernel
def watch_touch(w, i):
    """Keep penetration, its rate and the normal force of wall ``i``, largest inside the segment."""
    step, stepper, K = w.step, w.stepper, w.system.par.K
    start, end = step.start, step.end
    side, touch = 1.0 - 2.0 * i, w.system.mode.touch[i]
    width = step.x_end * step.h
    p_a, r_a = -start.gap[i], -start.gap_rate[i]
    p_b, r_b = -end.gap[i], -end.gap_rate[i]
    watch(w, Watched.PENETRATION, side, PENETRATION, p_a, r_a, p_b, r_b)
    touch.largest_rate = max(touch.largest_rate, r_b)
    force, _ = normal_force(p_b, r_b, K, touch.chi)
    if force > touch.peak_force:
        touch.peak_force = force
        touch.peak_time = step.t1
    # the rate in the middle of the cubic, and how far from these rates it may be inside
    r_m = 1.5 * (p_b - p_a) / width - 0.25 * (r_a + r_b)
    swing = abs(r_a) + abs(r_b) + abs(r_m)
    rate = max(r_a, r_b, r_m) + _RATE_RISE * swing
    depth = max(p_a, p_b) + _CUBIC_RISE * width * swing
    force, _ = normal_force(depth, rate, K, touch.chi)
    if rate > touch.largest_rate or force > touch.peak_force:
        a_a = -gap_acceleration(stepper.y, stepper.K[0], w.system.par, i)
        if step.x_end == 1.0:
            a_b = -gap_acceleration(w.y_end, stepper.K[stepper.stages], w.system.par, i)
        else:
            before = value_at(w, (1.0 - SMALL_MOVE) * step.x_end, Watched.PENETRATION_RATE, side)
            a_b = (r_b - before) / (SMALL_MOVE * width)
        _, touch.largest_rate = rise_inside(
            w, Watched.PENETRATION_RATE, side, touch.largest_rate, r_a, a_a, r_b, a_b
        )
        f_a, d_a = force_and_rate(p_a, r_a, a_a, K, touch.chi)
        f_b, d_b = force_and_rate(p_b, r_b, a_b, K, touch.chi)
        if step.x_end < 1.0 and step.t0 == touch.start:
            # all of the touch may lie in this segment, its force flat at both ends
            x, peak = largest_inside(w, Watched.NORMAL_FORCE, side, 0.5 * step.x_end)
        else:
            x, peak = rise_inside(
                w, Watched.NORMAL_FORCE, side, touch.peak_force, f_a, d_a, f_b, d_b
            )
        if peak > touch.peak_force:
            touch.peak_force = peak
            touch.peak_time = step.t0 + x * step.h
    slot = NORMAL_FORCE_PLUS_Y + i
    keep(w.totals, w.system.mode.latched, slot, touch.peak_force, touch.peak_time)


@kernel
def watch_loads(w):
    """Keep forces and torques of buffer and latch over the segment that ends."""
    step, stepper, system = w.step, w.stepper, w.system
    mode, par, small = system.mode, system.par, SMALL_MOVE * step.h
    y_a, y_b, near = stepper.y, w.y_end, stepper.y_stage
    first = 0 if mode.latched else 2  # the buffer depends on neither place nor speed of the chaser
    latch_a = latch_rate_a = 0.0
    # rates by small moves along the motion: they only decide where to look
    move(y_a, stepper.K[0], small, first, near)
    torque_a = buffer_torque_at(y_a, par)
    torque_rate_a = (buffer_torque_at(near, par) - torque_a) / small
    if mode.latched:
        latch_a = latch_force_at(y_a, system)
        latch_rate_a = (latch_force_at(near, system) - latch_a) / small
    if mode.seated:
        force_a, force_rate_a = step.seat_load[0], step.seat_load_rate[0]
    else:
        force_a = buffer_force_at(y_a, system)
        force_rate_a = (buffer_force_at(near, system) - force_a) / small
    if step.x_end == 1.0:
        move(y_b, stepper.K[stepper.stages], -small, first, near)
    else:
        state_inside(w, step.x_end - SMALL_MOVE)
        near = w.y_x
    torque_b = buffer_torque_at(y_b, par)
    torque_rate_b = (torque_b - buffer_torque_at(near, par)) / small
    if mode.seated and step.x_end == 1.0:
        force_b, force_rate_b = step.seat_load[1], step.seat_load_rate[1]
    else:
        force_b = buffer_force_at(y_b, system)
        force_rate_b = (force_b - buffer_force_at(near, system)) / small
    if mode.latched:
        latch_b = latch_force_at(y_b, system)
        latch_rate_b = (latch_b - latch_force_at(near, system)) / small
        watch(
            w, Watched.LATCH_FORCE, 1.0, LATCH_FORCE, latch_a, latch_rate_a, latch_b, latch_rate_b
        )
    # an impact, or a stop with a damper, changes the force at once
    keep(w.totals, mode.latched, BUFFER_FORCE, abs(force_a), step.t0)
    for side in (-1.0, 1.0):
        a, d_a, b, d_b = side * force_a, side * force_rate_a, side * force_b, side * force_rate_b
        watch(w, Watched.BUFFER_FORCE, side, BUFFER_FORCE, a, d_a, b, d_b)
        a, b = side * torque_a, side * torque_b
        d_a, d_b = side * torque_rate_a, side * torque_rate_b
        watch(w, Watched.BUFFER_TORQUE, side, BUFFER_TORQUE, a, d_a, b, d_b)


@kernel
def watch_rail(w, y):
    """Keep the distance at the end of a segment on the rail, along which it falls; t1 is there."""
    _, _, _, _, gap, _, _ = distances(y, w.system.par)
    keep(
        w.totals, w.system.mode.latched, TIP_DISTANCE, -(gap + w.system.par.latch_radius), w.step.t1
    )


@kernel
def begin_extremes(w):
    """Set the extremes of the phase that begins to the present values."""
    totals, y, row = w.totals, w.stepper.y, w.system.mode.latched
    for slot in range(totals.extreme.shape[1]):
        totals.extreme[row, slot] = 0.0
        totals.extreme_time[row, slot] = w.step.t0
    stroke = y[4] - w.system.par.h_0
    totals.extreme[row, STROKE_IN] = max(-stroke, 0.0)
    totals.extreme[row, STROKE_OUT] = max(stroke, 0.0)
    totals.extreme[row, TORSION] = abs(y[3] - y[2])
    totals.extreme[row, BUFFER_FORCE] = abs(buffer_force_at(y, w.system))
    totals.extreme[row, BUFFER_TORQUE] = abs(buffer_torque_at(y, w.system.par))
    if row:
        totals.extreme[row, LATCH_FORCE] = latch_force_at(y, w.system)
    _, _, _, _, gap, _, _ = distances(y, w.system.par)
    totals.extreme[row, TIP_DISTANCE] = -(gap + w.system.par.latch_radius)
