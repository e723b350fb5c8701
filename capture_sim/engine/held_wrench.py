"""Motion with a wrench on the tip from outside the model, or with a law of the walls.

For hardware in the loop: steps of fixed length.  The wrench from outside is held over a step; the
law of the walls is evaluated at every stage of every Runge-Kutta step.  Stroke stops, the seat of a
preloaded probe and the latch are met where their distance passes zero, and the seat is left where
the load on it reaches the preload: the Runge-Kutta step ends there, inside the step of the loop,
before its result is sent.
"""

from __future__ import annotations

import math

import numpy as np

from capture_sim.engine.events import event_value
from capture_sim.kernels import entry_kernel, inline_kernel, kernel
from capture_sim.model.equations import (
    AXIAL,
    LATCH,
    N_TOTAL,
    STOP,
    TORSION,
    buffer_energy,
    gap_and_rate,
    rate_of_change,
    slip_speed,
    strike_seat,
    tip_in_cone,
)
from capture_sim.model.observe import kinetic_energy
from capture_sim.model.trig import hyperbolic_tangent
from capture_sim.samples import EventKind

#: The state of the free phases, followed by the integral of the force's magnitude (N s).
N_LOOP = N_TOTAL + 1
IMPULSE_SIZE = N_TOTAL

#: Contact of the tip with either wall; see :class:`capture_sim.hardware.law.WallLaw`.
LAW = np.dtype(
    [
        ("stiffness", "f8"),  # N/m^exponent
        ("exponent", "f8"),
        ("damping", "f8"),  # N s/m^(exponent + 1)
        ("offset", "f8"),  # m, of the walls towards the tip
        ("friction", "f8"),
        ("slip_speed", "f8"),  # m/s
    ],
    align=True,
)

#: Columns of a trace: pose of the tip and its rates in the target's frame, force on the tip, all
#: at the begin of a Runge-Kutta step; energy at its end, as :func:`stored_energy` has it.
TRACE_COLUMNS = 9
ENERGY = 8


@inline_kernel
def _drive(y, system, law, fx, fy, torque):
    """Set the wrench on the tip: that of the law and the one held.

    Latched, the walls have let go: neither acts.
    """
    mode = system.mode
    mode.driven = 1
    if mode.latched:
        mode.wrench[0] = 0.0
        mode.wrench[1] = 0.0
        mode.wrench[2] = 0.0
        return
    wx, wy, wt = fx, fy, torque
    if law.stiffness > 0.0:
        par = system.par
        px, py, vx, vy = tip_in_cone(y, par)
        spin = y[11] - y[15]
        for i in range(2):
            gap, rate, nx, ny = gap_and_rate(px, py, vx, vy, 1.0 - 2.0 * i, par)
            depth = law.offset - gap
            if depth > 0.0:
                force = depth**law.exponent * (law.stiffness - law.damping * rate)
                force = max(force, 0.0)
                slip = slip_speed(gap, nx, ny, vx, vy, spin, par)
                friction = -law.friction * force * hyperbolic_tangent(slip / law.slip_speed)
                wx += force * nx - friction * ny
                wy += force * ny + friction * nx
                wt -= (gap + par.R_t) * friction
    mode.wrench[0] = wx
    mode.wrench[1] = wy
    mode.wrench[2] = wt


@kernel
def _rate(y, f, system, law, fx, fy, torque):
    _drive(y, system, law, fx, fy, torque)
    rate_of_change(0.0, y, f, system)
    wrench = system.mode.wrench
    f[IMPULSE_SIZE] = math.sqrt(wrench[0] * wrench[0] + wrench[1] * wrench[1])


@inline_kernel
def _note(y, row, system):
    px, py, wx, wy = tip_in_cone(y, system.par)
    row[0] = px
    row[1] = py
    row[2] = y[3] - y[7]
    row[3] = wx
    row[4] = wy
    row[5] = y[11] - y[15]
    row[6] = system.mode.wrench[0]
    row[7] = system.mode.wrench[1]


@kernel
def _runge_kutta(y, stages, system, law, h, fx, fy, torque):
    """Go one step by the classical Runge-Kutta method."""
    trial = stages[4]
    for stage in range(1, 4):
        share = h if stage == 3 else 0.5 * h
        for i in range(y.shape[0]):
            trial[i] = y[i] + share * stages[stage - 1, i]
        _rate(trial, stages[stage], system, law, fx, fy, torque)
    for i in range(y.shape[0]):
        slope = stages[0, i] + 2.0 * (stages[1, i] + stages[2, i]) + stages[3, i]
        y[i] += h / 6.0 * slope


@inline_kernel
def _has_come(before, y, system, event, which):
    start, _ = event_value(before, system.par, event, which)
    end, _ = event_value(y, system.par, event, which)
    return end < 0.0 <= start


