"""The paper's figures with our data, for one run or several laid over each other.

Every function takes runs (a :class:`capture_sim.Result` or a recorded run, one or a sequence)
and returns a figure of matplotlib; :func:`capture_sim.viewing.canvas.save_both` saves it.  As in
the paper, lines are solid while the tip touches the cone and dashed while it does not.

Common keywords: ``labels``, one for each run, instead of the scenes' names; ``window``, from
when to when, s on the drawn axis; ``aligned``, time counts from each run's first touch.

Touches of a light tip last a fraction of a millisecond, less than samples lie apart: give runs
through :func:`capture_sim.viewing.resolving.resolved` to see them whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capture_sim.viewing import palette
from capture_sim.viewing.canvas import FONT, SMALL, new_figure, set_fonts
from capture_sim.viewing.cone_drawing import draw_cone, draw_path, frame_cone, label_path
from capture_sim.viewing.series import (
    Shown,
    Trace,
    as_shown,
    common_window,
    draw_line,
    finish_time_axis,
    label_runs,
    trace_colour,
)
from capture_sim.viewing.source import ViewableRun, normal_force_with_peaks

Runs = ViewableRun | Sequence[ViewableRun]
Window = tuple[float, float] | None

_MM = 1e3
_UM = 1e6
_WIDTH, _HEIGHT = 8.0, 4.6  # inches
_MANY = 3  # runs beyond which a legend covers too much of its axes


def intrusion(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window = None,
    aligned: bool = False,
) -> Figure:
    """Draw how deep the tip is in the cone's wall (Figure 6a)."""
    return _over_time(_draw_intrusion, runs, labels, window, aligned, contact=False)


def impact_force(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window = None,
    aligned: bool = False,
) -> Figure:
    """Draw the normal contact force with the located peak of every touch (Figures 5 and 6b)."""
    return _over_time(_draw_force, runs, labels, window, aligned, contact=False)


def axial_performance(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window = None,
    aligned: bool = False,
    traces: Sequence[Trace] = (),
) -> Figure:
    """Draw the stroke of the axial spring (Figures 6c, 8a and 11); traces in m."""
    return _over_time(_draw_stroke, runs, labels, window, aligned, traces=traces)


def torsional_performance(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window = None,
    aligned: bool = False,
    traces: Sequence[Trace] = (),
) -> Figure:
    """Draw the stroke of the torsional spring (Figures 8a and 11); traces in rad."""
    return _over_time(_draw_torsion, runs, labels, window, aligned, traces=traces)


def distance(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window = None,
    aligned: bool = False,
) -> Figure:
    """Draw the distance of the tip's centre to that of BE (Figures 6d and 8b)."""
    return _over_time(_draw_distance, runs, labels, window, aligned)


def trajectory(runs: Runs, *, labels: Sequence[str] | None = None) -> Figure:
    """Draw the way of the tip's centre in the cone (Figures 7 and 8c), all in one cone."""
    shown = as_shown(runs, labels)
    figure = new_figure(7.4, 7.6)
    axes = figure.subplots()
    _draw_trajectory(axes, shown)
    set_fonts([axes])
    return figure


def trajectories(runs: Runs, *, labels: Sequence[str] | None = None) -> Figure:
    """Draw the ways of the tip's centre side by side, each in its own cone (Figure 13)."""
    shown = as_shown(runs, labels)
    figure = new_figure(5.4 * len(shown), 6.2)
    row = figure.subplots(1, len(shown), squeeze=False, sharey=True)[0]
    for axes, one in zip(row, shown, strict=True):
        _draw_trajectory(axes, [one._replace(colour=palette.BLACK)])
        axes.set_title(one.label, fontsize=FONT, fontweight="bold")
        if axes is not row[0]:
            axes.set_ylabel("")
    set_fonts(row)
    return figure


