"""The figures of the page on the paper, each made from the evidence for its statements."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.paper import CASES, DOCKING, Evidence, Scan
from capture_sim.run.run import Run
from capture_sim.viewing import figures, style
from capture_sim.viewing.canvas import subplots
from capture_sim.viewing.curves import HOLDS, STROKE, VELOCITIES, plotted_runs
from capture_sim.viewing.drawing import draw_end, draw_trajectory
from capture_sim.viewing.source import resolved, verdict

_COLUMNS = 3
_ENGINE_POINTS = 30  # so that the line under them is seen
_UNDAMPED = ("intrusion", "impact_force", "axial_performance", "distance")
_DESIGNED = ("axial_performance", "torsional_performance", "distance", "impact_force")
_CHASER_AND_TARGET = (0, 5, 1, 6, 2, 7)  # of q, by panels of the velocities


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the page: its title, and how it is drawn."""

    title: str
    draw: Callable[[Evidence], Figure]


def _impact_force(evidence: Evidence) -> Figure:
    return figures.over_time(
        "impact_force",
        [evidence.run("paper_clamped"), evidence.run("paper_undamped")],
        labels=["probe clamped", "buffer, no damper"],
        window=(0.0, 0.3),
    )


def _velocities(evidence: Evidence) -> Figure:
    engine = evidence.engine
    figure = figures.velocities(engine.ours, window=(0.0, 0.3))
    quantities = itertools.chain.from_iterable(VELOCITIES)
    for axes, index, quantity in zip(figure.axes, _CHASER_AND_TARGET, quantities, strict=True):
        draw_points(axes, engine.t, engine.v[:, index] * quantity.factor, "Exudyn")
    _name_ours(figure)
    return figure


def _axial_performance(evidence: Evidence) -> Figure:
    engine = evidence.engine
    figure = figures.over_time("axial_performance", engine.ours)
    stroke = engine.h - engine.ours.scene.rest_length
    draw_points(figure.axes[0], engine.t, stroke * STROKE.factor, "Exudyn")
    _name_ours(figure)
    return figure


def _name_ours(figure: Figure) -> None:
    """Explain the curves of this simulation and the points of the other engine above them."""
    for line in (line for axes in figure.axes for line in axes.get_lines()):
        if line.get_label() in HOLDS:
            line.set_label(f"capture_sim, {line.get_label()}")
    figures.legend_above(figure)


def draw_points(axes: Axes, t: np.ndarray, values: np.ndarray, label: str) -> None:
    """Draw some points of a curve of another engine, (n,) each, evenly over the drawn time."""
    evenly = np.searchsorted(t, np.linspace(*axes.get_xlim(), _ENGINE_POINTS))
    some = np.unique(evenly[evenly < len(t)])
    look = {"marker": "o", "ls": "", "ms": 5, "mfc": "none", "mew": 1.5, "zorder": 3}
    axes.plot(t[some], values[some], color=style.BLACK, label=label, **look)


def draw_trajectories(runs: Iterable[Run]) -> Figure:
    """Return a figure of the paths of the tip's centre, each in its own cone, side by side."""
    shown = plotted_runs(list(runs))
    figure, [row] = subplots(5.4 * len(shown), 6.2, 1, len(shown), grid=None, sharey=True)
    for axes, plotted in zip(row, shown, strict=True):
        draw_trajectory(axes, [plotted])
        draw_end(axes, plotted)
        title = f"{plotted.label}: {verdict(plotted.run)}"
        axes.set_title(title, fontsize=style.FONT, fontweight="bold")
    for axes in row[1:]:  # what is explained in the first
        axes.set_ylabel("")
        axes.get_legend().remove()
    return figure


