"""The benchmark's pictures: logarithmic axes with units, a colour for a kind of solver, one key."""

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
_MARKERS = "osD^v<>PX*"
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


def _draw(axes: Axes, trials: Sequence[Trial], x: Value, y: Value) -> None:
    """Draw a line for each family: its group's colour, and its own marker in the group."""
    axes.set(xscale="log", yscale="log")
    families: dict[str, list[str]] = {}
    for trial in trials:
        known = families.setdefault(trial.group, [])
        if trial.family not in known:
            known.append(trial.family)
    for curve in _curves(trials):
        points = [(x(t), y(t)) for t in curve]
        points = [(a, b) for a, b in points if a > 0.0 and b > 0.0 and math.isfinite(a + b)]
        if not points:
            continue
        family, group = curve[0].family, curve[0].group
        axes.plot(
            *zip(*points, strict=True),
            color=_COLOURS[group],
            marker=_MARKERS[families[group].index(family) % len(_MARKERS)],
            markersize=3.5,
            linewidth=1.8 if group == "own" else 1.0,
            label=f"capture_sim {family}" if group == "own" else family,
        )


def _key(figure: Figure, columns: int) -> None:
    """Write below all panels what the lines are, each once."""
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    figure.legend(
        lines.values(),
        list(lines),
        loc="outside lower center",
        ncols=columns,
        fontsize=8.0,
        frameon=False,
    )


def _titled(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title)


def _works(results: Results, x: Value, name: str) -> Figure:
    count = len(results.works)
    figure, [panels] = subplots(6.2 * count, 7.0, 1, count, font=_FONT)
    for axes, work in zip(panels, results.works, strict=True):
        _draw(axes, work.trials, x, lambda t: t.errors.position)
        _titled(axes, name, _POSITION, f"{results.scene} to {work.plan.t_end:g} s")
    _key(figure, 2 * count)
    return figure


def _quantities(results: Results) -> Figure:
    quantities: list[tuple[str, Value]] = [
        ("error of peak forces, 1", lambda t: t.errors.peak_force),
        ("error of event times, s", lambda t: t.errors.event_time),
        ("error of impulse, 1", lambda t: t.errors.impulse),
    ]
    count = len(results.works)
    figure, rows = subplots(13.0, 4.6 * count, count, 3, font=_FONT)
    for row, work in zip(rows, results.works, strict=True):
        trials = [t for t in work.trials if t.group in ("own", "compiled")]
        for axes, (name, value) in zip(row, quantities, strict=True):
            _draw(axes, trials, lambda t: t.median, value)
            _titled(axes, "wall time, s", name, f"to {work.plan.t_end:g} s")
    _key(figure, 5)
    return figure


def _engines(results: Results) -> Figure:
    (figure, [[axes]]), work = subplots(7.0, 6.5, font=_FONT), results.works[0]
    trials = [t for t in work.trials if t.group == "own"]
    trials += [t for engine in results.engines for t in engine.trials]
    _draw(axes, trials, lambda t: t.median, lambda t: t.errors.position)
    _titled(axes, "wall time, s", _POSITION, f"{results.scene} to {work.plan.t_end:g} s")
    _key(figure, 2)
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
