"""The paper's design flow (its section 4): from strokes of the first contact to a buffer.

Steps 1 to 5 find the springs for the strokes of the first contact without a damper.  Steps 6 and 7
find the damper, by the energy that it absorbs and by the verdict.
:mod:`capture_sim.studies.search.design` designs for the complete run instead.

The search for springs solves for the logarithms of the stiffnesses.  The residuals are the
logarithms of the ratio of each stroke to its target.  In these variables the energy balance of a
spring (stroke ~ k^-1/2 along the probe, ~ k^-1 across it) is a straight line.  However, the strokes
have kinks where the number of touches in the first contact changes, and the dampers that capture
may lie in several intervals.  Both searches therefore use a grid if the direct method fails.

The limit of the contact force is an addition to the paper's flow.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy import ndimage
from scipy.optimize import minimize, root

from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.samples import EventKind
from capture_sim.scene.approach import approach_of
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import changed
from capture_sim.scene.quantities import POSITIVE, Checked, Range, quantity
from capture_sim.studies.evaluate.limits import Limit, exceeded
from capture_sim.studies.evaluate.outcome import (
    FirstContactLoads,
    Outcome,
    run_first_contact,
    run_to_end,
    run_to_verdict,
)
from capture_sim.studies.search.variables import reduced_mass, with_values

#: Relative error of the strokes at which the search for springs ends, and the largest relative
#: error that is accepted.
CONVERGED_ERROR, ACCEPTED_ERROR = 2e-5, 0.01
#: Dampers that are tried first, as shares of the critical damping of both vehicles on the axial
#: spring; the first is no damper.
SHARES = (0.0, *np.geomspace(3e-3, 20.0, 36).tolist())

#: Springs that are tried, N/m and N m/rad: the limits of the search, and a coarse grid.
_RANGE = ((1.0, 1e6), (0.1, 1e6))
_GRID = (np.geomspace(20.0, 2e4, 7), np.geomspace(5.0, 2e4, 7))
_RESTARTS = 4  # searches from the best springs of the grid
_MAX_HYBRID_RUNS, _MAX_SIMPLEX_RUNS = 25, 120  # runs
_FIRST_STEP = 0.2  # in the scaled logarithms of the springs, see MINPACK's `factor`
_BOUND_TOLERANCE = 0.01  # relative error of the ends of the interval of dampers that capture
_PROMISING, _PARTS = 6, 12  # without a good damper: number to search around, parts between


@dataclass(frozen=True)
class FirstContactTarget(Checked):
    """Required strokes of the first contact, and the limit of the contact force.

    Attributes
    ----------
    axial_stroke, torsion : float
        Axial stroke, inwards or outwards (m), and torsion (rad) of the first contact without the
        damper.
    peak_force : float or None
        Upper limit of the normal force of every touch until the verdict, N; None for no limit.
    """

    axial_stroke: float = quantity("m", Range(1e-6, 1.0))
    torsion: float = quantity("rad", Range(1e-6, 1.0))
    peak_force: float | None = quantity("N", POSITIVE, default=None)

    @property
    def limits(self) -> tuple[Limit, ...]:
        """The target as limits of the complete run."""
        limits = [
            Limit("max_axial_stroke_in", self.axial_stroke),
            Limit("max_axial_stroke_out", self.axial_stroke),
            Limit("max_torsion", self.torsion),
        ]
        if self.peak_force is not None:
            limits.append(Limit("max_normal_force", self.peak_force))
        return tuple(limits)


@dataclass(frozen=True)
class FlowRun:
    """One run of the flow: the buffer that was tried, and its results, in SI units.

    Runs of the search for springs have no verdict.
    """

    k_A: float
    k_T: float
    c_A: float
    axial_stroke: float
    torsion: float
    peak_force: float
    nearest: float = math.nan
    verdict: str | None = None
    reason: str = ""


@dataclass(frozen=True)
class Energy:
    """Energies of a run, J."""

    approach: float  # kinetic energy of the reduced mass in the relative motion at first touch
    damper: float  # absorbed since the launch: the area under load over stroke
    contact: float  # dissipated in touches: the area in normal force over penetration


@dataclass(frozen=True)
class FirstContactDesign:
    """The result of the design flow."""

    target: FirstContactTarget
    refusal: str  # why no buffer meets the target; empty if one does
    scene: Scene | None = None  # with the buffer, or with the buffer closest to the target
    undamped: FirstContactLoads | None = None  # with the springs, without the damper
    damped: FirstContactLoads | None = None
    outcome: Outcome | None = None  # of the scene's complete run
    capturing: tuple[float, float] | None = None  # dampers that capture within limits, N s/m
    energy: Energy | None = None  # until the verdict
    history: tuple[FlowRun, ...] = field(default=(), repr=False)  # every run, in order

    @property
    def met(self) -> bool:
        """True if there is a buffer."""
        return not self.refusal

    @property
    def exceeded(self) -> tuple[Limit, ...]:
        """Limits of the target that the complete run exceeds by more than the accepted error.

        The target does not exclude this, because it concerns only the first contact and the force
        until the verdict.
        """
        if self.outcome is None:
            return ()
        wider = [
            Limit(each.key, each.value * (1.0 + ACCEPTED_ERROR)) for each in self.target.limits
        ]
        names = exceeded(wider, self.outcome.loads)
        return tuple(limit for limit in self.target.limits if limit.key in names)


@dataclass(frozen=True)
class Springs:
    """The best springs found (N/m, N m/rad), their loads, and the larger relative error."""

    k_A: float
    k_T: float
    response: FirstContactLoads
    error: float

    @property
    def met(self) -> bool:
        """True if both strokes are within the accepted error of the target."""
        return self.error <= ACCEPTED_ERROR

    def in_scene(self, scene: Scene, c_A: float) -> Scene:
        """Return a scene with these springs and a damper (N s/m)."""
        return with_buffer(scene, self.k_A, self.k_T, c_A)


@dataclass(frozen=True)
class _Damper:
    """A damper that was tried (N s/m), with its springs and the outcome of its run."""

    c_A: float
    springs: Springs
    outcome: Outcome

    @property
    def captures(self) -> bool:
        """True if the run ended with a capture and did not fail."""
        return self.outcome.captured and not self.outcome.failure

    @property
    def nearest(self) -> float:
        """Closest approach of the tip to BE, m; infinite if the run failed."""
        return math.inf if self.outcome.failure else float(self.outcome.loads["nearest_distance"])

    @property
    def peak_force(self) -> float:
        """Peak normal force of all touches, N."""
        return float(self.outcome.loads["max_normal_force"])


class _ConvergedError(Exception):
    """Signals that the search for springs has reached the required error."""


def with_buffer(scene: Scene, k_A: float, k_T: float, c_A: float) -> Scene:
    """Return a scene with another buffer (N/m, N m/rad, N s/m).

    A rebound damper keeps its ratio to the damper.
    """
    return with_values(scene, {"buffer.k_A": k_A, "buffer.k_T": k_T, "buffer.c_A": c_A})


def energy_of(scene: Scene, t_end: float) -> Energy:
    """Return the energies of a run from its launch to ``t_end`` (s).

    They are integrated together with the motion.

    Raises
    ------
    SimulationError
        The integration had to stop.
    """
    scene = changed(scene, "run.t_end", max(t_end, 1e-6))
    bench = Bench(scene)
    start, end = bench.advance(np.array([0.0, scene.run.t_end]))
    touch = next((event for event in bench.events if event.kind is EventKind.TOUCH), None)
    v = start["v"] if touch is None else touch.v
    relative = v[:2] - v[5:7]
    return Energy(
        approach=0.5 * reduced_mass(scene) * float(relative @ relative),
        damper=float(end["dissipated_axial"]),
        contact=float(end["dissipated_contact"]),
    )


def _critical_damping(scene: Scene, k_A: float) -> float:
    """Return the critical damping of both vehicles on the axial spring, N s/m."""
    return 2.0 * math.sqrt(k_A * reduced_mass(scene))


def first_guess(scene: Scene, target: FirstContactTarget) -> tuple[float, float]:
    """Return springs (N/m, N m/rad) that would absorb the approach's energy at the target strokes.

    The axial spring brings the reduced mass of both vehicles to rest along the axis.  The torsional
    spring carries the lateral part of this force at the tip, which is in contact with a wall at the
    cone's angle, with friction.
    """
    speed = approach_of(scene).speed
    k_A = reduced_mass(scene) * (speed / target.axial_stroke) ** 2
    mu = scene.friction.mu if scene.friction.law != "none" else 0.0
    tangent = math.tan(scene.cone.half_angle)
    lateral = max(1.0 - mu * tangent, 0.1) / (tangent + mu)
    return k_A, k_A * target.axial_stroke * lateral * scene.rest_length / target.torsion


def find_springs(
    scene: Scene,
    target: FirstContactTarget,
    c_A: float,
    start: tuple[float, float],
    *,
    thorough: bool = True,
    report: Callable[[FlowRun], None] | None = None,
) -> Springs:
    """Find the springs for which a scene has the target strokes.

    Parameters
    ----------
    scene
        Scene of the run; its own springs are not used.
    target
        Target strokes.
    c_A
        Axial damping, N s/m; the paper uses none in this step.
    start
        Initial values of k_A (N/m) and k_T (N m/rad).
    thorough
        True to search further if Powell's hybrid method from ``start`` does not converge.
    report
        Function called with every run.

    Returns
    -------
    Springs
        Springs with the smallest error; ``met`` is True if the error is accepted.
    """
    # in these variables the slope of the residual is about minus one
    unit = np.array([2.0, 1.0])
    low, high = np.log(_RANGE).T
    tried: list[Springs] = []

    @cache
    def residual_of(k_A: float, k_T: float) -> np.ndarray:
        response = run_first_contact(with_buffer(scene, k_A, k_T, c_A))
        if report is not None:
            strokes = response.axial_stroke, response.torsion
            report(FlowRun(k_A, k_T, c_A, *strokes, response.peak_force, reason=response.failure))
        strokes = response.axial_stroke, response.torsion
        # the lower bound avoids the logarithm of a stroke of 0
        r = np.log(np.maximum(strokes, 1e-12) / [target.axial_stroke, target.torsion])
        if response.failure:
            r[0] = max(r[0], 1.0)  # the probe went in up to its tip: the spring is far too soft
        tried.append(Springs(k_A, k_T, response, float(np.abs(np.expm1(r)).max())))
        if tried[-1].error <= CONVERGED_ERROR:
            raise _ConvergedError
        return r

    def residual(z: np.ndarray) -> np.ndarray:
        return residual_of(*np.exp(np.clip(unit * z, low, high)).tolist()).copy()

    def converge(z: np.ndarray) -> None:
        options = {"maxfev": _MAX_HYBRID_RUNS, "factor": _FIRST_STEP, "xtol": 1e-6}
        root(residual, z, jac=lambda z: -np.eye(2), method="hybr", options=options)

    def variables(springs: Springs) -> np.ndarray:
        return np.log([springs.k_A, springs.k_T]) / unit

    def error(springs: Springs) -> float:
        return springs.error

    try:
        converge(np.log(start) / unit)
        if thorough:
            count = len(tried)
            for pair in itertools.product(*_GRID):
                residual(np.log(pair) / unit)
            for springs in sorted(tried[count:], key=error)[:_RESTARTS]:
                converge(variables(springs))
            best = min(tried, key=error)
            if best.error < 0.5:
                corners = variables(best) + max(2.0 * best.error, 0.02) / unit * np.eye(3, 2, -1)
                minimize(
                    lambda z: float(np.sum(residual(z) ** 2)),
                    variables(best),
                    method="Nelder-Mead",
                    options={"initial_simplex": corners, "maxfev": _MAX_SIMPLEX_RUNS},
                )
    except _ConvergedError:
        pass
    return min(tried, key=error)


class _Flow:
    """One execution of the design flow, with the history of its runs."""

    def __init__(
        self, scene: Scene, target: FirstContactTarget, report: Callable[[FlowRun], None] | None
    ) -> None:
        self.scene, self.target, self._report = scene, target, report
        self.history: list[FlowRun] = []

    def _add(self, candidate: FlowRun) -> None:
        self.history.append(candidate)
        if self._report is not None:
            self._report(candidate)

    def springs(self) -> Springs:
        """Return the springs for the strokes of the first contact."""
        start = first_guess(self.scene, self.target)
        return find_springs(self.scene, self.target, 0.0, start, report=self._add)

    def damper(self, c_A: float, springs: Springs) -> _Damper:
        """Run a damper (N s/m) with the springs until the verdict."""
        outcome = run_to_verdict(springs.in_scene(self.scene, c_A))
        loads = outcome.loads
        stroke = max(loads["max_axial_stroke_in"], loads["max_axial_stroke_out"])
        values = stroke, loads["max_torsion"], loads["max_normal_force"]
        result = float(loads["nearest_distance"]), outcome.verdict, outcome.reason
        self._add(FlowRun(springs.k_A, springs.k_T, c_A, *values, *result))
        return _Damper(c_A, springs, outcome)

    def good(self, damper: _Damper) -> bool:
        """Return True if a damper captures within the limit of the contact force."""
        if not damper.captures:
            return False
        limit = self.target.peak_force
        return limit is None or damper.peak_force <= limit

    def widest(self, tried: Sequence[_Damper]) -> slice | None:
        """Return the slice with the longest sequence of good dampers; None if no damper is good."""
        labels, _ = ndimage.label([self.good(damper) for damper in tried])
        runs = [run for (run,) in ndimage.find_objects(labels)]
        return max(runs, key=lambda run: run.stop - run.start, default=None)

    def refined_grid(self, grid: Sequence[float], tried: Sequence[_Damper]) -> list[float]:
        """Return dampers between the tried dampers, on both sides of the promising ones (N s/m).

        All dampers that capture are promising, because the force jumps where the sequence of
        touches changes.  If no damper captures, the dampers with the closest approach to BE are
        promising.
        """
        nearest = [damper.nearest for damper in tried]
        promising = [n for n, damper in enumerate(tried) if damper.outcome.captured]
        promising = promising or np.argsort(nearest, kind="stable")[:_PROMISING].tolist()
        between: list[float] = []
        for n in promising:
            for low, high in itertools.pairwise(grid[max(n - 1, 0) : n + 2]):
                between += np.linspace(low, high, _PARTS + 1)[1:-1].tolist()
        return between

    def edge(self, inside: _Damper, outside: float) -> _Damper:
        """Return the last good damper before a bad one, found by bisection.

        ``inside`` is a good damper, ``outside`` the damping of a bad damper, N s/m.
        """
        while abs(outside - inside.c_A) > _BOUND_TOLERANCE * max(inside.c_A, outside):
            middle = 0.5 * (inside.c_A + outside)
            tried = self.damper(middle, inside.springs)
            if self.good(tried):
                inside = tried
            else:
                outside = middle
        return inside


def design_first_contact(
    scene: Scene, target: FirstContactTarget, report: Callable[[FlowRun], None] | None = None
) -> FirstContactDesign:
    """Find springs and damper for the strokes of the first contact by the paper's design flow.

    Parameters
    ----------
    scene
        Scene with vehicles, cone, contact and approach; its k_A, k_T and c_A are not used.
    target
        Target strokes, and the limit of the contact force.
    report
        Function called with every run when it has finished.

    Returns
    -------
    FirstContactDesign
        Result with a buffer, or with the reason why there is none.

    Raises
    ------
    SceneError
        A value is out of its range, or the chaser never meets the cone.
    """
    flow = _Flow(scene, target, report)
    springs = flow.springs()
    if not springs.met:
        return _refused(flow, _no_springs(target, springs), springs, None)
    grid = [share * _critical_damping(scene, springs.k_A) for share in SHARES]
    tried = [flow.damper(c_A, springs) for c_A in grid]
    interval = flow.widest(tried)
    if interval is None:
        # good dampers may lie between the tried ones: refine the grid around the promising dampers
        known = {damper.c_A: damper for damper in tried}
        grid = sorted({*grid, *flow.refined_grid(grid, tried)})
        tried = [known.get(c_A) or flow.damper(c_A, springs) for c_A in grid]
        interval = flow.widest(tried)
    if interval is None:
        nearest = min(tried, key=lambda damper: damper.nearest)
        return _refused(flow, _no_damper(flow, tried), springs, nearest)
    good = tried[interval]
    low, high = good[0], good[-1]
    if interval.start > 0:
        low = flow.edge(low, grid[interval.start - 1])
    if interval.stop < len(grid):
        high = flow.edge(high, grid[interval.stop])
    chosen = _choose(flow, low, high, good)
    final = chosen.springs.in_scene(scene, chosen.c_A)
    return FirstContactDesign(
        target,
        "",
        final,
        undamped=run_first_contact(chosen.springs.in_scene(scene, 0.0)),
        damped=run_first_contact(final),
        outcome=run_to_end(final),
        capturing=(low.c_A, high.c_A),
        energy=energy_of(final, chosen.outcome.t),
        history=tuple(flow.history),
    )


def _choose(flow: _Flow, low: _Damper, high: _Damper, between: Sequence[_Damper]) -> _Damper:
    """Return the good damper that is closest to the middle of the interval."""
    # The tolerance of a real damper is relative, so the middle is the geometric mean.  Above the
    # critical damping the probe hardly moves: such a damper is chosen only if no weaker damper
    # captures.
    critical = _critical_damping(flow.scene, low.springs.k_A)
    top = min(high.c_A, critical) if low.c_A < critical else high.c_A
    middle = math.sqrt(max(low.c_A, SHARES[1] * critical) * top)
    candidates = [flow.damper(middle, low.springs), low, high, *between]
    captures = [damper for damper in candidates if flow.good(damper)]
    return min(captures, key=lambda damper: abs(damper.c_A - middle))


def _refused(
    flow: _Flow, why: str, springs: Springs, nearest: _Damper | None
) -> FirstContactDesign:
    history = tuple(flow.history)
    if nearest is None:
        found = springs.response.touches > 0
        scene = springs.in_scene(flow.scene, 0.0) if found else None
        return FirstContactDesign(flow.target, why, scene, history=history)
    scene = nearest.springs.in_scene(flow.scene, nearest.c_A)
    return FirstContactDesign(flow.target, why, scene, outcome=nearest.outcome, history=history)


def _no_springs(target: FirstContactTarget, springs: Springs) -> str:
    found = springs.response
    return (
        f"no springs give, within {ACCEPTED_ERROR:.0%}, strokes of "
        f"{target.axial_stroke * 1e3:.4g} mm and {target.torsion * 1e3:.4g} mrad: "
        f"the nearest, k_A = {springs.k_A:.4g} N/m and k_T = {springs.k_T:.4g} N m/rad, "
        f"give {found.axial_stroke * 1e3:.4g} mm and {found.torsion * 1e3:.4g} mrad"
        + (f" ({found.failure})" if found.failure else "")
    )


def _no_damper(flow: _Flow, tried: Sequence[_Damper]) -> str:
    """Return the reason why no damper meets the target.

    It is the contact force, the cone's outer lip, or too much or too little remaining energy.
    """
    target = flow.target
    top = max(damper.c_A for damper in tried)
    captures = [damper for damper in tried if damper.captures]
    if captures:
        least = min(captures, key=lambda damper: damper.peak_force)
        return (
            f"every damper tried up to {top:.4g} N s/m that captures pushes too hard, with these "
            f"springs at least {least.peak_force:.4g} N (c_A = {least.c_A:.4g} N s/m); the limit "
            f"is {target.peak_force:.4g} N"
        )
    best = min(tried, key=lambda damper: damper.nearest)
    if best.nearest > flow.scene.cone.L_c:
        return (
            "no damper captures: the tip is turned away at the cone's outer lip, and comes no "
            f"nearer than {best.nearest * 1e3:.3g} mm ({_verdicts(tried)})"
        )
    why = (
        f"no damper captures up to {top:.4g} N s/m: the tip comes nearest, "
        f"{best.nearest * 1e3:.3g} mm, with c_A = {best.c_A:.4g} N s/m "
        f"({best.outcome.verdict}: {best.outcome.reason})"
    )
    if below := [damper for damper in tried if damper.c_A < best.c_A]:
        stuck = sum(damper.outcome.verdict == "stuck" for damper in below)
        energy = "too little energy" if 2 * stuck > len(below) else "too much energy"
        why += f"; with less, {energy} is left ({_verdicts(below)})"
    if above := [damper for damper in tried if damper.c_A > best.c_A]:
        why += f"; with more, too little is left to reach BE ({_verdicts(above)})"
    return why


def _verdicts(dampers: Sequence[_Damper]) -> str:
    """Return the number of dampers with each verdict as text."""
    labels = [damper.outcome.verdict for damper in dampers]
    return ", ".join(f"{labels.count(label)} x {label}" for label in dict.fromkeys(labels))
