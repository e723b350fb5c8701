"""The capture envelope: the verdict over relative angle, lateral offset and speed.

Two of the three are ranges and make a plane, the third a list and makes slices of it.  Each
plane starts as a coarse grid of cells; a cell whose points disagree about capture holds a
piece of the boundary and is cut in four, level by level.  What is run next depends on
verdicts alone, so the map is the same wherever and in whatever order its runs are done.

Last, every point of a cell that still disagrees is run once more at half the tolerance:
where the verdict hangs on that, the motion itself is ill-conditioned there (a touch more or
less decides) and no finer map would help.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from capture_sim.detection.exact import CaptureState
from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import changed
from capture_sim.scene.quantities import POSITIVE, Range, refuse
from capture_sim.studies.approach import placed
from capture_sim.studies.outcome import run_to_verdict

#: The axes, in the order of a row's columns: name, unit, and what their values may be.
AXES = (
    ("angle", "rad", Range(-math.pi / 2, math.pi / 2)),
    ("offset", "m", Range(-10.0, 10.0)),
    ("speed", "m/s", Range(1e-4, 10.0)),
)

_CELLS = Range(1, 1000)  # of a range, at the coarsest level
_LEVELS = Range(0, 10)

#: One run of the map.  ``verdict`` and ``finer_verdict`` are numbers of CaptureState.
ROW = np.dtype(
    [
        ("slice", "i4"),  # place in the slices
        ("i", "i4"),  # place in the plane's two ranges, in steps of the finest level
        ("j", "i4"),
        ("angle", "f8"),  # rad, target's heading less the chaser's
        ("offset", "f8"),  # m, of the chaser's path to the left of the target's centre of mass
        ("speed", "f8"),  # m/s, of the chaser at the first touch
        ("verdict", "i1"),
        ("t", "f8"),  # s, from the first touch (without one: the start) to the verdict
        ("touches", "i4"),
        ("peak_force", "f8"),  # N
        ("axial_stroke", "f8"),  # m
        ("torsion", "f8"),  # rad
        ("nearest", "f8"),  # m, tip's centre to the centre of BE
        ("failed", "?"),  # the integration had to stop
        ("checked", "?"),  # run again at half the tolerance
        ("finer_verdict", "i1"),  # the verdict then; the same as verdict if not checked
    ]
)

Key = tuple[int, int, int]  # slice, i, j
Evaluate = Callable[[str, Sequence[Key], float], np.ndarray]


@dataclass(frozen=True)
class Span:
    """A range that is refined: ``cells`` of them at the coarsest level."""

    low: float
    high: float
    cells: int


@dataclass(frozen=True)
class Slices:
    """Values that are taken as they are."""

    values: tuple[float, ...]


class Cell(NamedTuple):
    """A square of a plane: its slice, its level, and its place among those of that level."""

    slice: int
    level: int
    i: int
    j: int


@dataclass(frozen=True)
class Plan:
    """What to map, and how finely.

    Attributes
    ----------
    scene
        Buffer, vehicles, cone, supports, latch, detector.  Rail and string are taken off:
        each run starts ``run_up`` before the first touch, at the speed asked for there.
    angle, offset, speed
        rad, m and m/s: two of them a Span, one Slices.
    levels
        How often a cell may be cut in four.
    runs
        Most points of the map; the last level stays unfinished if they do not suffice.
    rtol
        Of the runs; a verdict is a coarse thing, see docs/envelope.md.
    run_up
        m.
    horizon
        Longest run, s.

    Raises
    ------
    SceneError
        Names what is out of its range.
    """

    scene: Scene
    angle: Span | Slices
    offset: Span | Slices
    speed: Span | Slices
    levels: int = 4
    runs: int = 10_000
    rtol: float = 1e-5
    run_up: float = 2e-3
    horizon: float = 5.0

    def __post_init__(self) -> None:
        for name, unit, allowed in AXES:
            _check_axis(name, unit, allowed, getattr(self, name))
        if sum(isinstance(axis, Slices) for axis in self._axes) != 1:
            raise SceneError(
                "angle, offset, speed: must be a list of values for one of them and "
                "LOW:HIGH:CELLS for the other two"
            )
        if self.levels not in _LEVELS:
            raise refuse("levels", self.levels, "", _LEVELS)
        if self.run_up not in POSITIVE:
            raise refuse("run_up", self.run_up, "m", POSITIVE)
        coarsest = len(self.slices) * math.prod(span.cells + 1 for _, span in self.plane)
        if self.runs not in (allowed := Range(coarsest, 10**8)):
            raise refuse("runs", self.runs, "", f"{allowed}: so many points has the coarsest grid")
        self.base  # checks rtol and horizon before anything runs  # noqa: B018

    @property
    def _axes(self) -> tuple[Span | Slices, ...]:
        return self.angle, self.offset, self.speed

    @property
    def sliced(self) -> int:
        """Which of the axes is the list: 0 angle, 1 offset, 2 speed."""
        return next(n for n, axis in enumerate(self._axes) if isinstance(axis, Slices))

    @property
    def slices(self) -> tuple[float, ...]:
        """The values of the sliced axis."""
        axis = self._axes[self.sliced]
        assert isinstance(axis, Slices)
        return axis.values

    @property
    def plane(self) -> tuple[tuple[int, Span], tuple[int, Span]]:
        """The two refined axes with their numbers, in order."""
        i, j = ((n, axis) for n, axis in enumerate(self._axes) if isinstance(axis, Span))
        return i, j

    @cached_property
    def base(self) -> Scene:
        """The scene that each run changes: no rail, no string, ends with the verdict."""
        run = replace(self.scene.run, rtol=self.rtol, t_end=self.horizon, after_latch=None)
        return replace(self.scene, run=run, rail=None, string=None)

    def values(self, key: Key) -> tuple[float, float, float]:
        """Return angle (rad), offset (m) and speed (m/s) of a point."""
        values = [0.0, 0.0, 0.0]
        values[self.sliced] = self.slices[key[0]]
        for (number, span), place in zip(self.plane, key[1:], strict=True):
            share = place / (span.cells << self.levels)
            values[number] = (1.0 - share) * span.low + share * span.high
        return values[0], values[1], values[2]

    def cells(self) -> list[Cell]:
        """Return the cells of the coarsest grid."""
        (_, across), (_, up) = self.plane
        return [
            Cell(*place)
            for place in itertools.product(
                range(len(self.slices)), (0,), range(across.cells), range(up.cells)
            )
        ]

    def points(self, cell: Cell, steps: int = 1) -> list[Key]:
        """Return the corners of a cell, or with 2 steps the nine points of its quarters."""
        size = 1 << (self.levels - cell.level)
        return [
            (cell.slice, cell.i * size + a * size // steps, cell.j * size + b * size // steps)
            for a in range(steps + 1)
            for b in range(steps + 1)
        ]


def _check_axis(name: str, unit: str, allowed: Range, axis: Span | Slices) -> None:
    values = axis.values if isinstance(axis, Slices) else (axis.low, axis.high)
    for value in values:
        if value not in allowed:
            raise refuse(name, value, unit, allowed)
    if not values or list(values) != sorted(set(values)):
        raise SceneError(f"{name} = {values!r} {unit}: must be ascending values")
    if isinstance(axis, Span) and axis.cells not in _CELLS:
        raise SceneError(f"{name}: {axis.cells!r} cells: must be {_CELLS}")


def evaluate(plan: Plan, keys: Sequence[Key], rtol: float, *, check: bool = False) -> np.ndarray:
    """Run points of a map to their verdicts, here and now.

    Parameters
    ----------
    plan, keys
        The map, and which of its points.
    rtol
        Of the runs.
    check
        Whether these are the runs at half the tolerance.

    Returns
    -------
    ndarray
        (n,) of dtype ROW, in the order of ``keys``.
    """
    rows = np.zeros(len(keys), ROW)
    rows["checked"] = check
    base = changed(plan.base, "run.rtol", rtol)
    for row, key in zip(rows, keys, strict=True):
        row["slice"], row["i"], row["j"] = key
        angle, offset, speed = plan.values(key)
        row["angle"], row["offset"], row["speed"] = angle, offset, speed
        scene = placed(base, angle, offset, speed, plan.run_up)
        if scene is None:
            row["verdict"] = row["finer_verdict"] = CaptureState.MISSED
            row["nearest"] = math.nan
            continue
        outcome = run_to_verdict(scene)
        row["verdict"] = row["finer_verdict"] = outcome.verdict
        touched = math.isfinite(outcome.first_touch)
        row["t"] = outcome.t - (outcome.first_touch if touched else 0.0)
        row["failed"] = bool(outcome.failure)
        for name, load in (
            ("touches", "touches"),
            ("peak_force", "max_normal_force_before_latch"),
            ("axial_stroke", "max_axial_stroke_in_before_latch"),
            ("torsion", "max_torsion_before_latch"),
            ("nearest", "nearest_distance"),
        ):
            row[name] = outcome.loads[load]
    return rows


@dataclass(frozen=True)
class Envelope:
    """A finished map.

    Attributes
    ----------
    plan : Plan
    rows : ndarray (n,) of dtype ROW
        Every run of the map, sorted by slice, i and j.
    cells : list of Cell
        What the planes are divided into, each as fine as it was refined.
    """

    plan: Plan
    rows: np.ndarray
    cells: list[Cell]

    @cached_property
    def places(self) -> dict[Key, int]:
        """The row of each point."""
        keys = zip(*(self.rows[name].tolist() for name in ("slice", "i", "j")), strict=True)
        return {key: number for number, key in enumerate(keys)}

    def corner_rows(self, cell: Cell) -> np.ndarray:
        """Return the rows (4,) of a cell's corners."""
        return self.rows[[self.places[key] for key in self.plan.points(cell)]]

    def is_boundary(self, cell: Cell) -> bool:
        """Whether a cell's corners disagree about capture."""
        return 0 < int((self.corner_rows(cell)["verdict"] == CaptureState.CAPTURED).sum()) < 4

    def area(self, cell: Cell) -> float:
        """Return the cell's share of its plane."""
        (_, across), (_, up) = self.plan.plane
        return 0.25**cell.level / (across.cells * up.cells)

    @cached_property
    def shares(self) -> list[dict[str, float]]:
        """For each slice: the plane's share that is captured at least, at most, and in doubt.

        ``surely`` has captured corners only, ``perhaps`` some, ``ill_conditioned`` are the
        cells of the boundary with a corner whose verdict hangs on the tolerance.
        """
        names = ("surely", "perhaps", "ill_conditioned")
        found = [dict.fromkeys(names, 0.0) for _ in self.plan.slices]
        for cell in self.cells:
            rows = self.corner_rows(cell)
            caught = int((rows["verdict"] == CaptureState.CAPTURED).sum())
            share, area = found[cell.slice], self.area(cell)
            share["surely"] += area * (caught == 4)
            share["perhaps"] += area * (caught > 0)
            flips = 0 < caught < 4 and bool(np.any(rows["verdict"] != rows["finer_verdict"]))
            share["ill_conditioned"] += area * flips
        return found


