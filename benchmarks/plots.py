"""The benchmark's plots: logarithmic axes with units, each line with its name.

``python -m benchmarks.plots docs/evidence/benchmark/trials.csv`` draws speed against error once
more, from the trials of an earlier measurement.
"""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.page import TRIALS, Results
from benchmarks.programs import OURS
from capture_sim.viewing import style
from capture_sim.viewing.canvas import save, subplots

#: By the first word of a program's name.
_COLOURS = {
    OURS: style.BLUE,
    "bare": style.GREEN,
    "CVODE": style.PURPLE,
    "SciPy": style.VERMILION,
}
_MARKERS = "osD^v"
_CHOSEN_AT = 1e-6  # m, position error at which the fastest program of a kind is chosen
_LABEL_GAP = 0.06  # of an axes' height, between two names
_FONT = 11.5  # of labels, points; numbers are smaller by 1.5


class Point(NamedTuple):
    """A setting of a program; an error is NaN if there is none."""

    program: str
    t_end: float  # s
    seconds: float  # CPU time
    position: float  # m or rad
    event_time: float  # s


def save_all(results: Results, folder: Path) -> None:
    """Draw everything into a folder that has the trials."""
    save_work_precision(folder / TRIALS, results.scene)
    save(_costs(results), folder / "costs.svg")


def save_work_precision(trials: Path, scene: str) -> Path:
    """Draw CPU time against error next to the trials, as ``page.write_trials`` writes them."""
    with trials.open(encoding="utf-8") as file:
        points = [
            Point(row["program"], float(row["t_end_s"]), *map(_number, _errors_of(row)))
            for row in csv.DictReader(file)
        ]
    return save(draw_work_precision(points, scene), trials.parent / "work_precision.svg")


def _errors_of(row: dict[str, str]) -> tuple[str, str, str]:
    return row["least_s"], row["position_error_m_or_rad"], row["event_time_error_s"]


def _number(text: str) -> float:
    return float(text) if text else math.nan


def draw_work_precision(points: Sequence[Point], scene: str) -> Figure:
    """Draw a row for each end time: CPU time against errors of the position and of event times."""
    ends = list(dict.fromkeys(point.t_end for point in points))
    figure, rows = subplots(13.0, 5.2 * len(ends), len(ends), 2, font=_FONT)
    for row, t_end in zip(rows, ends, strict=True):
        curves = chosen([point for point in points if point.t_end == t_end])
        for axes, (field, name) in zip(
            row,
            (("position", "position error, m or rad"), ("event_time", "error of event times, s")),
            strict=True,
        ):
            _draw(axes, curves, field)
            axes.set_xlabel("CPU time, s")
            axes.set_ylabel(name)
            axes.set_title(f"{scene} to {t_end:g} s")
    return figure


def chosen(points: Sequence[Point]) -> list[list[Point]]:
    """Return the programs to draw: all of ours, and of each other kind the fastest."""
    programs: dict[str, list[Point]] = {}
    for point in points:
        programs.setdefault(point.program, []).append(point)
    kinds: dict[str, list[list[Point]]] = {}
    for name, settings in programs.items():
        kinds.setdefault(name.split()[0], []).append(settings)

    def least(settings: list[Point]) -> float:
        accurate = (p.seconds for p in settings if p.position <= _CHOSEN_AT and p.event_time > 0.0)
        return min(accurate, default=math.inf)

    others = [min(several, key=least) for kind, several in kinds.items() if kind != OURS]
    return [*kinds.get(OURS, []), *others]


def _draw(axes: Axes, curves: Sequence[Sequence[Point]], error: str) -> None:
    """Draw CPU time against an error; hollow marks have other touches than the reference."""
    axes.set(xscale="log", yscale="log")
    axes.margins(0.1, 0.12)
    ends = []
    for settings, marker in zip(curves, _MARKERS, strict=False):
        shown = [(p.seconds, getattr(p, error)) for p in settings if getattr(p, error) > 0.0]
        counted = [(p.seconds, getattr(p, error)) for p in settings if p.event_time > 0.0]
        if not counted:
            continue
        name = settings[0].program
        colour, width = _COLOURS[name.split()[0]], 1.8 if name.startswith(OURS) else 1.2
        axes.plot(*zip(*shown, strict=True), marker, color=colour, mfc="white", ms=4.5)
        axes.plot(*zip(*counted, strict=True), f"{marker}-", color=colour, lw=width, ms=4.5)
        ends.append((*min(counted, key=itemgetter(1)), name, colour))
    _name_ends(axes, ends)


def _name_ends(axes: Axes, ends: Sequence[tuple[float, float, str, str]]) -> None:
    """Write each curve's name to the right of its accurate end, none over another."""
    left, right = axes.get_xlim()
    axes.set(xlim=(left, right * (right / left) ** 0.2), ylim=axes.get_ylim())  # final
    to_axes = axes.transData + axes.transAxes.inverted()
    lowest = 0.0
    for x, y, name, colour in sorted(ends, key=itemgetter(1)):
        across, up = to_axes.transform((x, y))
        lowest = max(lowest + _LABEL_GAP, up)
        axes.annotate(
            name,
            (x, y),
            (across + 0.03, lowest),
            textcoords="axes fraction",
            va="center",
            color=colour,
            fontsize=_FONT - 2.0,
            arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.6},
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )


def _costs(results: Results) -> Figure:
    figure, [[left, right]] = subplots(12.0, 4.5, 1, 2, font=_FONT)
    marks = {"color": _COLOURS[OURS], "marker": "o", "markersize": 4, "capsize": 3}

    def draw(axes: Axes, x: list[float], spreads: list[tuple[float, ...]]) -> None:
        median, low, high = ([1e3 * s for s in values] for values in zip(*spreads, strict=True))
        off = [
            [m - x for m, x in zip(median, low, strict=True)],
            [x - m for m, x in zip(median, high, strict=True)],
        ]
        axes.errorbar(x, median, yerr=off, **marks)
        axes.set_xscale("log")

    draw(left, [row.t_end for row in results.times], [tuple(row.seconds) for row in results.times])
    for row in results.times:
        at = (row.t_end, 1e3 * row.seconds.median)
        above = {"xytext": (0, 7), "textcoords": "offset points", "ha": "right", "fontsize": 8}
        left.annotate(f"{row.touches}", at, **above)
    left.set_yscale("log")
    left.margins(y=0.1)
    left.set_xlabel("simulated time, s")
    left.set_ylabel("CPU time, ms")
    left.set_title(f"{results.scene}, number of touches at each point")
    each = [tuple(x / row.runs for x in row.seconds) for row in results.batches]
    draw(right, [row.runs for row in results.batches], each)
    right.set_ylim(0.0, 1.3e3 * max(high for _, _, high in each))
    right.set_xlabel("runs in a batch")
    right.set_ylabel("CPU time per run, ms")
    right.set_title(f"runs to {results.contests[0].plan.t_end:g} s, with setting up")
    return figure


if __name__ == "__main__":
    print(save_work_precision(Path(sys.argv[1]), "paper_designed"))
