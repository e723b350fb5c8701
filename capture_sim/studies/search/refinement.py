"""Refinement of buffers: each goal is minimised from several starts, and all searches run in step.

A goal is a weighted sum of the objectives, with ceilings for some of them.  Loads are peaks over
touches.  Therefore a goal has kinks, where its minima lie, and jumps between basins.  The method of
Nelder and Mead (1965) needs neither gradients nor smoothness, and several starts find the basins.
Ten times the largest excess of a limit or ceiling is added to the goal (an exact penalty).

All goals choose their starts from the same archive of candidates, so each goal benefits from the
candidates of the other goals.  Each round evaluates what every search needs, and parallel workers
share these candidates.  Workers that are left run what the searches may need next.
"""

from __future__ import annotations

import copy
import heapq
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from capture_sim.studies.evaluate.limits import Measure
from capture_sim.studies.search.evaluator import Ahead, Candidate, KnownOf, costs_of
from capture_sim.studies.vary.inputs import Input

#: Penalty that is added to a goal for an excess of 1 (a load e times its limit).
PENALTY = 10.0
#: Maximum number of starts of a goal, and their least distance.  Size of the first simplex from a
#: start, and from the best point after these searches.  Lengths are in shares of the ranges.
_STARTS, _APART, _SIZE, _SIZE_OF_BEST = 3, 0.25, 0.08, 0.03
#: Share of the runs of a goal for the search from each start; the search from the best point has
#: the rest.
_OF_START = 0.2
#: Size of a simplex, in shares of the ranges, at which it has converged; factor on the size of the
#: new simplex that is then started around its best point.
_SMALL, _NEXT = 1e-6, 0.3
#: Shares of the outcomes in a design of tilt_p10.  Of a reflection: worse than the worst corner,
#: accepted, best, better than the worst corner alone.  Of an expansion: no better, better.  Of a
#: contraction: accepted, accepted and still the worst corner.
_OF_REFLECTION, _OF_EXPANSION = (0.55, 0.23, 0.15, 0.07), (0.66, 0.34)
_OF_CONTRACTION = (0.79, 0.18)


@dataclass(frozen=True)
class Goal:
    """Goal of a row of the front: a weighted sum of costs to minimise, and ceilings of costs."""

    weights: tuple[float, ...]  # of each objective's cost, see Measure.cost
    ceilings: tuple[float, ...]  # of each objective's cost; infinite for no ceiling

    def values(self, costs: np.ndarray, violations: np.ndarray) -> np.ndarray:
        """Return the values to minimise, (n,), from costs (n, objectives) and violations (n,)."""
        above = np.max(costs - np.array(self.ceilings), axis=1)
        excess = np.maximum(np.maximum(above, violations), 0.0)
        return np.asarray(costs @ np.array(self.weights) + PENALTY * excess)


class CandidatePoints:
    """Archive of candidates with their costs and their positions in the ranges."""

    def __init__(self, variables: Sequence[Input], objectives: Sequence[Measure]) -> None:
        self.variables, self.objectives = tuple(variables), tuple(objectives)
        self.candidates: list[Candidate] = []
        self._shares: list[list[float]] = []
        self._costs: list[list[float]] = []
        self._violations: list[float] = []

    def add(self, candidates: Sequence[Candidate]) -> None:
        """Add candidates to the archive."""
        self.candidates += candidates
        self._shares += [self.shares_of(each) for each in candidates]
        self._costs += [each.costs(self.objectives) for each in candidates]
        self._violations += [each.violation for each in candidates]

    def shares_of(self, candidate: Candidate) -> list[float]:
        """Return the positions of a candidate's values in their ranges, 0 to 1."""
        return [each.position(candidate.values[each.name]) for each in self.variables]

    def values_of(self, shares: Sequence[float]) -> dict[str, float]:
        """Return the values by name at positions in their ranges, 0 to 1."""
        return {
            each.name: each.value(share) for each, share in zip(self.variables, shares, strict=True)
        }

    @property
    def shares(self) -> np.ndarray:
        """Positions of the candidates in the ranges, (n, values), 0 to 1."""
        return np.array(self._shares).reshape(-1, len(self.variables))

    @property
    def costs(self) -> np.ndarray:
        """Costs of the candidates, (n, objectives)."""
        return np.array(self._costs).reshape(-1, len(self.objectives))

    @property
    def violations(self) -> np.ndarray:
        """By how much each candidate violates the limits, (n,); 0 if it is feasible.

        See :mod:`capture_sim.studies.search.evaluator` for the scale.
        """
        return np.array(self._violations)

    def goal_values_of(self, goal: Goal, candidates: Sequence[Candidate]) -> np.ndarray:
        """Return the value of a goal for some candidates, (n,)."""
        violations = np.array([each.violation for each in candidates])
        return goal.values(costs_of(candidates, self.objectives), violations)

    def goal_values(self, goal: Goal) -> np.ndarray:
        """Return the value of a goal for each candidate, (n,)."""
        return goal.values(self.costs, self.violations)

    def best_values(self, goals: Sequence[Goal]) -> np.ndarray:
        """Return the least value of each goal, (goals,)."""
        return np.array([self.goal_values(goal).min() for goal in goals])

    def best(self, goal: Goal, count: int, *, feasible: bool = False) -> list[Candidate]:
        """Return at most ``count`` best candidates of a goal, one for each value of the goal.

        With ``feasible``, only feasible candidates are returned.
        """
        values = self.goal_values(goal)
        order = np.argsort(values, kind="stable")
        if feasible:
            order = order[self.violations[order] <= 0.0]
        found: list[Candidate] = []
        last = math.nan
        for k in order.tolist():
            if len(found) == count:
                break
            if values[k] != last:
                found.append(self.candidates[k])
            last = values[k]
        return found


