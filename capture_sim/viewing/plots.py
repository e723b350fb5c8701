"""Pictures: one for each experiment, and several experiments side by side, a colour each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capture_sim.samples import EventKind
from capture_sim.viewing import style
from capture_sim.viewing.canvas import grid, new_figure, rows_of_axes, set_fonts
from capture_sim.viewing.drawing import (
    LETTERS,
    draw_bench,
    draw_cone,
    draw_path,
    draw_tip,
    frame_cone,
    key_moments,
    label_path,
)
from capture_sim.viewing.source import (
    ViewableRun,
    contacts,
    decided_at,
    distinct_names,
    headline,
    open_touches,
    start_word,
    strongest,
    time_window,
    verdict,
)

_FONT = 13.5
_COLUMN = 40  # letters of a title that a column of the overview is wide
_SMALLEST_FORCE = 0.05  # N, lower end of the logarithmic axis


def draw_run(run: ViewableRun, label: str | None = None) -> Figure:
    """Return the figure of one run, under its label or its scene's name."""
    title = headline(run, label)
    # titles have y=1.0, or matplotlib measures all ticks to place them
    figure = new_figure(15.5, 10.0, arranged=False)
    figure.suptitle(title, fontsize=19, fontweight="bold", y=0.993)
    top = 0.42 + 0.33 * len(title.splitlines())
    bench, cone = rows_of_axes(figure, (1.05, 6.85), top, [(1.65, 0.95), (6.0, 0.0)])
    several = [(2.5, 0.43), (1.6, 0.43), (1.6, 0.43), (1.6, 0.0)]
    force, stroke, torsion, distance = rows_of_axes(figure, (8.4, 15.38), top, several)
    seen = draw_bench(bench, run)
    bench.set_title(f"From above, {seen}", fontsize=_FONT + 1, y=1.0)
    _draw_trajectory(cone, run, style.BLUE)
    _draw_force(force, run, style.BLUE)
    _draw_buffer(stroke, run, style.STROKE, "Buffer, axial")
    _draw_buffer(torsion, run, style.TORSION, "Buffer, torsion")
    _draw_distance(distance, run, style.BLUE)
    _finish_time_axes(run, force, stroke, torsion, distance)
    set_fonts(figure.axes, _FONT)
    return figure


def draw_overview(runs: Sequence[ViewableRun], labels: Sequence[str] | None = None) -> Figure:
    """Return the figure of several runs side by side, one column each, under their labels.

    These are the scenes' names, numbered where they are the same, unless given.
    """
    if labels is None:
        labels = distinct_names([run.scene.name for run in runs])
    titles = [headline(run, label, _COLUMN) for run, label in zip(runs, labels, strict=True)]
    figure = new_figure(6.0 * len(runs), 14.0, arranged=False)
    top = 0.2 + 0.27 * max(len(title.splitlines()) for title in titles)
    rows = [(1.4, 1.03), (5.0, 0.96), (2.25, 0.43), (1.9, 0.0)]
    sides = [(6.0 * i + 1.05, 6.0 * i + 5.82) for i in range(len(runs))]
    columns = [rows_of_axes(figure, side, top, rows) for side in sides]
    for i, (run, title) in enumerate(zip(runs, titles, strict=True)):
        bench, cone, force, distance = columns[i]
        colour = style.run_colour(i)
        seen = draw_bench(bench, run, colour)
        bench.set_title(title, fontsize=16, fontweight="bold", pad=12, y=1.0)
        dashed = f"dashed: at the {start_word(run.scene)}" if " and " in seen else seen
        bench.set_xlabel(f"x in the world  [m]   ({dashed})")
        _draw_trajectory(cone, run, colour)
        cone.set_title("The tip in the cone", fontsize=_FONT + 1, y=1.0)
        _draw_force(force, run, colour)
        _draw_distance(distance, run, colour, "zone:")
        _finish_time_axes(run, force, distance)
    _give_common_limits([column[0] for column in columns])
    set_fonts(figure.axes, _FONT)
    return figure


def _give_common_limits(row: Sequence[Axes]) -> None:
    """Let axes of one row show the same, so that they are of one size."""
    for get, put in (("get_xlim", "set_xlim"), ("get_ylim", "set_ylim")):
        ends = np.array([getattr(axes, get)() for axes in row])
        for axes in row:
            getattr(axes, put)(ends[:, 0].min(), ends[:, 1].max())


def _draw_trajectory(axes: Axes, run: ViewableRun, colour: str) -> None:
    moments = key_moments(run)
    draw_cone(axes, run.scene)
    draw_path(axes, run, colour)
    label_path(axes, colour)
    draw_tip(axes, run.scene, moments, colour)
    frame_cone(axes, run.scene)
    axes.set_title("The tip in the cone, the chaser comes from the left", fontsize=_FONT + 1, y=1.0)
    axes.legend(loc="upper right", fontsize=_FONT - 1, framealpha=1.0).set_zorder(10)
    axes.text(
        0.985,
        0.015,
        "\n".join(
            f"{letter}  {moment.t:.3f} s  {moment.meaning}"
            for letter, moment in zip(LETTERS, moments, strict=False)
        ),
        transform=axes.transAxes,
        ha="right",
        va="bottom",
        fontsize=_FONT,
        bbox={"facecolor": "white", "edgecolor": style.LIGHT, "pad": 5},
        zorder=10,
    )


