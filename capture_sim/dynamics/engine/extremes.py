"""Peak forces, strokes and penetrations, and the closest approach, also inside the steps.

A quantity can exceed its values at both ends of a segment only if the cubic through values and
rates has a maximum in between.  In such a segment the maximum is searched on the dense output.  The
extremes therefore do not depend on the sample times, and depend on the steps only within the error
of the run.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from capture_sim.base.compiled.kernels import inline_kernel, kernel
from capture_sim.dynamics.engine.events import held_load
from capture_sim.dynamics.engine.steps import (
    SMALL_MOVE,
    distance_to_edge,
    entry_inside,
    move_along,
    state_inside,
)
from capture_sim.dynamics.model.contact import (
    contact_slope,
    normal_force,
    normal_force_and_rate,
)
from capture_sim.dynamics.model.equations import (
    axial_force,
    axial_force_rate,
    gap_acceleration,
    gap_and_rate,
    hinge_torque,
    hinge_torque_rate,
    stop_force,
    tip_in_cone,
)
from capture_sim.dynamics.samples import EXTREME_NAMES
from capture_sim.dynamics.solver.roots import cubic_minimum

#: Upper limits, as shares of the sum of both slopes: of the rise of a cubic above its ends (which
#: never exceeds 4/27), and of the rise of the quantity above the cubic.
_CUBIC_RISE, _RISE_ERROR = 0.25, 0.02
#: In a sustained contact, the dense output ripples between the ends of a long segment.  A segment
#: is therefore searched if it is longer than _RIPPLE_ANGLE, rad of the contact's oscillation, and
#: its force is within _RIPPLE (a share) of the peak.
_RIPPLE_ANGLE, _RIPPLE = 1.0, 0.02
#: Points of a segment at which a quantity is evaluated first in the search for a maximum.  With 16
#: points the peaks change by at most 3e-8 and runs take 1.03 times as long.  From the ends and a
#: few points alone, a peak near an end is missed by up to 3e-5.
_PLACES = 8
#: Smallest distance between the points of a parabola, as a share of the segment.
_MIN_PARABOLA = 1e-6
#: Upper limit of the rise of a penetration rate inside a segment in contact, as a share of the sum
#: of the rates at its ends and its middle.
_RATE_RISE = 1.0

#: Entries of the state; typed, as each literal would be compiled as a case of its own.
_THETA_S, _THETA_P, _H = np.int64(2), np.int64(3), np.int64(4)


class Watched(IntEnum):
    """A quantity whose maximum is searched; some quantities have two sides, -1 and +1."""

    STROKE = 0  # -1 inwards, +1 outwards
    TORSION = 1  # either direction
    NEARNESS = 2  # minus the distance of the tip to the centre of BE
    PENETRATION = 3  # of the wall on that side
    PENETRATION_RATE = 4
    NORMAL_FORCE = 5
    BUFFER_FORCE = (
        6  # of spring, damper, friction, stop and seat; -1 pulling, +1 pushing the probe out
    )
    BUFFER_TORQUE = 7  # either direction
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
    """Return the force of axial spring, damper, friction, stop and seat on the probe, N."""
    if system.mode.held:
        return held_load(y, system)
    return sliding_force_at(y, system)


@inline_kernel
def sliding_force_at(y, system):
    """Return the force of :func:`buffer_force_at` for a probe that is not held, N."""
    par, stop = system.par, system.mode.stop
    stroke, rate = y[4] - par.h_0, y[12]
    force, _ = axial_force(stroke, rate, system.mode.slide_direction, par)
    if stop:
        push, _ = stop_force(stroke, rate, stop, par)
        force += push
    return force


@kernel
def buffer_torque_at(y, par):
    """Return the torque of the torsional spring and its damper on the cylinder, N m."""
    torque, _ = hinge_torque(y[3] - y[2], y[11] - y[10], par)
    return torque


@inline_kernel
def latch_force_of(tip, system):
    """Return the magnitude of the latch's force, N; ``tip`` is a result of :func:`tip_in_cone`."""
    par, mode = system.par, system.mode
    px, py, wx, wy = tip[0], tip[1], tip[2], tip[3]
    return math.hypot(
        par.k_L * (px - mode.latch_x) + par.c_L * wx, par.k_L * (py - mode.latch_y) + par.c_L * wy
    )