class Evaluate(Protocol):
    """Function that evaluates candidates by their values, and may look ahead.

    It returns fewer candidates than requested, or none, when the budget has ended.
    """

    def __call__(
        self, values: Sequence[Mapping[str, float]], ahead: Ahead | None = None, /
    ) -> list[Candidate]:
        """Return candidates."""


def refine(
    goals: Sequence[Goal],
    points: CandidatePoints,
    evaluate: Evaluate,
    runs: int,
    rng: np.random.Generator | None = None,
) -> bool:
    """Minimise each goal from its best points; return False if the budget ended.

    ``runs`` is the number of runs for each goal.  New candidates are added to ``points``.  ``rng``
    gives the first simplices a random orientation; with None, they are along the axes.
    """
    firsts = []
    each = max(int(_OF_START * runs), 1)
    shares = points.shares
    for goal in goals:
        for start in _starts(points, shares, goal):
            firsts.append((goal, _search(points, shares[start], _SIZE, each, rng)))
        firsts += [(goal, Single(x)) for x in _neighbours(points, shares, goal)]
    if not _in_step(firsts, points, evaluate):
        return False
    shares, rest = points.shares, max(runs - _STARTS * each, 1)
    bests = [int(np.argmin(points.goal_values(goal))) for goal in goals]
    searches = [
        (goal, _search(points, shares[best], _SIZE_OF_BEST, rest, rng))
        for goal, best in zip(goals, bests, strict=True)
    ]
    return _in_step(searches, points, evaluate)


def refine_from(
    goal: Goal,
    start: Candidate,
    points: CandidatePoints,
    evaluate: Evaluate,
    runs: int,
    size: float,
    rng: np.random.Generator | None = None,
) -> bool:
    """Minimise a goal from one candidate; return False if the budget ended.

    ``size`` is the size of the first simplex in shares of the ranges; see :func:`refine`.
    """
    search = _search(points, np.array(points.shares_of(start)), size, runs, rng)
    return _in_step([(goal, search)], points, evaluate)


class Search(Protocol):
    """A search with an ask-and-tell interface: points are (m, inputs), their values (m,)."""

    def ask(self) -> np.ndarray:
        """Return the points that it needs now; none if it has ended."""

    def tell(self, values: np.ndarray) -> None:
        """Take the values of the points."""

    def after(self, values: np.ndarray) -> Search | None:
        """Return the search as it would be with these values; None if that is not certain."""

    def ahead(self) -> list[tuple[float, Search]]:
        """Return the search after each outcome of its present points, with its probability."""


def _in_step(
    searches: Sequence[tuple[Goal, Search]], points: CandidatePoints, evaluate: Evaluate
) -> bool:
    """Advance all searches in step until each has ended; return False if the budget ended."""
    active = [(goal, search, search.ask()) for goal, search in searches]
    while active := [each for each in active if len(each[2])]:
        asked = [points.values_of(x) for _, _, wanted in active for x in wanted.tolist()]
        present = [(goal, search) for goal, search, _ in active]
        found = evaluate(asked, partial(_looked_ahead, present, points))
        points.add(found)
        if len(found) < len(asked):
            return False
        begin = 0
        for goal, search, wanted in active:
            own = found[begin : (begin := begin + len(wanted))]
            search.tell(points.goal_values_of(goal, own))
        active = [(goal, search, search.ask()) for goal, search, _ in active]
    return True


