"""Capture range: the share of an area of approach that is captured and kept within the limits.

The area is a grid of approaches.  The lines of the grid are along the axis with the most values.
Bisection locates each edge of the captured range between two neighbours on a line.  The captured
lengths of the lines are averaged over the other axes (trapezoidal rule).  The error is the sum of
three parts: the width of the bisected intervals, the change if only every second value along a line
is used (for islands narrower than a cell), and the change if only every second line is used.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.scene.approach import APPROACH, approach_of
from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.executors import answers
from capture_sim.studies.evaluate.limits import Limit
from capture_sim.studies.evaluate.outcome import CAPTURED
from capture_sim.studies.evaluate.sweep import Recipe, result_columns, run_rows
from capture_sim.studies.vary.inputs import Input, read_input
from capture_sim.studies.vary.sampling import Samples

if TYPE_CHECKING:
    import pandas

#: Predefined areas by name.  ``idss``: initial contact conditions of the International Docking
#: System Standard (interface definition document, revision E, 2016): closing rate 0.05 to 0.10 m/s,
#: lateral misalignment 0.10 m, yaw 4 degrees.
AREAS: Mapping[str, Mapping[str, str]] = {
    "idss": {
        "approach.mouth_offset": "-0.1 m:0.1 m:9",
        "approach.angle": "-4 deg:4 deg:3",
        "approach.speed": "0.05:0.10:3",
    }
}
#: Number of bisections of the interval between two neighbours on the grid with different results.
BISECTIONS = 5

#: Number of runs in one task of a worker.
_CHUNK = 20

#: Function that returns True for each approach that is captured.  Its argument has, for each
#: approach, the index of the case and the values of the area's axes.
Captures = Callable[[Sequence[tuple[int, tuple[float, ...]]]], Sequence[bool] | np.ndarray]


@dataclass(frozen=True)
class CaptureRange:
    """Share of an area that is captured, with its error."""

    share: float  # 0 to 1
    error: float  # of the share
    runs: int  # runs that located the edges, without the runs of the grid
    edges: tuple[tuple[float, ...], ...] = ()  # approaches at the located edges


def make_area(scene: Scene, texts: Sequence[str]) -> tuple[Input, ...]:
    """Return the axes of an area of approach.

    ``texts`` are ``NAME=LOW:HIGH:COUNT``, or names in :data:`AREAS`.  SceneError if a name is not a
    value of the approach, if a range is empty, or if no axis has three values or more.
    """
    given: dict[str, str] = {}
    for text in texts:
        name, sign, values = (part.strip() for part in text.partition("="))
        full_name = name if name.startswith("approach.") else f"approach.{name}"
        items = {full_name: values} if sign else AREAS.get(name)
        if items is None or set(items) & set(given):
            raise SceneError(
                f"approach {text}: must be NAME=LOW:HIGH:COUNT, each name once, or "
                f"{', '.join(AREAS)}"
            )
        given |= items
    axes = []
    for name, text in given.items():
        if name not in APPROACH:
            raise SceneError(f"{name}: must be one of {', '.join(APPROACH)}")
        axis = read_input(scene, name, text)
        if axis.distribution is not None or not _is_ascending(axis):
            raise SceneError(f"{name} = {text}: must be LOW:HIGH:COUNT with LOW < HIGH")
        axes.append(axis)
    if {"approach.offset", "approach.mouth_offset"} <= {axis.name for axis in axes}:
        raise SceneError("approach.mouth_offset: must not vary with approach.offset")
    if axes and max(len(axis.values) for axis in axes) < 3:
        raise SceneError(f"approach {', '.join(given)}: one must have 3 values or more")
    if axes:
        approach_of(scene)
    return tuple(axes)


def _is_ascending(axis: Input) -> bool:
    return bool(np.all(np.diff(np.array(axis.values, dtype=float)) > 0.0))


def area_of_map(axes: Sequence[Input]) -> tuple[Input, ...]:
    """Return the axes of the area in a sweep's grid: the axes of its map that vary the approach.

    The axes of the map are the two axes with the most different values.  Empty if the sweep has a
    distribution, if no axis varies the approach, or if such an axis is not ascending or has fewer
    than three values.
    """
    if any(axis.distribution is not None for axis in axes):
        return ()
    shown = [axis.name for axis in sorted(axes, key=lambda axis: -len(set(axis.values)))[:2]]
    area = tuple(axis for axis in axes if axis.name in shown and axis.name in APPROACH)
    is_grid = all(len(axis.values) >= 3 and _is_ascending(axis) for axis in area)
    return area if is_grid else ()


def points_of(area: Sequence[Input]) -> list[tuple[float, ...]]:
    """Return the approaches of an area's grid; the last axis varies fastest."""
    return list(itertools.product(*(axis.values for axis in area)))