@kernel
def latch_force_at(y, system):
    """Return the magnitude of the latch's force on the tip, N."""
    return latch_force_of(tip_in_cone(y, system.par), system)


@kernel
def value_at(w, x, quantity, side):
    """Return a quantity at the fraction ``x`` of the present step."""
    y, par = w.scratch.watched, w.system.par
    if quantity == Watched.STROKE:
        return side * (entry_inside(w, x, _H) - par.h_0)
    if quantity == Watched.TORSION:
        return side * (entry_inside(w, x, _THETA_P) - entry_inside(w, x, _THETA_S))
    state_inside(w, x, y)
    if quantity == Watched.BUFFER_FORCE:
        return side * buffer_force_at(y, w.system)
    if quantity == Watched.BUFFER_TORQUE:
        return side * buffer_torque_at(y, par)
    if quantity == Watched.LATCH_FORCE:
        return latch_force_at(y, w.system)
    px, py, wx, wy = tip_in_cone(y, par)
    if quantity == Watched.NEARNESS:
        return -math.hypot(px + par.L_T, py)
    gap, rate, _, _ = gap_and_rate(px, py, wx, wy, side, par)
    if quantity == Watched.PENETRATION:
        return -gap
    if quantity == Watched.PENETRATION_RATE:
        return -rate
    chi = w.system.mode.touch[0 if side > 0 else 1].chi
    force, _ = normal_force(-gap, -rate, chi, par.contact)
    return force


@kernel
def largest_inside(w, quantity, side):
    """Return the maximum of a quantity within the present segment: fraction of the step, value.

    The search starts at the best of equidistant points and moves to the maximum of the parabola
    through three points.  The points become closer once the maximum is between them.
    """
    x_end = w.step.x_end
    width, x, f = x_end / _PLACES, 0.0, -math.inf
    for k in range(_PLACES):
        x_k = (k + 0.5) * width
        f_k = value_at(w, x_k, quantity, side)
        if f_k > f:
            x, f = x_k, f_k
    for _ in range(5):
        width = min(width, x, x_end - x)
        if width < _MIN_PARABOLA * x_end:
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
def keep_maximum(totals, row, slot, value, t):
    """Store a value and its time ``t`` (s) as the extreme ``slot`` if it is the largest so far.

    ``row`` is 0 before the latch closes and 1 afterwards.
    """
    if value > totals.extreme[row, slot]:
        totals.extreme[row, slot] = value
        totals.extreme_time[row, slot] = t


@inline_kernel
def may_exceed(largest, width, v_a, d_a, v_b, d_b):
    """Return True if the cubic through two values and rates may rise above ``largest``.

    ``width`` (s) is the length of the segment.  For most segments this cheap test is sufficient.
    """
    return max(v_a, v_b) + _CUBIC_RISE * width * (abs(d_a) + abs(d_b)) > largest


@inline_kernel
def is_monotonic(v_a, d_a, v_b, d_b):
    """Return True if the cubic through two values and slopes certainly has no maximum in between.

    The test is sufficient, and needs neither a root nor a division (Fritsch and Carlson 1980).
    """
    change = 3.0 * (v_b - v_a)
    return (min(d_a, d_b) >= 0.0 and max(d_a, d_b) < change) or (
        max(d_a, d_b) <= 0.0 and min(d_a, d_b) > change
    )


@kernel
def rise_inside(w, quantity, side, largest, v_a, d_a, v_b, d_b):
    """Return the fraction and the value of a maximum above ``largest`` inside the segment.

    ``v_a``, ``d_a``, ``v_b`` and ``d_b`` are values and rates at the ends of the segment.  Without
    such a maximum the result is (-1, ``largest``).
    """
    width = w.step.x_end * w.step.h
    if not may_exceed(largest, width, v_a, d_a, v_b, d_b):
        return -1.0, largest
    x_dip, dip = cubic_minimum(-v_a, -d_a * width, -v_b, -d_b * width)
    tolerance = _RISE_ERROR * width * (abs(d_a) + abs(d_b))
    if x_dip < 0.0 or -dip + tolerance <= largest:
        return -1.0, largest
    x, value = largest_inside(w, quantity, side)
    if value > largest:
        return x, value
    return -1.0, largest


