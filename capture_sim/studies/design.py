"""Design of a buffer: limits and objectives in, one buffer or the front of the best buffers out.

Some values of a scene are free.  NSGA-II (Deb et al. 2002, of pymoo) searches them: it begins with
buffers spread over the ranges, and evaluates each population through the executor of the sweeps
(:mod:`capture_sim.studies.candidates`).  The search runs at the tolerance of sweeps, and ends when
the front grows no more.  Its best buffers are then run at the tolerance of the scene, and the front
is that of these runs.

Under dispersions a second search begins with the buffers of the first.  The rows of the front are
checked with draws that the search has not seen.

An objective that the buffer does not decide ends the search: it varies by less than 1 % among the
feasible buffers, or many different buffers reach its least value within 1 %.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from capture_sim.scene import paths
from capture_sim.scene.parts import Scene
from capture_sim.studies.candidates import Candidate, Evaluator, Requirements
from capture_sim.studies.dispersion import Probability
from capture_sim.studies.executors import InProcess
from capture_sim.studies.front import hypervolume, knee, layers, require_pymoo, rows_of
from capture_sim.studies.limit_costs import LimitCost, limit_costs
from capture_sim.studies.limits import Measure
from capture_sim.studies.outcome import CAPTURED
from capture_sim.studies.sweep import RTOL
from capture_sim.studies.variables import FREE, Variable, make_variables, with_values

#: Most rows of the table over a front.
MAX_ROWS = 12
#: Most candidates of a search; with an area of approach each of them needs about 100 runs.
CANDIDATES, CANDIDATES_OF_AREA = 2400, 500
#: The search ends when the front grows by less than this share in so many populations.
_GROWTH, _PATIENCE = 2e-4, 6
#: Most buffers spread over the ranges before the search, and that are run at the tolerance of the
#: scene after it; buffers of a population for each free value.
_FIRST, _CONFIRMED, _POPULATION = 200, 140, 20
#: Under dispersions: buffers of a population for each free value and populations of a round;
#: rounds, each with twice the draws.
_ROBUST_POPULATION, _ROBUST_GENERATIONS, _ROUNDS = 10, 10, 3
#: Relative width within which values of an objective count as equal.
SAME = 0.01
#: An objective is not decided by the buffer if this share of the first feasible buffers, and at
#: least so many, reach its least value: a peak that all soft buffers share.
_MANY, _FEWEST = 0.08, 5


@dataclass(frozen=True)
class Row:
    """A buffer of the front that is shown."""

    candidate: Candidate  # at the tolerance of the scene; with draws: quantiles in new draws
    is_knee: bool
    check: Probability | None = None  # of success with new draws


@dataclass(frozen=True)
class Design:
    """The result of a design; the front is in the order of the first objective."""

    scene: Scene  # that was given
    requirements: Requirements
    variables: tuple[Variable, ...]
    front: tuple[Candidate, ...]
    rows: tuple[Row, ...]  # at most MAX_ROWS of the front; one with one objective
    own: Candidate  # the scene's own buffer
    refusal: str  # why there is no buffer; empty if there is one
    interrupted: bool = False  # under dispersions, the front is then that of the scene alone
    history: tuple[Candidate, ...] = field(default=(), repr=False)  # in order

    @property
    def met(self) -> bool:
        """Whether there is a buffer."""
        return not self.refusal

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
    candidates: int | None = None,
    seed: int = 1,
    executor: Executor | None = None,
    report: Callable[[Candidate], None] | None = None,
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
        ``"buffer.k_A=100:2000"``.  ``buffer.c_A_rebound`` keeps its ratio to ``buffer.c_A`` unless
        it is free.
    candidates
        Most buffers to try without dispersions, 100 or more; None for 2400, or 500 with an area of
        approach.  The search ends before if the front grows no more.
    seed
        Seed of the search and of the draws; the same seed gives the same front.
    executor
        Executor as in ``concurrent.futures``; None for this process.
    report
        Function called with every candidate.

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
    search = _Search(scene, requirements, variables, seed, executor or InProcess(), report)
    most = candidates or (CANDIDATES_OF_AREA if requirements.area else CANDIDATES)
    interrupted, refusal, front = False, "", []
    checks: list[Probability | None] = []
    try:
        refusal = search.nominal(most)
    except KeyboardInterrupt:
        interrupted = True
    if not refusal:
        n_confirmed = min(_CONFIRMED, most // 10)
        try:
            front = search.confirmed(n_confirmed)
        except KeyboardInterrupt:  # without these runs there would be no front
            interrupted, front = True, search.confirmed(n_confirmed)
        checks = [None] * len(front)
    if front and requirements.under is not None and not interrupted:
        try:
            front, checks = search.robust(front)
        except KeyboardInterrupt:
            interrupted = True
    if not front and not refusal:
        refusal = search.refusal(interrupted=interrupted)
    return Design(
        scene,
        requirements,
        variables,
        tuple(front),
        _rows(front, checks, requirements.objectives),
        search.own(with_draws=not interrupted),
        refusal,
        interrupted,
        tuple(search.history),
    )


def _rows(
    front: Sequence[Candidate],
    checks: Sequence[Probability | None],
    objectives: Sequence[Measure],
) -> tuple[Row, ...]:
    """Return the rows of a front with their checks."""
    if not front:
        return ()
    points = costs_of(front, objectives)
    at_knee = knee(points)
    shown = rows_of(points, MAX_ROWS, [at_knee])
    return tuple(Row(front[k], k == at_knee, checks[k]) for k in shown)


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
    design: Design, row: Row, *, seed: int = 1, executor: Executor | None = None
) -> tuple[LimitCost, ...]:
    """Return what the active limits of a row cost in the objectives."""
    requirements, variables = design.requirements, design.variables
    runs = Evaluator(design.scene, requirements, seed, executor or InProcess())

    def evaluate(shares: np.ndarray) -> list[dict[str, float]]:
        found = runs.alone([_values(variables, each) for each in shares.tolist()])
        if requirements.under is not None:
            found = [each for each, _ in runs.check(found, 1, requirements.draws)]
        return [
            {key: x if each.verdict == CAPTURED else math.nan for key, x in each.loads.items()}
            for each in found
        ]

    shares = [each.share(row.candidate.values[each.name]) for each in variables]
    return limit_costs(
        row.candidate.loads, shares, requirements.limits, requirements.objectives, evaluate, seed
    )


def costs_of(candidates: Sequence[Candidate], objectives: Sequence[Measure]) -> np.ndarray:
    """Return the objectives of candidates, (n, objectives), each so that less is better."""
    costs = [each.costs(objectives) for each in candidates]
    return np.array(costs, dtype=float).reshape(-1, len(objectives))


def _values(variables: Sequence[Variable], shares: Sequence[float]) -> dict[str, float]:
    return {each.name: each.value(share) for each, share in zip(variables, shares, strict=True)}


class _Search:
    """The search for one design, and its history."""

    def __init__(
        self,
        scene: Scene,
        requirements: Requirements,
        variables: tuple[Variable, ...],
        seed: int,
        executor: Executor,
        report: Callable[[Candidate], None] | None,
    ) -> None:
        self._requirements, self._variables, self._seed = requirements, variables, seed
        run = dataclasses.replace(scene.run, rtol=max(scene.run.rtol, RTOL))
        coarse = dataclasses.replace(scene, run=run)
        self._coarse = Evaluator(coarse, requirements, seed, executor, report)
        self._exact = Evaluator(scene, requirements, seed, executor, report)
        #: The rows of the last round under dispersions, with their check.
        self.checked: list[tuple[Candidate, Probability]] = []
        self._own = {each.name: float(paths.get(scene, each.name) or 0.0) for each in variables}

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

    def nominal(self, most: int) -> str:
        """Search without dispersions; return why the search ended before a front; else nothing."""
        from scipy.stats import qmc

        n_values = len(self._variables)
        n_first, population = min(_FIRST, most // 6), min(_POPULATION * n_values, most // 16)
        first = qmc.LatinHypercube(n_values, seed=self._seed).random(n_first)
        if all(each.low <= self._own[each.name] <= each.high for each in self._variables):
            # so that the front is no worse than the scene's own buffer
            first[0] = [each.share(self._own[each.name]) for each in self._variables]
        generations = (most - n_first - min(_CONFIRMED, most // 10)) // population
        for number, candidates in enumerate(
            self._populations(self._coarse.alone, first, population, generations)
        ):
            if number == 0 and (reason := undecided(candidates, self._requirements.objectives)):
                return reason
        return ""

    def confirmed(self, most: int) -> list[Candidate]:
        """Return the front of the best buffers at the tolerance of the scene."""
        best = self._best(most)
        return self._front(self._exact.alone([each.values for each in best]) if best else [])

    def robust(
        self, front: Sequence[Candidate]
    ) -> tuple[list[Candidate], list[Probability | None]]:
        """Return buffers of the front under dispersions that pass the check with new draws."""
        size = _ROBUST_POPULATION * len(self._variables)
        start = self._promising(front, size)
        for number in range(_ROUNDS):
            draws = self._coarse.draws(self._requirements.draws * 2**number, 2 * number)
            evaluate = partial(self._coarse.with_draws, draws)
            shares = np.array([self._shares(each) for each in start])
            tried: list[Candidate] = []
            for candidates in self._populations(evaluate, shares, size, _ROBUST_GENERATIONS):
                tried += candidates
            best = self._front(tried)
            if best:
                points = costs_of(best, self._requirements.objectives)
                shown = [best[k] for k in rows_of(points, MAX_ROWS, [knee(points)])]
                self.checked = self._coarse.check(shown, 2 * number + 1)
                passed = {id(each): check for each, check in self.checked if each.feasible}
                kept = [each for each, _ in self.checked if each.feasible]
                if kept:
                    found = self._front(kept)
                    return found, [passed[id(each)] for each in found]
            # the draws were too kind, or too few: more of them, beginning with the best
            tried.sort(key=lambda each: each.violation)
            start = [*best, *tried][:size]
        return [], []

    def _populations(
        self,
        evaluate: Callable[[Sequence[Mapping[str, float]]], list[Candidate]],
        first: np.ndarray,
        population: int,
        generations: int,
    ) -> Iterator[list[Candidate]]:
        """Yield the populations of a search that begins with buffers by their shares."""
        from pymoo.algorithms.moo.nsga2 import NSGA2
        from pymoo.core.evaluator import Evaluator as Marker
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination
        from pymoo.problems.static import StaticProblem

        objectives, n_values = self._requirements.objectives, len(self._variables)
        problem = Problem(n_var=n_values, n_obj=len(objectives), n_ieq_constr=1, xl=0.0, xu=1.0)
        algorithm = NSGA2(pop_size=population, sampling=first)
        algorithm.setup(problem, termination=NoTermination(), seed=self._seed)
        fronts: list[np.ndarray] = []
        found: list[Candidate] = []
        for number in range(generations + 1):
            asked = algorithm.ask()
            candidates = evaluate([_values(self._variables, x) for x in asked.get("X").tolist()])
            marks = {
                "F": costs_of(candidates, objectives),
                "G": np.array([[each.violation] for each in candidates]),
            }
            Marker().eval(StaticProblem(problem, **marks), asked)
            algorithm.tell(infills=asked)
            yield candidates
            found = self._front([*found, *candidates])
            fronts.append(costs_of(found, objectives))
            if number >= _PATIENCE and _growth(fronts[-1 - _PATIENCE], fronts[-1]) < _GROWTH:
                return

    def _best(self, most: int) -> list[Candidate]:
        """Return the best candidates: the front, the front without that, and so on.

        Of a front that is too large, those that are spread over it.
        """
        feasible = [each for each in self.history if each.feasible]
        points = costs_of(feasible, self._requirements.objectives)
        chosen: list[int] = []
        for layer in layers(points):
            room = most - len(chosen)
            if len(layer) > room:
                layer = layer[rows_of(points[layer], room)] if room > 0 else layer[:0]
            chosen += layer.tolist()
        return [feasible[k] for k in chosen]

    def _front(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Return the front of the feasible candidates in the order of the first objective."""
        feasible = [each for each in candidates if each.feasible]
        points = costs_of(feasible, self._requirements.objectives)
        first = layers(points)[:1]
        chosen = first[0].tolist() if first else []
        return [feasible[k] for k in sorted(chosen, key=lambda k: tuple(points[k]))]

    def _shares(self, candidate: Candidate) -> list[float]:
        return [each.share(candidate.values[each.name]) for each in self._variables]

    def _promising(self, front: Sequence[Candidate], size: int) -> list[Candidate]:
        """Return buffers to begin with under dispersions: of the front, and with much margin."""
        points = costs_of(front, self._requirements.objectives)
        feasible = [each for each in self.history if each.feasible]
        by_margin = sorted(feasible, key=self._largest_use)[: size - size // 2]
        return [*(front[k] for k in rows_of(points, size // 2)), *by_margin]

    def _largest_use(self, candidate: Candidate) -> float:
        limits = self._requirements.limits
        return max((limit.use(candidate.loads[limit.key]) for limit in limits), default=0.0)

    def refusal(self, *, interrupted: bool) -> str:
        """Return why there is no buffer."""
        searched = ", ".join(
            f"{each.name} {each.low:.4g} to {each.high:.4g}" for each in self._variables
        )
        among = f"among {len(self.history)} buffers tried ({searched})"
        if not self.history:
            return "interrupted before the first buffers were run"
        with_draws = [each for each in self.history if each.share is not None]
        best = min(with_draws or self.history, key=lambda each: each.violation)
        values = ", ".join(f"{name} = {value:.5g}" for name, value in best.values.items())
        required = f"{self._requirements.confidence:.0%}"
        if self.checked:
            best, check = max(self.checked, key=lambda each: each[1].estimate)
            values = ", ".join(f"{name} = {value:.5g}" for name, value in best.values.items())
            return (
                f"the best {among}, {values}, is captured within the limits in {check.met} of "
                f"{check.computed} new draws; {required} are required"
            )
        if best.share is not None:
            return (
                f"{among}, none is captured within the limits in {required} of the draws; the "
                f"nearest, {values}, is in {best.share:.1%}"
            )
        if best.verdict != CAPTURED:
            return f"{among}, none captures; the nearest, {values}, ends {best.verdict}"
        excess = ", ".join(
            f"{limit.meaning} {limit.shown(best.loads[limit.key])} {limit.load.shown_in} (limit "
            f"{limit.shown(limit.value)})"
            for limit in self._requirements.limits
            if limit.use(best.loads[limit.key]) > 1.0
        )
        if not excess:
            least = self._requirements.least_range
            excess = f"a capture range of {best.captured_share:.1%} ({least:.1%} required)"
        return f"{among}, none captures within the limits; the nearest, {values}, has {excess}"


def _growth(before: np.ndarray, now: np.ndarray) -> float:
    """Return the relative growth of a front; infinite where there is none."""
    if not len(before):
        return math.inf
    if now.shape[1] == 1:
        return float(before.min() - now.min())  # of logarithms
    ideal, nadir = now.min(axis=0), now.max(axis=0)
    nadir = nadir + 0.1 * (nadir - ideal)
    return 1.0 - hypervolume(before, ideal, nadir) / max(hypervolume(now, ideal, nadir), 1e-300)


def undecided(candidates: Sequence[Candidate], objectives: Sequence[Measure]) -> str:
    """Return which objective the buffer does not decide among candidates; empty if it does all.

    ``candidates`` are spread over the ranges.  The text names the loads that the buffer decides.
    """
    feasible = [each for each in candidates if each.feasible]
    if len(feasible) < 2 * _FEWEST:
        return ""
    by_key = {key: np.array([each.loads[key] for each in feasible]) for key in feasible[0].loads}
    fewest = max(_FEWEST, _MANY * len(feasible))
    for objective in objectives:
        same = _best_of(by_key[objective.key], objective.sign)
        if len(same) < fewest:
            continue
        decided = [
            f"{key} {Measure(key).shown(values.min())} to {Measure(key).shown(values.max())} "
            f"{Measure(key).load.shown_in}"
            for key, values in by_key.items()
            if not key.endswith("_before_latch") and len(_best_of(values, 1.0)) < fewest
        ]
        return (
            f"{objective.meaning} is not decided by the buffer: {len(same)} of {len(feasible)} "
            f"feasible buffers have {objective.shown(same.min())} to {objective.shown(same.max())} "
            f"{objective.load.shown_in}; loads that it decides: {', '.join(decided) or 'none'}"
        )
    return ""


def _best_of(values: np.ndarray, sign: float) -> np.ndarray:
    """Return the values within 1 % of the least, or of the greatest if the sign is negative."""
    best = np.min(sign * values)
    return values[sign * values <= best + SAME * abs(best)]