def velocities(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window = None,
    aligned: bool = False,
    traces: Sequence[Trace] = (),
) -> Figure:
    """Draw horizontal, vertical and angular velocities of both vehicles (Figure 10).

    Parameters
    ----------
    runs, labels, window, aligned
        See the module.
    traces
        From another engine; ``values`` (n, 8) or (n, 6): rates of ``q``, or of x, y, theta of
        chaser and target, m/s and rad/s.
    """
    shown = as_shown(runs, labels, aligned=aligned)
    span = common_window(shown, window)
    figure = new_figure(11.0, 8.2)
    rows = figure.subplots(3, 2, sharex=True, sharey="row")
    parts = ("velocity x\n[mm/s]", "velocity y\n[mm/s]", "angular velocity\n[mrad/s]")
    for column, (vehicle, first) in enumerate((("chaser", 0), ("target", 5))):
        rows[0, column].set_title(vehicle, fontsize=FONT, fontweight="bold")
        for row, name in enumerate(parts):
            axes = rows[row, column]
            for i, trace in enumerate(traces):
                index = row + first if trace.values.shape[1] == 8 else row + 3 * column
                _draw_trace(axes, i, trace, trace.values[:, index] * _MM, span)
            for one in shown:
                draw_line(axes, one, one.run.samples["v"][:, first + row] * _MM, span)
            finish_time_axis(axes, shown, span)
            if row < 2:
                axes.set_xlabel("")
            if column == 0:
                axes.set_ylabel(name)
    label_runs(rows[0, 1], shown, traces, outside=True)
    set_fonts(figure.axes)
    return figure


def load_stroke(runs: Runs, *, labels: Sequence[str] | None = None) -> Figure:
    """Draw force over stroke of the axial buffer; the loops' area is what its damper took."""
    shown = as_shown(runs, labels)
    figure = new_figure(7.4, 5.6)
    axes = figure.subplots()
    for one in shown:
        samples = one.run.samples
        axes.plot(
            samples["axial_stroke"] * _MM,
            samples["axial_force"],
            color=one.colour,
            lw=1.5,
            label=f"{one.label}: {samples['dissipated_axial'][-1] * 1e3:.1f} mJ in the damper",
        )
    axes.set_xlabel("axial stroke, compression is negative  [mm]")
    axes.set_ylabel("force of spring and damper  [N]")
    axes.grid(color=palette.LIGHT, lw=0.6)
    # above: inside, the loops are everywhere
    figure.legend(loc="outside upper center", fontsize=SMALL)
    set_fonts([axes])
    return figure


def undamped_results(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window = None,
    aligned: bool = False,
) -> Figure:
    """Draw intrusion, force, axial stroke and distance in one sheet (Figure 6)."""
    panels = (_draw_intrusion, _draw_force, _draw_stroke, _draw_distance)
    return _sheet(panels, runs, labels, window, aligned)


def buffer_results(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window = None,
    aligned: bool = False,
) -> Figure:
    """Draw both strokes, distance and contact force in one sheet (Figures 8 and 11)."""
    panels = (_draw_stroke, _draw_torsion, _draw_distance, _draw_force)
    return _sheet(panels, runs, labels, window, aligned)


_Panel = Callable[[Axes, Sequence[Shown], tuple[float, float]], None]


def _over_time(
    panel: _Panel,
    runs: Runs,
    labels: Sequence[str] | None,
    window: Window,
    aligned: bool,
    *,
    contact: bool = True,
    traces: Sequence[Trace] = (),
) -> Figure:
    """Return a figure of one panel over time."""
    shown = as_shown(runs, labels, aligned=aligned)
    span = common_window(shown, window)
    figure = new_figure(_WIDTH, _HEIGHT)
    axes = figure.subplots()
    for i, trace in enumerate(traces):
        _draw_trace(axes, i, trace, trace.values * _MM, span)  # strokes: mm and mrad
    panel(axes, shown, span)
    finish_time_axis(axes, shown, span)
    if contact or len(shown) > 1:
        label_runs(axes, shown, traces, contact=contact, outside=len(shown) > _MANY)
    set_fonts([axes])
    return figure


def _sheet(
    panels: Sequence[_Panel],
    runs: Runs,
    labels: Sequence[str] | None,
    window: Window,
    aligned: bool,
) -> Figure:
    """Return a figure of four panels over one time."""
    shown = as_shown(runs, labels, aligned=aligned)
    span = common_window(shown, window)
    figure = new_figure(12.5, 8.2)
    grid = figure.subplots(2, 2, sharex=True)
    for letter, axes, panel in zip("abcd", grid.flat, panels, strict=True):
        panel(axes, shown, span)
        finish_time_axis(axes, shown, span)
        axes.set_title(f"({letter})", fontsize=FONT, loc="left")
    for axes in grid[0]:
        axes.set_xlabel("")
    label_runs(grid[1, 0], shown, outside=True)
    set_fonts(figure.axes)
    return figure