def _draw_force(axes: Axes, run: ViewableRun, colour: str) -> None:
    t = run.samples["t"]
    for column, (side, (marker, _, name)) in enumerate(style.WALLS.items()):
        force = run.samples["normal_force"][:, column]
        axes.plot(t, np.where(force > 0.0, force, np.nan), color=colour, lw=1.6)
        touches = run.touches[run.touches["wall"] == side]
        when, peak = touches["peak_time"], touches["peak_force"]
        axes.vlines(when, _SMALLEST_FORCE, peak, color=colour, lw=1.0)
        count = len(touches) + [wall for _, wall in open_touches(run)].count(side)
        label = f"{name}: {count} touches"
        look: dict[str, Any] = {"color": colour, "mfc": colour if side > 0 else "white", "ms": 6}
        axes.plot(when, peak, marker, label=label, **look)
    _, highest = strongest(run)
    axes.set_yscale("log")
    axes.set_ylim(_SMALLEST_FORCE, 20.0 * max(highest, 1.0))
    axes.set_ylabel("normal force\n[N], log scale")
    axes.legend(loc="upper right", fontsize=_FONT - 1.5, ncols=2, framealpha=1.0)
    axes.set_title(
        f"Contact force: up to {highest:.0f} N (markers: peaks)", fontsize=_FONT + 1, y=1.0
    )


def _draw_buffer(axes: Axes, run: ViewableRun, quantity: style.Quantity, title: str) -> None:
    values = quantity.of(run.samples)
    shown = _plot_shown(axes, run, values, style.BLUE)
    axes.axhline(0.0, color=style.GREY, lw=0.8)
    axes.set_ylabel(f"{quantity.label}\n[{quantity.unit}]")
    spread = f"{shown.min():.3g} to {shown.max():.3g} {quantity.unit}"
    axes.set_title(f"{title} ({quantity.sign}): {spread}", fontsize=_FONT + 1, y=1.0)


def _draw_distance(
    axes: Axes, run: ViewableRun, colour: str, zone: str = "green: capture zone,"
) -> None:
    distance = style.DISTANCE.of(run.samples)
    radius = run.scene.detector.capture_radius * style.DISTANCE.factor
    _plot_shown(axes, run, distance, colour)
    axes.axhspan(0.0, radius, color=style.ZONE, alpha=0.25, lw=0)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("distance\n[mm]")
    # within the axes, the zone's name would lie under the curve or the verdict
    nearest = f"Tip to BE: nearest {distance.min():.1f} mm"
    axes.set_title(f"{nearest} ({zone} {radius:g} mm)", fontsize=_FONT + 1, y=1.0)
    start, end = time_window(run)
    for event in run.events:
        if event.kind is EventKind.LATCHED and start <= event.t <= end:
            _mark(axes, run, event.t, "latched", style.GREY, 0.95)
    decided = decided_at(run)
    # of a run that is cut, it may lie outside
    if decided is not None and start <= decided <= end:
        look = style.VERDICTS.get(run.statuses[-1].state)
        _mark(axes, run, decided, verdict(run), look.colour if look else style.BLACK, 0.72)


def _plot_shown(axes: Axes, run: ViewableRun, values: np.ndarray, colour: str) -> np.ndarray:
    """Plot and return what lies in the window of time, so that the axis fits it."""
    t = run.samples["t"]
    start, end = time_window(run)
    shown = (t >= start) & (t <= end)
    axes.plot(t[shown], values[shown], color=colour, lw=1.7)
    return np.asarray(values[shown])


def _mark(axes: Axes, run: ViewableRun, t: float, text: str, colour: str, height: float) -> None:
    """Mark an instant; the text stands left of it, or right where it would leave the axes."""
    start, end = time_window(run)
    side = -1 if t - start > 0.3 * (end - start) else 1
    axes.axvline(t, color=colour, lw=2.0)
    axes.annotate(
        text,
        (t, height),
        xycoords=axes.get_xaxis_transform(),
        xytext=(7 * side, 0),
        textcoords="offset points",
        ha="right" if side < 0 else "left",
        va="top",
        fontsize=_FONT,
        fontweight="bold",
        color=colour,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.9, "pad": 1},
    )


def _finish_time_axes(run: ViewableRun, *all_axes: Axes) -> None:
    touching = [(start, end - start) for start, end in contacts(run)]
    for axes in all_axes:
        axes.broken_barh(
            touching,
            (0.0, 1.0),
            transform=axes.get_xaxis_transform(),
            facecolor=style.CONTACT,
            edgecolor=style.CONTACT,  # so that the shortest touch is a visible line
            lw=0.6,
            alpha=0.4,
            zorder=0,
        )
        axes.set_xlim(time_window(run))
        axes.tick_params(labelbottom=axes is all_axes[-1])
        grid(axes)
    all_axes[-1].set_xlabel(f"time since the {start_word(run.scene)}  [s]   (shaded: in contact)")
