"""The benchmark's pictures: logarithmic axes with units, lines labelled where they end."""

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
from benchmarks.tables import Results
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
_GROUPS = {
    "own": "capture_sim",
    "compiled": "SciPy, compiled RHS",
    "numpy": "SciPy, NumPy RHS",
    "python": "SciPy, tuned Python RHS",
    "engine": "other engines",
}
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
    """Draw a line for each family and label it at its most exact end."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    labels = []
    count: dict[str, int] = {}
    for curve in _curves(trials):
        points = [(x(t), y(t)) for t in curve]
        points = [(a, b) for a, b in points if a > 0.0 and b > 0.0 and math.isfinite(a + b)]
        if not points:
            continue
        group = curve[0].group
        number = count[group] = count.get(group, -1) + 1
        failed = sum(bool(t.failure) for t in trials if t.family == curve[0].family)
        colour, marker = _COLOURS[group], _MARKERS[number % len(_MARKERS)]
        axes.plot(
            *zip(*points, strict=True),
            color=colour,
            marker=marker,
            markersize=3.5,
            linewidth=1.8 if group == "own" else 1.0,
        )
        name = curve[0].family.partition(",")[0].removeprefix("SciPy ")
        name = curve[0].family if group == "engine" else name
        name += f" ({failed} failed)" if failed else ""
        labels.append((*points[-1], name, colour))
    _label(axes, labels)


def _label(axes: Axes, labels: list[tuple[float, float, str, str]]) -> None:
    """Write labels to the right of the lines' ends, shifted where they would overlap."""
    low, high = axes.get_xlim()
    axes.set_xlim(low, high * (high / low) ** 0.25)  # room for them
    least = 0.032  # of the axes' height
    taken: list[tuple[float, float]] = []
    for x, y, text, colour in sorted(labels, key=lambda label: label[1]):
        at = axes.transAxes.inverted().transform(axes.transData.transform((x, y)))
        place = float(at[1])
        while any(abs(place - v) < least and abs(at[0] - u) < 0.28 for u, v in taken):
            place += 0.25 * least
        taken.append((float(at[0]), place))
        axes.annotate(
            text,
            xy=(x, y),
            xytext=(float(at[0]) + 0.012, place),
            textcoords="axes fraction",
            color=colour,
            fontsize=7.5,
            va="center",
            annotation_clip=False,
        )


def _key(axes: Axes, groups: Sequence[str]) -> None:
    """Write what the colours stand for, in those colours."""
    for k, group in enumerate(groups):
        axes.text(
            0.02,
            0.02 + 0.042 * (len(groups) - 1 - k),
            _GROUPS[group],
            color=_COLOURS[group],
            transform=axes.transAxes,
            fontsize=8.5,
            weight="bold",
        )


def _groups_of(trials: Sequence[Trial]) -> list[str]:
    return [group for group in _GROUPS if any(t.group == group and t.seconds for t in trials)]


def _works(results: Results, x: Value, name: str) -> Figure:
    figure = _figure(6.2 * len(results.works), 6.0)
    panels = figure.subplots(1, len(results.works), squeeze=False)[0]
    for axes, work in zip(panels, results.works, strict=True):
        _draw(axes, work.trials, x, lambda t: t.errors.position)
        axes.set_xlabel(name)
        axes.set_ylabel(_POSITION)
        axes.set_title(f"{results.scene} to {work.plan.t_end:g} s")
        _key(axes, _groups_of(work.trials))
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
            _key(axes, _groups_of(trials))
    return figure


def _engines(results: Results) -> Figure:
    figure = _figure(7.0, 5.5)
    axes = figure.subplots()
    work = results.works[0]
    trials = [t for t in work.trials if t.group == "own"]
    trials += [t for engine in results.engines for t in engine.trials]
    _draw(axes, trials, lambda t: t.median, lambda t: t.errors.position)
    axes.set_xlabel("wall time, s")
    axes.set_ylabel(_POSITION)
    axes.set_title(f"{results.scene} to {work.plan.t_end:g} s")
    _key(axes, _groups_of(trials))
    return figure


def _costs(results: Results) -> Figure:
    figure = _figure(12.0, 4.5)
    left, right = figure.subplots(1, 2)
    colour = _COLOURS["own"]

    def draw(axes: Axes, x: list[float], rows: Sequence[Any], each: list[int]) -> None:
        y = [row.seconds.median / n for row, n in zip(rows, each, strict=True)]
        low = [v - row.seconds.low / n for v, row, n in zip(y, rows, each, strict=True)]
        high = [row.seconds.high / n - v for v, row, n in zip(y, rows, each, strict=True)]
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.errorbar(x, y, yerr=[low, high], color=colour, marker="o", markersize=4, capsize=3)

    draw(left, [row.t_end for row in results.times], results.times, [1] * len(results.times))
    for row in results.times:
        left.annotate(
            f"{row.touches}",
            (row.t_end, row.seconds.median),
            xytext=(0, 7),
            textcoords="offset points",
            ha="right",
            fontsize=8,
        )
    left.set_xlabel("simulated time, s")
    left.set_ylabel("wall time, s")
    left.set_title(f"{results.scene}, number of touches at each point")
    sizes = [row.runs for row in results.batches]
    draw(right, [float(n) for n in sizes], results.batches, sizes)
    right.set_xlabel("runs in a batch")
    right.set_ylabel("wall time per run, s")
    right.set_title(f"runs to {results.works[0].plan.t_end:g} s, with setting up")
    return figure