def _draw_intrusion(axes: Axes, shown: Sequence[Shown], window: tuple[float, float]) -> None:
    for one in shown:
        samples, touches = one.run.samples, one.run.touches
        # of the walls that are touched: latches hold the tip in their place
        touched = (samples["walls"][:, None] & np.array([1, 2])) != 0
        depth = np.where(touched, samples["penetration"], 0.0).max(axis=1) * _UM
        # zero at the located ends, so that no touch looks longer than it was
        t = np.concatenate([samples["t"], touches["start"], touches["end"]])
        depth = np.concatenate([depth, np.zeros(2 * len(touches))])
        t, first = np.unique(t, return_index=True)
        _plot_inside(axes, t - one.origin, depth[first], window, one.colour)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("intrusion  [µm]")


def _draw_force(axes: Axes, shown: Sequence[Shown], window: tuple[float, float]) -> None:
    for one in shown:
        t, force = normal_force_with_peaks(one.run)
        _plot_inside(axes, t - one.origin, force, window, one.colour)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("normal contact force  [N]")


def _draw_stroke(axes: Axes, shown: Sequence[Shown], window: tuple[float, float]) -> None:
    _rest_line(axes)
    for one in shown:
        draw_line(axes, one, one.run.samples["axial_stroke"] * _MM, window)
        stops = one.run.scene.stops
        for stop in () if stops is None else (-stops.compression, stops.extension):
            axes.axhline(stop * _MM, color=palette.VERMILION, lw=1.2, ls=":")
    axes.set_ylabel("axial stroke  [mm]")


def _draw_torsion(axes: Axes, shown: Sequence[Shown], window: tuple[float, float]) -> None:
    _rest_line(axes)
    for one in shown:
        draw_line(axes, one, one.run.samples["torsion"] * _MM, window)
    axes.set_ylabel("torsion  [mrad]")


def _draw_distance(axes: Axes, shown: Sequence[Shown], window: tuple[float, float]) -> None:
    for radius in sorted({one.run.scene.detector.radius for one in shown}):
        name = f"capture zone, {radius * _MM:g} mm"
        axes.axhspan(0.0, radius * _MM, color=palette.GREEN, alpha=0.2, lw=0, label=name)
    for one in shown:
        draw_line(axes, one, one.run.samples["tip_distance"] * _MM, window)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("tip to the centre of BE  [mm]")


def _draw_trajectory(axes: Axes, shown: Sequence[Shown]) -> None:
    several = len(shown) > 1
    drawn: list[Any] = []
    for one in shown:
        shape = (one.run.scene.cone, one.run.scene.probe.tip_radius)
        if shape not in drawn:
            draw_cone(axes, one.run.scene, coloured=not several)
            drawn.append(shape)
    for one in shown:
        draw_path(axes, one.run, one.colour)
        if several:
            axes.plot([], [], color=one.colour, lw=3.2, label=one.label)
    label_path(axes, palette.GREY if several else shown[0].colour)
    frame_cone(axes, shown[0].run.scene)
    axes.legend(loc="upper right", fontsize=SMALL, framealpha=1.0).set_zorder(10)


def _plot_inside(
    axes: Axes, t: np.ndarray, values: np.ndarray, window: tuple[float, float], colour: str
) -> None:
    inside = (t >= window[0]) & (t <= window[1])
    axes.plot(t[inside], values[inside], color=colour, lw=1.5)


def _draw_trace(
    axes: Axes, i: int, trace: Trace, values: np.ndarray, window: tuple[float, float]
) -> None:
    """Draw a curve from elsewhere as some thirty points, so that the line under it is seen."""
    inside = np.flatnonzero((trace.t >= window[0]) & (trace.t <= window[1]))
    some = inside[:: max(len(inside) // 30, 1)]
    axes.plot(trace.t[some], values[some], "o", ms=5, mfc="none", mew=1.5, color=trace_colour(i))


def _rest_line(axes: Axes) -> None:
    axes.axhline(0.0, color=palette.GREY, lw=0.8)


#: Name of the file and function of each figure.
FIGURES: dict[str, Callable[..., Figure]] = {
    "impact_force": impact_force,
    "intrusion": intrusion,
    "axial_performance": axial_performance,
    "torsional_performance": torsional_performance,
    "distance": distance,
    "trajectory": trajectory,
    "velocities": velocities,
    "load_stroke": load_stroke,
}
#: Those over time, which can be ``aligned``.
OVER_TIME = frozenset(FIGURES) - {"trajectory", "load_stroke"}