@kernel
def watch(w, quantity, side, slot, v_a, d_a, v_b, d_b):
    """Update the extreme ``slot`` with a quantity's maximum over the ending segment.

    ``v_a``, ``d_a``, ``v_b`` and ``d_b`` are values and rates at the segment's start and end.
    """
    step, totals, row = w.step, w.totals, w.system.mode.latched
    # a force jumps at an impact, and at a stop with a damper
    keep_maximum(totals, row, slot, v_a, step.t0)
    keep_maximum(totals, row, slot, v_b, step.t1)
    width = step.x_end * step.h
    if is_monotonic(v_a, d_a * width, v_b, d_b * width):
        return
    x, value = rise_inside(w, quantity, side, totals.extreme[row, slot], v_a, d_a, v_b, d_b)
    if x >= 0.0:
        keep_maximum(totals, row, slot, value, step.t0 + x * step.h)


@inline_kernel
def watch_magnitude(w, quantity, slot, v_a, d_a, v_b, d_b):
    """Update the extreme ``slot`` with a quantity's largest magnitude over the ending segment.

    ``v_a``, ``d_a``, ``v_b`` and ``d_b`` are values and rates at the segment's start and end.
    """
    largest, width = w.totals.extreme[w.system.mode.latched, slot], w.step.x_end * w.step.h
    for side in (-1.0, 1.0):
        if may_exceed(largest, width, side * v_a, d_a, side * v_b, d_b):
            watch(w, quantity, side, slot, side * v_a, side * d_a, side * v_b, side * d_b)


@kernel
def watch_extremes(w):
    """Update the extremes of stroke, torsion, tip distance and contact with the ending segment."""
    start, end = w.step.start, w.step.end
    mode, par = w.system.mode, w.system.par
    a, b = w.stepper.y, w.y_end
    largest, width = w.totals.extreme[mode.latched], w.step.x_end * w.step.h
    for side in (-1.0, 1.0):
        slot = STROKE_IN if side < 0.0 else STROKE_OUT
        s_a, s_b, r_a, r_b = side * (a[4] - par.h_0), side * (b[4] - par.h_0), a[12], b[12]
        if may_exceed(largest[slot], width, s_a, r_a, s_b, r_b):
            watch(w, Watched.STROKE, side, slot, s_a, side * r_a, s_b, side * r_b)
    watch_magnitude(
        w, Watched.TORSION, TORSION, a[3] - a[2], a[11] - a[10], b[3] - b[2], b[11] - b[10]
    )
    d_a, d_b = start.gap[2] + par.latch_radius, end.gap[2] + par.latch_radius
    r_a, r_b = -start.gap_rate[2], -end.gap_rate[2]
    if may_exceed(largest[TIP_DISTANCE], width, -d_a, r_a, -d_b, r_b):
        watch(w, Watched.NEARNESS, 0.0, TIP_DISTANCE, -d_a, r_a, -d_b, r_b)
    for i in range(2):
        if mode.touch[i].on:
            watch_touch(w, i)


@inline_kernel
def may_ripple(w, touch, p_b, f_a, f_b):
    """Return True if the force of a sustained contact may exceed its peak within the segment.

    ``p_b`` is the penetration at the end of the segment, m; ``f_a`` and ``f_b`` are the forces at
    both ends, N.
    """
    par, width = w.system.par, w.step.x_end * w.step.h
    if p_b <= 0.0 or (1.0 + _RIPPLE) * max(f_a, f_b) <= touch.peak_force:
        return False
    stiffness, _ = contact_slope(p_b, touch.chi, par.contact)
    return width * width * stiffness > _RIPPLE_ANGLE * _RIPPLE_ANGLE * par.m_P


