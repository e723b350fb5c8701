"""The bench with SciPy's ``solve_ivp``, done as carefully as a good user would.

Each touch of a wall is a terminal event that latches the approach speed and restarts the solver,
and so is each lift-off.  Two traps are minded.  A restart lands on the event's own zero: rounding
may leave the gap on the wrong side of it, and ``solve_ivp`` then waits for a change of sign that
never comes, or sees one at once; a touch therefore ends a little beyond zero, where the force has
gone already.  And forces read at step ends miss their peaks: they are read from the dense output.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.engines.model import Model
from benchmarks.engines.own import packed
from benchmarks.trial import TOUCHED, Outcome
from capture_sim.base.compiled.kernels import entry_kernel
from capture_sim.dynamics.engine import loop
from capture_sim.dynamics.model.equations import (
    N_STATE,
    N_TOTAL,
    NO_TOUCH,
    gap_and_rate,
    make_system,
    tip_in_cone,
)
from capture_sim.scene.parts import Scene

METHODS = ("DOP853", "RK45", "LSODA", "BDF", "Radau")
#: Right-hand sides that are handed to SciPy, by group.
PROBLEMS = {"compiled": lambda scene: CompiledProblem(scene), "numpy": Model}
JUST_OFF = 1e-13  # m: gap at which a touch has ended, a thousand times its rounding
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(7)


@entry_kernel
def gap_of_wall(parameters, y, side):
    """Return the gap (m) and its rate (m/s) of the wall on ``side`` (+1: +y, -1: -y)."""
    par = parameters[0]
    px, py, wx, wy = tip_in_cone(y, par)
    gap, rate, _, _ = gap_and_rate(px, py, wx, wy, side, par)
    return gap, rate


class CompiledProblem:
    """The engine's own right-hand side, :func:`capture_sim.dynamics.engine.loop.evaluate`.

    What an integrator needs to know of the bench, as :class:`benchmarks.engines.model.Model` has it
    in NumPy; walls are 0: +y, 1: -y.
    """

    def __init__(self, scene: Scene) -> None:
        self.parameters = packed(scene)
        self.system = make_system(self.parameters)
        self.touch, self.par = self.system["mode"]["touch"][0], self.parameters[0]
        self._f = np.zeros(N_TOTAL)
        self.evaluations = 0

    def rate_of_change(self, _: float, y: np.ndarray) -> np.ndarray:
        """Return dy/dt (16,)."""
        self.evaluations += 1
        loop.evaluate(self.system, y, self._f)
        return self._f[:N_STATE].copy()

    def gap(self, y: np.ndarray, wall: int) -> tuple[float, float]:
        """Return gap (m) and its rate (m/s)."""
        return gap_of_wall(self.parameters, y, 1.0 - 2.0 * wall)

    def latch(self, wall: int, approach: float) -> None:
        """Begin a touch."""
        par = self.par
        chi = par["hysteresis"] * par["contact"]["stiffness"] / max(approach, par["v_0_floor"])
        self.touch["on"][wall], self.touch["chi"][wall] = 1, chi

    def release(self, wall: int) -> None:
        """End a touch."""
        self.touch[wall] = NO_TOUCH[0]

    def normal_force(self, y: np.ndarray, wall: int) -> float:
        """Return F_n, N; eq. (1)."""
        gap, rate = self.gap(y, wall)
        force = max(-gap, 0.0) ** 1.5 * (
            self.par["contact"]["stiffness"] - self.touch["chi"][wall] * rate
        )
        return max(float(force), 0.0)


class TookTooLongError(Exception):
    """The time allowed for a run is over."""


@dataclass
class Touch:
    """A touch of a wall; times in s, speed in m/s, force in N, impulse in N s."""

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


def solve(problem: Any, y_0: np.ndarray, t_end: float, allowed: float, **options: Any) -> ScipyRun:
    """Integrate from t = 0 to ``t_end`` (s), in at most ``allowed`` s of wall time.

    Parameters
    ----------
    problem
        :class:`CompiledProblem` or :class:`Model`, with no wall in touch.
    y_0
        (16,) q and v at t = 0.
    options
        Of ``solve_ivp``; with ``dense_output`` the run can be given to :func:`read_forces`.
    """
    deadline, run, t = time.perf_counter() + allowed, ScipyRun(y_0), 0.0
    on: dict[int, Touch] = {}
    while t < t_end:
        events = [_gap_event(problem, wall, wall in on, deadline) for wall in (0, 1)]
        try:
            piece = solve_ivp(problem.rate_of_change, (t, t_end), run.y, events=events, **options)
        except TookTooLongError:
            run.failure = f"not done after {allowed:g} s"
            break
        except (ArithmeticError, ValueError) as error:
            run.failure = f"stopped: {error}"
            break
        if piece.status < 0 or not np.isfinite(piece.y[:, -1]).all():
            run.failure = f"stopped at {piece.t[-1]:.4f} s: {piece.message}"
            break
        if piece.sol is not None:
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
    problem: Any, wall: int, touching: bool, deadline: float
) -> Callable[[float, np.ndarray], float]:
    """Return the event function of a wall: its gap, watched for the change that is to come."""
    zero = JUST_OFF if touching else 0.0

    def event(_: float, y: np.ndarray) -> float:
        if time.perf_counter() > deadline:
            raise TookTooLongError
        return problem.gap(y, wall)[0] - zero

    vars(event).update(terminal=True, direction=1.0 if touching else -1.0)  # read by SciPy
    return event


def read_forces(run: ScipyRun, problem: Any) -> None:
    """Fill peak force and impulse of a run's touches from its dense output.

    Seven Gauss points a step; the peak is the parabola's through the highest and its neighbours.
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
    if 0 < k < force.size - 1:
        curvature, slope, height = np.polyfit(t[k - 1 : k + 2] - t[k], force[k - 1 : k + 2], 2)
        if curvature < 0.0:
            return float(height - slope**2 / (4.0 * curvature))
    return float(force[k])


def prepare(
    scene: Scene, group: str, y_0: np.ndarray, allowed: float, options: dict[str, Any]
) -> tuple[Callable[[], ScipyRun], Callable[[ScipyRun], Outcome]]:
    """Make a problem of :data:`PROBLEMS`; return what runs it and what reads the outcome.

    Forces of a compiled one are read in a second run, with dense output, that is not timed.
    """
    problem = PROBLEMS[group](scene)

    def read(run: ScipyRun) -> Outcome:
        evaluations = problem.evaluations
        if run.failure:
            return Outcome.failed(run.failure, evaluations)
        if group == "compiled":
            again = CompiledProblem(scene)
            found = solve(again, y_0, scene.run.t_end, allowed, **options, dense_output=True)
            if not found.failure:
                read_forces(found, again)
                run = found
        touches = np.zeros(len(run.touches), TOUCHED)
        for row, touch in zip(touches, run.touches, strict=True):
            row["start"], row["end"], row["wall"] = touch.start, touch.end, 1 - 2 * touch.wall
            row["peak_force"] = touch.peak_force
        return Outcome(
            q=run.y[:8].copy(),
            evaluations=evaluations,
            touches=touches,
            impulse=float(np.sum([touch.impulse for touch in run.touches])),
            peak_force=float(touches["peak_force"].max(initial=0.0)),
        )

    return lambda: solve(problem, y_0, scene.run.t_end, allowed, **options), read
