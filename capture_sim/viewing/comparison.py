"""The diagram of two runs held against each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from capture_sim.analysis.measurements import Measurements
from capture_sim.errors import RecordingError
from capture_sim.viewing import palette

_COLOURS = (palette.BLUE, palette.VERMILION)
_STYLES = ("-", "--")
_ROWS = (
    ("force", "force on the tip\nN", 1.0),
    ("stroke", "stroke\nmm", 1e3),
    ("torsion", "torsion\nmrad", 1e3),
)
_BEFORE = 0.05  # share of the window that is shown before the first contact


def save_comparison(
    runs: Sequence[Measurements], labels: Sequence[str], window: float, path: Path | str
) -> Path:
    """Draw what was measured in two runs over each other, and where the vehicles went.

    Parameters
    ----------
    runs
        Their first contacts at t = 0.
    labels
        Of the runs.
    window
        s that are shown.
    path
        PNG, or whatever its ending says.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    figure = Figure(figsize=(9.0, 10.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(_ROWS) + 1, 1, sharex=True)
    first = -_BEFORE * window
    for ax, (name, label, factor) in zip(axes, _ROWS, strict=False):
        for run, colour, style, of_run in zip(runs, _COLOURS, _STYLES, labels, strict=True):
            series = getattr(run, name)
            shown = (series.t >= first) & (series.t <= window)
            ax.plot(
                series.t[shown],
                series.values[shown] * factor,
                style,
                color=colour,
                label=of_run,
                linewidth=1.6,
            )
        ax.set_ylabel(label)
    relative = axes[-1]
    for run, colour, style, of_run in zip(runs, _COLOURS, _STYLES, labels, strict=True):
        if not run.chaser.t.size or not run.target.t.size:
            continue
        t = run.chaser.t[(run.chaser.t >= first) & (run.chaser.t <= window)]
        gap = _x(run.target.t, run.target.values, t) - _x(run.chaser.t, run.chaser.values, t)
        at_contact = _x(run.target.t, run.target.values, np.zeros(1)) - _x(
            run.chaser.t, run.chaser.values, np.zeros(1)
        )
        relative.plot(t, (gap - at_contact) * 1e3, style, color=colour, label=of_run, linewidth=1.6)
    relative.set_ylabel("gap of the vehicles\nsince contact, mm")
    relative.set_xlabel("time after the first contact, s")
    for ax in axes:
        ax.axvline(0.0, color=palette.GREY, linewidth=0.8)
        ax.grid(color=palette.LIGHT, linewidth=0.6)
    axes[0].legend(loc="upper right", frameon=False)
    figure.align_ylabels(axes)
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None
    return Path(path)


def _x(t: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.interp(at, t, poses[:, 0])
