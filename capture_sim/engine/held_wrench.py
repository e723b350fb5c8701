"""Motion under an external wrench on the tip, or under a contact law of the walls.

For hardware in the loop, with steps of fixed length.  The external wrench is held over a step; the
contact law is evaluated at every stage of every Runge-Kutta step.  A Runge-Kutta step ends at an
event: a stroke stop, the seat of a preloaded probe or the latch is reached, or the load on the seat
exceeds the preload.
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
    gap_and_rate,
    rate_of_change,
    slip_speed,
    strike_seat,
    tip_in_cone,
)
from capture_sim.model.observe import mechanical_energy
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
#: at the start of a Runge-Kutta step; energy at its end, see :func:`stored_energy`.
TRACE_COLUMNS = 9
ENERGY = 8


@inline_kernel
def _set_wrench(y, system, law, fx, fy, torque):
    """Set the wrench on the tip: contact law and held wrench together.

    Neither acts after the latch has closed.
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
    """Write dy/dt (N_LOOP,) into ``f``."""
    _set_wrench(y, system, law, fx, fy, torque)
    rate_of_change(0.0, y, f, system)
    wrench = system.mode.wrench
    f[IMPULSE_SIZE] = math.sqrt(wrench[0] * wrench[0] + wrench[1] * wrench[1])


@inline_kernel
def _write_tip(y, row, system):
    """Write pose, rates and force of the tip into a row of the trace."""
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
    """Take a classical Runge-Kutta step of ``h`` (s); stages[0] is dy/dt at its start."""
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
def _has_happened(y, system, event, which):
    """Return True if an event's function is below zero."""
    value, _ = event_value(y, system.par, event, which)
    return value < 0.0


@kernel
def _next_event(y, spare, system, law, fx, fy, torque):
    """Return an event that has happened but is not applied yet, and its stop; -1 if none.

    ``spare`` (N_LOOP,) is overwritten.
    """
    par, mode = system.par, system.mode
    if mode.seated:
        _rate(y, spare, system, law, fx, fy, torque)
        if system.out.axial_force > par.preload:
            return EventKind.UNSEATED, 0
    elif par.preload > 0.0 and _has_happened(y, system, EventKind.SEATED, 0):
        return EventKind.SEATED, 0
    if par.has_latch and not mode.latched and _has_happened(y, system, EventKind.LATCHED, 0):
        return EventKind.LATCHED, 0
    if par.has_stops:
        for side in (-1, 1):
            if mode.stop == -side or (side > 0 and par.stop_extended == math.inf):
                continue
            event = EventKind.STOP_LEFT if mode.stop == side else EventKind.STOP_HIT
            if _has_happened(y, system, event, side):
                return event, side
    return -1, 0


@kernel
def _energy(y, system, law):
    """Return what :func:`stored_energy` returns."""
    energy = mechanical_energy(y, system)
    if law.stiffness > 0.0 and not system.mode.latched:
        px, py, vx, vy = tip_in_cone(y, system.par)
        for i in range(2):
            gap, _, _, _ = gap_and_rate(px, py, vx, vy, 1.0 - 2.0 * i, system.par)
            depth = law.offset - gap
            if depth > 0.0:
                energy += law.stiffness * depth ** (law.exponent + 1.0) / (law.exponent + 1.0)
    return energy + y[AXIAL] + y[TORSION] + y[LATCH] + y[STOP]


#: Bisections that locate an event to round-off.
_HALVINGS = 50
#: Largest number of events located within one step of the loop, to limit its cost.
_MAX_EVENTS = 8


@kernel
def _step_to_event(y, stages, system, law, h, fx, fy, torque):
    """Take a step up to the first event of buffer or latch and apply that; return its length, s."""
    before, spare = stages[5], stages[4]
    for i in range(y.shape[0]):
        before[i] = y[i]
    _runge_kutta(y, stages, system, law, h, fx, fy, torque)
    event, which = _next_event(y, spare, system, law, fx, fy, torque)
    if event < 0:
        return h
    low, high = 0.0, h
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        for i in range(y.shape[0]):
            y[i] = before[i]
        _runge_kutta(y, stages, system, law, middle, fx, fy, torque)
        earlier_event, earlier_which = _next_event(y, spare, system, law, fx, fy, torque)
        if earlier_event >= 0:
            high, event, which = middle, earlier_event, earlier_which
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
        before_seat = _energy(y, system, law)
        y[4] = system.par.h_0
        y[STOP] += before_seat - _energy(y, system, law)
        y[STOP] += strike_seat(y, system.par)
        mode.seated = 1
    else:
        mode.stop = which if event == EventKind.STOP_HIT else 0
    return high


@entry_kernel
def step_with_wrench(systems, laws, y, stages, trace, h, fx, fy, torque):
    """Take a step of ``h`` (s) for each row of the trace, by the classical Runge-Kutta method.

    ``y`` (N_LOOP,) is changed; ``stages`` (6, N_LOOP) is overwritten; ``trace`` (n, 9) receives
    tip, force and energy.  The held wrench (N, N, N m) is in the target's axes.
    """
    system = systems[0]
    law = laws[0]
    for k in range(trace.shape[0]):
        left = h
        events = 0
        while left > 0.0:
            _rate(y, stages[0], system, law, fx, fy, torque)
            is_lifted = system.mode.seated and system.out.axial_force > system.par.preload
            if is_lifted and events < _MAX_EVENTS:
                system.mode.seated = 0
                _rate(y, stages[0], system, law, fx, fy, torque)
            if left == h:
                _write_tip(y, trace[k], system)
            if events < _MAX_EVENTS:
                left -= _step_to_event(y, stages, system, law, left, fx, fy, torque)
                events += 1
            else:
                _runge_kutta(y, stages, system, law, left, fx, fy, torque)
                left = 0.0
        trace[k, ENERGY] = _energy(y, system, law)


@entry_kernel
def tip_state(systems, y):
    """Return the tip in the target's frame: x, y (m), heading (rad), and their rates."""
    px, py, wx, wy = tip_in_cone(y, systems[0].par)
    return px, py, y[3] - y[7], wx, wy, y[11] - y[15]


@entry_kernel
def stored_energy(systems, laws, y):
    """Return the kinetic energy, that of the springs of buffer, stops, latch and law, and what the
    dampers of buffer, stops and latch have dissipated, J.
    """
    return _energy(y, systems[0], laws[0])