#: By name of the file.
FIGURES = {
    "figure_5": PaperFigure(
        "Figure 5: impact force, probe clamped and on the buffer", _impact_force
    ),
    "figure_6": PaperFigure(
        "Figure 6: the buffer without damper",
        lambda e: figures.sheet(_UNDAMPED, resolved(e.run("paper_undamped"))),
    ),
    "figure_7": PaperFigure(
        "Figure 7: the tip in the cone, without damper",
        lambda e: figures.trajectory(e.run("paper_undamped")),
    ),
    "figure_8": PaperFigure(
        "Figure 8, a and b: the designed buffer",
        lambda e: figures.sheet(_DESIGNED, e.run("paper_designed")),
    ),
    "figure_8c": PaperFigure(
        "Figure 8, c: the tip in the cone, designed buffer",
        lambda e: figures.trajectory(e.run("paper_designed")),
    ),
    "figure_10": PaperFigure("Figure 10: velocities, compared with a second engine", _velocities),
    "figure_11": PaperFigure(
        "Figure 11: the buffer, compared with a second engine", _axial_performance
    ),
    "figure_12": PaperFigure(
        "Figure 12: docking from one metre away", lambda e: figures.snapshots(e.run(DOCKING))
    ),
    "figure_13": PaperFigure(
        "Figure 13: cases 1 to 3",
        lambda e: draw_trajectories(e.run(f"paper_case_{n}") for n in (1, 2, 3)),
    ),
    "figure_15": PaperFigure(
        "Figures 15 to 17: the experiments at 0, +10 and -10 degrees",
        lambda e: figures.snapshots(
            [e.run(n) for n in ("tilt_0", "tilt_p10", "tilt_m10")], count=5
        ),
    ),
    "assumptions": PaperFigure(
        "Verdicts over what the paper leaves open", lambda e: draw_assumptions(e.scans)
    ),
}


def draw_assumptions(scans: Sequence[Scan]) -> Figure:
    """Return a figure with a panel for each assumption: a strip for each case's verdicts.

    A point's colour shows whether the verdict is the paper's; a filled point is a capture.
    """
    rows = math.ceil(len(scans) / _COLUMNS)
    figure, panels = subplots(6.2 * _COLUMNS, 0.9 + 3.0 * rows, rows, _COLUMNS, grid="y", font=13.5)
    for panel, scan in itertools.zip_longest(panels.flat, scans):
        if scan is None:
            panel.set_axis_off()
        else:
            _draw_scan(panel, scan)
    marks = [
        Line2D([], [], ls="", label=text, **_verdict_look(agrees=agrees, captured=captured))
        for text, agrees, captured in (
            ("as the paper: captured", True, True),
            ("as the paper: not captured", True, False),
            ("differs: captured", False, True),
            ("differs: not captured", False, False),
        )
    ]
    marks.append(Line2D([], [], color=style.GREY, lw=6, alpha=0.4, label="assumed here"))
    figure.legend(handles=marks, loc="outside lower center", ncols=5, fontsize=13)
    return figure


def _verdict_look(*, agrees: bool, captured: bool) -> dict[str, Any]:
    colour = style.BLUE if agrees else style.VERMILION
    look: dict[str, Any] = {"color": colour, "marker": "o" if agrees else "D", "ms": 8, "mew": 2}
    return look | {"mfc": colour if captured else "white"}


def _draw_scan(axes: Axes, scan: Scan) -> None:
    of = scan.assumption
    named = isinstance(of.values[0], str)
    x = np.arange(len(of.values)) if named else np.array(of.values) * of.factor
    for row, (case, says) in enumerate(CASES.items()):
        verdicts = np.array([point.captured for point in scan.points[case]])
        for captured in (True, False):
            at = x[verdicts == captured]
            look = _verdict_look(agrees=captured == says, captured=captured)
            axes.plot(at, np.full(at.size, row), ls="", **look)
    if named:
        axes.set_xticks(x, [str(value).replace("_", "\n") for value in of.values])
        if len(x) > 6:
            axes.tick_params(axis="x", rotation=90)
        assumed = float(of.values.index(of.assumed))
    else:
        assumed = float(of.assumed) * of.factor
        if x.min() > 0.0 and x.max() / x.min() > 20.0:
            axes.set_xscale("log")
    axes.axvline(assumed, color=style.GREY, lw=6, alpha=0.4, zorder=0)
    axes.set_yticks(range(len(CASES)), [case.removeprefix("paper_") for case in CASES])
    axes.set_ylim(len(CASES) - 0.5, -0.5)
    axes.set_title(of.name + (f"  [{of.unit}]" if of.unit else ""), fontsize=14)
    axes.tick_params(axis="x", labelsize=11.5 if not named or len(x) <= 6 else 9)
