"""The diagram of two runs held against each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from capture_sim.errors import RecordingError
from capture_sim.studies.measurements import Measurements
from capture_sim.viewing import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from capture_sim.studies.touches import Touches

_COLOURS = (palette.BLUE, palette.VERMILION)
_STYLES = ("-", "--")
_MARKS = ("o", "D")
_SERIES = (("stroke", "stroke\nmm", 1e3), ("torsion", "torsion\nmrad", 1e3))
_BEFORE = 0.05  # share of the window that is shown before the first contact


class Drawn(NamedTuple):
    """A run in the diagram.

    Attributes
    ----------
    label
        In words.
    measured
        First contact at t = 0.
    sources
        Topic and rate of each series.
    touches
        Those in the window, first contact at t = 0; None where nothing tells of them.
    """

    label: str
    measured: Measurements
    sources: Mapping[str, str]
    touches: Touches | None


def save_comparison(runs: Sequence[Drawn], window: float, path: Path | str) -> Path:
    """Draw what was measured in two runs over each other, and where the vehicles went.

    A touch lasts about a millisecond, so it is drawn as what was located: a stem up to its
    peak, with a bar under it that is as wide as the touch and whose area is its impulse.  Only
    where nothing tells of touches the sampled force is drawn, with its samples.

    Parameters
    ----------
    runs
        Two.
    window
        s that are shown.
    path
        PNG, or whatever its ending says.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    figure = Figure(figsize=(9.0, 11.5), layout="constrained")
    FigureCanvasAgg(figure)
    force, impulse, *axes, relative = figure.subplots(len(_SERIES) + 3, 1, sharex=True)
    first = -_BEFORE * window
    looks = list(zip(runs, _COLOURS, _STYLES, _MARKS, strict=True))
    for run, colour, style, mark in looks:
        if run.touches is None:
            _draw_sampled_force(force, run, (first, window), colour)
        else:
            draw_touches(force, run.touches, run.label, colour, mark)
            t, total = impulse_so_far(run.touches, window)
            if np.isfinite(total).all():
                impulse.plot(t, total * 1e3, style, color=colour, linewidth=1.6)
    force.set_ylabel("peak of each touch\nN")
    force.set_ylim(bottom=0.0)
    impulse.set_ylabel("impulse so far\nmN s")
    if not impulse.lines:
        impulse.text(0.5, 0.5, "not told by either", ha="center", transform=impulse.transAxes)
    for ax, (name, label, factor) in zip(axes, _SERIES, strict=True):
        for run, colour, style, _ in looks:
            series = getattr(run.measured, name)
            shown = (series.t >= first) & (series.t <= window)
            t, values = series.t[shown], series.values[shown] * factor
            ax.plot(t, values, style, color=colour, linewidth=1.6)
        ax.set_ylabel(label)
        ax.set_title(_told_by(runs, name), loc="right", fontsize="small", color=palette.DARK)
    for run, colour, style, _ in looks:
        chaser, target = run.measured.chaser, run.measured.target
        if not chaser.t.size or not target.t.size:
            continue
        t = chaser.t[(chaser.t >= first) & (chaser.t <= window)]
        gap = _x(target.t, target.values, t) - _x(chaser.t, chaser.values, t)
        zero = np.zeros(1)
        at_contact = _x(target.t, target.values, zero) - _x(chaser.t, chaser.values, zero)
        relative.plot(t, (gap - at_contact) * 1e3, style, color=colour, linewidth=1.6)
    relative.set_title(_told_by(runs, "chaser"), loc="right", fontsize="small", color=palette.DARK)
    relative.set_ylabel("gap of the vehicles\nsince contact, mm")
    relative.set_xlabel("time after the first contact, s")
    relative.set_xlim(first, window)
    for ax in (force, impulse, *axes, relative):
        ax.axvline(0.0, color=palette.GREY, linewidth=0.8)
        ax.grid(color=palette.LIGHT, linewidth=0.6)
    force.legend(loc="upper right", frameon=False)
    figure.align_ylabels()
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None
    return Path(path)


def draw_touches(ax: Axes, touches: Touches, label: str, colour: str, mark: str) -> None:
    """Draw each touch as a stem up to its peak, and a bar whose area is its impulse."""
    ax.vlines(touches.peak_time, 0.0, touches.peak, color=colour, linewidth=1.2)
    look: dict[str, Any] = {"color": colour, "fillstyle": "none", "linestyle": "none"}
    ax.plot(touches.peak_time, touches.peak, mark, label=label, **look)
    known = touches.lasted > 0.0
    ax.bar(
        touches.start[known],
        touches.impulse[known] / touches.lasted[known],
        width=touches.lasted[known],
        align="edge",
        color=colour,
        alpha=0.25,
    )


def _draw_sampled_force(ax: Axes, run: Drawn, shown: tuple[float, float], colour: str) -> None:
    series = run.measured.force
    inside = (series.t >= shown[0]) & (series.t <= shown[1])
    label = f"{run.label}: no touches told"
    if inside.any():
        label = f"{run.label}: samples, {run.sources['force']}; touches between them do not show"
    ax.plot(series.t[inside], series.values[inside], ".", color=colour, label=label)


def impulse_so_far(touches: Touches, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and the impulse until then, N s; over a touch it grows evenly."""
    start, lasted = touches.start, np.maximum(touches.lasted, 1e-9)
    t = np.sort(np.concatenate([[0.0, window], start, start + lasted]))
    share = np.clip((t[:, None] - start) / lasted, 0.0, 1.0)
    return t, np.asarray(share @ touches.impulse)


def _told_by(runs: Sequence[Drawn], name: str) -> str:
    return " and ".join(dict.fromkeys(run.sources[name] for run in runs if name in run.sources))


def _x(t: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.interp(at, t, poses[:, 0])
