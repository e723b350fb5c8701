"""Design of a buffer: limits and objectives in, one buffer or the front of the best buffers out.

Some values of a scene are free.  The search has two steps, for the scene alone and then, where
there are dispersions, with draws.  NSGA-II covers the ranges (:mod:`capture_sim.studies.coverage`).
Each row that is shown is then refined on its own: one objective is minimised, the others held
(:mod:`capture_sim.studies.refinement`).  A row says how far it has converged: by the gain of its
last pass, and by a second coverage and refinement with another seed, which alone shows a basin that
the first has missed.  The search runs at the tolerance of sweeps and within limits that are smaller
by 1e-5; the rows are then run as the scene is.

An objective that the buffer does not decide ends the search, unless the ranges are narrow.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from capture_sim.scene.parts import Scene
from capture_sim.studies.candidates import Archive, Candidate, Evaluator, Requirements
from capture_sim.studies.coverage import cover, undecided
from capture_sim.studies.dispersion import Probability
from capture_sim.studies.executors import InProcess
from capture_sim.studies.front import knee, layers, require_pymoo, rows_of
from capture_sim.studies.limit_costs import ACTIVE, LimitCost, limit_costs
from capture_sim.studies.limits import Measure
from capture_sim.studies.outcome import CAPTURED
from capture_sim.studies.refinement import Evaluate, Goal, Points, refine
from capture_sim.studies.sweep import RTOL
from capture_sim.studies.variables import (
    FREE,
    Variable,
    fields_of,
    make_variables,
    own_value,
    with_values,
)

#: Most rows of the table over a front.
MAX_ROWS = 12
#: Candidates of a search; with an area of approach each of them needs about 100 runs, with
#: dispersions as many as there are draws.
CANDIDATES, CANDIDATES_OF_AREA, CANDIDATES_OF_DRAWS = 8000, 1000, 1500
#: Rows of a front unless the budget is small, and the candidates that a row needs.
_ROWS, _FEWEST_ROWS, _RUNS_OF_ROW = 7, 3, 800
#: Most candidates of the coverage and its share of the budget; a second seed has half of them.
_COVERAGE, _COVERAGE_SHARE = 800, 0.25
#: Candidates of a pass over a row; a pass of fewer is not followed by a second seed.
_PASS, _SHORT_PASS = 200, 50
_PASSES = 3
#: Share of the budget without dispersions, where there are some; of the costs of limits.
_ALONE, RESERVE = 0.3, 0.12
#: Under dispersions: rounds, each with twice the draws.
_ROUNDS = 3
#: By which share the search's limits are smaller.
_TIGHTER = 1e-5
#: A row has converged if its last pass gains less, and a second seed is no further away.
GAINED, AGREES = 1e-3, 5e-3
#: Weight of the held objectives of a row, so that of equal buffers the better is found; at an end
#: of the front that of the other objectives.
_WEIGHT, _WEIGHT_AT_END = 1e-3, 0.02
#: Most wider ranges of a value.
_WIDENINGS = 3
#: A load that is neither limited nor minimised is named from this multiple of the own buffer's on.
GROWN = 3.0
#: The loads that are watched for that.
WATCHED = (
    *("max_axial_stroke_in", "max_axial_stroke_out", "max_torsion", "max_buffer_force"),
    *("max_buffer_torque", "max_normal_force"),
)
#: Most candidates with draws that the cost of a limit begins with.
_KEPT_OF_DRAWS = 100
#: By which share each value of a row is changed, to see how sharp the row is.
SHARP = 0.01
#: Without a latch, rows are also run to these multiples of t_end.
_LONGER, LONGEST = 3.0, 10.0
#: Candidates that are run at the scene's tolerance for a row, at most.
_CONFIRMED = 6

CONVERGED, ENDED = "converged", "budget ended"


@dataclass(frozen=True)
class Window:
    """The values of an objective over which the rows are spaced, SI."""

    key: str
    low: float
    high: float


@dataclass(frozen=True)
class Sharpness:
    """How sharp a row is: the worst of its runs with one value 1 % larger or smaller."""

    change: float  # of the worst objective, relative
    excess: float  # of the worst limit, relative; 0 if all are kept
    not_held: bool  # a run does not capture, or the tip leaves again


@dataclass(frozen=True)
class Row:
    """A buffer of the front."""

    candidate: Candidate  # at the tolerance of the scene; with draws: quantiles in new draws
    goal: Goal
    is_knee: bool = False
    convergence: str = ENDED
    check: Probability | None = None  # of success with new draws
    at_ends: tuple[str, ...] = ()  # values at an end of their range, in words
    stays: float | None = None  # s: the last of t_end, 3 and 10 t_end with the tip captured
    sharpness: Sharpness | None = None
    grown: tuple[tuple[Measure, float], ...] = ()  # loads without a limit, over the own buffer's


@dataclass(frozen=True)
class Design:
    """The result of a design; the rows are in the order of the first objective."""

    scene: Scene  # that was given
    requirements: Requirements
    variables: tuple[Variable, ...]
    rows: tuple[Row, ...]  # one with one objective
    own: Candidate  # the scene's own buffer
    refusal: str  # why there is no buffer; empty if there is one
    interrupted: bool = False  # under dispersions, the front is then that of the scene alone
    history: tuple[Candidate, ...] = field(default=(), repr=False)  # in order
    archive: Archive = field(default_factory=Archive, repr=False, compare=False)

    @property
    def met(self) -> bool:
        """Whether there is a buffer."""
        return not self.refusal

    @property
    def front(self) -> tuple[Candidate, ...]:
        """The buffers of the rows."""
        return tuple(row.candidate for row in self.rows)

    @property
    def knee(self) -> int:
        """Index of the row at the knee."""
        return next(k for k, row in enumerate(self.rows) if row.is_knee)

    def scene_of(self, candidate: Candidate) -> Scene:
        """Return the scene with a candidate's buffer."""
        return with_values(self.scene, candidate.values)