def _looked_ahead(
    searches: Sequence[tuple[Goal, Search]], points: CandidatePoints, known: KnownOf
) -> Iterator[Mapping[str, float]]:
    """Yield what the searches will ask for, then what they may ask for, the likeliest first.

    A search whose points are known goes on to the first that are not.  Free workers run them ahead;
    no result depends on that.
    """
    number = itertools.count()  # orders equal probabilities
    open_ones = []
    for goal, search in searches:
        later: Search | None = search
        while later is not None:
            reached = later
            found = known([points.values_of(x) for x in reached.ask().tolist()])
            later = None if not found else reached.after(points.goal_values_of(goal, found))
        if reached is not search:
            yield from (points.values_of(x) for x in reached.ask().tolist())
        open_ones.append((-1.0, next(number), reached))
    while open_ones:
        likely, _, search = heapq.heappop(open_ones)
        for probability, after in search.ahead():
            yield from (points.values_of(x) for x in after.ask().tolist())
            heapq.heappush(open_ones, (likely * probability, next(number), after))


def _starts(points: CandidatePoints, shares: np.ndarray, goal: Goal) -> list[int]:
    """Return the indices of the best points of a goal with a least distance between each other."""
    chosen: list[int] = []
    for k in np.argsort(points.goal_values(goal), kind="stable").tolist():
        if all(np.linalg.norm(shares[k] - shares[other]) > _APART for other in chosen):
            chosen.append(k)
        if len(chosen) == _STARTS:
            break
    return chosen


def _neighbours(points: CandidatePoints, shares: np.ndarray, goal: Goal) -> list[np.ndarray]:
    """Return the points next to the best point: one step up or down in one catalogue."""
    best = shares[int(np.argmin(points.goal_values(goal)))]
    found = []
    for k, variable in enumerate(points.variables):
        for step in (-1.0, 1.0) if variable.values else ():
            moved = best.copy()
            moved[k] += step / len(variable.values)
            if 0.0 < moved[k] < 1.0:
                found.append(moved)
    return found


class Single:
    """Search that asks for some points once."""

    def __init__(self, x: np.ndarray) -> None:
        self._asked = np.atleast_2d(x)

    def ask(self) -> np.ndarray:
        """Return the points, or none after their values were received."""
        return self._asked

    def tell(self, values: np.ndarray) -> None:
        """End."""
        self._asked = self._asked[: -len(values)]

    def after(self, values: np.ndarray) -> Search | None:
        """Return nothing: it asks once."""
        return None

    def ahead(self) -> list[tuple[float, Search]]:
        """Return nothing."""
        return []


def _search(
    points: CandidatePoints,
    start: np.ndarray,
    size: float,
    runs: int,
    rng: np.random.Generator | None,
) -> Search:
    """Return a search from a start over the values that have a range.

    Values from a catalogue keep the item of the start.
    """
    free = [k for k, each in enumerate(points.variables) if not each.values]
    return NelderMead(start, size, runs, rng, free) if free else Single(start)


