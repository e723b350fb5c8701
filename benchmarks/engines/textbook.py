"""The bench with a textbook DOP853 and nothing else, compiled.

16 states under error control, no energy ledger, no peak loads, no limit of a step by the path to
an event.  A touch or lift-off is a change of sign of a gap between two ends of a step, located in
the dense output; the solver then restarts.  The right-hand side is the engine's own, called from
compiled code, so what differs is the integrator (Hairer, Norsett and Wanner 1993, II.5 and II.6;
the coefficients are SciPy's).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate._ivp import dop853_coefficients as table

from benchmarks.engines.own import packed
from benchmarks.trial import TOUCHED, Outcome
from capture_sim.base.compiled.kernels import entry_kernel, kernel
from capture_sim.dynamics.bench import error_scale
from capture_sim.dynamics.model.equations import (
    N_STATE,
    N_TOTAL,
    gap_and_rate,
    make_system,
    rate_of_change,
    tip_in_cone,
)
from capture_sim.scene.parts import Scene

_A, _D = np.ascontiguousarray(table.A), table.D.copy()  # the weights are A's row 12
_E3, _E5 = table.E3.copy(), table.E5.copy()
JUST_OFF = 1e-13  # m: gap at which a touch has ended, see scipy_ivp
_ROOM = 4096  # touches


@kernel
def wall_gap(y, par, wall):
    """Return a wall's gap (m) and its rate (m/s)."""
    px, py, wx, wy = tip_in_cone(y, par)
    gap, rate, _, _ = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * wall, par)
    return gap, rate


@kernel
def stage(y, K, A, row, n, h, y_stage):
    """Write y + h sum(A[row, j] K[j]) over the first n stages into ``y_stage``."""
    for i in range(N_STATE):
        y_stage[i] = y[i]
    for j in range(n):
        weight = h * A[row, j]
        if weight != 0.0:
            for i in range(N_STATE):
                y_stage[i] += weight * K[j, i]


@kernel
def weighted_sum(weights, K, n, total):
    """Write sum(weights[j] K[j]) over the first n stages into ``total``."""
    for i in range(N_STATE):
        total[i] = 0.0
    for j in range(n):
        weight = weights[j]
        if weight != 0.0:
            for i in range(N_STATE):
                total[i] += weight * K[j, i]


@kernel
def square(values, atol):
    """Return the sum of the squares of values by their tolerances."""
    total = 0.0
    for i in range(N_STATE):
        total += (values[i] / atol[i]) ** 2
    return total


@kernel
def interpolate(y, F, x, y_inside):
    """Write the dense output at the fraction ``x`` of a step into ``y_inside``."""
    for i in range(N_STATE):
        value = 0.0
        for k in range(6, -1, -1):
            value = (value + F[k, i]) * (x if k % 2 == 0 else 1.0 - x)
        y_inside[i] = y[i] + value