def design_buffer(
    scene: Scene,
    requirements: Requirements,
    free: Sequence[str] = FREE,
    *,
    window: Window | None = None,
    candidates: int | None = None,
    seed: int = 1,
    executor: Executor | None = None,
    report: Callable[[Candidate], None] | None = None,
    archive: Archive | None = None,
) -> Design:
    """Find the buffers that capture within limits and that no other beats in all objectives.

    Parameters
    ----------
    scene
        Scene with vehicles, cone, contact and approach; its values of free parameters are only
        compared with the front.
    requirements
        Objectives, limits, and the dispersions under which they must hold.
    free
        Names of the values to search, e.g. ``"buffer.preload"``; with a range as
        ``"buffer.k_A=100:2000"``, or a catalogue as ``"buffer.k_A=[450,500,560]"``.
        ``"damping_ratio"`` is the damper as a share of the critical one.  ``buffer.c_A_rebound``
        keeps its ratio to ``buffer.c_A`` unless it is free.
    window
        Values of an objective over which the rows are spaced; None: over the whole front.
    candidates
        Number of buffers to try in all, 100 or more; None for 8000, 1500 with dispersions, or 1000
        with an area of approach.
    seed
        Seed of the search and of the draws; the same seed gives the same front.
    executor
        Executor as in ``concurrent.futures``; None for this process.
    report
        Function called with every candidate.
    archive
        Runs that were made before, and those of this call; see
        :class:`capture_sim.studies.candidates.Archive`.

    Returns
    -------
    Design
        Its front, or the reason why there is none.  After Ctrl-C, the front found so far.

    Raises
    ------
    SceneError
        A name or a value is invalid, or the chaser never meets the cone.
    MissingPackageError
        pymoo is not installed.
    """
    require_pymoo()
    variables = make_variables(scene, requirements.limits, free)
    budget = candidates or default_candidates(requirements)
    search = _Search(
        scene, requirements, variables, window, seed, executor or InProcess(), report, archive
    )
    interrupted, refusal = False, ""
    rows: list[Row] = []
    try:
        refusal = search.alone(budget)
    except KeyboardInterrupt:
        interrupted = True
    if not refusal:
        rows = search.confirmed(interrupted=interrupted)
        if rows and requirements.under is not None and not interrupted:
            try:
                rows = search.with_draws(budget)
            except KeyboardInterrupt:
                interrupted = True
        refusal = search.refusal(rows)
    own = search.own(with_draws=not interrupted)
    if not interrupted:
        rows = search.detailed(rows, own)
    return Design(
        scene,
        requirements,
        search.variables,
        _knee_marked(rows, requirements.objectives),
        own,
        refusal,
        interrupted,
        tuple(search.history),
        search.archive,
    )


