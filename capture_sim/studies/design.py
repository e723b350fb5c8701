"""The paper's design flow: target strokes in, buffer out, or the reason why there is none.

Steps as in the paper's section 4: springs for the target strokes of the first contact (1 to 5),
the damper by the energy it absorbs (6) and the verdict (7).  The unknowns of steps 1 to 5 are
the springs' logarithms, what is to vanish is the logarithm of each stroke's ratio to its target:
in these a spring's energy balance (stroke ~ k^-1/2 along the probe, ~ k^-1 across it) is a
straight line.  The strokes have corners, though, where a touch more or less belongs to the first
contact, and dampers that capture need not lie in one interval: both searches go over a grid
where the direct way does not lead there.

Beyond the paper: the strokes may be required with the damper in, the contact force may be
limited, and among the dampers that capture the one is taken that keeps furthest from losing
the capture under a spread of speed, offset and angle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy import ndimage
from scipy.optimize import minimize, root

from capture_sim.bench import Bench
from capture_sim.detection.exact import CaptureState
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import changed
from capture_sim.scene.quantities import POSITIVE, Checked, Range, quantity
from capture_sim.studies.approach import Spread, approach_of, margin_of
from capture_sim.studies.outcome import (
    FirstContact,
    Outcome,
    run_first_contact,
    run_to_verdict,
)

#: Relative error of a stroke at which the search for springs ends, and up to which it is met.
CLOSE, ACCEPTED = 2e-5, 0.01
#: Dampers that are tried first: none, and these shares of the critical damping of both
#: vehicles on the axial spring.
SHARES = (0.0, *np.geomspace(3e-3, 20.0, 36).tolist())

#: Springs that are tried, N/m and N m/rad: the whole range, and a coarse grid.
_RANGE = ((1.0, 1e6), (0.1, 1e6))
_GRID = (np.geomspace(20.0, 2e4, 7), np.geomspace(5.0, 2e4, 7))
_RESTARTS = 4  # from the best of the grid
_MOST_HYBRID, _MOST_SIMPLEX = 25, 120  # runs
_FIRST_STEP = 0.2  # of the springs' logarithms, see MINPACK's `factor`
_EDGE = 0.01  # relative, of the interval of dampers that capture
_PROMISING, _CLOSER = 6, 12  # where no damper is good: those to search beside, parts between
_SIDE = 3  # dampers on each side of the middle whose margin is computed


@dataclass(frozen=True)
class DesignTarget(Checked):
    """What the buffer is to do.

    Attributes
    ----------
    axial_stroke, torsion : float
        Largest strokes of the first contact, m and rad: Delta_1 and Delta_2.
    damped : bool
        Whether the strokes are those with the damper in; the paper's are those without.
    peak_force : float or None
        Largest force that any touch until the verdict may have, N.
    spread : Spread or None
        Of the approach, for the margin; None takes the middle of the dampers that capture.

    Raises
    ------
    SceneError
        A value is out of its range.
    """

    axial_stroke: float = quantity("m", Range(1e-6, 1.0))
    torsion: float = quantity("rad", Range(1e-6, 1.0))
    damped: bool = False
    peak_force: float | None = quantity("N", POSITIVE, default=None)
    spread: Spread | None = None


@dataclass(frozen=True)
class Trial:
    """One run of the flow: the buffer tried, and its result; SI units.

    ``step`` is 5 for strokes, 7 for a verdict; what a step does not need is NaN or None.
    """

    step: int
    k_A: float
    k_T: float
    c_A: float
    axial_stroke: float
    torsion: float
    peak_force: float
    nearest: float = math.nan
    verdict: CaptureState | None = None
    reason: str = ""


@dataclass(frozen=True)
class Energy:
    """Step 6: energies of a run, J.

    Attributes
    ----------
    approach : float
        Kinetic energy of the relative motion at the start, of the reduced mass.
    damper : float
        Absorbed by the axial damper: what the curve of load over stroke encloses.
    contact : float
        Lost in the touches: what the curve of normal force over penetration encloses.
    """

    approach: float
    damper: float
    contact: float


@dataclass(frozen=True)
class Design:
    """The result of the flow.

    Attributes
    ----------
    target : DesignTarget
    refusal : str
        Why no buffer meets the target; empty if one does.
    scene : Scene or None
        With the buffer in it; without one that meets the target, the nearest that was found.
    undamped, damped : FirstContact or None
        The first contact with these springs, without and with the damper.
    outcome : Outcome or None
        Of the run to the verdict.
    capturing : (float, float) or None
        Dampers round the chosen one that capture and keep the limit of force, N s/m.
    margin : float or None
        How many times the spread the approach may be off before a capture is lost.
    energy : Energy or None
        Until the verdict.
    history : tuple of Trial
        Every run, in order.
    """

    target: DesignTarget
    refusal: str
    scene: Scene | None = None
    undamped: FirstContact | None = None
    damped: FirstContact | None = None
    outcome: Outcome | None = None
    capturing: tuple[float, float] | None = None
    margin: float | None = None
    energy: Energy | None = None
    history: tuple[Trial, ...] = field(default=(), repr=False)

    @property
    def met(self) -> bool:
        """Whether there is a buffer."""
        return not self.refusal


@dataclass(frozen=True)
class Springs:
    """The best springs found: N/m, N m/rad, their first contact, and the larger relative error."""

    k_A: float
    k_T: float
    contact: FirstContact
    error: float

    @property
    def met(self) -> bool:
        """Whether both strokes are as required."""
        return self.error <= ACCEPTED

    def in_scene(self, scene: Scene, c_A: float) -> Scene:
        """Return a scene with these springs and a damper (N s/m)."""
        return with_buffer(scene, self.k_A, self.k_T, c_A)


@dataclass(frozen=True)
class _Damper:
    """A damper tried, with the springs that go with it."""

    c_A: float
    springs: Springs
    outcome: Outcome


class _CloseError(Exception):
    """A search has come close enough."""


def with_buffer(scene: Scene, k_A: float, k_T: float, c_A: float) -> Scene:
    """Return a scene with another buffer."""
    return replace(scene, buffer=replace(scene.buffer, k_A=k_A, k_T=k_T, c_A=c_A))


def energy_of(scene: Scene, t_end: float) -> Energy:
    """Return the energies of a run up to ``t_end`` (s), as integrated with the motion.

    Raises
    ------
    SimulationError
        The integration had to stop.
    """
    scene = changed(scene, "run.t_end", max(t_end, 1e-6))
    start, end = Bench(scene).advance(np.array([0.0, scene.run.t_end]))
    relative = start["v"][:2] - start["v"][5:7]
    return Energy(
        approach=0.5 * _reduced_mass(scene) * float(relative @ relative),
        damper=float(end["dissipated_axial"]),
        contact=float(end["dissipated_contact"]),
    )


def _reduced_mass(scene: Scene) -> float:
    chaser, target = scene.chaser_total_mass, scene.target.mass
    return chaser * target / (chaser + target)


def _critical_damping(scene: Scene, k_A: float) -> float:
    """Return the damper that just stops both vehicles swinging on the axial spring, N s/m."""
    return 2.0 * math.sqrt(k_A * _reduced_mass(scene))


def first_guess(scene: Scene, target: DesignTarget) -> tuple[float, float]:
    """Return springs (N/m, N m/rad) that would absorb the approach's energy at the target strokes.

    The reduced mass of both vehicles, brought to rest along the axis by the axial spring; the
    torsional spring bears, at the tip, the lateral part of that force on a wall at the cone's
    angle with its friction.
    """
    speed = approach_of(scene)[2]
    k_A = _reduced_mass(scene) * (speed / target.axial_stroke) ** 2
    mu = scene.friction.mu if scene.friction.law != "none" else 0.0
    tangent = math.tan(scene.cone.half_angle)
    lateral = max(1.0 - mu * tangent, 0.1) / (tangent + mu)
    return k_A, k_A * target.axial_stroke * lateral * scene.rest_length / target.torsion


def find_springs(
    scene: Scene,
    target: DesignTarget,
    c_A: float,
    start: tuple[float, float],
    *,
    thorough: bool = True,
    report: Callable[[Trial], None] | None = None,
) -> Springs:
    """Find the springs with which the first contact has the target strokes: steps 1 to 5.

    Parameters
    ----------
    scene
        Its own springs do not matter.
    target
        The strokes.
    c_A
        Axial damping meanwhile, N s/m; the paper's flow has none in this step.
    start
        k_A and k_T to start from.
    thorough
        Search on where Powell's hybrid method from there does not converge.
    report
        Called with every run.

    Returns
    -------
    Springs
        The best found; see ``met``.
    """
    # in these variables the slope of the residual is about minus one
    unit = np.array([2.0, 1.0])
    low, high = np.log(_RANGE).T
    tried: list[Springs] = []

    @cache
    def residual_of(k_A: float, k_T: float) -> np.ndarray:
        contact = run_first_contact(with_buffer(scene, k_A, k_T, c_A))
        strokes = contact.axial_stroke, contact.torsion
        if report is not None:
            report(Trial(5, k_A, k_T, c_A, *strokes, contact.peak_force, reason=contact.failure))
        # a stroke of nothing is as far off as the range of springs allows
        r = np.log(np.maximum(strokes, 1e-12) / [target.axial_stroke, target.torsion])
        if contact.failure:
            r[0] = max(r[0], 1.0)  # the probe went in up to its tip: far too soft
        tried.append(Springs(k_A, k_T, contact, float(np.abs(np.expm1(r)).max())))
        if tried[-1].error <= CLOSE:
            raise _CloseError
        return r

    def residual(z: np.ndarray) -> np.ndarray:
        return residual_of(*np.exp(np.clip(unit * z, low, high)).tolist()).copy()

    def converge(z: np.ndarray) -> None:
        options = {"maxfev": _MOST_HYBRID, "factor": _FIRST_STEP, "xtol": 1e-6}
        root(residual, z, jac=lambda z: -np.eye(2), method="hybr", options=options)

    def at(springs: Springs) -> np.ndarray:
        return np.log([springs.k_A, springs.k_T]) / unit

    def error(springs: Springs) -> float:
        return springs.error

    try:
        converge(np.log(start) / unit)
        if thorough:
            count = len(tried)
            for pair in itertools.product(*_GRID):
                residual(np.log(pair) / unit)
            for one in sorted(tried[count:], key=error)[:_RESTARTS]:
                converge(at(one))
            best = min(tried, key=error)
            if best.error < 0.5:
                corners = at(best) + max(2.0 * best.error, 0.02) / unit * np.eye(3, 2, -1)
                minimize(
                    lambda z: float(np.sum(residual(z) ** 2)),
                    at(best),
                    method="Nelder-Mead",
                    options={"initial_simplex": corners, "maxfev": _MOST_SIMPLEX},
                )
    except _CloseError:
        pass
    return min(tried, key=error)


class _Flow:
    """One pass through the flow, and its history."""

    def __init__(
        self, scene: Scene, target: DesignTarget, report: Callable[[Trial], None] | None
    ) -> None:
        self.scene, self.target, self._report = scene, target, report
        self.history: list[Trial] = []
        self._last: tuple[float, float] | None = None

    def _add(self, trial: Trial) -> None:
        self.history.append(trial)
        if self._report is not None:
            self._report(trial)

    def springs(self, c_A: float) -> Springs:
        """Steps 1 to 5 with a damper of ``c_A``, from the last springs that were met."""
        start = self._last or first_guess(self.scene, self.target)
        thorough = self._last is None
        found = find_springs(
            self.scene, self.target, c_A, start, thorough=thorough, report=self._add
        )
        if found.met:
            self._last = (found.k_A, found.k_T)
        return found

    def damper(self, c_A: float, springs: Springs) -> _Damper | None:
        """Step 7 for one damper, with springs of its own if the target requires; None without."""
        if self.target.damped and c_A > 0.0:
            springs = self.springs(c_A)
            if not springs.met:
                return None
        buffer = (springs.k_A, springs.k_T, c_A)
        outcome = run_to_verdict(with_buffer(self.scene, *buffer))
        loads = outcome.loads
        strokes = loads["max_axial_stroke_in"], loads["max_torsion"]
        result = *strokes, loads["max_normal_force"], loads["nearest_distance"]
        self._add(Trial(7, *buffer, *result, outcome.verdict, outcome.reason))
        return _Damper(c_A, springs, outcome)

    def good(self, damper: _Damper | None) -> bool:
        """Whether a damper captures within the limit of force."""
        if damper is None or damper.outcome.failure or not damper.outcome.captured:
            return False
        limit = self.target.peak_force
        return limit is None or damper.outcome.loads["max_normal_force"] <= limit

    def widest(self, tried: Sequence[_Damper | None]) -> slice | None:
        """Return where the longest run of good dampers is."""
        labels, _ = ndimage.label([self.good(one) for one in tried])
        runs = [run for (run,) in ndimage.find_objects(labels)]
        return max(runs, key=lambda run: run.stop - run.start, default=None)

    def closer(self, grid: Sequence[float], tried: Sequence[_Damper | None]) -> list[float]:
        """Return dampers between those tried, next to the promising ones.

        Promising are all captures, as the force jumps from one touch sequence to the next;
        without any, the dampers that bring the tip nearest.
        """

        def nearest(n: int) -> float:
            one = tried[n]
            return (
                math.inf
                if one is None or one.outcome.failure
                else one.outcome.loads["nearest_distance"]
            )

        promising = [n for n, one in enumerate(tried) if one is not None and one.outcome.captured]
        promising = promising or sorted(range(len(grid)), key=nearest)[:_PROMISING]
        more: list[float] = []
        for n in promising:
            for low, high in itertools.pairwise(grid[max(n - 1, 0) : n + 2]):
                more += np.linspace(low, high, _CLOSER + 1)[1:-1].tolist()
        return more

    def edge(self, inside: _Damper, outside: float) -> _Damper:
        """Bisect to the last good damper between a good one and a bad one (N s/m)."""
        while abs(outside - inside.c_A) > _EDGE * max(inside.c_A, outside):
            middle = 0.5 * (inside.c_A + outside)
            tried = self.damper(middle, inside.springs)
            if tried is not None and self.good(tried):
                inside = tried
            else:
                outside = middle
        return inside


def design_buffer(
    scene: Scene, target: DesignTarget, report: Callable[[Trial], None] | None = None
) -> Design:
    """Find springs and damper for a target.

    Parameters
    ----------
    scene
        Vehicles, cone, contact and approach; its k_A, k_T and c_A do not matter.
    target
        Strokes, and what else the buffer has to keep.
    report
        Called with every run as it is done.

    Returns
    -------
    Design
        With a buffer, or with the reason why there is none.

    Raises
    ------
    SceneError
        A value is out of its range, or the chaser never meets the cone.
    """
    flow = _Flow(scene, target, report)
    springs = flow.springs(0.0)
    if not springs.met and not target.damped:
        return _refused(flow, _no_springs(target, springs), springs, None)
    grid = [share * _critical_damping(scene, springs.k_A) for share in SHARES]
    tried = [flow.damper(c_A, springs) for c_A in grid]
    interval = flow.widest(tried)
    if interval is None:
        # good ones may lie between those tried: look closer where they come nearest
        known = {one.c_A: one for one in tried if one is not None}
        grid = sorted({*grid, *flow.closer(grid, tried)})
        tried = [known.get(c_A) or flow.damper(c_A, springs) for c_A in grid]
        interval = flow.widest(tried)
    judged = [one for one in tried if one is not None]
    if interval is None:
        nearest = min(judged, key=lambda one: one.outcome.loads["nearest_distance"], default=None)
        return _refused(flow, _no_damper(flow, judged, springs), springs, nearest)
    good = [one for one in tried[interval] if one is not None]
    low, high = good[0], good[-1]
    if interval.start > 0:
        low = flow.edge(low, grid[interval.start - 1])
    if interval.stop < len(grid):
        high = flow.edge(high, grid[interval.stop])
    chosen, margin = _choose(flow, low, high, good)
    final = chosen.springs.in_scene(scene, chosen.c_A)
    return Design(
        target,
        "",
        final,
        undamped=run_first_contact(chosen.springs.in_scene(scene, 0.0)),
        damped=run_first_contact(final),
        outcome=chosen.outcome,
        capturing=(low.c_A, high.c_A),
        margin=margin,
        energy=energy_of(final, chosen.outcome.t),
        history=tuple(flow.history),
    )


def _choose(
    flow: _Flow, low: _Damper, high: _Damper, between: Sequence[_Damper]
) -> tuple[_Damper, float | None]:
    """Return the damper to take, and its margin if a spread is given.

    Without a spread, the good one next to the middle of the interval; with one, that of the
    largest margin, the middle's neighbours first where several have the same.
    """
    spread = flow.target.spread
    # a damper is off by a part of itself: the middle of the logarithms.  Stiffer than critical
    # it hardly lets the probe move, and is taken only where nothing softer captures
    critical = _critical_damping(flow.scene, low.springs.k_A)
    top = min(high.c_A, critical) if low.c_A < critical else high.c_A
    middle = math.sqrt(max(low.c_A, SHARES[1] * critical) * top)
    if spread is None:
        one = flow.damper(middle, low.springs)
        captures = [d for d in (one, low, high, *between) if d is not None and flow.good(d)]
        return min(captures, key=lambda d: abs(d.c_A - middle)), None
    shares = np.linspace(0.0, 1.0, _SIDE + 1)
    around = [*middle * (high.c_A / middle) ** shares, *low.c_A + shares * (middle - low.c_A)]
    nearest_first = sorted(map(float, around), key=lambda c_A: abs(c_A - middle))
    tried = [flow.damper(c_A, low.springs) for c_A in dict.fromkeys(nearest_first)]
    good = [one for one in tried if one is not None and flow.good(one)]  # low at least
    margins = [margin_of(one.springs.in_scene(flow.scene, one.c_A), spread) for one in good]
    best = int(np.argmax(margins))
    return good[best], margins[best]


def _refused(flow: _Flow, why: str, springs: Springs, nearest: _Damper | None) -> Design:
    history = tuple(flow.history)
    if nearest is None:
        found = springs.contact.touches > 0
        scene = springs.in_scene(flow.scene, 0.0) if found else None
        return Design(flow.target, why, scene, history=history)
    scene = nearest.springs.in_scene(flow.scene, nearest.c_A)
    return Design(flow.target, why, scene, outcome=nearest.outcome, history=history)


def _no_springs(target: DesignTarget, springs: Springs) -> str:
    contact = springs.contact
    return (
        f"no springs give, within {ACCEPTED:.0%}, strokes of {target.axial_stroke * 1e3:.4g} mm "
        f"and {target.torsion * 1e3:.4g} mrad: the nearest, k_A = {springs.k_A:.4g} N/m and "
        f"k_T = {springs.k_T:.4g} N m/rad, give {contact.axial_stroke * 1e3:.4g} mm and "
        f"{contact.torsion * 1e3:.4g} mrad" + (f" ({contact.failure})" if contact.failure else "")
    )


def _no_damper(flow: _Flow, judged: Sequence[_Damper], springs: Springs) -> str:
    """Return why no damper will do: the force, too much energy left, or too little."""
    target = flow.target
    if not judged:
        return _no_springs(target, springs)
    top = max(one.c_A for one in judged)
    captures = [one for one in judged if one.outcome.captured and not one.outcome.failure]
    if captures:
        least = min(captures, key=lambda one: one.outcome.loads["max_normal_force"])
        return (
            f"every damper up to {top:.4g} N s/m that captures pushes too hard: at least "
            f"{least.outcome.loads['max_normal_force']:.4g} N (c_A = {least.c_A:.4g} N s/m), "
            f"{target.peak_force:.4g} N are allowed"
        )
    best = min(judged, key=lambda one: one.outcome.loads["nearest_distance"])
    nearest = best.outcome.loads["nearest_distance"] * 1e3
    if best.outcome.loads["nearest_distance"] > flow.scene.cone.L_c:
        return (
            "no damper captures: the tip is turned away at the cone's outer lip, and comes no "
            f"nearer than {nearest:.3g} mm ({_verdicts(judged)})"
        )
    why = (
        f"no damper captures up to {top:.4g} N s/m: the tip comes nearest, {nearest:.3g} mm, with "
        f"c_A = {best.c_A:.4g} N s/m ({best.outcome.verdict.label}: {best.outcome.reason})"
    )
    if below := [one for one in judged if one.c_A < best.c_A]:
        stuck = sum(one.outcome.verdict is CaptureState.STUCK for one in below)
        energy = "too little energy" if 2 * stuck > len(below) else "too much energy"
        why += f"; with less, {energy} is left ({_verdicts(below)})"
    if above := [one for one in judged if one.c_A > best.c_A]:
        why += f"; with more, too little is left to reach BE ({_verdicts(above)})"
    return why


def _verdicts(dampers: Sequence[_Damper]) -> str:
    """Return how often each verdict was given."""
    labels = [one.outcome.verdict.label for one in dampers]
    return ", ".join(f"{labels.count(label)} x {label}" for label in dict.fromkeys(labels))
