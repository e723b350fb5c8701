"""What decides the length of a step: the permitted error, the step control, and upper limits.

A step is accepted if its error, weighted by :func:`error_scale`, is at most 1; :func:`next_factor`
makes the next step from that error, and :func:`step_length` limits it where events could be missed.
"""

from __future__ import annotations

import math

import numpy as np

from capture_sim.base.compiled.kernels import kernel
from capture_sim.dynamics.engine.state import N_WATCHED
from capture_sim.dynamics.model.contact import contact_slope, normal_force

# step control as in DOPRI5 and DOP853 (Hairer, Norsett and Wanner 1993, II.4)
SAFETY = 0.9
MIN_FACTOR = 0.2
MAX_FACTOR = 6.0
BETA = 0.04  # share of the previous error: Gustafsson's PI control
#: Lower limit of the previous error in the step control.
MIN_PREVIOUS_ERROR = 1e-4
#: At an error from this on, or NaN, the step shrinks by the smallest factor.
OVERFLOW = 1e300
#: Longest step in contact, rad of the contact's oscillation, less than a period: a longer step may
#: be accurate at its end but not in between, where samples and events are read.
_CONTACT_ANGLE = 5.0
#: Longest step with stops, a seat, friction in the slide or a table of forces, rad of the probe's
#: oscillation on the axial spring: the cubic through stroke and rate at the ends of a shorter step
#: shows every stop that is hit, and no steep part of the table is stepped over.
_STROKE_ANGLE = 2.0
#: Permitted error of a step in contact, as a share of the penetration.
_DEPTH_SHARE = 0.03
#: Shares of the time to the end of a touch at the present rate.  A step that would go beyond
#: _NEARLY ends at _PAST_END if the error of crossing the end is below _END_ERROR of the permitted
#: one, else at _TOWARDS_END.
_NEARLY, _PAST_END, _TOWARDS_END, _END_ERROR = 0.8, 1.02, 0.6, 0.3
#: Share of the time to the end of the run: a step goes a little past it and is cut there.
_RUN_END_REACH = 1.01
#: Share of the tip's or the latch's radius: the longest path of the tip in a step near a wall.
_NEAR = 0.25
#: Share of the fixed step: a time this close to a multiple of it counts as that multiple.
_GRID_TOLERANCE = 1e-9
#: Share of the fixed step: a longer step is a full one, not the rest after an event.
_FULL_STEP_SHARE = 0.999


def error_scale(par: np.void) -> np.ndarray:
    """Return the permitted error per step of each coordinate and rate: rtol times its scale.

    The scale is a length (the tip's radius) and a speed (of the approach), not the state's
    present value, so the weight of an error does not depend on the bench's place on the floor.
    An angle counts by the displacement that it causes at the tip.  ``par`` is of dtype PARAMETERS.
    """
    arm, at_target = float(par["a"] + par["h_0"]), float(par["L_T"] + par["R_c"])
    levers = (1.0, 1.0, arm, arm, 1.0, 1.0, 1.0, at_target)
    rtol, speed, length = float(par["rtol"]), float(par["speed_scale"]), float(par["length_scale"])
    lengths = [rtol * (length / lever) for lever in levers]
    speeds = [rtol * (speed / lever) for lever in levers]
    energy = rtol * float(par["m_P"]) * speed**2
    return np.array([*lengths, *speeds, *(N_WATCHED - 16) * [energy]])


@kernel
def raise_speed_scale(w):
    """Raise the speed scale of the error control to the present speeds and to those of a thrust.

    The scene's scale is that of its release.  A host may set other speeds, and a thrust may cause
    them later; with a scale near 0, no step would be accurate enough.  The speed of a thrust is
    that of a vehicle that starts from rest, after a path of the tip's radius.  The present speeds
    count from twice the scale on, so that runs as planned keep theirs.
    """
    par, y, thrust = w.system.par, w.stepper.y, w.system.mode.thrust
    arm, at_target = par.a + par.h_0, par.L_T + par.R_c
    speed = max(math.hypot(y[8] - y[13], y[9] - y[14]), abs(y[10]) * arm, abs(y[15]) * at_target)
    if not speed > 2.0 * par.speed_scale:
        speed = par.speed_scale
    if w.system.mode.thrusting:
        push = max(
            math.hypot(thrust[0], thrust[1]) / par.m_total,
            math.hypot(thrust[3], thrust[4]) * par.inverse_m_T,
            abs(thrust[2]) / par.I_S * arm,
            abs(thrust[5]) * par.inverse_I_T * at_target,
        )
        speed = max(speed, math.sqrt(2.0 * push * par.R_t))
    if not speed > par.speed_scale:
        return
    par.speed_scale = speed
    weights = w.stepper.weights
    for i in range(weights.shape[0]):
        if i < 8:
            continue  # positions have a length as their scale
        scale = par.rtol * par.m_P * speed**2
        if i < 16:
            lever = arm if i == 10 or i == 11 else at_target if i == 15 else 1.0
            scale = par.rtol * (speed / lever)
        weights[i] = min(weights[i], 1.0 / scale)