@kernel
def _next_event(before, y, spare, system, law, fx, fy, torque):
    """Return what has come between two states: an event and its stop; -1 if nothing has.

    ``spare`` (N_LOOP,) is overwritten.
    """
    par, mode = system.par, system.mode
    if mode.seated:
        _rate(y, spare, system, law, fx, fy, torque)
        if system.out.axial_force > par.preload:
            return EventKind.UNSEATED, 0
    elif par.preload > 0.0 and _has_come(before, y, system, EventKind.SEATED, 0):
        return EventKind.SEATED, 0
    if par.has_latch and not mode.latched and _has_come(before, y, system, EventKind.LATCHED, 0):
        return EventKind.LATCHED, 0
    if par.has_stops:
        for side in (-1, 1):
            if mode.stop == -side or (side > 0 and par.stop_extended == math.inf):
                continue
            event = EventKind.STOP_LEFT if mode.stop == side else EventKind.STOP_HIT
            if _has_come(before, y, system, event, side):
                return event, side
    return -1, 0


#: Halvings that locate an event: to rounding of the place in a Runge-Kutta step.
_HALVINGS = 50
#: Events located within one Runge-Kutta step: bounds its cost.
_MOST_EVENTS = 8


@kernel
def _meet(y, stages, system, law, h, fx, fy, torque):
    """Go one Runge-Kutta step, cut at an event of buffer or latch; return its length, s."""
    before, spare = stages[5], stages[4]
    for i in range(y.shape[0]):
        before[i] = y[i]
    _runge_kutta(y, stages, system, law, h, fx, fy, torque)
    event, which = _next_event(before, y, spare, system, law, fx, fy, torque)
    if event < 0:
        return h
    low, high = 0.0, h
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        for i in range(y.shape[0]):
            y[i] = before[i]
        _runge_kutta(y, stages, system, law, middle, fx, fy, torque)
        earlier, its = _next_event(before, y, spare, system, law, fx, fy, torque)
        if earlier >= 0:
            high, event, which = middle, earlier, its
        else:
            low = middle
    for i in range(y.shape[0]):
        y[i] = before[i]
    _runge_kutta(y, stages, system, law, high, fx, fy, torque)
    mode = system.mode
    if event == EventKind.LATCHED:
        px, py, _, _ = tip_in_cone(y, system.par)
        mode.latched = 1
        mode.latch_x = px
        mode.latch_y = py
    elif event == EventKind.UNSEATED:
        mode.seated = 0
    elif event == EventKind.SEATED:
        mode.seated = 1
        y[4] = system.par.h_0
        y[STOP] += strike_seat(y, system.par)
    else:
        mode.stop = which if event == EventKind.STOP_HIT else 0
    return high


@kernel
def _energy(y, system, law):
    p, mode = system.par, system.mode
    stroke, torsion = y[4] - p.h_0, y[3] - y[2]
    axial, turning = buffer_energy(stroke, torsion, p)
    energy = kinetic_energy(y, p) + axial + turning
    if mode.stop:
        past = stroke - (p.stop_compressed if mode.stop < 0 else p.stop_extended)
        energy += 0.5 * p.k_stop * past * past
    px, py, vx, vy = tip_in_cone(y, p)
    if mode.latched:
        energy += 0.5 * p.k_L * ((px - mode.latch_x) ** 2 + (py - mode.latch_y) ** 2)
    elif law.stiffness > 0.0:
        for i in range(2):
            gap, _, _, _ = gap_and_rate(px, py, vx, vy, 1.0 - 2.0 * i, p)
            depth = law.offset - gap
            if depth > 0.0:
                energy += law.stiffness * depth ** (law.exponent + 1.0) / (law.exponent + 1.0)
    return energy + y[AXIAL] + y[TORSION] + y[LATCH] + y[STOP]


@entry_kernel
def step_with_wrench(systems, laws, y, stages, trace, h, fx, fy, torque):
    """Go one step of ``h`` (s) by the classical Runge-Kutta method for each row of the trace.

    ``y`` (N_LOOP,) is changed; ``stages`` (6, N_LOOP) is overwritten; ``trace`` (n, 9) receives
    tip, force and energy.  The wrench held is in the target's axes.
    """
    system = systems[0]
    law = laws[0]
    for k in range(trace.shape[0]):
        left = h
        events = 0
        while left > 0.0:
            _rate(y, stages[0], system, law, fx, fy, torque)
            is_lifted = system.mode.seated and system.out.axial_force > system.par.preload
            if is_lifted and events < _MOST_EVENTS:
                system.mode.seated = 0
                _rate(y, stages[0], system, law, fx, fy, torque)
            if left == h:
                _note(y, trace[k], system)
            if events < _MOST_EVENTS:
                left -= _meet(y, stages, system, law, left, fx, fy, torque)
                events += 1
            else:
                _runge_kutta(y, stages, system, law, left, fx, fy, torque)
                left = 0.0
        trace[k, ENERGY] = _energy(y, system, law)


@entry_kernel
def tip_state(systems, y):
    """Return the tip in the target's frame: x, y (m), heading, and their rates against it."""
    px, py, wx, wy = tip_in_cone(y, systems[0].par)
    return px, py, y[3] - y[7], wx, wy, y[11] - y[15]


@entry_kernel
def stored_energy(systems, laws, y):
    """Return the kinetic energy, that of the springs of buffer, stops, latch and law, and what the
    dampers of buffer, stops and latch have dissipated, J.
    """
    return _energy(y, systems[0], laws[0])
