"""Costs of limits: changes of the objectives if a limit is increased by 1 and by 5 per cent.

Each objective is minimised again with the wider limit, while the other objectives may not exceed
the row's values.  The starts are the row and the candidates of the search.  The optimisation is
also repeated with the unchanged limit, so that incomplete convergence of the search does not count
as a change.  Gradients from runs near the optimum would be misleading, because loads have kinks and
jumps there.

The error of a change is the larger value of two optimisations, with and without the wider limit.
The error of an optimisation is the gain of its last restart or its difference to a second seed,
whichever is larger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.studies.evaluate.limits import Limit
from capture_sim.studies.search.evaluator import Candidate, Requirements
from capture_sim.studies.search.refinement import (
    CandidatePoints,
    Evaluate,
    Goal,
    refine,
    refine_from,
)
from capture_sim.studies.vary.inputs import Input

#: Least use (share of the limit) of an active limit.
ACTIVE = 0.98
#: Relative increases of a limit.
STEPS = (0.01, 0.05)
#: Sizes of the first simplex and of the simplex of a restart, in shares of the ranges; minimum and
#: maximum number of candidates of an optimisation; maximum number of points from which it starts.
_SIZE, _SIZE_OF_RESTART, _MIN_CANDIDATES, _MAX_CANDIDATES, _MAX_STARTS = 0.02, 0.003, 40, 200, 2000
#: Least use of a limit for which a wider limit must improve the objective.
_BINDING = 0.999
#: Least error of a change, due to the tolerance of the runs.
_MIN_ERROR = 1e-6


class CostChange(NamedTuple):
    """Relative change of an objective, and its error; NaN if it could not be determined."""

    value: float
    error: float


@dataclass(frozen=True)
class LimitCost:
    """Changes of the objectives with a wider limit; a negative change of a load is a gain."""

    limit: Limit
    use: float  # load of the row as a share of the limit
    changes: tuple[tuple[CostChange, ...], ...]  # by step and objective


#: Function that returns the evaluation of candidates for some requirements.
EvaluatorOf = Callable[[Requirements], Evaluate]


class _Optimum(NamedTuple):
    value: float  # of the cost
    error: float
    best: Candidate | None


def limit_costs(
    row: Candidate,
    known: Sequence[Mapping[str, float]],
    variables: Sequence[Input],
    requirements: Requirements,
    evaluate: EvaluatorOf,
    runs: int,
    seed: int = 1,
) -> tuple[LimitCost, ...]:
    """Return the cost of each active limit of a row; empty if no limit is active.

    Parameters
    ----------
    row
        Buffer of the row.
    known
        Values of buffers that were run before; ``evaluate`` returns them without new runs.
    variables, requirements
        Free values and requirements of the search.
    evaluate
        Function that returns the evaluation of candidates for other requirements.
    runs
        Approximate total number of candidates to try.
    seed
        Seed of the simplices of the second optimisation.
    """
    active = [x for x in requirements.limits if x.use(row.loads[x.key]) >= ACTIVE]
    if not active:
        return ()
    objectives = requirements.objectives
    count = len(objectives) * (1 + len(STEPS) * len(active))
    each = min(max(int(runs / (3.5 * count)), _MIN_CANDIDATES), _MAX_CANDIDATES)
    held = row.costs(objectives)

    def optimum(n: int, with_limits: Requirements, warm: Sequence[Candidate]) -> _Optimum:
        ceilings = [math.inf if k == n else x for k, x in enumerate(held)]
        goal = Goal(tuple(float(k == n) for k in range(len(held))), tuple(ceilings))
        begin = [dict(row.values), *(dict(x.values) for x in warm), *known]
        return _optimum(goal, begin, variables, with_limits, evaluate(with_limits), each, seed)

    base = [optimum(n, requirements, ()) for n in range(len(objectives))]
    found = []
    for limit in active:
        warm = [[x.best] if x.best is not None else [] for x in base]
        changes = []
        for step in STEPS:
            wider = requirements.with_limit(limit, 1.0 + step)
            of_step = []
            for n, objective in enumerate(objectives):
                new = optimum(n, wider, warm[n])
                warm[n] += [new.best] if new.best is not None else []
                error = max(new.error, base[n].error, _MIN_ERROR)
                difference = new.value - base[n].value
                if difference == 0.0 and limit.use(_load(base[n], limit)) > _BINDING:
                    difference = math.nan  # no gain from an active limit: the search is stuck
                if objective.sign > 0.0:
                    of_step.append(CostChange(math.expm1(difference), error))
                else:
                    of_step.append(CostChange(-difference, error))
            changes.append(tuple(of_step))
        found.append(LimitCost(limit, limit.use(row.loads[limit.key]), tuple(changes)))
    return tuple(found)


def _load(optimum: _Optimum, limit: Limit) -> float:
    return math.nan if optimum.best is None else optimum.best.loads[limit.key]


def _optimum(
    goal: Goal,
    begin: Sequence[Mapping[str, float]],
    variables: Sequence[Input],
    requirements: Requirements,
    evaluate: Evaluate,
    runs: int,
    seed: int,
) -> _Optimum:
    """Minimise a goal twice, with two seeds, and restart the first search.

    ``begin`` are values of buffers to start from, the most important ones first.
    """
    start = CandidatePoints(variables, requirements.objectives)
    start.add(evaluate(begin[:_MAX_STARTS]))
    found = []
    gain = 0.0
    for rng in (None, np.random.default_rng([seed, 5])):
        points = CandidatePoints(variables, requirements.objectives)
        points.add(start.candidates)
        refine_from(goal, points.best(goal, 1)[0], points, evaluate, runs, _SIZE, rng)
        if rng is None:
            before = float(points.goal_values(goal).min())
            near = points.best(goal, 1)[0]
            refine_from(goal, near, points, evaluate, runs // 2, _SIZE_OF_RESTART)
            gain = before - float(points.goal_values(goal).min())
        else:
            refine([goal], points, evaluate, runs, rng)  # look for other basins
        found.append((float(points.goal_values(goal).min()), points.best(goal, 1)[0]))
    values = [value for value, _ in found]
    best = found[int(np.argmin(values))][1]
    if not best.feasible:
        return _Optimum(math.nan, math.nan, None)
    return _Optimum(min(values), max(gain, abs(values[0] - values[1])), best)
