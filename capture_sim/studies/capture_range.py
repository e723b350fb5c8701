"""Capture range: the share of an area of approach that is captured within the limits.

The area is a grid of approaches.  Along the axis with the most values, each change between
neighbours is located by bisection; the lengths between these edges are averaged over the other
axes (trapezoidal rule).  The error adds the width of the bisected intervals and two differences
from half the grid: every second value along the line (islands narrower than a cell), and every
second line.
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
from capture_sim.studies.axes import Axis, make_axis
from capture_sim.studies.executors import answers
from capture_sim.studies.limits import Limit
from capture_sim.studies.outcome import CAPTURED
from capture_sim.studies.sampling import Samples
from capture_sim.studies.sweep import Recipe, result_columns, run_rows

if TYPE_CHECKING:
    import pandas

#: Ready areas by name.  ``idss``: initial contact conditions of the International Docking System
#: Standard (interface definition document, revision E, 2016): closing rate 0.05 to 0.10 m/s,
#: lateral misalignment 0.10 m, yaw 4 degrees.
AREAS: Mapping[str, Mapping[str, str]] = {
    "idss": {
        "approach.mouth_offset": "-0.1 m:0.1 m:9",
        "approach.angle": "-4 deg:4 deg:3",
        "approach.speed": "0.05:0.10:3",
    }
}
#: Bisections of a change between neighbours on the grid.
BISECTIONS = 5

#: Runs that a worker does in one go.
_CHUNK = 20

#: Returns whether approaches are captured: of each, the case and the values of the area's axes.
Captures = Callable[[Sequence[tuple[int, tuple[float, ...]]]], Sequence[bool] | np.ndarray]


@dataclass(frozen=True)
class CaptureRange:
    """Share of an area that is captured, with its error."""

    share: float  # 0 to 1
    error: float  # of the share
    runs: int  # that located the edge, beyond those of the grid


def make_area(scene: Scene, texts: Sequence[str]) -> tuple[Axis, ...]:
    """Return the axes of an area of approach.

    ``texts`` are ``NAME=LOW:HIGH:COUNT``, or a name of :data:`AREAS`.  SceneError if a name is not
    one of the approach, a range is empty, or nothing has three values or more.
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
        axis = make_axis(scene, name, text)
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


def _is_ascending(axis: Axis) -> bool:
    return bool(np.all(np.diff(np.array(axis.values, dtype=float)) > 0.0))


def area_of_map(axes: Sequence[Axis]) -> tuple[Axis, ...]:
    """Return the axes of the area in a sweep's grid: of the approach, shown on the map's axes.

    Empty if the grid has none, or if an axis is not ascending or has fewer than three values.
    """
    if any(axis.distribution is not None for axis in axes):
        return ()
    shown = [axis.name for axis in sorted(axes, key=lambda axis: -len(set(axis.values)))[:2]]
    area = tuple(axis for axis in axes if axis.name in shown and axis.name in APPROACH)
    is_grid = all(len(axis.values) >= 3 and _is_ascending(axis) for axis in area)
    return area if is_grid else ()


def points_of(area: Sequence[Axis]) -> list[tuple[float, ...]]:
    """Return the approaches of an area's grid, the last axis fastest."""
    return list(itertools.product(*(axis.values for axis in area)))


def capture_ranges(
    area: Sequence[Axis],
    captured: np.ndarray,
    is_captured: Captures,
    bisections: int = BISECTIONS,
) -> list[CaptureRange]:
    """Return the capture range of each case.

    Parameters
    ----------
    area
        Axes, ascending.
    captured
        (cases, points): whether each approach of the grid is captured, in the order of
        :func:`points_of`.
    is_captured
        Runs further approaches.
    bisections
        Halvings of the interval between two neighbours of the grid that differ.
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
    return [
        CaptureRange(float(v), float(e), int(n))
        for v, e, n in zip(values, errors, runs, strict=True)
    ]


def ranges_of_sweep(
    scene: Scene,
    samples: Samples,
    table: pandas.DataFrame,
    limits: Sequence[Limit],
    executor: Executor,
) -> dict[tuple[Any, ...], CaptureRange]:
    """Return the capture ranges of a sweep over a grid, by the values of its other axes.

    :func:`area_of_map` defines the area.  The result is empty if the sweep has no such grid.
    """
    area = area_of_map([axis for axis in samples.axes if len(axis.values) != 1])
    if not area or len(table) < len(samples.rows):
        return {}
    cases = [axis for axis in samples.axes if axis.name not in {each.name for each in area}]
    names = [axis.name for axis in samples.axes]
    order = [names.index(axis.name) for axis in (*cases, *area)]
    is_good = table["verdict"] == CAPTURED
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
        return [row["verdict"] == CAPTURED and not row.get("exceeded") for row in found]

    ranges = capture_ranges(area, captured, is_captured)
    return dict(zip(points, ranges, strict=True))


def _point(area: Sequence[Axis], along: int, others: Sequence[int], at: float) -> tuple[float, ...]:
    """Return the values of an approach, its place on the line among them."""
    index = iter(others)
    return tuple(at if k == along else axis.values[next(index)] for k, axis in enumerate(area))


def _shares(x: np.ndarray, lines: np.ndarray, edges: np.ndarray, step: int = 1) -> np.ndarray:
    """Return the captured share of each line; with ``step`` 2, as half of the grid shows it."""
    ends = [*range(0, x.size - 1, step), x.size - 1]
    length = np.zeros(lines.shape[:-1])
    for first, last in itertools.pairwise(ends):
        at_low, at_high = lines[..., first], lines[..., last]
        # the edge between both; of several, their mean
        inside = edges[..., first:last]
        known = np.isfinite(inside)
        edge = np.where(known, inside, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
        partly = np.where(at_low, edge - x[first], x[last] - edge)
        whole = np.where(at_low, x[last] - x[first], 0.0)
        length += np.where(at_low == at_high, whole, partly)
    return length / np.ptp(x)


def _weights(x: np.ndarray) -> np.ndarray:
    """Return the weights of the trapezoidal rule for a mean."""
    if x.size == 1:
        return np.ones(1)
    gaps = np.diff(x)
    return (np.append(gaps, 0.0) + np.append(0.0, gaps)) / (2.0 * np.ptp(x))


def _mean(
    values: np.ndarray, positions: Sequence[np.ndarray], every_second: int | None = None
) -> np.ndarray:
    """Return the means of values (cases, other axes..); of one axis only every second value."""
    for k, x in reversed(list(enumerate(positions))):
        if k == every_second and x.size > 2:
            kept = [*range(0, x.size - 1, 2), x.size - 1]
            values, x = values[..., kept], x[kept]
        values = values @ _weights(x)
    return values
