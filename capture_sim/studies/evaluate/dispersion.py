"""Statistics of a sweep: probability of capture, percentiles, worst runs, main influences."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from capture_sim.studies.evaluate.limits import ROUND_OFF, Limit
from capture_sim.studies.evaluate.outcome import CAPTURED
from capture_sim.studies.evaluate.sweep import FAILED
from capture_sim.studies.vary.sampling import EDGES, problem_of

if TYPE_CHECKING:
    import pandas

#: Loads that plots and printed tables show first.
MAIN_LOADS = ("max_normal_force", "max_axial_stroke_in", "max_torsion", "nearest_distance")
#: Label of a capture whose tip is outside the capture zone again.
CAPTURED_LEFT = f"{CAPTURED}, left"
#: Shares of the quantiles that are shown, and the confidence level of every interval.
QUANTILES = (0.01, 0.05, 0.5, 0.95, 0.99)
_CONFIDENCE = 0.95


class Probability(NamedTuple):
    """Share of the computed runs that meet a condition, with its exact 95 % interval."""

    met: int
    computed: int
    failed: int  # number of runs that could not be computed; not in the other numbers
    estimate: float
    low: float
    high: float


def probability(is_met: np.ndarray, failed: int = 0) -> Probability:
    """Return the share of runs that meet a condition, with its Clopper-Pearson interval.

    ``is_met`` (n,) is True for each computed run that meets the condition.  ``failed`` is the
    number of runs that could not be computed.  The share is NaN if there are no computed runs.
    """
    from scipy.stats import binomtest

    met, computed = int(np.count_nonzero(is_met)), int(np.size(is_met))
    if computed == 0:
        return Probability(0, 0, failed, math.nan, math.nan, math.nan)
    interval = binomtest(met, computed).proportion_ci(_CONFIDENCE, method="exact")
    return Probability(
        met, computed, failed, met / computed, float(interval.low), float(interval.high)
    )


def capture_probability(table: pandas.DataFrame) -> Probability:
    """Return the probability of capture, estimated from the independent draws of a table."""
    return _probability(table, lambda rows: rows["verdict"] == CAPTURED)


def hold_probability(table: pandas.DataFrame) -> Probability:
    """Return the probability that the tip is captured and does not leave the zone again."""
    return _probability(
        table, lambda rows: (rows["verdict"] == CAPTURED) & ~rows["left_again"].astype(bool)
    )


def limit_probability(table: pandas.DataFrame, limits: Sequence[Limit]) -> Probability:
    """Return the probability that all given limits are met."""
    return _probability(table, lambda rows: ~_exceeds(rows, limits))


def success_probability(table: pandas.DataFrame, limits: Sequence[Limit]) -> Probability:
    """Return the probability of a capture with all given limits met."""
    return _probability(table, lambda rows: (rows["verdict"] == CAPTURED) & ~_exceeds(rows, limits))


def _probability(
    table: pandas.DataFrame, condition: Callable[[pandas.DataFrame], Any]
) -> Probability:
    plain = plain_rows(table)
    computed = computed_rows(plain)
    return probability(condition(computed).to_numpy(bool), len(plain) - len(computed))


def _exceeds(rows: pandas.DataFrame, limits: Sequence[Limit]) -> pandas.Series:
    """Return True for each run that exceeds a limit.

    A load that was not measured exceeds no limit.
    """
    exceeding = rows["verdict"] != rows["verdict"]
    for limit in limits:
        exceeding |= rows[limit.key] > limit.value * (1.0 + ROUND_OFF)
    return exceeding


def margin_at(table: pandas.DataFrame, limit: Limit, share: float) -> float:
    """Return the margin 1 - q / limit, where q is the (1 - share) quantile of the load.

    The margin is negative if more than this share of the runs exceed the limit, and NaN if there
    are no runs.
    """
    values = computed_rows(plain_rows(table))[limit.key].dropna().to_numpy(float)
    return 1.0 - float(np.quantile(values, 1.0 - share)) / limit.value if values.size else math.nan


def outcome_labels(table: pandas.DataFrame) -> pandas.Series:
    """Return the verdicts of a table, with CAPTURED_LEFT where the tip left the zone again."""
    return table["verdict"].where(~table["left_again"].astype(bool), CAPTURED_LEFT)


def plain_rows(table: pandas.DataFrame) -> pandas.DataFrame:
    """Return the rows of a table without the additional draws near the edges."""
    return table if "design" not in table else table[table["design"] != EDGES]


def computed_rows(table: pandas.DataFrame) -> pandas.DataFrame:
    """Return the rows of a table whose runs could be computed."""
    return table[table["verdict"] != FAILED]


class Quantile(NamedTuple):
    """A quantile of a sample with its 95 % interval.

    An end of the interval is NaN if the sample is too small for it.
    """

    share: float
    value: float
    low: float
    high: float


def quantiles(values: np.ndarray, shares: Sequence[float] = QUANTILES) -> list[Quantile]:
    """Return quantiles of a sample, with intervals between order statistics.

    The intervals apply to any distribution: the number of values below a quantile is binomial.
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