@kernel
def next_factor(error, previous, order):
    """Return the factor for the next step after an ``error`` (accepted if <= 1)."""
    if error == 0.0:
        return MAX_FACTOR
    if not error < OVERFLOW:
        return MIN_FACTOR
    growth = -(1.0 / order - 0.75 * BETA) * math.log(error)
    if error <= 1.0:
        growth += BETA * math.log(max(previous, MIN_PREVIOUS_ERROR))
    factor = SAFETY * math.exp(growth)
    return min(MAX_FACTOR, max(MIN_FACTOR, factor))


@kernel
def path_to_events(w):
    """Return the longest path of the tip in the present step that cannot miss an event, m.

    A distance changes no faster than the tip moves.  Far from the walls and the latch, the step
    ends before them; near them it is so short that gap and rate at its ends show every dip.
    """
    par, start = w.system.par, w.step.start
    path = math.inf
    if w.system.mode.latched:
        return path
    near = _NEAR * par.R_t
    for i in range(2):
        path = min(path, max(start.gap[i] - near, near))
    if par.has_latch:
        near = _NEAR * par.latch_radius
        path = min(path, max(start.gap[2] - near, near))
    return path


@kernel
def step_length(w):
    """Return the upper limit of the next step, s."""
    par, step = w.system.par, w.step
    if par.fixed_step > 0.0:
        # to the next multiple of the fixed step, also after an event
        multiple = math.floor(step.t0 / par.fixed_step + 1.0 + _GRID_TOLERANCE)
        left = multiple * par.fixed_step - step.t0
        if left > _FULL_STEP_SHARE * par.fixed_step:
            step.substeps = 0
        return left
    h = min(step.h_next, _RUN_END_REACH * (w.progress.t_stop - step.t0))
    if step.start.tip_speed > 0.0:
        h = min(h, path_to_events(w) / step.start.tip_speed)
    has_end = par.has_stops or par.preload > 0.0 or par.slide_friction > 0.0
    if (has_end or par.force_table.count > 0) and not w.system.mode.held:
        # the spring is stiffest at a stop
        stroke = max(-par.stop_compressed, abs(w.stepper.y[4] - par.h_0))
        if par.stop_extended < math.inf:
            stroke = max(stroke, par.stop_extended)
        stiffness = par.k_A + 3.0 * par.k_A3 * stroke * stroke + par.force_table.largest_slope
        if stiffness > 0.0:
            h = min(h, _STROKE_ANGLE * math.sqrt(par.m_P / stiffness))
    for i in range(2):
        touch, depth = w.system.mode.touch[i], -step.start.gap[i]
        if touch.on and depth > 0.0:
            stiffness, damping = contact_slope(depth, touch.chi, par.contact)
            rate = max(math.sqrt(stiffness / par.m_P), damping / par.m_P)
            if rate > 0.0:
                h = min(h, _CONTACT_ANGLE / rate)
            opening = step.start.gap_rate[i]
            if opening * h > _NEARLY * depth:
                # F ~ t^1.5 at the end of a touch: a step across it errs by about F t^2 / m_P
                left = depth / opening
                allowed = min(par.rtol * par.length_scale, _DEPTH_SHARE * touch.depth)
                _, elastic = normal_force(depth, 0.0, 0.0, par.contact)
                is_small = elastic * left * left < _END_ERROR * allowed * par.m_P
                h = min(h, (_PAST_END if is_small else _TOWARDS_END) * left)
    return h


@kernel
def update_depths(w):
    """Keep the largest penetration of each touch at the start of a step, for the error scale."""
    for i in range(2):
        touch = w.system.mode.touch[i]
        if touch.on:
            touch.depth = max(touch.depth, -w.step.start.gap[i])


@kernel
def contact_share(w):
    """Return the factor on the error of a step in contact, above 1 for a small penetration."""
    par, share = w.system.par, 1.0
    for i in range(2):
        touch = w.system.mode.touch[i]
        if touch.on:
            share = max(share, par.rtol * par.length_scale / (_DEPTH_SHARE * touch.depth))
    return share
