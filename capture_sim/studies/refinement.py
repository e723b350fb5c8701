"""Refinement of buffers: each goal is minimised from several starts, and all searches run in step.

A goal is a weighted sum of the objectives, with ceilings for some of them.  Loads are peaks over
touches.  Therefore a goal has kinks, where its minima lie, and jumps between basins.  The method of
Nelder and Mead (1965) needs neither gradients nor smoothness, and several starts find the basins.
Ten times the largest excess of a limit or ceiling is added to the goal (an exact penalty).

All goals choose their starts from the same archive of candidates, so each goal benefits from the
candidates of the other goals.  Each round evaluates one candidate of every search, and parallel
workers share these candidates.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture_sim.studies.candidates import Candidate
from capture_sim.studies.inputs import Input
from capture_sim.studies.limits import Measure

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

        See :mod:`capture_sim.studies.candidates` for the scale.
        """
        return np.array(self._violations)

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


#: Function that evaluates candidates by their values.  It returns fewer candidates than requested,
#: or none, when the budget has ended.
Evaluate = Callable[[Sequence[Mapping[str, float]]], list[Candidate]]


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
        firsts += [(goal, single(x)) for x in _neighbours(points, shares, goal)]
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


Search = Generator[np.ndarray, float, None]


def _in_step(
    searches: Sequence[tuple[Goal, Search]], points: CandidatePoints, evaluate: Evaluate
) -> bool:
    """Advance all searches in step until each has ended; return False if the budget ended."""
    active = []
    for goal, search in searches:
        with contextlib.suppress(StopIteration):
            active.append((goal, search, next(search)))
    while active:
        found = evaluate([points.values_of(x.tolist()) for _, _, x in active])
        points.add(found)
        if len(found) < len(active):
            return False
        costs = np.array([each.costs(points.objectives) for each in found])
        violations = np.array([each.violation for each in found])
        advanced = []
        for k, (goal, search, _) in enumerate(active):
            value = float(goal.values(costs[k : k + 1], violations[k : k + 1])[0])
            with contextlib.suppress(StopIteration):
                advanced.append((goal, search, search.send(value)))
        active = advanced
    return True


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


def single(x: np.ndarray) -> Search:
    """Search that requests one point only."""
    yield x


def _search(
    points: CandidatePoints,
    start: np.ndarray,
    size: float,
    runs: int,
    rng: np.random.Generator | None,
) -> Search:
    """Search from a start over the values that have a range.

    Values from a catalogue keep the item of the start.
    """
    free = [k for k, each in enumerate(points.variables) if not each.values]
    if not free:
        yield from single(start)
        return
    inner = nelder_mead(start[free], size, runs, rng)
    value = None
    while True:
        try:
            x = next(inner) if value is None else inner.send(value)
        except StopIteration:
            return
        whole = start.copy()
        whole[free] = x
        value = yield whole


def nelder_mead(
    start: np.ndarray, size: float, runs: int, rng: np.random.Generator | None = None
) -> Search:
    """Minimise a function in the unit cube by the method of Nelder and Mead, as a generator.

    The generator yields points and receives their values.  Points are clipped to the cube.  A
    simplex that has converged is restarted around its best point, with a smaller size than before.
    """
    n, left = start.size, runs
    best = np.clip(start, 0.0, 1.0)
    value_of_best = None
    for round_number in itertools.count():
        simplex = _simplex(best, size * _NEXT**round_number, n, rng)
        values = []
        for k, x in enumerate(simplex):
            if k == 0 and value_of_best is not None:
                values.append(value_of_best)
                continue
            if not left:
                return
            left -= 1
            values.append((yield x))
        f = np.array(values)
        while np.max(np.abs(simplex - simplex[f.argmin()])) > _SMALL:
            order = np.argsort(f, kind="stable")
            simplex, f = simplex[order], f[order]
            if not left:
                return
            left -= 1
            centre = simplex[:-1].mean(axis=0)
            reflected = np.clip(2.0 * centre - simplex[-1], 0.0, 1.0)
            of_reflected = yield reflected
            if of_reflected < f[0]:
                if not left:
                    return
                left -= 1
                expanded = np.clip(3.0 * centre - 2.0 * simplex[-1], 0.0, 1.0)
                of_expanded = yield expanded
                simplex[-1], f[-1] = (
                    (expanded, of_expanded)
                    if of_expanded < of_reflected
                    else (reflected, of_reflected)
                )
                continue
            if of_reflected < f[-2]:
                simplex[-1], f[-1] = reflected, of_reflected
                continue
            if not left:
                return
            left -= 1
            outside = of_reflected < f[-1]
            towards = reflected if outside else simplex[-1]
            contracted = 0.5 * (centre + towards)
            of_contracted = yield contracted
            if of_contracted < min(of_reflected, float(f[-1])):
                simplex[-1], f[-1] = contracted, of_contracted
                continue
            for k in range(1, n + 1):
                if not left:
                    return
                left -= 1
                simplex[k] = 0.5 * (simplex[0] + simplex[k])
                f[k] = yield simplex[k].copy()
        best, value_of_best = simplex[f.argmin()].copy(), float(f.min())


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
