"""What a limit costs: what one per cent more of it would bring in the objectives.

Some buffers next to the chosen one are run.  Straight lines are fitted to their loads, relative to
the loads of the chosen buffer, and a linear programme minimises each objective with the others
held, with and without the wider limit.  Loads are peaks over touches, so they have corners and
jumps: the uncertainty is the standard deviation over resampled runs (bootstrap), which contains the
scatter of the runs around the lines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.studies.limits import Limit, Measure

#: Use of a limit from which on it is active.
ACTIVE = 0.98
#: By how much a limit is widened, relative.
STEP = 0.01
#: The buffers lie within this share of each range to either side.
_HALF_WIDTH = 0.005
#: Buffers for each free value and one more; samples of the bootstrap.
_RUNS_PER_VALUE, _RESAMPLED = 12, 40


class Change(NamedTuple):
    """Relative change of an objective, with its standard deviation."""

    value: float
    deviation: float


@dataclass(frozen=True)
class LimitCost:
    """What a wider limit brings; a negative change of a load is a gain."""

    limit: Limit
    use: float  # share of the limit
    changes: tuple[Change, ...]  # of each objective, the others held


def limit_costs(
    chosen: Mapping[str, float],
    shares: Sequence[float],
    limits: Sequence[Limit],
    objectives: Sequence[Measure],
    evaluate: Callable[[np.ndarray], Sequence[Mapping[str, float]]],
    seed: int = 1,
) -> tuple[LimitCost, ...]:
    """Return what each active limit costs; empty if none is active.

    Parameters
    ----------
    chosen
        Loads of the chosen buffer, SI.
    shares
        Its free values, as shares of the ranges.
    limits, objectives
        Of the design.
    evaluate
        Returns the loads of buffers by their shares (n, values); NaN where the run does not
        capture.
    seed
        Of the buffers and of the bootstrap.
    """
    from scipy.stats import qmc

    active = [limit for limit in limits if limit.use(chosen[limit.key]) >= ACTIVE]
    if not active or not all(chosen[each.key] for each in objectives):
        return ()
    count = _RUNS_PER_VALUE * (len(shares) + 1)
    steps = 2.0 * qmc.LatinHypercube(len(shares), seed=seed).random(count) - 1.0
    centre = np.clip(np.array(shares), _HALF_WIDTH, 1.0 - _HALF_WIDTH)
    loads = evaluate(centre + _HALF_WIDTH * steps)
    held = [each for each in limits if chosen[each.key]]
    keys = [*(each.key for each in objectives), *(each.key for each in held)]
    signs = np.array([*(each.sign for each in objectives), *(1.0 for _ in held)])
    relative = np.array([[row[key] / chosen[key] - 1.0 for key in keys] for row in loads]) * signs
    known = np.isfinite(relative).all(axis=1)
    steps, relative = steps[known], relative[known]
    if len(steps) < 2 * (len(shares) + 1):
        return ()
    rng = np.random.default_rng(seed)
    room = np.array([1.0 / limit.use(chosen[limit.key]) - 1.0 for limit in held])
    draws = [np.arange(len(steps)), *rng.integers(len(steps), size=(_RESAMPLED, len(steps)))]
    slopes = [_slopes(steps[rows], relative[rows]) for rows in draws]
    found = []
    for limit in active:
        wider = room + STEP * np.array([each is limit for each in held])
        changes = []
        for k, objective in enumerate(objectives):
            gains = [
                _least(each, k, wider, len(objectives)) - _least(each, k, room, len(objectives))
                for each in slopes
            ]
            changes.append(Change(objective.sign * gains[0], float(np.nanstd(gains[1:]))))
        found.append(LimitCost(limit, limit.use(chosen[limit.key]), tuple(changes)))
    return tuple(found)


def _slopes(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the slopes (values, steps) of the lines through some runs."""
    with_offset = np.hstack([steps, np.ones((len(steps), 1))])
    fitted, *_ = np.linalg.lstsq(with_offset, values, rcond=None)
    return np.asarray(fitted[:-1].T)


def _least(slopes: np.ndarray, objective: int, room: np.ndarray, n_objectives: int) -> float:
    """Return the least change of an objective, the others held and the limits kept."""
    from scipy.optimize import linprog

    others = [k for k in range(n_objectives) if k != objective]
    most = np.append(np.zeros(len(others)), np.maximum(room, 0.0))
    below = np.vstack([slopes[others], slopes[n_objectives:]])
    bounds = [(-1.0, 1.0)] * slopes.shape[1]
    return float(linprog(slopes[objective], A_ub=below, b_ub=most, bounds=bounds).fun)
