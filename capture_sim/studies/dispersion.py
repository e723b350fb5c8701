"""What the table of a sweep says: probability of capture, percentiles, worst runs, what matters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from capture_sim.studies.outcome import CAPTURED
from capture_sim.studies.sampling import EDGES, problem_of
from capture_sim.studies.sweep import FAILED

if TYPE_CHECKING:
    import pandas

#: Loads that are shown first, in pictures and printed tables.
MAIN_LOADS = ("max_normal_force", "max_axial_stroke_in", "max_torsion", "nearest_distance")
QUANTILES = (0.01, 0.05, 0.5, 0.95, 0.99)
_CONFIDENCE = 0.95


class Probability(NamedTuple):
    """Share of captures among the runs that were computed, with its exact 95 % interval."""

    captured: int
    computed: int
    failed: int  # could not be computed, in none of the other numbers
    estimate: float
    low: float
    high: float


def capture_probability(table: pandas.DataFrame) -> Probability:
    """Return the probability of capture with its Clopper-Pearson interval; NaN without runs."""
    from scipy.stats import binomtest

    plain = plain_rows(table)
    failed = int((plain["verdict"] == FAILED).sum())
    captured, computed = int((plain["verdict"] == CAPTURED).sum()), len(plain) - failed
    if computed == 0:
        return Probability(0, 0, failed, math.nan, math.nan, math.nan)
    interval = binomtest(captured, computed).proportion_ci(_CONFIDENCE, method="exact")
    return Probability(
        captured, computed, failed, captured / computed, float(interval.low), float(interval.high)
    )


def plain_rows(table: pandas.DataFrame) -> pandas.DataFrame:
    """Return the rows of a table without the draws that favour the edges."""
    return table if "design" not in table else table[table["design"] != EDGES]


def computed_rows(table: pandas.DataFrame) -> pandas.DataFrame:
    """Return the rows of a table whose runs could be computed."""
    return table[table["verdict"] != FAILED]


class Quantile(NamedTuple):
    """A quantile of a sample with its 95 % interval; an end is NaN where the sample has none."""

    share: float
    value: float
    low: float
    high: float


def quantiles(values: np.ndarray, shares: Sequence[float] = QUANTILES) -> list[Quantile]:
    """Return quantiles of a sample, with intervals between order statistics.

    The intervals hold for any distribution: the number of values below a quantile is binomial.
    """
    from scipy.stats import binom

    ordered = np.sort(values[np.isfinite(values)])
    if ordered.size == 0:
        return [Quantile(share, math.nan, math.nan, math.nan) for share in shares]
    tail, found = (1.0 - _CONFIDENCE) / 2.0, []
    for share in shares:
        first = int(binom.ppf(tail, ordered.size, share)) - 1
        last = int(binom.ppf(1.0 - tail, ordered.size, share))
        found.append(
            Quantile(
                share,
                float(np.quantile(ordered, share)),
                float(ordered[first]) if first >= 0 else math.nan,
                float(ordered[last]) if last < ordered.size else math.nan,
            )
        )
    return found


def worst_runs(table: pandas.DataFrame, load: str, count: int = 10) -> pandas.DataFrame:
    """Return the runs with the largest values of a load, the largest first."""
    return computed_rows(table).nlargest(count, load)


def rank_correlations(table: pandas.DataFrame, inputs: Sequence[str]) -> pandas.DataFrame:
    """Return Spearman's rank correlation of each input that varies with each main load.

    A last column ``captured`` has that with capture, 1 or 0; NaN where a load does not vary.
    """
    plain = computed_rows(plain_rows(table))
    results = plain[[*MAIN_LOADS]].assign(captured=(plain["verdict"] == CAPTURED).astype(float))
    ranks, result_ranks = plain[list(inputs)].rank(), results.rank()
    return ranks.apply(lambda column: result_ranks.corrwith(column), axis=0).T


class Indices(NamedTuple):
    """Sobol's first and total indices of each input for a load, with 95 % intervals of each."""

    load: str
    first: np.ndarray
    first_interval: np.ndarray
    total: np.ndarray
    total_interval: np.ndarray
    used: int  # base samples whose runs could all be computed


def sobol_indices(
    table: pandas.DataFrame, inputs: Sequence[str], load: str, seed: int = 1
) -> Indices | None:
    """Return the indices of a load from runs of Saltelli's design; None where it does not vary."""
    from SALib.analyze import sobol

    values = table[load].to_numpy(float)
    blocks = values[: len(values) - len(values) % (len(inputs) + 2)].reshape(-1, len(inputs) + 2)
    whole = blocks[np.isfinite(blocks).all(axis=1)]
    if len(whole) < 2 or np.ptp(whole) == 0.0:
        return None
    found = sobol.analyze(
        problem_of(len(inputs)), whole.ravel(), calc_second_order=False, seed=seed
    )
    first, first_interval, total, total_interval = (
        np.asarray(found[name]) for name in ("S1", "S1_conf", "ST", "ST_conf")
    )
    return Indices(load, first, first_interval, total, total_interval, len(whole))


def wilks_runs(share: float, confidence: float = _CONFIDENCE, failures: int = 0) -> int:
    """Return how many runs with so many failures show a probability at a confidence (Wilks).

    59 runs without a failure show 0.95 at 95 %.
    """
    from scipy.stats import binom

    if failures == 0:
        return math.ceil(math.log1p(-confidence) / math.log(share))
    runs = failures + 1
    while binom.cdf(failures, runs, 1.0 - share) > 1.0 - confidence:
        runs += 1
    return runs
