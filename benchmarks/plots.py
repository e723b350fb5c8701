"""The benchmark's plots: logarithmic axes with units, at most six lines, each with its name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks import work_precision
from benchmarks.page import Results
from benchmarks.trial import Trial
from capture_sim.viewing import style
from capture_sim.viewing.canvas import save, subplots

_COLOURS = {
    "own": style.BLUE,
    "compiled": style.VERMILION,
    "numpy": style.GREY,
    "engine": style.GREEN,
}
_MARKERS = "osD^v<"
_MOST_LINES = 6  # of an axes
_SIDES = {"rk4": "right"}  # of its end where a name is written
_COMPARED_AT = 1e-6  # m or rad, error at which the fastest are chosen
_FONT = 11.5  # of labels, points; numbers are smaller by 1.5
_POSITION = "position error, m or rad"

Value = Callable[[Trial], float]


def save_all(results: Results, folder: Path) -> None:
    """Draw everything into a folder."""
    figures = {
        "work_precision": _works(results, lambda t: t.median, "wall time, s"),
        "evaluations": _works(results, _evaluations, "evaluations of the right-hand side"),
        "quantities": _quantities(results),
        "costs": _costs(results),
    }
    if any(engine.trials for engine in results.engines):
        figures["engines"] = _engines(results)
    for name, figure in figures.items():
        save(figure, folder / f"{name}.svg")


def _evaluations(trial: Trial) -> float:
    return float(trial.outcome.evaluations) if trial.outcome is not None else math.nan


def _curves(trials: Sequence[Trial]) -> Iterator[list[Trial]]:
    """Yield one curve of each family: of SciPy's tolerances the form that does better."""
    forms: dict[str, list[list[Trial]]] = {}
    for curve in work_precision.families(trials):
        forms.setdefault(curve[0].family, []).append(curve)
    for curves in forms.values():
        # where all of them get to
        level = max(1e-8, *(min(t.errors.position for t in curve) for curve in curves))
        yield min(curves, key=lambda curve, e=level: work_precision.time_at(curve, e))


def _chosen(trials: Sequence[Trial]) -> list[list[Trial]]:
    """Return the curves to draw: all of ours, and the fastest of each other right-hand side."""
    curves = list(_curves(trials))
    drawn = [curve for curve in curves if curve[0].group == "own"]
    for group in dict.fromkeys(curve[0].group for curve in curves):
        rivals = [curve for curve in curves if curve[0].group == group]
        if group == "engine":
            drawn += rivals
        elif group != "own":
            drawn.append(min(rivals, key=lambda curve: work_precision.time_at(curve, _COMPARED_AT)))
    if len(drawn) > _MOST_LINES:  # fixed steps are the slowest of ours
        drawn = [curve for curve in drawn if curve[0].family != "rk4"]
    return drawn[:_MOST_LINES]


def _draw(axes: Axes, curves: Sequence[Sequence[Trial]], x: Value, y: Value) -> None:
    """Draw a line for each curve in its group's colour, with its name at its most exact point."""
    axes.set(xscale="log", yscale="log")
    axes.margins(0.15, 0.12)
    for curve, marker in zip(curves, _MARKERS, strict=False):
        points = [(x(t), y(t)) for t in curve]
        points = [(a, b) for a, b in points if a > 0.0 and b > 0.0 and math.isfinite(a + b)]
        if not points:
            continue
        own, colour = curve[0].group == "own", _COLOURS[curve[0].group]
        line = {"color": colour, "marker": marker, "markersize": 4.0}
        axes.plot(*zip(*points, strict=True), linewidth=1.8 if own else 1.2, **line)
        # of ours the names are at the exact end, of others at the loose one
        axes.annotate(
            f"capture_sim {curve[0].family}" if own else curve[0].family,
            (min if own else max)(points, key=lambda point: point[1]),
            xytext=(0, -6 if own else 7),
            textcoords="offset points",
            ha=_SIDES.get(curve[0].family, "left" if own else "center"),
            va="top" if own else "bottom",
            color=colour,
            fontsize=_FONT - 2.0,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )


def _titled(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title)


def _works(results: Results, x: Value, name: str) -> Figure:
    count = len(results.works)
    figure, [panels] = subplots(6.4 * count, 5.6, 1, count, font=_FONT)
    for axes, work in zip(panels, results.works, strict=True):
        _draw(axes, _chosen(work.trials), x, lambda t: t.errors.position)
        _titled(axes, name, _POSITION, f"{results.scene} to {work.plan.t_end:g} s")
    return figure


def _quantities(results: Results) -> Figure:
    quantities: list[tuple[str, Value]] = [
        ("error of peak forces, 1", lambda t: t.errors.peak_force),
        ("error of event times, s", lambda t: t.errors.event_time),
        ("error of impulse, 1", lambda t: t.errors.impulse),
    ]
    count = len(results.works)
    figure, rows = subplots(14.0, 4.6 * count, count, 3, font=_FONT)
    for row, work in zip(rows, results.works, strict=True):
        curves = _chosen([t for t in work.trials if t.group in ("own", "compiled")])
        for axes, (name, value) in zip(row, quantities, strict=True):
            _draw(axes, curves, lambda t: t.median, value)
            _titled(axes, "wall time, s", name, f"to {work.plan.t_end:g} s")
    return figure


def _engines(results: Results) -> Figure:
    (figure, [[axes]]), work = subplots(7.0, 6.5, font=_FONT), results.works[0]
    trials = [t for t in work.trials if t.group == "own"]
    trials += [t for engine in results.engines for t in engine.trials]
    _draw(axes, _chosen(trials), lambda t: t.median, lambda t: t.errors.position)
    _titled(axes, "wall time, s", _POSITION, f"{results.scene} to {work.plan.t_end:g} s")
    return figure


def _costs(results: Results) -> Figure:
    figure, [[left, right]] = subplots(12.0, 4.5, 1, 2, font=_FONT)
    times, batches = results.times, results.batches

    def draw(axes: Axes, x: Iterable[float], spreads: Iterable[Sequence[float]]) -> None:
        median, low, high = ([1e3 * s for s in values] for values in zip(*spreads, strict=True))
        off = [
            [m - x for m, x in zip(median, low, strict=True)],
            [x - m for m, x in zip(median, high, strict=True)],
        ]
        marks = {"color": _COLOURS["own"], "marker": "o", "markersize": 4, "capsize": 3}
        axes.errorbar(list(x), median, yerr=off, **marks)
        axes.set_xscale("log")

    draw(left, (row.t_end for row in times), (row.seconds for row in times))
    for row in times:
        at = (row.t_end, 1e3 * row.seconds.median)
        above = {"xytext": (0, 7), "textcoords": "offset points", "ha": "right", "fontsize": 8}
        left.annotate(f"{row.touches}", at, **above)
    left.set_yscale("log")
    left.margins(y=0.1)
    title = f"{results.scene}, number of touches at each point"
    _titled(left, "simulated time, s", "wall time, ms", title)
    each = [[x / row.runs for x in row.seconds] for row in batches]
    draw(right, (row.runs for row in batches), each)
    # what differs little is to look so
    right.set_ylim(0.0, 1.3e3 * max(high for _, _, high in each))
    title = f"runs to {results.works[0].plan.t_end:g} s, with setting up"
    _titled(right, "runs in a batch", "wall time per run, ms", title)
    return figure
