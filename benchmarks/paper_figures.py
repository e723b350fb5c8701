"""The figures of the page on the paper, each made from the evidence for its statements."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.paper import CASES, DOCKING, Evidence, Scan
from capture_sim.viewing import figures, style
from capture_sim.viewing.canvas import subplots
from capture_sim.viewing.curves import Trace
from capture_sim.viewing.figures import snapshots
from capture_sim.viewing.source import resolved

_COLUMNS = 3


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the page: its title, and how it is drawn."""

    title: str
    draw: Callable[[Evidence], Figure]


def _impact_force(evidence: Evidence) -> Figure:
    return figures.impact_force(
        [evidence.run("paper_clamped"), evidence.run("paper_undamped")],
        labels=["probe clamped", "buffer, no damper"],
        window=(0.0, 0.3),
    )


def _velocities(evidence: Evidence) -> Figure:
    engine = evidence.engine
    rates = Trace("Exudyn", engine.t, engine.v)
    return figures.velocities(
        engine.ours, labels=["capture_sim"], window=(0.0, 0.3), traces=[rates]
    )


def _axial_performance(evidence: Evidence) -> Figure:
    engine = evidence.engine
    stroke = Trace("Exudyn", engine.t, engine.h - engine.ours.scene.rest_length)
    return figures.axial_performance(engine.ours, labels=["capture_sim"], traces=[stroke])


#: By name of the file.
FIGURES = {
    "figure_5": PaperFigure(
        "Figure 5: impact force, probe clamped and on the buffer", _impact_force
    ),
    "figure_6": PaperFigure(
        "Figure 6: the buffer without damper",
        lambda e: figures.undamped_results(resolved(e.run("paper_undamped"))),
    ),
    "figure_7": PaperFigure(
        "Figure 7: the tip in the cone, without damper",
        lambda e: figures.trajectory(e.run("paper_undamped")),
    ),
    "figure_8": PaperFigure(
        "Figure 8, a and b: the designed buffer",
        lambda e: figures.buffer_results(e.run("paper_designed")),
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
        "Figure 12: docking from one metre away", lambda e: snapshots(e.run(DOCKING))
    ),
    "figure_13": PaperFigure(
        "Figure 13: cases 1 to 3",
        lambda e: figures.trajectories([e.run(f"paper_case_{n}") for n in (1, 2, 3)]),
    ),
    "figure_15": PaperFigure(
        "Figures 15 to 17: the experiments at 0, +10 and -10 degrees",
        lambda e: snapshots([e.run(n) for n in ("tilt_0", "tilt_p10", "tilt_m10")], count=5),
    ),
    "assumptions": PaperFigure(
        "Verdicts over what the paper leaves open", lambda e: draw_assumptions(e.scans)
    ),
}


def draw_assumptions(scans: Sequence[Scan]) -> Figure:
    """Return a figure with a panel for each assumption: a strip for each case's verdicts."""
    rows = math.ceil(len(scans) / _COLUMNS)
    figure, panels = subplots(6.2 * _COLUMNS, 0.9 + 3.0 * rows, rows, _COLUMNS, grid="y", font=13.5)
    for panel, scan in itertools.zip_longest(panels.flat, scans):
        if scan is None:
            panel.set_axis_off()
        else:
            _draw_scan(panel, scan)
    marks = [
        Line2D([], [], ls="", marker=m, color=c, ms=9, label=t)
        for m, c, t in (
            ("o", style.GREEN, "captured, as the paper says"),
            ("x", style.GREEN, "captured, the paper says not"),
            ("o", style.GREY, "not captured, as the paper says"),
            ("x", style.GREY, "not captured, the paper says captured"),
        )
    ]
    marks.append(Line2D([], [], color=style.GREY, lw=6, alpha=0.4, label="assumed here"))
    figure.legend(handles=marks, loc="outside lower center", ncols=5, fontsize=13)
    return figure


def _draw_scan(axes: Axes, scan: Scan) -> None:
    of = scan.assumption
    named = isinstance(of.values[0], str)
    x = np.arange(len(of.values)) if named else np.array(of.values) * of.factor
    for row, (case, says) in enumerate(CASES.items()):
        captured = np.array([point.captured for point in scan.points[case]])
        for got, colour in ((True, style.GREEN), (False, style.GREY)):
            at = x[captured == got]
            mark = "o" if got == says else "x"
            axes.plot(at, np.full(at.size, row), mark, color=colour, ms=7, mew=2)
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
