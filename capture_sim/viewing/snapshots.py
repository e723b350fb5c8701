"""The docking in a strip of pictures from above, as in the paper's Figures 12 and 15 to 17."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capture_sim.viewing import palette
from capture_sim.viewing.bench_drawing import draw_state
from capture_sim.viewing.canvas import FONT, SMALL, new_figure, set_fonts
from capture_sim.viewing.geometry import (
    CHASER,
    TARGET,
    chaser_box,
    placed,
    target_box,
    tip_in_world,
)
from capture_sim.viewing.series import Shown, as_shown
from capture_sim.viewing.source import ViewableRun, first_touch, start_word, time_window

_MARGIN = 0.02  # m
_PANEL = 5.4  # inches, width of a picture


def snapshots(
    runs: ViewableRun | Sequence[ViewableRun],
    *,
    times: Sequence[float] | None = None,
    count: int = 6,
    labels: Sequence[str] | None = None,
) -> Figure:
    """Draw a run as a strip of pictures, or several runs as strips side by side.

    Parameters
    ----------
    runs
        One, or several.
    times
        Of the pictures, s since the start; None chooses them for each run: the start, the
        first touch, and the rest evenly spread up to the verdict.
    count
        Pictures of each run, at least 2, where no times are given.
    labels
        One for each run; None takes the scenes' names.
    """
    shown = as_shown(runs, labels)
    instants = [
        np.asarray(times, float) if times is not None else snapshot_times(one.run, count)
        for one in shown
    ]
    frame = _common([_bounds(one.run, when) for one, when in zip(shown, instants, strict=True)])
    # a single strip is laid in two columns, read line by line
    columns, rows = len(shown), max(map(len, instants))
    if len(shown) == 1:
        columns, rows = 2, -(-rows // 2)
    panel = _PANEL * (frame[3] - frame[2]) / (frame[1] - frame[0]) + 0.12
    figure = new_figure((_PANEL + 0.75) * columns, rows * panel + 1.1)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    strips = [grid.ravel()] if len(shown) == 1 else list(grid.T)
    for strip, one, when in zip(strips, shown, instants, strict=True):
        for axes in strip[len(when) :]:
            axes.set_axis_off()
        for i, (axes, t) in enumerate(zip(strip, when, strict=False)):
            _draw_instant(axes, one, float(t), frame, chr(ord("a") + i))
        if len(shown) > 1:
            strip[0].set_title(one.label, fontsize=FONT + 1, fontweight="bold")
    if len(shown) == 1:
        figure.suptitle(shown[0].label, fontsize=FONT + 1, fontweight="bold")
    for axes in grid[-1]:
        axes.set_xlabel("x in the world  [m]")
    for axes in grid[:, 0]:
        axes.set_ylabel("y  [m]")
    set_fonts(figure.axes)
    return figure


def _common(
    frames: Sequence[tuple[float, float, float, float]],
) -> tuple[float, float, float, float]:
    """Return the frame that holds all frames."""
    lefts, rights, lows, highs = zip(*frames, strict=True)
    return min(lefts), max(rights), min(lows), max(highs)


def snapshot_times(run: ViewableRun, count: int) -> np.ndarray:
    """Return times worth a picture, (count,), s: start, first touch, evenly to the verdict."""
    start, end = float(run.samples["t"][0]), time_window(run)[1]
    touch = first_touch(run)
    if touch is None or touch.t - start < 0.02:
        return np.linspace(start, end, count)
    return np.concatenate([[start], np.linspace(touch.t, end, count - 1)])


def _draw_instant(
    axes: Axes, one: Shown, t: float, frame: tuple[float, float, float, float], letter: str
) -> None:
    run = one.run
    q = state_at(run, t)
    before = run.samples["q"][run.samples["t"] <= t]
    draw_state(axes, run.scene, q)
    axes.plot(*tip_in_world(run.scene, before).T, color=palette.PURPLE, lw=2.2, zorder=1.5)
    axes.set_aspect("equal")
    axes.set_xlim(frame[0], frame[1])
    axes.set_ylim(frame[2], frame[3])
    axes.text(
        0.012,
        0.975,
        f"({letter})  {t:.3f} s {_meaning(run, t)}".rstrip(),
        transform=axes.transAxes,
        ha="left",
        va="top",
        fontsize=SMALL,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        zorder=9,
    )


def _meaning(run: ViewableRun, t: float) -> str:
    touch = first_touch(run)
    if t == run.samples["t"][0]:
        return start_word(run.scene)
    return "first touch" if touch is not None and t == touch.t else ""


def state_at(run: ViewableRun, t: float) -> np.ndarray:
    """Return the coordinates at a time between the samples, (8,)."""
    samples = run.samples
    return np.array([np.interp(t, samples["t"], samples["q"][:, i]) for i in range(8)])


def _bounds(run: ViewableRun, times: np.ndarray) -> tuple[float, float, float, float]:
    """Return left, right, low and high end of what is seen at these times, m."""
    corners = []
    for t in times:
        q = state_at(run, float(t))
        corners.append(placed(chaser_box(run.scene).corners, *q[list(CHASER)]))
        corners.append(placed(target_box(run.scene).corners, *q[list(TARGET)]))
    points = np.concatenate(corners)
    (left, low), (right, high) = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
    # room for the caption
    return float(left), float(right), float(low), float(high) + 0.09 * float(right - left)