@entry_kernel
def solve_textbook(systems, y, atol, t_end, A, D, E3, E5, touches, latest, room, work):
    """Integrate from 0 to ``t_end`` (s); return the number of touches and of evaluations.

    The number of touches is -1 if the step falls below 1e-15 s, -2 if ``touches`` is full.

    ``y`` (N_TOTAL,) holds the state and is changed; ``room`` (2, 16, N_TOTAL) and ``work``
    (3, N_TOTAL) are overwritten; ``touches`` receives rows of start, end and wall,
    ``latest`` (2,) the number of each wall's last touch.
    """
    system = systems[0]
    par, touch = system.par, system.mode.touch
    K, F = room[0], room[1]
    y_stage, y_new, y_inside = work[0], work[1], work[2]
    t, h, n_touches, count = 0.0, 1e-6, 0, 1
    rate_of_change(t, y, K[0], system)
    while t < t_end:
        if h < 1e-15:
            return -1, count
        h = min(h, t_end - t)
        for s in range(1, 12):
            stage(y, K, A, s, s, h, y_stage)
            rate_of_change(t, y_stage, K[s], system)
        stage(y, K, A, 12, 12, h, y_new)
        rate_of_change(t, y_new, K[12], system)
        count += 12
        weighted_sum(E3, K, 13, y_inside)
        error_3 = square(y_inside, atol)
        weighted_sum(E5, K, 13, y_inside)
        error_5 = square(y_inside, atol)
        error = 0.0
        if error_5 != 0.0:
            error = h * error_5 / math.sqrt((error_5 + 0.01 * error_3) * N_STATE)
        if not error < math.inf:  # a stage has left the numbers
            error = math.inf
        factor = min(6.0, max(0.333, 0.9 * error**-0.125)) if error > 0.0 else 6.0
        if not error < 1.0:
            h *= min(factor, 1.0)
            continue
        x_event, wall = 2.0, -1
        for i in range(2):
            zero = JUST_OFF if touch[i].on else 0.0
            end, _ = wall_gap(y_new, par, i)
            if (end - zero > 0.0) != (touch[i].on == 1):
                continue
            if wall < 0:
                for s in range(13, 16):
                    stage(y, K, A, s, s, h, y_stage)
                    rate_of_change(t, y_stage, K[s], system)
                count += 3
                dense_output(y, y_new, K, F, D, h)
            low, high = 0.0, 1.0
            for _ in range(60):
                middle = 0.5 * (low + high)
                interpolate(y, F, middle, y_inside)
                gap, _ = wall_gap(y_inside, par, i)
                if (gap - zero > 0.0) == (touch[i].on == 1):
                    high = middle
                else:
                    low = middle
                if (high - low) * h < 1e-15:
                    break
            if high < x_event:
                x_event, wall = high, i
        if wall < 0:
            t += h
            for i in range(N_STATE):
                y[i], K[0, i] = y_new[i], K[12, i]
        else:
            interpolate(y, F, x_event, y_inside)
            t += x_event * h
            for i in range(N_STATE):
                y[i] = y_inside[i]
            if touch[wall].on:
                touch[wall].on = 0
                touch[wall].chi = 0.0
                touches[latest[wall], 1] = t
            elif n_touches == len(touches):
                return -2, count
            else:
                _, rate = wall_gap(y, par, wall)
                touch[wall].on = 1
                touch[wall].chi = par.hysteresis * par.K / max(-rate, par.v_0_floor)
                touches[n_touches, 0], touches[n_touches, 1] = t, math.nan
                touches[n_touches, 2] = 1.0 - 2.0 * wall
                latest[wall] = n_touches
                n_touches += 1
            rate_of_change(t, y, K[0], system)
            count += 1
        h *= factor
    return n_touches, count


@kernel
def dense_output(y, y_new, K, F, D, h):
    """Write the coefficients of the dense output of order 7 into ``F`` (7, N_TOTAL)."""
    for i in range(N_STATE):
        change = y_new[i] - y[i]
        F[0, i] = change
        F[1, i] = h * K[0, i] - change
        F[2, i] = 2.0 * change - h * (K[12, i] + K[0, i])
    for k in range(4):
        for i in range(N_STATE):
            F[3 + k, i] = 0.0
        for j in range(16):
            weight = h * D[k, j]
            if weight != 0.0:
                for i in range(N_STATE):
                    F[3 + k, i] += weight * K[j, i]


def prepare(scene: Scene) -> tuple[Callable[[], Any], Callable[[Any], Outcome]]:
    """Set a run up at the scene's ``run.rtol``; return what runs it and what reads the outcome."""
    parameters = packed(scene)
    system, y = make_system(parameters), np.zeros(N_TOTAL)
    y[:N_STATE] = np.concatenate(scene.initial_coordinates())
    touches = np.zeros((_ROOM, 3))
    latest, room, work = np.zeros(2, np.int64), np.zeros((2, 16, N_TOTAL)), np.zeros((3, N_TOTAL))
    options = (error_scale(parameters[0])[:N_STATE], scene.run.t_end, _A, _D, _E3, _E5)

    def read(found: tuple[int, int]) -> Outcome:
        count, evaluations = found
        if count < 0:
            reason = "the step fell below 1e-15 s" if count == -1 else f"more than {_ROOM} touches"
            return Outcome.failed(reason, evaluations)
        rows = np.zeros(count, TOUCHED)
        rows["start"], rows["end"], rows["wall"] = touches[:count].T
        rows["peak_force"] = np.nan
        return Outcome(q=y[:8].copy(), evaluations=evaluations, touches=rows)

    return lambda: solve_textbook(system, y, *options, touches, latest, room, work), read