def default_candidates(requirements: Requirements) -> int:
    """Return the number of buffers that a design tries unless another is given."""
    if requirements.area:
        return CANDIDATES_OF_AREA
    return CANDIDATES if requirements.under is None else CANDIDATES_OF_DRAWS


def beaten_by(design: Design) -> list[tuple[Measure, float]]:
    """Return the best value of each objective on the front, the others no worse than the own.

    Objectives in which no buffer of the front beats the scene's own are left out.
    """
    objectives = design.requirements.objectives
    own, front = costs_of([design.own], objectives)[0], costs_of(design.front, objectives)
    found = []
    for k, objective in enumerate(objectives):
        no_worse = np.delete(front <= own, k, axis=1).all(axis=1)
        better = [n for n in np.flatnonzero(no_worse).tolist() if front[n, k] < own[k]]
        if better:
            best = min(better, key=lambda n: float(front[n, k]))
            found.append((objective, design.front[best].loads[objective.key]))
    return found


def costs_of_limits(
    design: Design,
    row: Row,
    *,
    seed: int = 1,
    executor: Executor | None = None,
    candidates: int | None = None,
) -> tuple[LimitCost, ...]:
    """Return what the active limits of a row cost in the objectives, with a share of the budget."""
    scene, requirements = search_scene(design.scene), search_requirements(design.requirements)
    runs = Evaluator(scene, requirements, seed, executor or InProcess(), None, design.archive)
    draws = runs.draws(requirements.draws, 0) if requirements.under is not None else []

    def evaluate(others: Requirements) -> Evaluate:
        under = runs.under(others)
        return partial(under.with_draws, draws) if draws else under.alone

    is_drawn = bool(draws)
    known = [x for x in design.history if (x.share is not None) == is_drawn and x.violation < 0.2]
    at = np.array(row.candidate.costs(requirements.objectives))
    known.sort(key=lambda x: float(np.abs(x.costs(requirements.objectives) - at).max()))
    budget = int(RESERVE * (candidates or default_candidates(design.requirements)))
    return limit_costs(
        row.candidate,
        [x.values for x in known[: _KEPT_OF_DRAWS if draws else None]],
        design.variables,
        requirements,
        evaluate,
        budget,
        seed,
    )


def costs_of(candidates: Sequence[Candidate], objectives: Sequence[Measure]) -> np.ndarray:
    """Return the objectives of candidates, (n, objectives), each so that less is better."""
    costs = [each.costs(objectives) for each in candidates]
    return np.array(costs, dtype=float).reshape(-1, len(objectives))


def search_scene(scene: Scene) -> Scene:
    """Return the scene at the tolerance of a search."""
    run = dataclasses.replace(scene.run, rtol=max(scene.run.rtol, RTOL))
    return dataclasses.replace(scene, run=run)


def search_requirements(requirements: Requirements) -> Requirements:
    """Return the requirements that a search keeps: their limits a little smaller."""
    return requirements.tightened(_TIGHTER)


def _knee_marked(rows: Sequence[Row], objectives: Sequence[Measure]) -> tuple[Row, ...]:
    if not rows:
        return ()
    at = knee(costs_of([row.candidate for row in rows], objectives))
    return tuple(dataclasses.replace(row, is_knee=k == at) for k, row in enumerate(rows))


