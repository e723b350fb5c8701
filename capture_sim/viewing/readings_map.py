"""Verdicts over what is open to reading: one strip for each case of the paper."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from capture_sim.viewing import palette
from capture_sim.viewing.canvas import new_figure

_COLUMNS = 3


class _Reading(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def factor(self) -> float: ...
    @property
    def values(self) -> Sequence[float | str]: ...
    @property
    def taken(self) -> float | str: ...


def draw_readings(
    readings: Sequence[_Reading],
    captured: Sequence[Mapping[str, Sequence[bool]]],
    says: Mapping[str, bool],
) -> Figure:
    """Return a figure with a panel for each reading.

    Parameters
    ----------
    readings
        Name, unit and values of each.
    captured
        For each, by case, whether the tip was captured, along the values.
    says
        By case, what the paper says.
    """
    rows = math.ceil(len(readings) / _COLUMNS)
    figure = new_figure(6.2 * _COLUMNS, 0.9 + 3.0 * rows)
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for panel in panels[len(readings) :]:
        panel.set_axis_off()
    for panel, reading, verdicts in zip(panels, readings, captured, strict=False):
        _draw(panel, reading, verdicts, says)
    marks = [
        Line2D([], [], ls="", marker=m, color=c, ms=9, label=t)
        for m, c, t in (
            ("o", palette.GREEN, "captured, as the paper says"),
            ("x", palette.GREEN, "captured, the paper says not"),
            ("o", palette.ORANGE, "not captured, as the paper says"),
            ("x", palette.ORANGE, "not captured, the paper says captured"),
        )
    ]
    marks.append(Line2D([], [], color=palette.GREY, lw=6, alpha=0.4, label="taken here"))
    figure.legend(handles=marks, loc="outside lower center", ncols=5, fontsize=13)
    return figure


def _draw(
    axes: Axes, reading: _Reading, verdicts: Mapping[str, Sequence[bool]], says: Mapping[str, bool]
) -> None:
    named = isinstance(reading.values[0], str)
    x = np.arange(len(reading.values)) if named else np.array(reading.values) * reading.factor
    for row, (case, caught) in enumerate(verdicts.items()):
        for got in (True, False):
            at = x[[one is got for one in caught]]
            colour = palette.GREEN if got else palette.ORANGE
            right = got == says[case]
            axes.plot(at, np.full(at.size, row), "o" if right else "x", color=colour, ms=7, mew=2)
    if named:
        axes.set_xticks(x, [str(value).replace("_", "\n") for value in reading.values])
        if len(x) > 6:
            axes.tick_params(axis="x", rotation=90)
        taken = float(list(reading.values).index(reading.taken))
    else:
        taken = float(reading.taken) * reading.factor
        if x.min() > 0.0 and x.max() / x.min() > 20.0:
            axes.set_xscale("log")
    axes.axvline(taken, color=palette.GREY, lw=6, alpha=0.4, zorder=0)
    axes.set_yticks(range(len(verdicts)), [case.removeprefix("paper_") for case in verdicts])
    axes.set_ylim(len(verdicts) - 0.5, -0.5)
    axes.set_title(reading.name + (f"  [{reading.unit}]" if reading.unit else ""), fontsize=14)
    axes.tick_params(labelsize=11.5 if not named or len(x) <= 6 else 9)
    axes.tick_params(axis="y", labelsize=12)
    axes.grid(axis="y", color=palette.LIGHT, lw=0.6)
