"""Samples of a sweep: a full grid of values, and draws from distributions at each grid point.

The draws of a distribution depend on its name and the seed.  With ``random`` and ``latin``, they do
not depend on the other distributions, so that different studies have the same draws.  The
dimensions of Sobol's sequence are assigned in the order of the names.
"""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.scene.quantities import Range, refuse
from capture_sim.studies.vary.inputs import Input

SAMPLES = ("random", "latin", "sobol", "saltelli")
PLAIN, EDGES = "plain", "edges"
#: Maximum number of runs; a larger number is probably a typing error.
MAX_RUNS = 10_000_000
#: Shape of the beta distribution of the draws near the edges, and the least distance from 0 and 1.
#: A quarter of these draws lie in the lowest 2 % of the distribution, a quarter in the highest 2 %.
_EDGE_SHAPE, _EDGE_CUT = 0.2, 0.005


@dataclass(frozen=True)
class Samples:
    """The runs of a sweep."""

    axes: tuple[Input, ...]
    rows: list[tuple[Any, ...]]  # values of each run, in the order of the axes, SI units
    designs: list[str]  # of each run: plain, or edges for an additional draw near the edges
    # from the user's table: columns that are not fields, and reasons why rows cannot run, by number
    notes: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    failures: Mapping[int, str] = field(default_factory=dict)


#: Correlations by pairs of names of distributions.
Correlations = Mapping[tuple[str, str], float]


def make_samples(
    axes: Sequence[Input],
    runs: int = 0,
    sample: str = "random",
    seed: int = 1,
    edges: int = 0,
    correlations: Correlations | None = None,
) -> Samples:
    """Return the runs over some axes: all combinations of the values, each with the same draws.

    See :func:`capture_sim.sweep` for the parameters.  A base sample of ``saltelli`` has
    (number of distributions + 2) draws.  Raises SceneError if a number is out of its range.
    """
    grid, drawn = ([a for a in axes if not a.distribution], [a for a in axes if a.distribution])
    drawn.sort(key=lambda axis: axis.name)
    _check(grid, drawn, runs, sample, edges)
    names = [axis.name for axis in drawn]
    copula = _Copula.of(names, correlations or {}, sample)
    draws_of_base = len(drawn) + 2 if sample == "saltelli" else 1
    draws_of_point = max(runs * draws_of_base + edges, 1)
    count = math.prod(len(axis.values) for axis in grid) * draws_of_point
    if count not in (allowed := Range(1, MAX_RUNS)):
        raise refuse("number of runs", count, "", allowed)
    points = list(itertools.product(*(axis.values for axis in grid)))
    draws: list[tuple[float, ...]] = [()]
    designs = [PLAIN]
    if drawn:
        plain, edge = _draw(names, runs, sample, seed), _draw_edges(names, edges, seed)
        shares = copula.correlated(np.concatenate([plain, edge]))
        columns = [axis.quantile(u).tolist() for axis, u in zip(drawn, shares.T, strict=True)]
        draws = list(zip(*columns, strict=True))
        designs = [PLAIN] * len(plain) + [EDGES] * len(edge)
    # restore the order of the axes
    order = [axis.name for axis in (*grid, *drawn)]
    pick = [order.index(axis.name) for axis in axes]
    rows = [(*point, *draw) for point in points for draw in draws]
    return Samples(
        tuple(axes), [tuple(row[k] for k in pick) for row in rows], designs * len(points)
    )