def explore(plan: Plan, run: Evaluate) -> Envelope:
    """Map an envelope.

    Parameters
    ----------
    plan
        What to map.
    run
        Called with the name of a round, its points, and a tolerance; returns their rows in
        that order.  :func:`evaluate` here, or something that spreads it over many workers.

    Returns
    -------
    Envelope
    """
    rows: dict[Key, np.void] = {}
    cells = plan.cells()
    new = list(dict.fromkeys(key for cell in cells for key in plan.points(cell)))
    for number in itertools.count():
        rows.update(zip(new, run(f"round-{number:02d}", new, plan.rtol), strict=True))
        cells, new = _refine(plan, cells, rows)
        if not new:
            break
    doubtful = [key for cell in cells if _mixed(plan, cell, rows, 1) for key in plan.points(cell)]
    doubtful = list(dict.fromkeys(doubtful))
    # a path past the cone was not run: nothing can differ there
    doubtful = [key for key in doubtful if not math.isnan(rows[key]["nearest"])]
    for key, again in zip(doubtful, run("check", doubtful, plan.rtol / 2.0), strict=True):
        rows[key] = rows[key].copy()
        rows[key]["checked"], rows[key]["finer_verdict"] = True, again["verdict"]
    table = np.array([rows[key] for key in sorted(rows)], ROW)
    return Envelope(plan, table, sorted(cells))


