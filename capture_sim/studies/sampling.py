"""Which runs a sweep makes: a full grid of values, and draws from distributions at each point."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.scene.quantities import Range, refuse
from capture_sim.studies.axes import Axis

SAMPLES = ("random", "latin", "sobol", "saltelli")
PLAIN, EDGES = "plain", "edges"
MAX_RUNS = 10_000_000
#: A quarter of the edge-weighted draws of an axis lie in the lowest 2 % of its distribution, and
#: a quarter in the highest; none lies further out than the cut.
_EDGE_SHAPE, _EDGE_CUT = 0.2, 0.005


@dataclass(frozen=True)
class Samples:
    """The runs of a sweep."""

    axes: tuple[Axis, ...]
    rows: list[tuple[Any, ...]]  # values of each run, in the order of the axes, SI units
    designs: list[str]  # of each run: plain, or edges for a draw that favours the edges


def make_samples(
    axes: Sequence[Axis], runs: int = 0, sample: str = "random", seed: int = 1, edges: int = 0
) -> Samples:
    """Return the runs over some axes: all combinations of values, the same draws at each of them.

    See :func:`capture_sim.sweep` for the parameters; a base sample of ``saltelli`` is
    (distributions + 2) draws.  Raises SceneError for a number that is out of its range.
    """
    grid, drawn = ([a for a in axes if not a.distribution], [a for a in axes if a.distribution])
    _check(grid, drawn, runs, sample, edges)
    draws_of_base = len(drawn) + 2 if sample == "saltelli" else 1
    draws_of_point = max(runs * draws_of_base + edges, 1)
    count = math.prod(len(axis.values) for axis in grid) * draws_of_point
    if count not in (allowed := Range(1, MAX_RUNS)):
        raise refuse("number of runs", count, "", allowed)
    points = list(itertools.product(*(axis.values for axis in grid)))
    draws: list[tuple[float, ...]] = [()]
    designs = [PLAIN]
    if drawn:
        plain, edge = _draw(len(drawn), runs, sample, seed), _draw_edges(len(drawn), edges, seed)
        shares = np.concatenate([plain, edge])
        columns = [axis.quantile(u).tolist() for axis, u in zip(drawn, shares.T, strict=True)]
        draws = list(zip(*columns, strict=True))
        designs = [PLAIN] * len(plain) + [EDGES] * len(edge)
    # as the user named them
    order = [axis.name for axis in (*grid, *drawn)]
    pick = [order.index(axis.name) for axis in axes]
    rows = [(*point, *draw) for point in points for draw in draws]
    return Samples(
        tuple(axes), [tuple(row[k] for k in pick) for row in rows], designs * len(points)
    )


def _check(grid: list[Axis], drawn: list[Axis], runs: int, sample: str, edges: int) -> None:
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


def _draw(axes: int, runs: int, sample: str, seed: int) -> np.ndarray:
    """Return shares (n, axes) of the distributions, from 0 to 1."""
    if sample == "random":
        return np.random.default_rng(seed).random((runs, axes))
    if sample == "saltelli":
        from SALib.sample import sobol

        shares: np.ndarray = sobol.sample(
            problem_of(axes), runs, calc_second_order=False, seed=seed
        )
        return shares
    from scipy.stats import qmc

    generator = np.random.default_rng(seed)
    engine = qmc.LatinHypercube if sample == "latin" else qmc.Sobol
    return np.asarray(engine(axes, seed=generator).random(runs))


def problem_of(axes: int) -> dict[str, Any]:
    """Return SALib's description of so many independent shares from 0 to 1."""
    return {
        "num_vars": axes,
        "names": [str(k) for k in range(axes)],
        "bounds": [[0.0, 1.0]] * axes,
    }


def _draw_edges(axes: int, count: int, seed: int) -> np.ndarray:
    # another stream than that of the plain draws
    generator = np.random.default_rng([seed, 1])
    shares = generator.beta(_EDGE_SHAPE, _EDGE_SHAPE, (count, axes))
    return np.clip(shares, _EDGE_CUT, 1.0 - _EDGE_CUT)