@dataclass(frozen=True)
class _Copula:
    """A Gaussian copula: correlations of the normal scores of some distributions."""

    columns: list[int]  # of the correlated distributions
    factor: np.ndarray  # lower triangular, Cholesky's

    @classmethod
    def of(cls, names: Sequence[str], correlations: Correlations, sample: str) -> _Copula:
        """Return the copula; SceneError if a correlation is invalid or they contradict each other.

        ``names`` are the names of all distributions, ``sample`` is the sampling method.
        """
        if correlations and sample == "saltelli":
            raise SceneError("correlate: must be omitted with saltelli, whose inputs are apart")
        for pair, value in correlations.items():
            where = f"correlate {','.join(pair)}"
            for name in pair:
                if name not in names:
                    available = ", ".join(names) or "none"
                    raise SceneError(f"{where}: {name} is no distribution; available: {available}")
            if pair[0] == pair[1]:
                raise SceneError(f"{where}: must be two distributions")
            if value not in (allowed := Range(-1.0, 1.0, low_open=True, high_open=True)):
                raise refuse(where, value, "", allowed)
        columns = sorted({names.index(name) for pair in correlations for name in pair})
        matrix = np.eye(len(columns))
        for pair, value in correlations.items():
            first, second = (columns.index(names.index(name)) for name in pair)
            matrix[first, second] = matrix[second, first] = value
        try:
            return cls(columns, np.linalg.cholesky(matrix))
        except np.linalg.LinAlgError:
            raise SceneError(
                "correlate: must be possible together: these correlations contradict each other"
            ) from None

    def correlated(self, shares: np.ndarray) -> np.ndarray:
        """Return probabilities (n, axes) of the distributions after adding the correlations."""
        if not self.columns:
            return shares
        from scipy.special import ndtr, ndtri

        tiny = np.finfo(float).eps / 2.0  # the scores of 0 and 1 are infinite
        scores = ndtri(np.clip(shares[:, self.columns], tiny, 1.0 - tiny))
        correlated = shares.copy()
        correlated[:, self.columns] = ndtr(scores @ self.factor.T)
        return correlated


def _check(grid: list[Input], drawn: list[Input], runs: int, sample: str, edges: int) -> None:
    if sample not in SAMPLES:
        raise refuse("sample", sample, "", f"one of {', '.join(SAMPLES)}")
    if not drawn:
        if runs or edges:
            raise SceneError("runs, edges: must be 0 where no axis is a distribution")
        return
    if runs not in (allowed := Range(1, MAX_RUNS)):
        raise refuse("runs", runs, "", f"{allowed} where an axis is a distribution")
    if edges not in (allowed := Range(0, MAX_RUNS)):
        raise refuse("edges", edges, "", allowed)
    if sample in ("sobol", "saltelli") and runs & (runs - 1):
        raise refuse("runs", runs, "", f"a power of 2 with {sample}")
    if sample == "saltelli" and (grid or edges or len(drawn) < 2):
        raise SceneError("saltelli: must have two distributions or more, no values and no edges")


def _generator(seed: int, name: str, *stream: int) -> np.random.Generator:
    """Return the generator of the draws of one distribution."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), *stream])


def _draw(names: Sequence[str], runs: int, sample: str, seed: int) -> np.ndarray:
    """Return the draws as probabilities (n, axes) of the distributions, from 0 to 1."""
    if sample == "saltelli":
        from SALib.sample import sobol

        shares: np.ndarray = sobol.sample(
            problem_of(len(names)), runs, calc_second_order=False, seed=seed
        )
        return shares
    if sample == "random":
        return np.stack([_generator(seed, name).random(runs) for name in names], axis=1)
    from scipy.stats import qmc

    if sample == "sobol":
        generator = np.random.default_rng(seed)
        return np.asarray(qmc.Sobol(len(names), seed=generator).random(runs))
    columns = [qmc.LatinHypercube(1, seed=_generator(seed, name)).random(runs) for name in names]
    return np.concatenate(columns, axis=1)


def problem_of(axes: int) -> dict[str, Any]:
    """Return SALib's problem description for independent inputs from 0 to 1.

    ``axes`` is the number of inputs.
    """
    return {
        "num_vars": axes,
        "names": np.array([str(k) for k in range(axes)]),  # pandas 3 rejects a list from SALib 1.5
        "bounds": [[0.0, 1.0]] * axes,
    }


def _draw_edges(names: Sequence[str], count: int, seed: int) -> np.ndarray:
    # stream 1, which is independent of the plain draws
    columns = [_generator(seed, name, 1).beta(_EDGE_SHAPE, _EDGE_SHAPE, count) for name in names]
    return np.clip(np.stack(columns, axis=1), _EDGE_CUT, 1.0 - _EDGE_CUT)
