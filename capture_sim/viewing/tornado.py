"""Sensitivities in pictures: what each parameter does over its spread, and in the whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from capture_sim.studies.sensitivity import (
    QUANTITIES,
    SMOOTH,
    Global,
    Local,
    Parameter,
    Quantity,
)
from capture_sim.viewing import palette
from capture_sim.viewing.canvas import new_figure, save, set_fonts


def save_tornado(found: Local, path: Path | str) -> Path:
    """Draw a tornado and save it; see :func:`draw_tornado`.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    return save(draw_tornado(found), path)


def save_indices(found: Global, path: Path | str) -> Path:
    """Draw the indices and save them; see :func:`draw_indices`.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    return save(draw_indices(found), path)


def draw_tornado(found: Local) -> Figure:
    """Return a figure with a panel for each quantity: bars over each parameter's spread.

    A tick on a bar is what the derivative promises; a cross, that the derivative is
    ill-conditioned; a ring, that the verdict is another one at that end.
    """
    figure = new_figure(19.0, 12.0)
    panels = figure.subplots(2, 3).ravel()
    for q, (panel, quantity) in enumerate(zip(panels, SMOOTH, strict=False)):
        _draw_bars(panel, found, q, quantity)
    panels[-1].set_axis_off()
    panels[-1].legend(
        handles=[
            Patch(color=palette.BLUE, label="parameter below by its spread"),
            Patch(color=palette.VERMILION, label="parameter above by its spread"),
            Line2D([], [], ls="", marker="|", color="k", ms=14, mew=2, label="by the derivative"),
            Line2D([], [], ls="", marker="x", color="k", ms=9, mew=2, label="ill-conditioned"),
            Line2D(
                [],
                [],
                ls="",
                marker="o",
                mfc="none",
                color="k",
                ms=11,
                mew=2,
                label="verdict flips",
            ),
        ],
        loc="center",
        fontsize=15,
    )
    set_fonts(figure.axes, 13.0)
    return figure


def _draw_bars(axes: Axes, found: Local, q: int, quantity: Quantity) -> None:
    _, title, unit, factor = quantity
    low = (found.low[:, q] - found.base[q]) * factor
    high = (found.high[:, q] - found.base[q]) * factor
    order = np.argsort(np.maximum(np.abs(low), np.abs(high)))
    for place, p in enumerate(order):
        axes.barh(place, low[p], color=palette.BLUE, alpha=0.75, height=0.75)
        axes.barh(place, high[p], color=palette.VERMILION, alpha=0.75, height=0.75)
        derivative = found.derivatives[p][q]
        promised = derivative.value * factor
        if derivative.converged:
            axes.plot([-promised, promised], [place, place], "|", color="k", ms=12, mew=2)
        else:
            axes.plot(0.0, place, "x", color="k", ms=8, mew=2, zorder=3)
        for end, values in ((low[p], found.low), (high[p], found.high)):
            if values[p, -1] != found.base[-1]:
                axes.plot(end, place, "o", mfc="none", color="k", ms=10, mew=1.8, zorder=3)
    axes.set_yticks(range(len(order)), [_label(found.parameters[p]) for p in order])
    axes.axvline(0.0, color=palette.BLACK, lw=0.8)
    reach = max(float(np.abs([low, high]).max()), 1e-12) * 1.15
    axes.set_xlim(-reach, reach)
    axes.set_xlabel(f"change  [{unit}]")
    axes.set_title(f"{title}: {found.base[q] * factor:.4g} {unit}", fontsize=14)
    axes.grid(axis="x", color=palette.LIGHT, lw=0.6)
    axes.set_axisbelow(True)


def _label(parameter: Parameter) -> str:
    return f"{parameter.name} ±{parameter.displayed_spread}"


def draw_indices(found: Global) -> Figure:
    """Return a figure of Morris' or Sobol's indices: a panel for each quantity."""
    figure = new_figure(19.0, 12.0)
    panels = figure.subplots(2, 3).ravel()
    morris = found.method == "morris"
    for q, (panel, quantity) in enumerate(zip(panels, QUANTITIES, strict=True)):
        _, title, unit, factor = quantity
        if not morris:
            factor = 1.0
        total, first = found.total[:, q] * factor, found.first[:, q] * factor
        spread = found.confidence[:, q] * factor
        if np.isnan(total).all():
            panel.set_axis_off()
            panel.set_title(f"{title}: the same in every run", fontsize=14)
            continue
        order = np.argsort(total)
        places = np.arange(len(order))
        panel.barh(places, total[order], color=palette.SKY, height=0.75, xerr=spread[order])
        panel.plot(first[order], places, "D", color=palette.BLACK, ms=6)
        panel.set_yticks(places, [_label(found.parameters[p]) for p in order])
        panel.set_xlim(left=min(0.0, float(np.nanmin(first)) * 1.1))
        panel.set_xlabel(f"effect  [{unit}]" if morris else "share of the variance")
        panel.set_title(title, fontsize=14)
        panel.grid(axis="x", color=palette.LIGHT, lw=0.6)
        panel.set_axisbelow(True)
    set_fonts(figure.axes, 13.0)
    what = (
        "bars: mean magnitude of the elementary effects, over the whole spread (95 %); "
        "diamonds: their scatter"
        if morris
        else "bars: total index (95 %); diamonds: first-order index"
    )
    figure.suptitle(f"{found.method.capitalize()}, {found.runs} runs; {what}", fontsize=15)
    return figure
