"""Coverage of the ranges by NSGA-II (Deb et al. 2002, from pymoo): global search for good buffers.

The search begins with buffers that are spread over the ranges.  It finds the basins and the coarse
shape of a front.  :mod:`capture_sim.studies.search.refinement` then finds the minima.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from capture_sim.studies.evaluate.limits import Measure
from capture_sim.studies.search.evaluator import Candidate
from capture_sim.studies.search.refinement import CandidatePoints, Evaluate

#: Relative difference up to which values of an objective count as equal.
SAME = 0.01
#: An objective does not depend on the buffer if at least this share of the first feasible buffers,
#: and at least this number, have its best value, e.g. a peak that is equal for all soft buffers.
_EQUAL_SHARE, _MIN_EQUAL = 0.08, 5
#: Number of buffers of a population for each free value; share of the runs in the first population,
#: and its minimum number of buffers.
_POPULATION, _FIRST, _MIN_FIRST = 15, 0.25, 50


def cover(
    points: CandidatePoints,
    evaluate: Evaluate,
    runs: int,
    seed: int,
    begin: Sequence[Sequence[float]] = (),
) -> Iterator[list[Candidate]]:
    """Search the ranges, and yield each population after adding it to the points.

    ``runs`` is the number of buffers to run.  ``begin`` are positions in the ranges, 0 to 1, of
    buffers to include in the first population.
    """
    from pymoo.algorithms.moo.nsga2 import NSGA2
    from pymoo.core.evaluator import Evaluator as Marker
    from pymoo.core.problem import Problem
    from pymoo.core.termination import NoTermination
    from pymoo.problems.static import StaticProblem
    from scipy.stats import qmc

    n_values, objectives = len(points.variables), points.objectives
    first = qmc.LatinHypercube(n_values, seed=seed).random(
        min(max(int(_FIRST * runs), _MIN_FIRST), max(runs, 4))
    )
    for k, place in enumerate(list(begin)[: len(first)]):
        first[k] = place
    population = max(min(_POPULATION * n_values, runs // 8), 4)
    problem = Problem(n_var=n_values, n_obj=len(objectives), n_ieq_constr=1, xl=0.0, xu=1.0)
    algorithm = NSGA2(pop_size=population, sampling=first)
    algorithm.setup(problem, termination=NoTermination(), seed=seed)
    left = runs
    while left > 0:
        asked = algorithm.ask()
        places = asked.get("X").tolist()
        found = evaluate([points.values_of(x) for x in places])
        points.add(found)
        yield found
        left -= len(places)
        if len(found) < len(places):
            return
        marks = {
            "F": np.array([each.costs(objectives) for each in found]),
            "G": np.array([[each.violation] for each in found]),
        }
        Marker().eval(StaticProblem(problem, **marks), asked)
        algorithm.tell(infills=asked)


def undecided(candidates: Sequence[Candidate], objectives: Sequence[Measure]) -> str:
    """Return a message if an objective does not depend on the buffer; empty if all depend on it.

    ``candidates`` must be spread over the ranges.  The message also names the loads that depend on
    the buffer.
    """
    feasible = [each for each in candidates if each.feasible]
    if len(feasible) < 2 * _MIN_EQUAL:
        return ""
    by_key = {key: np.array([each.loads[key] for each in feasible]) for key in feasible[0].loads}
    fewest = max(_MIN_EQUAL, _EQUAL_SHARE * len(feasible))
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
    """Return the values within 1 % of the least value, or of the greatest if ``sign`` is -1."""
    best = np.min(sign * values)
    return values[sign * values <= best + SAME * abs(best)]
