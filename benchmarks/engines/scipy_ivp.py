"""The bench with SciPy's ``solve_ivp``, done as carefully as a good user would.

Each touch of a wall is a terminal event that latches the approach speed and restarts the
solver, and so is each lift-off.  Two traps are minded.  A restart lands on the event's own
zero: rounding may leave the gap on the wrong side of it, and ``solve_ivp`` then waits for a
change of sign that never comes, or sees one at once; a touch therefore ends a little beyond
zero, where the force has gone already.  And forces read at step ends miss their peaks: they are
read from the dense output.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.engines.problems import Problem
from benchmarks.trial import TOUCHED, Outcome

METHODS = ("DOP853", "RK45", "LSODA", "BDF", "Radau")
_JUST_OFF = 1e-13  # m: gap at which a touch has ended, a thousand times its rounding
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(7)


class TookTooLongError(Exception):
    """The time allowed for a run is over."""


@dataclass
class Touch:
    """A touch of a wall (0: +y, 1: -y); times in s, speed in m/s, force in N, impulse in N s."""

    wall: int
    start: float
    approach: float
    end: float = math.nan
    peak_force: float = math.nan
    impulse: float = math.nan


@dataclass
class ScipyRun:
    """A run as it comes out of :func:`solve`.

    Attributes
    ----------
    y : ndarray (16,)
        q and v at the end.
    touches : list of Touch
        In order of their starts.
    pieces : list of (solution, touches that are on)
        SciPy's dense output between two restarts, where it was asked for.
    failure : str
        Why it did not get to the end; empty if it did.
    """

    y: np.ndarray
    touches: list[Touch] = field(default_factory=list)
    pieces: list[tuple[Any, list[Touch]]] = field(default_factory=list)
    failure: str = ""


def solve(
    problem: Problem,
    y_0: np.ndarray,
    t_end: float,
    method: str,
    rtol: float,
    atol: np.ndarray,
    allowed: float,
    dense: bool = False,
) -> ScipyRun:
    """Integrate from t = 0 to ``t_end``.

    Parameters
    ----------
    problem
        With no wall in touch.
    y_0
        (16,) q and v at t = 0.
    t_end
        s.
    method
        One of :data:`METHODS`.
    rtol, atol
        As ``solve_ivp`` takes them; ``atol`` (16,).
    allowed
        Wall time, s.
    dense
        Keep the dense output, for :func:`read_forces`.
    """
    from scipy.integrate import solve_ivp

    deadline = time.perf_counter() + allowed
    run = ScipyRun(y_0)
    on: dict[int, Touch] = {}
    t = 0.0
    while t < t_end:
        try:
            piece = solve_ivp(
                problem.rate_of_change,
                (t, t_end),
                run.y,
                method=method,
                rtol=rtol,
                atol=atol,
                events=[_gap_event(problem, wall, wall in on, deadline) for wall in (0, 1)],
                dense_output=dense,
            )
        except TookTooLongError:
            run.failure = f"not done after {allowed:g} s"
            break
        except (ArithmeticError, ValueError) as error:
            run.failure = f"stopped: {error}"
            break
        if piece.status < 0 or not np.isfinite(piece.y[:, -1]).all():
            run.failure = f"stopped at {piece.t[-1]:.4f} s: {piece.message}"
            break
        if dense:
            run.pieces.append((piece.sol, list(on.values())))
        t, run.y = float(piece.t[-1]), np.ascontiguousarray(piece.y[:, -1])
        for wall in (0, 1):
            if not piece.t_events[wall].size:
                continue
            if wall in on:
                on.pop(wall).end = t
                problem.release(wall)
            else:
                approach = -problem.gap(run.y, wall)[1]
                problem.latch(wall, approach)
                on[wall] = Touch(wall, t, approach)
                run.touches.append(on[wall])
    return run


def _gap_event(
    problem: Problem, wall: int, touching: bool, deadline: float
) -> Callable[[float, np.ndarray], float]:
    """Return the event function of a wall: its gap, watched for the change that is to come."""
    zero = _JUST_OFF if touching else 0.0

    def event(_: float, y: np.ndarray) -> float:
        if time.perf_counter() > deadline:
            raise TookTooLongError
        return problem.gap(y, wall)[0] - zero

    event.terminal = True  # type: ignore[attr-defined]
    event.direction = 1.0 if touching else -1.0  # type: ignore[attr-defined]
    return event


def read_forces(run: ScipyRun, problem: Problem) -> None:
    """Fill peak force and impulse of a run's touches from its dense output.

    Seven Gauss points a step; the peak is the parabola's through the highest and its
    neighbours.
    """
    for solution, touches in run.pieces:
        begin, end = solution.ts[:-1], solution.ts[1:]
        half = 0.5 * (end - begin)[:, None]
        t = (0.5 * (begin + end)[:, None] + half * _GAUSS_X).ravel()
        states = np.ascontiguousarray(solution(t).T)
        for touch in touches:
            problem.latch(touch.wall, touch.approach)
            force = np.array([problem.normal_force(y, touch.wall) for y in states])
            problem.release(touch.wall)
            impulse = float((force.reshape(half.size, -1) * (half * _GAUSS_W)).sum())
            # NaN stands for nothing read yet
            touch.impulse = np.nansum([touch.impulse, impulse])
            touch.peak_force = np.fmax(touch.peak_force, _peak(t, force))


def _peak(t: np.ndarray, force: np.ndarray) -> float:
    """Return the largest value of a sampled smooth function."""
    k = int(force.argmax())
    if not 0 < k < force.size - 1:
        return float(force[k])
    a, b = t[k] - t[k - 1], t[k + 1] - t[k]
    left, right = (force[k] - force[k - 1]) / a, (force[k + 1] - force[k]) / b
    curvature = 2.0 * (right - left) / (a + b)
    slope = (left * b + right * a) / (a + b)
    return float(force[k] - 0.5 * slope * slope / curvature) if curvature < 0.0 else float(force[k])


def outcome(run: ScipyRun, problem: Problem) -> Outcome:
    """Return what a run gave, in the form that all engines share."""
    if run.failure:
        return Outcome(np.full(8, np.nan), problem.evaluations, failure=run.failure)
    touches = np.zeros(len(run.touches), TOUCHED)
    for row, touch in zip(touches, run.touches, strict=True):
        row["start"], row["end"], row["wall"] = touch.start, touch.end, 1 - 2 * touch.wall
        row["peak_force"] = touch.peak_force
    return Outcome(
        q=run.y[:8].copy(),
        evaluations=problem.evaluations,
        touches=touches,
        impulse=float(np.sum([touch.impulse for touch in run.touches])),
        peak_force=float(touches["peak_force"].max(initial=0.0)),
    )
