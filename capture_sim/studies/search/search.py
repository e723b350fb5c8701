"""The search for the rows of a front: coverage, refinement, and a comparison with a second seed.

With dispersions, a search without draws precedes the search with draws.
:mod:`capture_sim.studies.search.design` describes the steps.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.dispersion import Probability, probability
from capture_sim.studies.evaluate.outcome import CAPTURED
from capture_sim.studies.evaluate.sweep import RTOL
from capture_sim.studies.search.coverage import cover, undecided
from capture_sim.studies.search.evaluator import (
    Ahead,
    Archive,
    Candidate,
    Evaluator,
    Requirements,
    costs_of,
)
from capture_sim.studies.search.front import knee, layers, spread_points
from capture_sim.studies.search.limit_costs import ACTIVE
from capture_sim.studies.search.refinement import CandidatePoints, Evaluate, Goal, refine
from capture_sim.studies.search.rows import (
    CONVERGED,
    ENDED,
    LONGER,
    LONGEST,
    SETTLED,
    UNREFINED,
    DesignRow,
    detailed,
    lasting,
)
from capture_sim.studies.search.variables import (
    fields_of,
    may_widen,
    own_value,
    widened,
    with_values,
)
from capture_sim.studies.vary.inputs import Input

#: Maximum and minimum number of rows of a front, and the number of candidates that a row needs.
_MAX_ROWS, _MIN_ROWS, _RUNS_OF_ROW = 7, 3, 800
#: Maximum number of candidates of the coverage, and its maximum share of the budget.  The coverage
#: with the second seed has half as many candidates.
_COVERAGE, _COVERAGE_SHARE = 800, 0.25
#: Maximum number of candidates of a pass over one of several rows (a single row has twice as many),
#: and the least number for which a second seed follows.
_PASS, _SHORT_PASS = 200, 100
#: Maximum number of passes over all rows, and of later passes from the points of both seeds.
_PASSES, _MORE_PASSES = 3, 4
#: Rows are settled after this many passes in a row without a gain.
_IDLE = 2
#: With dispersions, the share of the budget for the search without draws; the share of the budget
#: for the costs of limits.
_ALONE, RESERVE = 0.3, 0.12
#: Maximum number of rounds with dispersions; each has twice as many draws as the previous round.
_ROUNDS = 3
#: Relative amount by which the limits of the search are smaller than the given limits.
_TIGHTER = 1e-5
#: A row has converged if its last pass gains at most GAINED, and if the goal's values of both seeds
#: differ by at most AGREES.
GAINED, AGREES = 1e-3, 5e-3
#: Weight of the objectives that a row does not minimise: it selects the better of otherwise equal
#: buffers.  At an end of the front, the second weight is used.
_WEIGHT, _WEIGHT_AT_END = 1e-3, 0.02
#: Maximum number of times that a range is widened.
_WIDENINGS = 3
#: Number of rows up to which gaps of the front are filled with buffers that were run, and the least
#: gap that is: the logarithm of a load, so 10 %.
_SHOWN_ROWS, _LEAST_GAP = 12, 0.1
#: Maximum number of candidates of a row that are run at the scene's tolerance.
_CONFIRMED = 6


@dataclass(frozen=True)
class Window:
    """Range of an objective over which the rows are spaced, in SI units."""

    key: str
    low: float
    high: float


def search_scene(scene: Scene) -> Scene:
    """Return the scene with the relative tolerance of sweeps, or its own if that is larger."""
    run = dataclasses.replace(scene.run, rtol=max(scene.run.rtol, RTOL))
    return dataclasses.replace(scene, run=run)


def search_requirements(requirements: Requirements) -> Requirements:
    """Return the requirements of the search, with limits that are smaller by a share of 1e-5."""
    return requirements.tightened(_TIGHTER)


class DesignSearch:
    """The search of one design, with the history of its candidates."""

    def __init__(
        self,
        scene: Scene,
        requirements: Requirements,
        variables: tuple[Input, ...],
        window: Window | None,
        seed: int,
        executor: Executor,
        report: Callable[[Candidate], None] | None,
        archive: Archive | None,
        reserve: float = 0.0,
    ) -> None:
        self._reserve = reserve
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
                *(
                    lasting(scene, factor * scene.run.t_end),
                    requirements,
                    seed,
                    executor,
                    None,
                    archive,
                ),
                kind=f"exact, {factor:g} t_end",
            )
            for factor in (1.0, LONGER, LONGEST)
        }
        self._exact = self._longer[1.0]
        self._own = {each.name: own_value(scene, each.name) for each in variables}
        self._left = 0  # candidates that the present stage may still run
        self.points = CandidatePoints(variables, self._objectives)
        self._goals: list[Goal] = []
        self._words: list[str] = []
        self._n_lost = 0  # feasible candidates whose tip is not held until LONGEST times t_end
        #: Candidates of the last round with dispersions, each with its check in new draws.
        self.checked: list[tuple[Candidate, Probability]] = []

    @property
    def history(self) -> list[Candidate]:
        """The candidates so far, in order."""
        return self._coarse.history

    def own(self, *, with_draws: bool) -> Candidate:
        """Return the scene's own buffer as a candidate; ``with_draws`` evaluates it with draws."""
        found = self._exact.alone([self._own])
        if self._requirements.under is not None and with_draws:
            found = [each for each, _ in self._coarse.check(found, 1)]
        return found[0]

    def alone(self, budget: int) -> str:
        """Search without dispersions.

        Return the reason if an objective does not depend on the buffer; else an empty text.
        """
        is_first_of_two = self._requirements.under is not None
        self._left = int(budget * (_ALONE if is_first_of_two else 1.0 - self._reserve))
        begin = self._earlier()
        if all(each.has(self._own[each.name]) for each in self.variables):
            # with the scene's own buffer as a start, the front is no worse than this buffer
            begin = [self._own, *begin]
        return self._stage(self._coarse.alone, begin, brief=is_first_of_two)

    def with_draws(self, budget: int) -> list[DesignRow]:
        """Search with dispersions and return the front of the buffers that pass the check.

        The check uses new draws.  Empty if no buffer passes.
        """
        alone = self.points
        start = [alone.candidates[k].values for k in _promising(alone, self._requirements)]
        rest = budget - len(self.history)
        for number in range(_ROUNDS):
            draws = self._coarse.draws(self._requirements.draws * 2**number, 2 * number)
            # a round has two thirds of the remaining budget, the last round all of it
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
                    DesignRow(found, self._goals[k], convergence=self._words[k], check=check)
                    for k, (found, check) in zip(shown, self.checked, strict=True)
                    if found.feasible
                ]
                held = self._held_until_longest([row.candidate for row in rows])
                rows = [row for row in rows if row.candidate in held]
                if rows:
                    return self._front(rows)
            # no buffer passed: search again with more draws, starting from the best candidates
            order = np.argsort(self.points.violations, kind="stable")[:20].tolist()
            start = [self.points.candidates[k].values for k in order]
        return []

    def confirmed(self, *, interrupted: bool) -> list[DesignRow]:
        """Return the front of the best buffer of each goal, run at the tolerance of the scene.

        If the best candidate is infeasible at this tolerance, or its tip is not held until
        :data:`LONGEST` times t_end, the next best ones are run.
        """
        if interrupted:
            self._goals = self._make_goals(_MIN_ROWS if len(self._objectives) > 1 else 1)
            self._words = ["interrupted"] * len(self._goals)
        rows: dict[int, DesignRow] = {}
        for number in range(_CONFIRMED):
            tried = {}
            for k, goal in enumerate(self._goals):
                best = self.points.best(goal, number + 1, feasible=True)
                if k not in rows and len(best) > number:
                    tried[k] = best[number]
            if not tried:
                break
            found = self._exact.alone([each.values for each in tried.values()])
            held = self._held_until_longest(found)
            for k, exact in zip(tried, found, strict=True):
                if exact in held:
                    rows[k] = DesignRow(exact, self._goals[k], convergence=self._words[k])
        refined = [rows[k] for k in sorted(rows)]
        if refined and len(self._objectives) > 1 and self._window is None and not interrupted:
            refined += self._in_gaps(refined)
        return self._front(refined)

    def _in_gaps(self, rows: Sequence[DesignRow]) -> list[DesignRow]:
        """Return rows in the largest gaps of the front: of buffers that were run, not refined."""
        feasible = np.flatnonzero(self.points.violations <= 0.0)
        front = feasible[layers(self.points.costs[feasible])[0]]
        tried, found = self.points.costs[front], list(rows)
        while len(found) < _SHOWN_ROWS:
            shown = costs_of([row.candidate for row in found], self._objectives)
            gaps = np.abs(tried[:, None] - shown).max(axis=2).min(axis=1)
            k = int(gaps.argmax())
            if gaps[k] < _LEAST_GAP:
                break
            values = self.points.candidates[int(front[k])].values
            for exact in self._held_until_longest(self._exact.alone([values])):
                found.append(DesignRow(exact, rows[0].goal, convergence=UNREFINED))
            front, tried = np.delete(front, k), np.delete(tried, k, axis=0)
            if not len(front):
                break
        return found[len(rows) :]

    def _held_until_longest(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Return those that are feasible, and whose tip is still held at LONGEST times t_end."""
        feasible = [each for each in candidates if each.feasible]
        if not feasible or self._requirements.allow_leaving:
            return feasible
        later = self._longer[LONGEST].alone([each.values for each in feasible])
        held = [
            each
            for each, at_end in zip(feasible, later, strict=True)
            if at_end.verdict == CAPTURED and not at_end.left_again
        ]
        self._n_lost += len(feasible) - len(held)
        return held

    def _stage(
        self,
        evaluate: Evaluate,
        begin: Sequence[Mapping[str, float]],
        *,
        brief: bool = False,
    ) -> str:
        """Cover the ranges and refine the rows.

        Return the reason if an objective does not depend on the buffer; else an empty text.
        ``begin`` are values of buffers to start from.  ``brief`` omits the second seed.
        """

        def within_budget(
            values: Sequence[Mapping[str, float]], ahead: Ahead | None = None
        ) -> list[Candidate]:
            asked = values[: max(self._left, 0)]
            self._left -= len(asked)
            return evaluate(asked, ahead) if asked else []

        points = self.points = CandidatePoints(self.variables, self._objectives)
        runs = min(_COVERAGE, int(_COVERAGE_SHARE * self._left))
        places = [[each.position(x[each.name]) for each in self.variables] for x in begin]
        for number, found in enumerate(cover(points, within_budget, runs, self._seed, places)):
            # not of buffers that an earlier design has chosen for their objectives
            is_spread = number == 0 and len(begin) <= 1
            is_whole = is_spread and all(each.is_whole for each in self.variables)
            if is_whole and (reason := undecided(found, self._objectives)):
                return reason
        count = 1
        if len(self._objectives) > 1:
            count = min(max(self._left // _RUNS_OF_ROW, _MIN_ROWS), _MAX_ROWS)
        second = 0 if brief else runs // 2
        n_ends = 0 if self._window is not None else 2
        of_second, per_pass = self._planned(count, second, n_ends)
        is_whole_front = count > 1 and self._window is None
        if is_whole_front or not points.violations.size or points.violations.min() > 0.0:
            # the ends come first, because the other rows lie between them
            refine(self._ends(), points, within_budget, per_pass)
        self._goals = self._make_goals(count)
        self._words = [ENDED] * len(self._goals)
        if points.violations.min() > 0.0:
            return ""  # none is feasible
        if len(self._goals) != count:  # the rows are as many as the front has room for
            of_second, per_pass = self._planned(len(self._goals), second, 0)
        gains = self._passes(within_budget, per_pass, of_second)
        if of_second and gains is not None:
            self._compare(within_budget, per_pass, of_second, gains)
        if not brief:
            self._spend(within_budget)
        return ""

    def _planned(self, n_rows: int, second: int, n_ends: int) -> tuple[int, int]:
        """Return the candidates for a second seed, and those for each row in a pass.

        ``second`` are wanted for the second seed, which is left out if the passes would be short.
        ``n_ends`` ends of the front are refined before.
        """
        per_pass = int((self._left - second) / (n_rows * 4.2 + n_ends))
        if per_pass < _SHORT_PASS:
            second, per_pass = 0, int(self._left / (n_rows * 2.0 + 1.0))
        return second, max(min(per_pass, _PASS if n_rows > 1 else 2 * _PASS), 4)

    def _spend(self, evaluate: Evaluate) -> None:
        """Refine rows that no second seed has confirmed until the budget ends, or nothing gains."""
        n_rows, idle, number = len(self._goals), 0, _PASSES
        while self._words[0] == ENDED and self._left >= 4 * n_rows:
            before, number = self.points.best_values(self._goals), number + 1
            rng = np.random.default_rng([self._seed, number])
            refine(self._goals, self.points, evaluate, min(self._left // n_rows, _PASS), rng)
            gain = (before - self.points.best_values(self._goals)).max()
            idle = 0 if gain > GAINED else idle + 1
            if idle == _IDLE:
                self._words = [SETTLED] * n_rows

    def _passes(
        self,
        evaluate: Evaluate,
        per_pass: int,
        of_second: int,
    ) -> np.ndarray | None:
        """Refine all rows; return each row's gain in the last pass, None if the budget ended."""
        kept = of_second + 2 * len(self._goals) * per_pass if of_second else 0
        gains, values = None, self.points.best_values(self._goals)
        for number in range(_PASSES):
            if self._left - kept < 0.9 * len(self._goals) * per_pass:
                return gains
            rng = None if number % 2 == 0 else np.random.default_rng([self._seed, number])
            if not refine(self._goals, self.points, evaluate, per_pass, rng):
                return None
            now = self.points.best_values(self._goals)
            gains, values = values - now, now
            if number < _WIDENINGS and self._widen():
                continue
            if number and gains.max() <= GAINED:
                break
        return gains

    def _compare(
        self,
        evaluate: Evaluate,
        per_pass: int,
        of_second: int,
        gains: np.ndarray,
    ) -> None:
        """Search with a second seed, keep the better buffers, and record how far both agree.

        Where the searches disagree, the worse search is refined once more without the points of
        the other.  A difference that remains is due to separate basins or to a small budget.  The
        rest of the budget refines rows from the points of both searches, because both may have
        stopped at the same kink.  Rows that disagree come first, then rows that still gain, then
        all other rows.
        """
        goals, rng = self._goals, np.random.default_rng([self._seed, 99])
        other = CandidatePoints(self.variables, self._objectives)
        for _ in cover(other, evaluate, of_second, self._seed + 7919):
            pass
        if not len(other.candidates) or not refine(goals, other, evaluate, per_pass, rng):
            return
        gains = gains.copy()
        first, second = self.points.best_values(goals), other.best_values(goals)
        open_rows = self._rows_of_budget(np.abs(first - second), AGREES, per_pass)
        for points, behind in ((self.points, first > second), (other, first < second)):
            if chosen := [k for k in open_rows if behind[k]]:
                refine([goals[k] for k in chosen], points, evaluate, per_pass, rng)
        first, now = self.points.best_values(goals), other.best_values(goals)
        gains = np.where(now < first, second - now, gains)
        apart = np.abs(first - now)
        self.points.add(other.candidates)
        is_tried = np.zeros(len(goals), dtype=bool)  # refined from the points of both searches
        for _ in range(_MORE_PASSES):
            before = self.points.best_values(goals)
            doubt = np.maximum(np.where(apart > AGREES, apart, 0.0), gains)
            doubt += np.where(is_tried, 0.0, 2.0 * GAINED)
            chosen = self._rows_of_budget(doubt, GAINED, per_pass)
            if not chosen:
                break
            refine([goals[k] for k in chosen], self.points, evaluate, per_pass, rng)
            gains[chosen] = (before - self.points.best_values(goals))[chosen]
            is_tried[chosen] = True
        self._words = []
        for gain, difference in zip(gains, apart, strict=True):
            agrees = difference <= AGREES and gain <= GAINED
            words = f"within {_rounded_up(float(difference))} of a second seed"
            self._words.append(CONVERGED if agrees else words)

    def _rows_of_budget(self, doubts: np.ndarray, allowed: float, per_pass: int) -> list[int]:
        """Return the indices of the rows with the largest doubts, as many as the budget permits.

        Only doubts above ``allowed`` count.  ``per_pass`` is the number of candidates for each row.
        """
        room = int(self._left / (0.95 * per_pass))
        asked = [k for k in np.argsort(-doubts, kind="stable").tolist() if doubts[k] > allowed]
        return sorted(asked[:room])

    def _widen(self) -> bool:
        """Widen the ranges that have an optimum at an end; return True if any was widened.

        Optima with an active limit, and the ends of a front, do not count.
        """
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
                if end and may_widen(variable, end):
                    wider[k] = widened(variable, end)
        if wider == list(self.variables):
            return False
        self.variables = tuple(wider)
        points = CandidatePoints(self.variables, self._objectives)
        points.add(self.points.candidates)
        self.points = points
        return True

    def _ends(self) -> list[Goal]:
        """Return the goals of the ends of the front, one for each objective."""
        count = len(self._objectives)
        none = (math.inf,) * count
        return [
            Goal(tuple(1.0 if k == n else _WEIGHT_AT_END for k in range(count)), none)
            for n in range(count)
        ]

    def _make_goals(self, count: int) -> list[Goal]:
        """Return the goals of the rows.

        With two objectives there are ``count`` goals, in the order of the spaced objective.
        Without a feasible candidate, the goals are the ends of the front.
        """
        feasible = np.flatnonzero(self.points.violations <= 0.0)
        costs = self.points.costs[feasible]
        if len(self._objectives) == 1:
            return [Goal((1.0,), (math.inf,))]
        if not len(costs):
            return self._ends()
        front = costs[layers(costs)[0]]
        at_knee = front[knee(front)]
        if len(self._objectives) > 2 or count < 3:
            shown = front[spread_points(front, count, [knee(front)])]
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
            # equal steps of the larger gap: a front may be steep in either objective
            along = front[np.argsort(front[:, held], kind="stable")]
            gaps = np.abs(np.diff(along, axis=0)).max(axis=1, initial=0.0)
            way = np.concatenate([[0.0], np.cumsum(gaps)])
            levels = np.interp(np.linspace(0.0, way[-1], count), way, along[:, held])[1:-1]
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

    def _front(self, rows: Sequence[DesignRow]) -> list[DesignRow]:
        """Return the non-dominated rows in the order of the objectives.

        With a window, rows above the window are left out.  Empty if no row is in the window.
        """
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
        """Return the buffers of an earlier design that are in the present ranges, the best first.

        They are evaluated under the present requirements.  The feasible non-dominated buffers come
        first, then the others by their violation.
        """
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
        # in an order that does not depend on which of several workers was the first
        found.sort(key=lambda mine: tuple(mine.values()))
        points = CandidatePoints(self.variables, self._objectives)
        points.add(self._coarse.under(search_requirements(self._requirements)).alone(found))
        order = np.argsort(points.violations, kind="stable")
        feasible = np.flatnonzero(points.violations <= 0.0)
        if feasible.size:
            first = feasible[layers(points.costs[feasible])[0]]
            order = np.array([*first, *(k for k in order if k not in set(first.tolist()))])
        return [dict(points.candidates[k].values) for k in order[:_COVERAGE].tolist()]

    def detailed(self, rows: Sequence[DesignRow], own: Candidate) -> list[DesignRow]:
        """Return the rows with their details, see :func:`detailed`."""
        of_scene = self._scene, self._requirements, self.variables
        return detailed(rows, own, *of_scene, self._longer)

    def _required_text(self, count: int, *, strict: bool) -> str:
        """Return what the search (``strict``), or the check, requires of a number of draws."""
        share = self._requirements.confidence
        least = self._coarse.required(count) if strict else math.ceil(share * count)
        return (
            f"captured within the limits in {share:.0%} of the draws is required, shown if "
            f"{least} of {count} are"
        )

    def refusal(self, rows: Sequence[DesignRow]) -> str:
        """Return the reason why there is no buffer; empty if there are rows."""
        if rows:
            return ""
        searched = ", ".join(
            f"{each.name} {', '.join(f'{x:.4g}' for x in each.values)}"
            if each.values
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
        best = min(self.history, key=lambda each: each.violation)
        if with_draws:
            best = max(with_draws, key=lambda each: _number_of(each.share))
        values_text = _values_text(best)
        if self.checked:
            best, check = max(self.checked, key=lambda each: each[1].estimate)
            return (
                f"{self._required_text(check.computed, strict=False)}; the best {among}, "
                f"{_values_text(best)}, is in {_share_text(check.met, check.computed)} new draws"
            )
        if best.share is not None:
            draws = self._requirements.draws
            own = "" if best.share else f"; its run without dispersions ends {best.verdict}"
            return (
                f"{self._required_text(draws, strict=True)}; {among}, the best, {values_text}, is "
                f"in {_share_text(round(best.share * draws), draws)}{own}"
            )
        if self._n_lost:
            n_times = f"{LONGEST:g} times {self._scene.run.t_end:g} s"
            return (
                f"{among}, none is held until {n_times}: the {self._n_lost} best ones leave, or "
                "are behind BE, by then (a latch would hold the tip; --allow-leaving)"
            )
        if best.verdict != CAPTURED:
            return f"{among}, none captures; the nearest, {values_text}, ends {best.verdict}"
        if best.left_again and not self._requirements.allow_leaving:
            left = "has left again"
            if self._requirements.hold_at_be:
                left += " or is behind BE"
            return (
                f"{among}, none is still captured at {self._scene.run.t_end:g} s; the nearest, "
                f"{values_text}, {left} (a latch would hold it; --allow-leaving)"
            )
        excess = ", ".join(
            f"{limit.meaning} {limit.shown(best.loads[limit.key])} {limit.load.shown_in} (limit "
            f"{limit.shown(limit.value)})"
            for limit in self._requirements.limits
            if limit.is_exceeded(best.loads[limit.key])
        )
        least = self._requirements.least_range
        if not excess and least > 0.0:
            excess = f"a capture range of {best.captured_share:.1%} ({least:.1%} required)"
        elif not excess:
            excess = "a load at its limit: the search stays 1e-5 below"
        return f"{among}, none captures within the limits; the nearest, {values_text}, has {excess}"


def _number_of(share: float | None) -> float:
    return -1.0 if share is None else share


def _share_text(met: int, count: int) -> str:
    """Return a share of draws with its 95 % interval, e.g. ``92.5 % of 80 (84 to 97 %)``."""
    low, high = probability(np.arange(count) < met)[-2:]
    return f"{met / count:.1%} of {count} ({low:.0%} to {high:.0%})"


def _values_text(candidate: Candidate) -> str:
    return ", ".join(f"{name} = {value:.5g}" for name, value in candidate.values.items())


def _weights(minimised: int, count: int) -> tuple[float, ...]:
    return tuple(1.0 if k == minimised else _WEIGHT for k in range(count))


def _within(value: float, low: float, high: float, room: float) -> bool:
    return low - room <= value <= high + room


def _rounded_up(share: float) -> str:
    """Return a share as text in per cent, rounded up to one decimal place."""
    return f"{math.ceil(share * 1000.0) / 10.0:.1f} %"


def _promising(points: CandidatePoints, requirements: Requirements) -> list[int]:
    """Return the indices of the points from which the search with dispersions starts.

    They are points of the front, and the feasible points with the largest margins to the limits.
    """
    feasible = np.flatnonzero(points.violations <= 0.0)
    if not feasible.size:
        return []
    front = feasible[layers(points.costs[feasible])[0]].tolist()

    def largest_use(k: int) -> float:
        loads = points.candidates[k].loads
        return max((each.use(loads[each.key]) for each in requirements.limits), default=0.0)

    by_margin = sorted(feasible.tolist(), key=largest_use)
    chosen = [front[k] for k in spread_points(points.costs[front], 20)]
    return list(dict.fromkeys([*chosen, *by_margin[:20]]))
