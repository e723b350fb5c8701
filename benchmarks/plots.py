"""The benchmark's pictures: logarithmic axes with units, a colour for a kind of solver, one key."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from benchmarks import work_precision
from benchmarks.page import Results
from benchmarks.trial import Trial

# Okabe and Ito's colours, told apart with any common colour vision
_COLOURS = {
    "own": "#0072B2",
    "compiled": "#D55E00",
    "numpy": "#7F7F7F",
    "python": "#CC79A7",
    "engine": "#009E73",
}
_MARKERS = "osD^v<>PX*"
_POSITION = "position error, m or rad"

Value = Callable[[Trial], float]


def save_all(results: Results, folder: Path) -> list[Path]:
    """Draw everything into a folder; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    # the same data give the same file
    style: Any = {
        "svg.hashsalt": "capture_sim",
        "font.size": 9.0,
        "axes.grid": True,
        "grid.alpha": 0.3,
    }
    with rc_context(style):
        figures = {
            "work_precision": _works(results, lambda t: t.median, "wall time, s"),
            "evaluations": _works(results, _evaluations, "evaluations of the right-hand side"),
            "quantities": _quantities(results),
            "costs": _costs(results),
        }
        if any(engine.trials for engine in results.engines):
            figures["engines"] = _engines(results)
        paths = []
        for name, figure in figures.items():
            path = folder / f"{name}.svg"
            FigureCanvasSVG(figure)
            figure.savefig(path, format="svg", metadata={"Date": None})
            paths.append(path)
    return paths


def _evaluations(trial: Trial) -> float:
    return float(trial.outcome.evaluations) if trial.outcome is not None else math.nan


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained")


def _curves(trials: Sequence[Trial]) -> list[list[Trial]]:
    """Return one curve of each family: of SciPy's tolerances the form that does better."""
    best: dict[str, list[Trial]] = {}
    for curve in work_precision.families(trials):
        name = curve[0].family
        error = min(t.errors.position for t in curve)
        rival = best.get(name)
        reached = max(error, *(t.errors.position for t in rival[-1:])) if rival else error
        level = max(1e-8, reached)
        if rival is None or work_precision.time_at(curve, level) < work_precision.time_at(
            rival, level
        ):
            best[name] = curve
    return list(best.values())


def _draw(axes: Axes, trials: Sequence[Trial], x: Value, y: Value) -> None:
    """Draw a line for each family: its group's colour, and its own marker in the group."""
    axes.set_xscale("log")
    axes.set_yscale("log")
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


def _works(results: Results, x: Value, name: str) -> Figure:
    figure = _figure(6.2 * len(results.works), 7.0)
    panels = figure.subplots(1, len(results.works), squeeze=False)[0]
    for axes, work in zip(panels, results.works, strict=True):
        _draw(axes, work.trials, x, lambda t: t.errors.position)
        axes.set_xlabel(name)
        axes.set_ylabel(_POSITION)
        axes.set_title(f"{results.scene} to {work.plan.t_end:g} s")
    _key(figure, 2 * len(results.works))
    return figure


def _quantities(results: Results) -> Figure:
    quantities: list[tuple[str, Value]] = [
        ("error of peak forces, 1", lambda t: t.errors.peak_force),
        ("error of event times, s", lambda t: t.errors.event_time),
        ("error of impulse, 1", lambda t: t.errors.impulse),
    ]
    figure = _figure(13.0, 4.6 * len(results.works))
    rows = figure.subplots(len(results.works), 3, squeeze=False)
    for row, work in zip(rows, results.works, strict=True):
        trials = [t for t in work.trials if t.group in ("own", "compiled")]
        for axes, (name, value) in zip(row, quantities, strict=True):
            _draw(axes, trials, lambda t: t.median, value)
            axes.set_xlabel("wall time, s")
            axes.set_ylabel(name)
            axes.set_title(f"to {work.plan.t_end:g} s")
    _key(figure, 5)
    return figure


def _engines(results: Results) -> Figure:
    figure = _figure(7.0, 6.5)
    axes = figure.subplots()
    work = results.works[0]
    trials = [t for t in work.trials if t.group == "own"]
    trials += [t for engine in results.engines for t in engine.trials]
    _draw(axes, trials, lambda t: t.median, lambda t: t.errors.position)
    axes.set_xlabel("wall time, s")
    axes.set_ylabel(_POSITION)
    axes.set_title(f"{results.scene} to {work.plan.t_end:g} s")
    _key(figure, 2)
    return figure


def _costs(results: Results) -> Figure:
    figure = _figure(12.0, 4.5)
    left, right = figure.subplots(1, 2)
    colour = _COLOURS["own"]

    def draw(axes: Axes, x: list[float], rows: Sequence[Any], each: list[int]) -> None:
        y = [1e3 * row.seconds.median / n for row, n in zip(rows, each, strict=True)]
        low = [v - 1e3 * row.seconds.low / n for v, row, n in zip(y, rows, each, strict=True)]
        high = [1e3 * row.seconds.high / n - v for v, row, n in zip(y, rows, each, strict=True)]
        axes.set_xscale("log")
        axes.errorbar(x, y, yerr=[low, high], color=colour, marker="o", markersize=4, capsize=3)

    draw(left, [row.t_end for row in results.times], results.times, [1] * len(results.times))
    for row in results.times:
        left.annotate(
            f"{row.touches}",
            (row.t_end, 1e3 * row.seconds.median),
            xytext=(0, 7),
            textcoords="offset points",
            ha="right",
            fontsize=8,
        )
    left.set_yscale("log")
    left.margins(y=0.1)
    left.set_xlabel("simulated time, s")
    left.set_ylabel("wall time, ms")
    left.set_title(f"{results.scene}, number of touches at each point")
    sizes = [row.runs for row in results.batches]
    draw(right, [float(n) for n in sizes], results.batches, sizes)
    right.set_xlabel("runs in a batch")
    # what differs little is to look so
    right.set_ylim(0.0, 1.3e3 * max(row.seconds.high / row.runs for row in results.batches))
    right.set_ylabel("wall time per run, ms")
    right.set_title(f"runs to {results.works[0].plan.t_end:g} s, with setting up")
    return figure