def capture_ranges(
    area: Sequence[Input],
    captured: np.ndarray,
    is_captured: Captures,
    bisections: int = BISECTIONS,
) -> list[CaptureRange]:
    """Return the capture range of each case.

    Parameters
    ----------
    area
        Axes of the area with ascending values.
    captured
        Array (cases, points), True for each approach of the grid that is captured, in the order of
        :func:`points_of`.
    is_captured
        Function that runs further approaches.
    bisections
        Number of bisections between two neighbours on the grid with different results.
    """
    along = max(range(len(area)), key=lambda k: len(area[k].values))
    shape = tuple(len(axis.values) for axis in area)
    grid = np.asarray(captured, dtype=bool).reshape(len(captured), *shape)
    lines = np.moveaxis(grid, along + 1, -1)  # (cases, other axes.., along)
    x = np.array(area[along].values, dtype=float)
    changes = np.argwhere(lines[..., 1:] != lines[..., :-1])
    low, high = x[changes[:, -1]], x[changes[:, -1] + 1]
    begins = lines[tuple(changes.T)]  # captured at the lower end
    for _ in range(bisections if len(changes) else 0):
        middle = 0.5 * (low + high)
        asked = [
            (int(change[0]), _point(area, along, change[1:-1].tolist(), at))
            for change, at in zip(changes, middle.tolist(), strict=True)
        ]
        is_as_low = np.asarray(is_captured(asked), dtype=bool) == begins
        low, high = np.where(is_as_low, middle, low), np.where(is_as_low, high, middle)
    edges = np.full(lines[..., 1:].shape, np.nan)
    edges[tuple(changes.T)] = 0.5 * (low + high)
    width = np.zeros(edges.shape)
    width[tuple(changes.T)] = 0.5 * (high - low)
    others = [np.array(axis.values, float) for k, axis in enumerate(area) if k != along]
    share, error = _shares(x, lines, edges), width.sum(axis=-1) / np.ptp(x)
    error = error + np.abs(share - _shares(x, lines, edges, 2))
    runs = np.bincount(changes[:, 0], minlength=len(grid)) * bisections
    values, errors = _mean(share, others), _mean(error, others)
    for k in range(len(others)):
        errors = errors + np.abs(values - _mean(share, others, every_second=k))
    located: list[list[tuple[float, ...]]] = [[] for _ in grid]
    for change, at in zip(changes, (0.5 * (low + high)).tolist(), strict=True):
        located[change[0]].append(_point(area, along, change[1:-1].tolist(), at))
    return [
        CaptureRange(float(v), float(e), int(n), tuple(points))
        for v, e, n, points in zip(values, errors, runs, located, strict=True)
    ]