def replay(plan: Plan, rows: np.ndarray) -> Envelope:
    """Return the map that a plan's finished rows make, without running anything."""
    by_key = {(int(r["slice"]), int(r["i"]), int(r["j"])): r for r in rows}

    def known(name: str, keys: Sequence[Key], _: float) -> np.ndarray:
        found = np.array([by_key[key] for key in keys], ROW)
        if name == "check":
            found["verdict"] = found["finer_verdict"]
        return found

    return explore(plan, known)


def _mixed(plan: Plan, cell: Cell, rows: dict[Key, np.void], steps: int) -> bool:
    """Whether the points of a cell that have been run disagree about capture."""
    seen = {
        int(rows[key]["verdict"]) == CaptureState.CAPTURED
        for key in plan.points(cell, steps)
        if key in rows
    }
    return len(seen) == 2


def _refine(
    plan: Plan, cells: list[Cell], rows: dict[Key, np.void]
) -> tuple[list[Cell], list[Key]]:
    """Cut every cell that holds boundary in four; return all cells and the points to run.

    A cell counts its neighbours' points on its own edges as well: the boundary may leave a
    fine cell through the side of a coarse one.
    """
    kept: list[Cell] = []
    cut: list[Cell] = []
    for cell in cells:
        open_to_cut = cell.level < plan.levels and _mixed(plan, cell, rows, 2)
        (cut if open_to_cut else kept).append(cell)
    new: dict[Key, None] = {}
    for place, cell in enumerate(sorted(cut, key=_scattered)):
        more = [key for key in plan.points(cell, 2) if key not in rows and key not in new]
        if len(rows) + len(new) + len(more) > plan.runs:
            kept += sorted(cut, key=_scattered)[place:]
            break
        new.update(dict.fromkeys(more))
        kept += [
            Cell(cell.slice, cell.level + 1, 2 * cell.i + a, 2 * cell.j + b)
            for a in range(2)
            for b in range(2)
        ]
    if cut and not new and len(kept) > len(cells):
        # all points of the quarters were known already: look at them at once
        return _refine(plan, kept, rows)
    return kept, list(new)


def _scattered(cell: Cell) -> tuple[int, int]:
    """Sort coarse cells first, those of a level in a scattered order that is always the same.

    Where the runs end within a level, the cells that stay coarse are spread over the map.
    """
    number = (cell.slice * 0x9E3779B1 + cell.i * 0x85EBCA77 + cell.j * 0xC2B2AE3D) & 0xFFFFFFFF
    return cell.level, (number * 0x9E3779B1) & 0xFFFFFFFF
