"""The benchmark's plots: logarithmic axes with units, at most six lines, each with its name."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.page import Results
from benchmarks.programs import LEVELS, Contest, best, programs
from benchmarks.trial import Trial
from capture_sim.viewing import style
from capture_sim.viewing.canvas import save, subplots

_COLOURS = {
    "own": style.BLUE,
    "textbook": style.GREEN,
    "library": style.PURPLE,
    "python": style.VERMILION,
    "numpy": style.GREY,
}
_MARKERS = "osD^v<"
_MOST_LINES = 6  # of an axes
_FONT = 11.5  # of labels, points; numbers are smaller by 1.5


def save_all(results: Results, folder: Path) -> None:
    """Draw everything into a folder."""
    figures = {
        "work_precision": _work_precision(results),
        "costs": _costs(results),
    }
    for name, figure in figures.items():
        save(figure, folder / f"{name}.svg")


def _chosen(contest: Contest) -> list[list[Trial]]:
    """Return the programs to draw: all of ours, and the others that are the fastest."""
    by_program = list(programs(contest.trials).values())
    own = [tried for tried in by_program if tried[0].group == "own"]

    def least(tried: list[Trial]) -> float:
        found = best(tried, LEVELS[0])
        return math.inf if found is None else found.least

    others = sorted((tried for tried in by_program if tried not in own), key=least)
    return [*own, *others][:_MOST_LINES]


def _draw(axes: Axes, contest: Contest, error: Callable[[Trial], float]) -> None:
    """Draw CPU time against an error; hollow marks have other touches than the reference."""
    axes.set(xscale="log", yscale="log")
    axes.margins(0.15, 0.12)
    for tried, marker in zip(_chosen(contest), _MARKERS, strict=False):
        shown = [(t, t.least, error(t)) for t in tried if t.seconds and error(t) > 0.0]
        if not shown:
            continue
        trials, x, y = zip(*shown, strict=True)
        own, colour = tried[0].group == "own", _COLOURS[tried[0].group]
        axes.plot(x, y, color=colour, linewidth=1.8 if own else 1.2)
        for trial, at, value in zip(trials, x, y, strict=True):
            counts = not math.isnan(trial.errors.event_time)
            face = colour if counts else "white"
            axes.plot(at, value, marker, color=colour, markerfacecolor=face, markersize=4.5)
        # of ours the names are at the exact end, of others at the loose one
        at = (min if own else max)(zip(x, y, strict=True), key=lambda point: point[1])
        axes.annotate(
            tried[0].family,
            at,
            xytext=(0, -6 if own else 7),
            textcoords="offset points",
            ha="left" if own else "center",
            va="top" if own else "bottom",
            color=colour,
            fontsize=_FONT - 2.0,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )


def _work_precision(results: Results) -> Figure:
    count = len(results.contests)
    figure, rows = subplots(13.0, 5.2 * count, count, 2, font=_FONT)
    errors: list[tuple[str, Callable[[Trial], float]]] = [
        ("position error, m or rad", lambda t: t.errors.position),
        ("error of event times, s", lambda t: t.errors.event_time),
    ]
    for row, contest in zip(rows, results.contests, strict=True):
        for axes, (name, error) in zip(row, errors, strict=True):
            _draw(axes, contest, error)
            axes.set_xlabel("CPU time, s")
            axes.set_ylabel(name)
            axes.set_title(f"{results.scene} to {contest.plan.t_end:g} s")
    return figure


def _costs(results: Results) -> Figure:
    figure, [[left, right]] = subplots(12.0, 4.5, 1, 2, font=_FONT)
    marks = {"color": _COLOURS["own"], "marker": "o", "markersize": 4, "capsize": 3}

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