def ranges_of_sweep(
    scene: Scene,
    samples: Samples,
    table: pandas.DataFrame,
    limits: Sequence[Limit],
    executor: Executor,
) -> dict[tuple[Any, ...], CaptureRange]:
    """Return the capture ranges of a sweep over a grid, by the values of the axes not in the area.

    The area is the result of :func:`area_of_map`.  Empty if there is no area or the sweep is
    incomplete.
    """
    area = area_of_map([axis for axis in samples.axes if len(axis.values) != 1])
    if not area or len(table) < len(samples.rows):
        return {}
    cases = [axis for axis in samples.axes if axis.name not in {each.name for each in area}]
    names = [axis.name for axis in samples.axes]
    order = [names.index(axis.name) for axis in (*cases, *area)]
    is_good = (table["verdict"] == CAPTURED) & ~table["left_again"].astype(bool)
    if limits:
        is_good &= table["exceeded"] == ""
    grid = is_good.to_numpy().reshape([len(axis.values) for axis in samples.axes])
    points = list(itertools.product(*(axis.values for axis in cases)))
    captured = grid.transpose(order).reshape(len(points), -1)
    columns = result_columns(check=False, limited=bool(limits))
    recipe = Recipe(scene, tuple(axis.name for axis in (*cases, *area)))
    work = functools.partial(run_rows, recipe, False, tuple(limits))

    def is_captured(asked: Sequence[tuple[int, tuple[float, ...]]]) -> list[bool]:
        rows = [(*points[case], *point) for case, point in asked]
        chunks = [rows[start : start + _CHUNK] for start in range(0, len(rows), _CHUNK)]
        done = [row for results in answers(executor, work, chunks) for row in results]
        found = [dict(zip(columns, row, strict=True)) for row in done]
        kept = [row["verdict"] == CAPTURED and not row["left_again"] for row in found]
        return [
            is_kept and not row.get("exceeded") for is_kept, row in zip(kept, found, strict=True)
        ]

    ranges = capture_ranges(area, captured, is_captured)
    return dict(zip(points, ranges, strict=True))


def _point(
    area: Sequence[Input], along: int, others: Sequence[int], at: float
) -> tuple[float, ...]:
    """Return the values of an approach at position ``at`` on a line of the grid.

    ``along`` is the axis of the line, ``others`` are the indices of the values on the other axes.
    """
    index = iter(others)
    return tuple(at if k == along else axis.values[next(index)] for k, axis in enumerate(area))


def _shares(x: np.ndarray, lines: np.ndarray, edges: np.ndarray, step: int = 1) -> np.ndarray:
    """Return the captured share of each line, (cases, other axes..).

    With ``step`` 2, only every second value along the line is used.
    """
    ends = [*range(0, x.size - 1, step), x.size - 1]
    length = np.zeros(lines.shape[:-1])
    for first, last in itertools.pairwise(ends):
        at_low, at_high = lines[..., first], lines[..., last]
        # the edge between both ends; if there are several edges, their mean
        inside = edges[..., first:last]
        known = np.isfinite(inside)
        edge = np.where(known, inside, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
        partly = np.where(at_low, edge - x[first], x[last] - edge)
        whole = np.where(at_low, x[last] - x[first], 0.0)
        length += np.where(at_low == at_high, whole, partly)
    return length / np.ptp(x)


def _weights(x: np.ndarray) -> np.ndarray:
    """Return the weights of the trapezoidal rule for a mean over ``x``."""
    if x.size == 1:
        return np.ones(1)
    gaps = np.diff(x)
    return (np.append(gaps, 0.0) + np.append(0.0, gaps)) / (2.0 * np.ptp(x))


def _mean(
    values: np.ndarray, positions: Sequence[np.ndarray], every_second: int | None = None
) -> np.ndarray:
    """Return the means of values (cases, other axes..) over the axes, (cases,).

    ``positions`` are the values of the axes.  On the axis with the index ``every_second``, only
    every second value is used.
    """
    for k, x in reversed(list(enumerate(positions))):
        if k == every_second and x.size > 2:
            kept = [*range(0, x.size - 1, 2), x.size - 1]
            values, x = values[..., kept], x[kept]
        values = values @ _weights(x)
    return values