def rank_correlations(table: pandas.DataFrame, inputs: Sequence[str]) -> pandas.DataFrame:
    """Return Spearman's rank correlation of each varied input with each main load.

    The last column ``captured`` has the correlation with capture (1 or 0).  A correlation is NaN if
    the input or the result does not vary.
    """
    plain = computed_rows(plain_rows(table))
    results = plain[[*MAIN_LOADS]].assign(captured=(plain["verdict"] == CAPTURED).astype(float))
    ranks, result_ranks = plain[list(inputs)].rank(), results.rank()
    return ranks.apply(lambda column: result_ranks.corrwith(column), axis=0).T


class Indices(NamedTuple):
    """Sobol's first-order and total indices of each input for a load, with 95 % intervals."""

    load: str
    first: np.ndarray
    first_interval: np.ndarray
    total: np.ndarray
    total_interval: np.ndarray
    used: int  # number of base samples with all runs computed


def complete_samples(table: pandas.DataFrame, inputs: Sequence[str]) -> pandas.DataFrame:
    """Return the runs of Saltelli's design that belong to completely computed base samples.

    A base sample has ``len(inputs) + 2`` rows: two independent runs and, for each input, one run
    that differs from the first in this input only.  Estimates from incomplete base samples would
    be invalid.
    """
    size = len(inputs) + 2
    whole = table[: len(table) - len(table) % size]
    computed = (whole["verdict"] != FAILED).to_numpy().reshape(-1, size).all(axis=1)
    return whole[np.repeat(computed, size)]


def sobol_indices(
    table: pandas.DataFrame, inputs: Sequence[str], load: str, seed: int = 1
) -> Indices | None:
    """Return the Sobol indices of a load from runs of Saltelli's design.

    None if the load does not vary, or if fewer than two base samples are complete.  ``inputs`` must
    be in the order of the design, which is the order of their names.
    """
    from SALib.analyze import sobol

    values = complete_samples(table, inputs)[load].to_numpy(float)
    blocks = values.reshape(-1, len(inputs) + 2)
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


def main_effects(table: pandas.DataFrame, inputs: Sequence[str]) -> pandas.DataFrame:
    """Return the effect of each input of a grid on each main load.

    The mean of a load is computed at each value of an input; the effect is the range of these
    means.  In the column ``captured``, it is the range of the share of captures.  An effect is NaN
    if no run has the load.
    """
    import pandas

    rows = computed_rows(plain_rows(table))
    results = rows[[*MAIN_LOADS]].assign(captured=(rows["verdict"] == CAPTURED).astype(float))
    means = {name: results.groupby(rows[name]).mean() for name in inputs}
    return pandas.DataFrame({name: of.max() - of.min() for name, of in means.items()}).T


def wilks_runs(share: float, confidence: float = _CONFIDENCE, failures: int = 0) -> int:
    """Return the number of runs that demonstrates a probability of success by Wilks' method.

    ``share`` is the probability, and ``failures`` the number of unsuccessful runs among them.  For
    example, 59 runs without a failure demonstrate 0.95 at 95 % confidence.
    """
    from scipy.stats import binom

    if failures == 0:
        return math.ceil(math.log1p(-confidence) / math.log(share))
    runs = failures + 1
    while binom.cdf(failures, runs, 1.0 - share) > 1.0 - confidence:
        runs += 1
    return runs