class NelderMead:
    """The method of Nelder and Mead (1965) in the unit cube, with an ask-and-tell interface.

    Points are clipped to the cube.  A simplex that has converged is restarted around its best
    point, with a smaller size than before.

    Parameters
    ----------
    start
        Point (values,) where the search begins.
    size, runs
        Edge of the first simplex, and number of points that it may ask for.
    rng
        Gives the simplices a random orientation; None: along the axes.
    free
        Indices of the values that change; None: all.
    """

    def __init__(
        self,
        start: np.ndarray,
        size: float,
        runs: int,
        rng: np.random.Generator | None = None,
        free: Sequence[int] | None = None,
    ) -> None:
        self._whole, self._free = start, list(range(start.size)) if free is None else free
        self._size, self._rng, self._left, self._round = size, rng, runs, 0
        self._values = np.array([])  # of the first corners of the simplex
        self._begin(np.clip(start[self._free], 0.0, 1.0))

    def _begin(self, best: np.ndarray) -> None:
        size = self._size * _NEXT**self._round
        self._simplex = _simplex(best, size, best.size, self._rng)
        self._want(NelderMead._corners, self._simplex[len(self._values) :])

    def _want(self, take: Callable[[NelderMead, np.ndarray], None], asked: np.ndarray) -> None:
        """Ask for points next, and let ``take`` have their values."""
        self._take, self._asked = take, np.atleast_2d(asked)

    def ask(self) -> np.ndarray:
        """Return the points that it needs now; none if it has ended."""
        asked = self._asked[: self._left]
        whole = np.tile(self._whole, (len(asked), 1))
        whole[:, self._free] = asked
        return whole

    def tell(self, values: np.ndarray) -> None:
        """Take the values of the points."""
        self._left -= len(values)
        if len(values) < len(self._asked):
            self._left = 0
        else:
            self._take(self, values)

    def ahead(self) -> list[tuple[float, Search]]:
        """Return the search after each outcome of one point, with its probability.

        There is none beyond a new simplex.
        """
        outcomes = self._outcomes() if self._left > 1 else ()
        found = [(probability, self.after(np.array([value]))) for probability, value in outcomes]
        return [(probability, later) for probability, later in found if later is not None]

    def after(self, values: np.ndarray) -> Search | None:
        """Return the search as it would be with these values; None beyond a new simplex."""
        later = copy.copy(self)
        later._rng = None  # the draws of a new simplex are those of the search itself
        later.tell(values)
        return later if later._round == self._round and later._left > 0 else None

    def _outcomes(self) -> list[tuple[float, float]]:
        """Return the probability and a value of each way in which the search may go on."""
        if self._take is NelderMead._corners:
            return []
        best, second, worst = self._values[[0, -2, -1]].tolist()
        if self._take is NelderMead._reflection:
            values = worst + 1.0, 0.5 * (best + second), best - 1.0, 0.5 * (second + worst)
            return list(zip(_OF_REFLECTION, values, strict=True))
        least = self._of_reflected
        if self._take is NelderMead._expansion:
            return list(zip(_OF_EXPANSION, (least, least - 1.0), strict=True))
        barely = math.nextafter(min(least, worst), -math.inf)
        return list(zip(_OF_CONTRACTION, (0.5 * (best + second), barely), strict=True))

    def _corners(self, values: np.ndarray) -> None:
        """Take the values of a new simplex, or of one that has shrunk."""
        self._values = np.append(self._values, values)
        self._go_on()

    def _go_on(self) -> None:
        """Ask for the reflected worst corner; begin anew if the simplex is small."""
        best = self._simplex[self._values.argmin()]
        if np.max(np.abs(self._simplex - best)) <= _SMALL:
            self._values, self._round = self._values.min(keepdims=True), self._round + 1
            self._begin(best.copy())
            return
        order = np.argsort(self._values, kind="stable")
        self._simplex, self._values = self._simplex[order], self._values[order]
        self._centre = self._simplex[:-1].mean(axis=0)
        self._reflected = np.clip(2.0 * self._centre - self._simplex[-1], 0.0, 1.0)
        self._want(NelderMead._reflection, self._reflected)

    def _reflection(self, values: np.ndarray) -> None:
        value, worst = float(values[0]), self._simplex[-1]
        self._of_reflected = value
        if value < self._values[0]:
            expanded = np.clip(3.0 * self._centre - 2.0 * worst, 0.0, 1.0)
            self._want(NelderMead._expansion, expanded)
        elif value < self._values[-2]:
            self._replace(self._reflected, value)
        else:
            towards = self._reflected if value < self._values[-1] else worst
            self._want(NelderMead._contraction, 0.5 * (self._centre + towards))

    def _expansion(self, values: np.ndarray) -> None:
        if values[0] < self._of_reflected:
            self._replace(self._asked[0], float(values[0]))
        else:
            self._replace(self._reflected, self._of_reflected)

    def _contraction(self, values: np.ndarray) -> None:
        if values[0] < min(self._of_reflected, float(self._values[-1])):
            self._replace(self._asked[0], float(values[0]))
            return
        self._simplex = np.vstack([self._simplex[:1], 0.5 * (self._simplex[0] + self._simplex[1:])])
        self._values = self._values[:1]
        self._want(NelderMead._corners, self._simplex[1:])

    def _replace(self, point: np.ndarray, value: float) -> None:
        """Replace the worst corner, in new arrays: searches that look ahead share the old ones."""
        self._simplex = np.vstack([self._simplex[:-1], point])
        self._values = np.append(self._values[:-1], value)
        self._go_on()


def _simplex(best: np.ndarray, size: float, n: int, rng: np.random.Generator | None) -> np.ndarray:
    """Return the corners of a simplex: a point, and one further point in each direction.

    ``size`` is the edge length.  Of both signs of a direction, the longer step in the cube is used.
    """
    directions = np.eye(n)
    if rng is not None:
        directions = np.linalg.qr(rng.normal(size=(n, n)))[0]
    corners = [best]
    for direction in directions:
        step = size * direction
        moved = np.clip(best + step, 0.0, 1.0)
        other = np.clip(best - step, 0.0, 1.0)
        is_further = np.linalg.norm(moved - best) >= np.linalg.norm(other - best)
        corners.append(moved if is_further else other)
    return np.array(corners)