@kernel
def watch_touch(w, i):
    """Update the peaks of penetration, penetration rate and normal force of wall ``i``.

    They are those of the present touch, over the ending segment.
    """
    step, stepper, par = w.step, w.stepper, w.system.par
    start, end = step.start, step.end
    side, touch = 1.0 - 2.0 * i, w.system.mode.touch[i]
    width = step.x_end * step.h
    p_a, r_a = -start.gap[i], -start.gap_rate[i]
    p_b, r_b = -end.gap[i], -end.gap_rate[i]
    largest = w.totals.extreme[w.system.mode.latched, PENETRATION]
    if may_exceed(largest, width, p_a, r_a, p_b, r_b):
        watch(w, Watched.PENETRATION, side, PENETRATION, p_a, r_a, p_b, r_b)
    touch.largest_rate = max(touch.largest_rate, r_b)
    force, _ = normal_force(p_b, r_b, touch.chi, par.contact)
    force_a, _ = normal_force(p_a, r_a, touch.chi, par.contact)
    if may_ripple(w, touch, p_b, force_a, force):
        x, peak = largest_inside(w, Watched.NORMAL_FORCE, side)
        if peak > touch.peak_force:
            touch.peak_force = peak
            touch.peak_time = step.t0 + x * step.h
    if force > touch.peak_force:
        touch.peak_force = force
        touch.peak_time = step.t1
    # rate in the middle of the cubic, and upper limits of rate and depth inside the segment
    r_m = 1.5 * (p_b - p_a) / width - 0.25 * (r_a + r_b)
    swing = abs(r_a) + abs(r_b) + abs(r_m)
    rate = max(r_a, r_b, r_m) + _RATE_RISE * swing
    depth = max(p_a, p_b) + _CUBIC_RISE * width * swing
    force, _ = normal_force(depth, rate, touch.chi, par.contact)
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
        f_a, d_a = normal_force_and_rate(p_a, r_a, a_a, touch.chi, par.contact)
        f_b, d_b = normal_force_and_rate(p_b, r_b, a_b, touch.chi, par.contact)
        if step.x_end < 1.0 and step.t0 == touch.start:
            # the entire touch may lie in this segment, with zero force at both ends
            x, peak = largest_inside(w, Watched.NORMAL_FORCE, side)
        else:
            x, peak = rise_inside(
                w, Watched.NORMAL_FORCE, side, touch.peak_force, f_a, d_a, f_b, d_b
            )
        if peak > touch.peak_force:
            touch.peak_force = peak
            touch.peak_time = step.t0 + x * step.h
    slot = NORMAL_FORCE_PLUS_Y + i
    keep_maximum(w.totals, w.system.mode.latched, slot, touch.peak_force, touch.peak_time)


@inline_kernel
def buffer_force_rate(y, acceleration, system):
    """Return the time derivative of the force of :func:`sliding_force_at`, N/s.

    ``acceleration`` is that of the stroke, m/s^2.
    """
    par, stop = system.par, system.mode.stop
    stroke, rate = y[4] - par.h_0, y[12]
    total = axial_force_rate(stroke, rate, acceleration, par)
    if stop:
        total -= par.k_stop * rate + par.c_stop * acceleration
    return total


@inline_kernel
def write_loads(loads, y, axial, turning, system):
    """Write hinge torque, its rate, axial force and its rate into ``loads`` (4,).

    Units are N m, N m/s, N and N/s.  ``axial`` (m/s^2) and ``turning`` (rad/s^2) are the
    accelerations of stroke and torsion.  The force is that of a sliding probe.
    """
    par = system.par
    loads[0] = buffer_torque_at(y, par)
    loads[1] = hinge_torque_rate(y[3] - y[2], y[11] - y[10], turning, par)
    loads[2] = sliding_force_at(y, system)
    loads[3] = buffer_force_rate(y, axial, system)