class _Search:
    """The search for one design, and its history."""

    def __init__(
        self,
        scene: Scene,
        requirements: Requirements,
        variables: tuple[Variable, ...],
        window: Window | None,
        seed: int,
        executor: Executor,
        report: Callable[[Candidate], None] | None,
        archive: Archive | None,
    ) -> None:
        self._scene, self._requirements, self._window = scene, requirements, window
        self._objectives = requirements.objectives
        self.variables, self._seed = variables, seed
        archive = archive or Archive()
        self.archive = archive
        self._coarse = Evaluator(
            *(search_scene(scene), search_requirements(requirements), seed, executor, report),
            archive,
        )
        self._longer = {
            factor: Evaluator(
                *(_lasting(scene, factor), requirements, seed, executor, None, archive),
                kind=f"exact, {factor:g} t_end",
            )
            for factor in (1.0, _LONGER, LONGEST)
        }
        self._exact = self._longer[1.0]
        self._own = {each.name: own_value(scene, each.name) for each in variables}
        self._left = 0  # candidates of the stage
        self.points = Points(variables, self._objectives)
        self._goals: list[Goal] = []
        self._words: list[str] = []
        #: The rows of the last round under dispersions, with their check.
        self.checked: list[tuple[Candidate, Probability]] = []

    @property
    def history(self) -> list[Candidate]:
        """The candidates so far, in order."""
        return self._coarse.history

    def own(self, *, with_draws: bool) -> Candidate:
        """Return the scene's own buffer as a candidate."""
        found = self._exact.alone([self._own])
        if self._requirements.under is not None and with_draws:
            found = [each for each, _ in self._coarse.check(found, 1)]
        return found[0]

    def alone(self, budget: int) -> str:
        """Search without dispersions; return why the search ended before a front; else nothing."""
        is_first_of_two = self._requirements.under is not None
        self._left = int(budget * (_ALONE if is_first_of_two else 1.0 - RESERVE))
        begin = self._earlier()
        if all(each.has(self._own[each.name]) for each in self.variables):
            # so that the front is no worse than the scene's own buffer
            begin = [self._own, *begin]
        return self._stage(self._coarse.alone, begin, brief=is_first_of_two)

    def with_draws(self, budget: int) -> list[Row]:
        """Return buffers under dispersions that pass the check with new draws."""
        alone = self.points
        start = [alone.candidates[k].values for k in _promising(alone, self._requirements)]
        rest = budget - len(self.history)
        for number in range(_ROUNDS):
            draws = self._coarse.draws(self._requirements.draws * 2**number, 2 * number)
            # the first round has two thirds, the next two thirds of the rest
            self._left = int(rest * (2 / 3 if number < _ROUNDS - 1 else 1.0))
            rest -= self._left
            if self._left < 1:
                break
            self._stage(partial(self._coarse.with_draws, draws), start)
            best = [self.points.best(goal, 1, feasible=True) for goal in self._goals]
            shown = [k for k, each in enumerate(best) if each]
            if shown:
                self.checked = self._coarse.check([best[k][0] for k in shown], 2 * number + 1)
                rows = [
                    Row(found, self._goals[k], convergence=self._words[k], check=check)
                    for k, (found, check) in zip(shown, self.checked, strict=True)
                    if found.feasible
                ]
                if rows:
                    return self._front(rows)
            # the draws were too kind, or too few: more of them, beginning with the best
            order = np.argsort(self.points.violations, kind="stable")[:20].tolist()
            start = [self.points.candidates[k].values for k in order]
        return []

    def confirmed(self, *, interrupted: bool) -> list[Row]:
        """Return the best buffer of each goal at the tolerance of the scene."""
        if interrupted:
            self._goals = self._make_goals(_FEWEST_ROWS if len(self._objectives) > 1 else 1)
            self._words = ["interrupted"] * len(self._goals)
        rows: dict[int, Row] = {}
        for number in range(_CONFIRMED):
            tried = {}
            for k, goal in enumerate(self._goals):
                best = self.points.best(goal, number + 1, feasible=True)
                if k not in rows and len(best) > number:
                    tried[k] = best[number]
            if not tried:
                break
            found = self._exact.alone([each.values for each in tried.values()])
            for k, exact in zip(tried, found, strict=True):
                if exact.feasible:
                    rows[k] = Row(exact, self._goals[k], convergence=self._words[k])
        return self._front([rows[k] for k in sorted(rows)])

    def _stage(
        self,
        evaluate: Callable[[Sequence[Mapping[str, float]]], list[Candidate]],
        begin: Sequence[Mapping[str, float]],
        *,
        brief: bool = False,
    ) -> str:
        """Cover the ranges and refine the rows; return why there is nothing to search, if so."""

        def within_budget(values: Sequence[Mapping[str, float]]) -> list[Candidate]:
            asked = values[: max(self._left, 0)]
            self._left -= len(asked)
            return evaluate(asked) if asked else []

        points = self.points = Points(self.variables, self._objectives)
        runs = min(_COVERAGE, int(_COVERAGE_SHARE * self._left))
        places = [[each.share(x[each.name]) for each in self.variables] for x in begin]
        for number, found in enumerate(cover(points, within_budget, runs, self._seed, places)):
            is_whole = number == 0 and all(each.is_whole for each in self.variables)
            if is_whole and (reason := undecided(found, self._objectives)):
                return reason
        count = 1
        if len(self._objectives) > 1:
            count = min(max(self._left // _RUNS_OF_ROW, _FEWEST_ROWS), _ROWS)
        of_second = 0 if brief else runs // 2
        per_pass = int((self._left - of_second) / (count * 4.2 + 2.0))
        if per_pass < _SHORT_PASS:
            of_second, per_pass = 0, int(self._left / (count * 2.0 + 1.0))
        per_pass = max(min(per_pass, _PASS if count > 1 else 2 * _PASS), 4)
        if (
            count > 1 or not points.violations.size or points.violations.min() > 0.0
        ):  # the ends first: the other rows lie between
            refine(self._ends(), points, within_budget, per_pass)
        self._goals = self._make_goals(count)
        self._words = [ENDED] * len(self._goals)
        if points.violations.min() > 0.0:
            return ""  # none is feasible
        gains = self._passes(within_budget, per_pass, of_second)
        if of_second and gains is not None:
            self._compare(within_budget, per_pass, of_second, gains)
        elif gains is not None and self._left > 0:
            self._words = [CONVERGED if gain <= GAINED else ENDED for gain in gains]
        return ""

    def _passes(
        self,
        evaluate: Callable[[Sequence[Mapping[str, float]]], list[Candidate]],
        per_pass: int,
        of_second: int,
    ) -> np.ndarray | None:
        """Refine all rows; return the gain of each in its last pass, None if the budget ended."""
        kept = of_second + 2 * len(self._goals) * per_pass if of_second else 0
        gains, values = None, self._best_values()
        for number in range(_PASSES):
            if self._left - kept < 0.9 * len(self._goals) * per_pass:
                return gains
            rng = None if number % 2 == 0 else np.random.default_rng([self._seed, number])
            if not refine(self._goals, self.points, evaluate, per_pass, rng):
                return None
            if number < _WIDENINGS and self._widen():
                continue
            now = self._best_values()
            gains, values = values - now, now
            if number and gains.max() <= GAINED:
                break
        return gains

    def _compare(
        self,
        evaluate: Callable[[Sequence[Mapping[str, float]]], list[Candidate]],
        per_pass: int,
        of_second: int,
        gains: np.ndarray,
    ) -> None:
        """Search with a second seed, keep what is better, and say how far both agree."""
        goals, rng = self._goals, np.random.default_rng([self._seed, 99])
        other = Points(self.variables, self._objectives)
        for _ in cover(other, evaluate, of_second, self._seed + 7919):
            pass
        if not len(other.candidates) or not refine(goals, other, evaluate, per_pass, rng):
            return
        if self._left >= 0.9 * len(goals) * per_pass:
            refine(goals, other, evaluate, per_pass, rng)
        first = self._best_values()
        second = np.array([other.goal_values(goal).min() for goal in goals])
        self.points.add(other.candidates)
        better = [k for k in range(len(goals)) if second[k] < first[k] - GAINED]
        if better:
            before = self._best_values()
            refine([goals[k] for k in better], self.points, evaluate, per_pass)
            gains = np.maximum(before - self._best_values(), 0.0)
        self._words = []
        for gain, apart in zip(gains, np.abs(first - second), strict=True):
            agrees = apart <= AGREES and gain <= GAINED
            words = f"within {_rounded_up(float(apart))} of a second seed"
            self._words.append(CONVERGED if agrees else words)

    def _best_values(self) -> np.ndarray:
        return np.array([self.points.goal_values(goal).min() for goal in self._goals])

    def _widen(self) -> bool:
        """Widen ranges with an optimum at their end and no active limit; return whether any."""
        limits = self._requirements.limits
        wider = list(self.variables)
        ends = self._ends() if len(self._objectives) > 1 else []
        for goal in self._goals:
            best = self.points.best(goal, 1)[0]
            is_limited = any(each.use(best.loads[each.key]) >= ACTIVE for each in limits)
            if goal in ends or is_limited or not best.feasible:
                continue
            for k, variable in enumerate(self.variables):
                end = variable.end_at(best.values[variable.name])
                if end and variable.may_widen(end):
                    wider[k] = variable.widened(end)
        if wider == list(self.variables):
            return False
        self.variables = tuple(wider)
        points = Points(self.variables, self._objectives)
        points.add(self.points.candidates)
        self.points = points
        return True

    def _ends(self) -> list[Goal]:
        """Return the goals of the ends of the front."""
        count = len(self._objectives)
        none = (math.inf,) * count
        return [
            Goal(tuple(1.0 if k == n else _WEIGHT_AT_END for k in range(count)), none)
            for n in range(count)
        ]

    def _make_goals(self, count: int) -> list[Goal]:
        """Return the goals of so many rows, in the order of the held objective."""
        feasible = np.flatnonzero(self.points.violations <= 0.0)
        costs = self.points.costs[feasible]
        if len(self._objectives) == 1:
            return [Goal((1.0,), (math.inf,))]
        if not len(costs):
            return self._ends()
        front = costs[layers(costs)[0]]
        at_knee = front[knee(front)]
        if len(self._objectives) > 2 or count < 3:
            shown = front[rows_of(front, count, [knee(front)])]
            last = len(self._objectives) - 1
            inner = [
                Goal(_weights(last, last + 1), (*(point[:-1] - _TIGHTER), math.inf))
                for point in shown
                if self._window is None
                or _within(point[self._held], *self._window_costs(), _TIGHTER)
            ]
            return inner if self._window is not None else [*self._ends(), *inner]
        held = self._held
        ends = self._ends()
        low, high = front[:, held].min(), front[front[:, 1 - held].argmin(), held]
        if self._window is not None:
            low, high = self._window_costs()
            levels = np.linspace(low, high, count)
        else:
            levels = np.linspace(low, high, count)[1:-1]
        marked = [float(at_knee[held])]
        own = self._exact.alone([self._own])[0]
        if own.feasible:
            marked.append(own.costs(self._objectives)[held])
        for level in marked:
            if levels.size > 2 and levels[0] < level < levels[-1]:
                inner_levels = np.abs(levels - level)
                if self._window is not None:
                    inner_levels[[0, -1]] = math.inf  # the ends of a window stay
                levels[inner_levels.argmin()] = level
        goals = []
        for level in np.sort(levels):
            ceilings = [math.inf, math.inf]
            ceilings[held] = float(level) - _TIGHTER
            goals.append(Goal(_weights(1 - held, 2), tuple(ceilings)))
        return goals if self._window is not None else [ends[held], *goals, ends[1 - held]]

    @property
    def _held(self) -> int:
        """Index of the objective over which rows are spaced."""
        if self._window is None:
            return 0
        return [each.key for each in self._objectives].index(self._window.key)

    def _window_costs(self) -> tuple[float, float]:
        assert self._window is not None
        measure = self._objectives[self._held]
        low, high = sorted((measure.cost(self._window.low), measure.cost(self._window.high)))
        return low, high

    def _front(self, rows: Sequence[Row]) -> list[Row]:
        """Return the rows of which no other is better in all objectives, in order."""
        if not rows:
            return []
        costs = costs_of([row.candidate for row in rows], self._objectives)
        chosen = layers(costs)[0].tolist()
        if self._window is not None:
            low, high = self._window_costs()
            held = costs[:, self._held]
            chosen = [k for k in chosen if held[k] <= high]
            if not any(low - 1e-3 <= held[k] for k in chosen):
                return []
        return [rows[k] for k in sorted(chosen, key=lambda k: tuple(costs[k]))]

    def _earlier(self) -> list[dict[str, float]]:
        """Return the buffers of an earlier design that are best here, apart in what they trade."""
        names = [each.name for each in self.variables]
        found = []
        for known, values in self.archive.earlier:
            fields = {**fields_of(self._scene, self._own), **dict(zip(known, values, strict=True))}
            scene = with_values(self._scene, {n: fields[n] for n in known})
            mine = {name: own_value(scene, name) for name in names}
            if all(each.has(mine[each.name]) for each in self.variables):
                found.append(mine)
        if not found:
            return []
        points = Points(self.variables, self._objectives)
        points.add(self._coarse.under(search_requirements(self._requirements)).alone(found))
        order = np.argsort(points.violations, kind="stable")
        feasible = np.flatnonzero(points.violations <= 0.0)
        if feasible.size:
            first = feasible[layers(points.costs[feasible])[0]]
            order = np.array([*first, *(k for k in order if k not in set(first.tolist()))])
        return [dict(points.candidates[k].values) for k in order[:_COVERAGE].tolist()]

    def detailed(self, rows: Sequence[Row], own: Candidate) -> list[Row]:
        """Return rows with what they should be known for: ends, sharpness, staying, other loads."""
        if not rows:
            return []
        stays = self._stays([row.candidate.values for row in rows])
        found = []
        for row, until in zip(rows, stays, strict=True):
            at_ends = [
                f"{each.name} at the {end} end of its range"
                for each in self.variables
                if (end := each.end_at(row.candidate.values[each.name]))
            ]
            found.append(
                dataclasses.replace(
                    row,
                    at_ends=tuple(at_ends),
                    stays=until,
                    grown=self._grown(row.candidate, own),
                    sharpness=self._sharpness(row),
                )
            )
        return found

    def _stays(self, values: Sequence[Mapping[str, float]]) -> list[float | None]:
        """Return until when the tip stays captured: of t_end, 3 and 10 t_end; None with a latch."""
        if self._scene.latch is not None:
            return [None] * len(values)
        until, holds = [0.0] * len(values), [True] * len(values)
        for factor, evaluator in self._longer.items():
            for k, each in enumerate(evaluator.alone(values)):
                holds[k] &= each.verdict == CAPTURED and not each.left_again
                if holds[k]:
                    until[k] = factor * self._scene.run.t_end
        return list(until)

    def _grown(self, found: Candidate, own: Candidate) -> tuple[tuple[Measure, float], ...]:
        """Return the loads without a limit that are far beyond those of the own buffer."""
        known = {each.key for each in (*self._objectives, *self._requirements.limits)}
        grown = []
        for key in WATCHED:
            if key in known:
                continue
            value, before = found.loads[key], own.loads[key]
            if before > 0.0 and value / before >= GROWN:
                grown.append((Measure(key), value / before))
        return tuple(grown)

    def _sharpness(self, row: Row) -> Sharpness | None:
        """Return the worst of the runs with one value 1 % larger or smaller; None with draws."""
        if row.check is not None or self._requirements.area:
            return None
        values = row.candidate.values
        moved = [
            {**values, each.name: values[each.name] * factor}
            for each in self.variables
            for factor in (1.0 - SHARP, 1.0 + SHARP)
            if values[each.name]
        ]
        found = self._exact.alone(moved) if moved else []
        held = [x for x in found if x.verdict == CAPTURED]
        held = [x for x in held if self._requirements.allow_leaving or not x.left_again]
        if not held:
            return Sharpness(math.nan, math.nan, not_held=bool(found))
        before = np.array(row.candidate.costs(self._objectives))
        change = float(np.expm1((costs_of(held, self._objectives) - before).max()))
        excess = max(
            (each.use(x.loads[each.key]) - 1.0 for each in self._requirements.limits for x in held),
            default=0.0,
        )
        return Sharpness(change, max(excess, 0.0), not_held=len(held) < len(found))

    def refusal(self, rows: Sequence[Row]) -> str:
        """Return why there is no buffer; empty if there is one."""
        if rows:
            return ""
        searched = ", ".join(
            f"{each.name} {', '.join(f'{x:.4g}' for x in each.choices)}"
            if each.choices
            else f"{each.name} {each.low:.4g} to {each.high:.4g}"
            for each in self.variables
        )
        among = f"among {len(self.history)} buffers tried ({searched})"
        if not self.history:
            return "interrupted before the first buffers were run"
        feasible = [each for each in self.history if each.feasible]
        if self._window is not None and feasible and not self.checked:
            measure = self._objectives[self._held]
            values = [each.loads[measure.key] for each in feasible]
            return (
                f"--window {measure.key}: {measure.shown(self._window.low)} to "
                f"{measure.shown(self._window.high)} {measure.load.shown_in} is not reached by the "
                f"front; feasible buffers {among} have {measure.shown(min(values))} to "
                f"{measure.shown(max(values))} {measure.load.shown_in}"
            )
        with_draws = [each for each in self.history if each.share is not None]
        best = min(with_draws or self.history, key=lambda each: each.violation)
        values_text = _values_text(best)
        required = f"{self._requirements.confidence:.0%}"
        if self.checked:
            best, check = max(self.checked, key=lambda each: each[1].estimate)
            return (
                f"the best {among}, {_values_text(best)}, is captured within the limits in "
                f"{check.met} of {check.computed} new draws; {required} are required"
            )
        if best.share is not None:
            return (
                f"{among}, none is captured within the limits in {required} of the draws; the "
                f"nearest, {values_text}, is in {best.share:.1%}"
            )
        if best.verdict != CAPTURED:
            return f"{among}, none captures; the nearest, {values_text}, ends {best.verdict}"
        if best.left_again and not self._requirements.allow_leaving:
            return (
                f"{among}, none is still captured at {self._scene.run.t_end:g} s; the nearest, "
                f"{values_text}, has left again (a latch would hold it; --allow-leaving)"
            )
        excess = ", ".join(
            f"{limit.meaning} {limit.shown(best.loads[limit.key])} {limit.load.shown_in} (limit "
            f"{limit.shown(limit.value)})"
            for limit in self._requirements.limits
            if limit.is_exceeded(best.loads[limit.key])
        )
        if not excess:
            least = self._requirements.least_range
            excess = f"a capture range of {best.captured_share:.1%} ({least:.1%} required)"
        return f"{among}, none captures within the limits; the nearest, {values_text}, has {excess}"


def _values_text(candidate: Candidate) -> str:
    return ", ".join(f"{name} = {value:.5g}" for name, value in candidate.values.items())


def _lasting(scene: Scene, factor: float) -> Scene:
    """Return a scene that runs so many times as long."""
    run = dataclasses.replace(scene.run, t_end=factor * scene.run.t_end)
    return dataclasses.replace(scene, run=run)


def _weights(minimised: int, count: int) -> tuple[float, ...]:
    return tuple(1.0 if k == minimised else _WEIGHT for k in range(count))


def _within(value: float, low: float, high: float, room: float) -> bool:
    return low - room <= value <= high + room


def _rounded_up(share: float) -> str:
    """Return a share in per cent with one digit, rounded up."""
    return f"{math.ceil(share * 1000.0) / 10.0:.1f} %"


def _promising(points: Points, requirements: Requirements) -> list[int]:
    """Return the points to begin with under dispersions: the best, and those with much margin."""
    feasible = np.flatnonzero(points.violations <= 0.0)
    if not feasible.size:
        return []
    front = feasible[layers(points.costs[feasible])[0]].tolist()

    def largest_use(k: int) -> float:
        loads = points.candidates[k].loads
        return max((each.use(loads[each.key]) for each in requirements.limits), default=0.0)

    by_margin = sorted(feasible.tolist(), key=largest_use)
    chosen = [front[k] for k in rows_of(points.costs[front], 20)]
    return list(dict.fromkeys([*chosen, *by_margin[:20]]))