@kernel
def watch_loads(w):
    """Update the peak forces and torques of buffer and latch with the ending segment."""
    step, stepper, system = w.step, w.stepper, w.system
    mode, y_b, f_b, loads = system.mode, w.y_end, stepper.K[stepper.stages], step.loads
    if not step.loads_kept:
        write_loads(loads, stepper.y, stepper.K[0, 12], stepper.K[0, 11] - stepper.K[0, 10], system)
    torque_a, turning_a, force_a, force_rate_a = loads[0], loads[1], loads[2], loads[3]
    axial_b, turning_b = f_b[12], f_b[11] - f_b[10]
    near_end, small = w.scratch.near_end, SMALL_MOVE * step.h
    if step.x_end < 1.0:
        # the rates only select where to search
        state_inside(w, step.x_end - SMALL_MOVE, near_end)
        axial_b = (y_b[12] - near_end[12]) / small
        turning_b = (y_b[11] - y_b[10] - near_end[11] + near_end[10]) / small
    write_loads(loads, y_b, axial_b, turning_b, system)
    step.loads_kept = 1
    watch_magnitude(
        w, Watched.BUFFER_TORQUE, BUFFER_TORQUE, torque_a, turning_a, loads[0], loads[1]
    )
    force_b, force_rate_b = loads[2], loads[3]
    if mode.held:
        force_a, force_rate_a = step.hold_load[0], step.hold_load_rate[0]
        force_b, force_rate_b = step.hold_load[1], step.hold_load_rate[1]
        if step.x_end < 1.0:
            force_b = buffer_force_at(y_b, system)
            force_rate_b = (force_b - buffer_force_at(near_end, system)) / small
    watch_magnitude(
        w, Watched.BUFFER_FORCE, BUFFER_FORCE, force_a, force_rate_a, force_b, force_rate_b
    )
    if mode.latched:
        watch_latch(w)


@kernel
def watch_latch(w):
    """Update the peak force of the latch with the ending segment.

    If the segment ends before its step does, :func:`watch_loads` has written
    ``w.scratch.near_end``.
    """
    step, stepper, system = w.step, w.stepper, w.system
    tip_a, tip_b, k, c = step.start.tip, step.end.tip, system.par.k_L, system.par.c_L
    latch_a, latch_b = latch_force_of(tip_a, system), latch_force_of(tip_b, system)
    # a coarse test with the mean acceleration
    width = step.x_end * step.h
    x, y = c / width * (tip_b[2] - tip_a[2]), c / width * (tip_b[3] - tip_a[3])
    rate_a = 2.0 * math.hypot(k * tip_a[2] + x, k * tip_a[3] + y)
    rate_b = 2.0 * math.hypot(k * tip_b[2] + x, k * tip_b[3] + y)
    largest = w.totals.extreme[system.mode.latched, LATCH_FORCE]
    if not may_exceed(largest, width, latch_a, rate_a, latch_b, rate_b):
        return
    near_start, near_end, small = w.scratch.near_start, w.scratch.near_end, SMALL_MOVE * step.h
    move_along(stepper.y, stepper.K[0], small, 0, near_start)
    if step.x_end == 1.0:
        move_along(w.y_end, stepper.K[stepper.stages], -small, 0, near_end)
    rate_a = (latch_force_at(near_start, system) - latch_a) / small
    rate_b = (latch_b - latch_force_at(near_end, system)) / small
    watch(w, Watched.LATCH_FORCE, 1.0, LATCH_FORCE, latch_a, rate_a, latch_b, rate_b)


@kernel
def watch_rail(w, y):
    """Update the closest approach with the end of a rail segment, where the distance is smallest.

    The distance is that from the tip's centre to the centre of BE.
    """
    px, py, wx, wy = tip_in_cone(y, w.system.par)
    distance, _ = distance_to_edge(px, py, wx, wy, w.system.par)
    keep_maximum(w.totals, w.system.mode.latched, TIP_DISTANCE, -distance, w.step.t1)


@kernel
def begin_extremes(w):
    """Start a new row of extremes with the present values: at the release, and at the latching."""
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
    px, py, wx, wy = tip_in_cone(y, w.system.par)
    distance, _ = distance_to_edge(px, py, wx, wy, w.system.par)
    totals.extreme[row, TIP_DISTANCE] = -distance
