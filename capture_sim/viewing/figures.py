"""The paper's figures with our data, for one run or several laid over each other.

Every function takes runs (a :class:`capture_sim.Result` or a recorded run, one or a sequence)
and returns a figure of matplotlib; :func:`capture_sim.viewing.canvas.save` saves it.

Common keywords: ``labels``, one for each run, instead of the scenes' names; ``window``, from
when to when, s on the drawn axis; ``aligned``, time counts from each run's first touch;
``traces``, curves from elsewhere in SI units.

Touches of a light tip last a fraction of a millisecond, less than samples lie apart: give runs
through :func:`capture_sim.viewing.source.resolved` to see them whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D

from capture_sim.viewing import style
from capture_sim.viewing.canvas import draw_shapes, grid, new_figure, set_fonts
from capture_sim.viewing.curves import (
    PANELS,
    Runs,
    Shown,
    Trace,
    Window,
    as_shown,
    common_window,
    split,
    time_label,
)
from capture_sim.viewing.drawing import draw_cone, draw_path, frame_cone, label_path
from capture_sim.viewing.shapes import (
    CHASER,
    TARGET,
    chaser_box,
    placed,
    state_shapes,
    target_box,
    tip_in_world,
)
from capture_sim.viewing.source import ViewableRun, first_touch, start_word, time_window

_MM = 1e3
_MANY = 3  # runs beyond which a legend covers too much of its axes
_ENTRY = 2.3  # inches, about the width of an entry of a legend
_TRACES = (style.BLACK, style.BROWN, style.GREY)
_MARGIN = 0.02  # m, round the vehicles
_PANEL = 5.4  # inches, width of a picture of a strip


def over_time(
    panel: str,
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window | None = None,
    aligned: bool = False,
    traces: Sequence[Trace] = (),
) -> Figure:
    """Draw one of :data:`capture_sim.viewing.curves.PANELS`."""
    shown = as_shown(runs, labels, aligned=aligned)
    span = common_window(shown, window)
    figure = new_figure(8.0, 4.6)
    axes = figure.subplots()
    _draw_panel(axes, panel, shown, span)
    for i, trace in enumerate(traces):
        _draw_trace(axes, i, trace, trace.values * PANELS[panel].factor, span)
    _finish_time_axis(axes, shown, span)
    contact = PANELS[panel].sampled
    if contact or len(shown) > 1:
        _label_runs(axes, shown, traces, contact=contact, outside=len(shown) > _MANY)
    set_fonts([axes])
    return figure


intrusion = partial(over_time, "intrusion")  #: Figure 6a
impact_force = partial(over_time, "impact_force")  #: Figures 5 and 6b
axial_performance = partial(over_time, "axial_performance")  #: Figures 6c, 8a and 11
torsional_performance = partial(over_time, "torsional_performance")  #: Figures 8a and 11
distance = partial(over_time, "distance")  #: Figures 6d and 8b


def sheet(
    panels: Sequence[str],
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window | None = None,
    aligned: bool = False,
) -> Figure:
    """Draw four panels over one time."""
    shown = as_shown(runs, labels, aligned=aligned)
    span = common_window(shown, window)
    figure = new_figure(12.5, 8.2)
    axes_grid = figure.subplots(2, 2, sharex=True)
    for letter, axes, panel in zip("abcd", axes_grid.flat, panels, strict=True):
        _draw_panel(axes, panel, shown, span)
        _finish_time_axis(axes, shown, span)
        axes.set_title(f"({letter})", fontsize=style.FONT, loc="left")
    for axes in axes_grid[0]:
        axes.set_xlabel("")
    _label_runs(axes_grid[1, 0], shown, outside=True)
    set_fonts(figure.axes)
    return figure


#: Figure 6
undamped_results = partial(sheet, ("intrusion", "impact_force", "axial_performance", "distance"))
#: Figures 8 and 11
buffer_results = partial(
    sheet, ("axial_performance", "torsional_performance", "distance", "impact_force")
)


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
        _draw_trajectory(axes, [one])
        axes.set_title(one.label, fontsize=style.FONT, fontweight="bold")
        if axes is not row[0]:
            axes.set_ylabel("")
    set_fonts(row)
    return figure


def velocities(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window | None = None,
    aligned: bool = False,
    traces: Sequence[Trace] = (),
) -> Figure:
    """Draw horizontal, vertical and angular velocities of both vehicles (Figure 10).

    ``values`` of the traces are (n, 8) or (n, 6): rates of ``q``, or of x, y, theta of chaser
    and target, m/s and rad/s.
    """
    shown = as_shown(runs, labels, aligned=aligned)
    span = common_window(shown, window)
    figure = new_figure(11.0, 8.2)
    rows = figure.subplots(3, 2, sharex=True, sharey="row")
    parts = ("velocity x\n[mm/s]", "velocity y\n[mm/s]", "angular velocity\n[mrad/s]")
    for column, (vehicle, first) in enumerate((("chaser", 0), ("target", 5))):
        rows[0, column].set_title(vehicle, fontsize=style.FONT, fontweight="bold")
        for row, name in enumerate(parts):
            axes = rows[row, column]
            for one in shown:
                _draw_line(axes, one, one.run.samples["v"][:, first + row] * _MM, span)
            for i, trace in enumerate(traces):
                index = row + first if trace.values.shape[1] == 8 else row + 3 * column
                _draw_trace(axes, i, trace, trace.values[:, index] * _MM, span)
            _finish_time_axis(axes, shown, span)
            if row < 2:
                axes.set_xlabel("")
            if column == 0:
                axes.set_ylabel(name)
    _label_runs(rows[0, 1], shown, traces, outside=True)
    set_fonts(figure.axes)
    return figure


def load_stroke(runs: Runs, *, labels: Sequence[str] | None = None) -> Figure:
    """Draw force over stroke of the axial buffer; the loops' area is what its damper took."""
    shown = as_shown(runs, labels)
    figure = new_figure(7.4, 5.6)
    axes = figure.subplots()
    for one in shown:
        samples = one.run.samples
        taken = samples["dissipated_axial"][-1] * 1e3
        axes.plot(
            style.STROKE.of(samples),
            samples["axial_force"],
            color=one.colour,
            lw=1.5,
            label=f"{one.label}: {taken:.1f} mJ in the damper",
        )
    axes.set_xlabel(style.STROKE.axis)
    axes.set_ylabel("force of spring and damper  [N]")
    grid(axes)
    # above: inside, the loops are everywhere
    figure.legend(loc="outside upper center", fontsize=style.SMALL)
    set_fonts([axes])
    return figure


def snapshots(
    runs: Runs,
    *,
    times: Sequence[float] | None = None,
    count: int = 6,
    labels: Sequence[str] | None = None,
    first: int = 0,
) -> Figure:
    """Draw a run as a strip of pictures from above, or several as strips side by side.

    As the paper's Figures 12 and 15 to 17.

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
    first
        Number of the first run among others, for its colour.
    """
    shown = [
        one._replace(colour=style.run_colour(first + i))
        for i, one in enumerate(as_shown(runs, labels))
    ]
    instants = [
        np.asarray(times, float) if times is not None else snapshot_times(one.run, count)
        for one in shown
    ]
    (left, low), (right, high) = _frame([one.run for one in shown], instants)
    # a single strip is laid in two columns, read line by line
    columns, rows = len(shown), max(map(len, instants))
    if len(shown) == 1:
        columns, rows = 2, -(-rows // 2)
    panel = _PANEL * (high - low) / (right - left) + 0.12
    figure = new_figure((_PANEL + 0.75) * columns, rows * panel + 1.5)
    axes_grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    strips = [axes_grid.ravel()] if len(shown) == 1 else list(axes_grid.T)
    for strip, one, when in zip(strips, shown, instants, strict=True):
        for axes in strip[len(when) :]:
            axes.set_axis_off()
        for i, (axes, t) in enumerate(zip(strip, when, strict=False)):
            _draw_instant(axes, one, float(t), chr(ord("a") + i))
            axes.set(xlim=(left, right), ylim=(low, high))
        if len(shown) > 1:
            strip[0].set_title(one.label, fontsize=style.FONT + 1, fontweight="bold")
    if len(shown) == 1:
        figure.suptitle(shown[0].label, fontsize=style.FONT + 1, fontweight="bold")
    for axes in axes_grid[-1]:
        axes.set_xlabel("x in the world  [m]")
    for axes in axes_grid[:, 0]:
        axes.set_ylabel("y  [m]")
    key: Any = Line2D([], [], color=style.DARK, lw=3.0), tuple(map(_way_line, shown))
    figure.legend(
        key,
        ["walls of the cone", "way of the tip's centre"],
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0.0)},
        loc="outside lower center",
        ncols=2,
        fontsize=style.SMALL,
    )
    set_fonts(figure.axes)
    return figure


def snapshot_times(run: ViewableRun, count: int) -> np.ndarray:
    """Return times worth a picture, (count,), s: start, first touch, evenly to the verdict."""
    start, end = float(run.samples["t"][0]), time_window(run)[1]
    touch = first_touch(run)
    if touch is None or touch.t - start < 0.02:
        return np.linspace(start, end, count)
    return np.concatenate([[start], np.linspace(touch.t, end, count - 1)])


def state_at(run: ViewableRun, t: float) -> np.ndarray:
    """Return the coordinates at a time between the samples, (8,)."""
    samples = run.samples
    return np.array([np.interp(t, samples["t"], samples["q"][:, i]) for i in range(8)])


def _draw_instant(axes: Axes, one: Shown, t: float, letter: str) -> None:
    run = one.run
    touch = first_touch(run)
    meaning = "first touch" if touch is not None and t == touch.t else ""
    if t == run.samples["t"][0]:
        meaning = start_word(run.scene)
    draw_shapes(axes, state_shapes(run.scene, state_at(run, t), one.colour))
    way = tip_in_world(run.scene, run.samples["q"][run.samples["t"] <= t][::5])
    axes.add_line(_way_line(one, way))
    axes.set_aspect("equal")
    axes.text(
        0.012,
        0.975,
        f"({letter})  {t:.3f} s {meaning}".rstrip(),
        transform=axes.transAxes,
        ha="left",
        va="top",
        fontsize=style.SMALL,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        zorder=9,
    )


def _way_line(one: Shown, way: np.ndarray | None = None) -> Line2D:
    """Return the tip's way, (n, 2), m, as a line over the bodies; without one for a legend."""
    x, y = ([], []) if way is None else way.T
    return Line2D(x, y, color=one.colour, lw=1.8, zorder=2.5)


def _frame(
    runs: Sequence[ViewableRun], instants: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower left and upper right corner of what is seen at these times, m."""
    corners = []
    for run, times in zip(runs, instants, strict=True):
        for t in times:
            q = state_at(run, float(t))
            corners.append(placed(chaser_box(run.scene).corners, *q[list(CHASER)]))
            corners.append(placed(target_box(run.scene).corners, *q[list(TARGET)]))
    points = np.concatenate(corners)
    low, high = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
    high[1] += 0.09 * (high - low)[0]  # room for the caption
    return low, high


def _draw_panel(axes: Axes, name: str, shown: Sequence[Shown], window: Window) -> None:
    panel = PANELS[name]
    if name == "distance":
        for radius in sorted({one.run.scene.detector.capture_radius for one in shown}):
            label = f"capture zone, {radius * _MM:g} mm"
            axes.axhspan(0.0, radius * _MM, color=style.ZONE, alpha=0.2, lw=0, label=label)
    if panel.sampled and not panel.from_zero:
        axes.axhline(0.0, color=style.GREY, lw=0.8)
    for one in shown:
        t, values = panel.curve(one.run)
        if panel.sampled:
            _draw_line(axes, one, values, window)
        else:
            inside = (t - one.origin >= window[0]) & (t - one.origin <= window[1])
            axes.plot(t[inside] - one.origin, values[inside], color=one.colour, lw=1.5)
        stops = one.run.scene.stops if name == "axial_performance" else None
        for stop in () if stops is None else (-stops.compression, stops.extension):
            axes.axhline(stop * _MM, color=style.BLACK, lw=1.2, ls=":")
    if panel.from_zero:
        axes.set_ylim(bottom=0.0)
    axes.set_ylabel(panel.axis)


def _draw_line(axes: Axes, one: Shown, values: np.ndarray, window: Window) -> None:
    """Draw values of the samples, (n,), that lie in the window, so that the axis fits them."""
    t = one.time
    inside = (t >= window[0]) & (t <= window[1])
    touch, free = split(values[inside], one.touching[inside])
    axes.plot(t[inside], free, color=one.colour, lw=1.4, ls=style.FREE_LINE)
    axes.plot(t[inside], touch, color=one.colour, lw=2.1, solid_capstyle="butt")


def _draw_trace(axes: Axes, i: int, trace: Trace, values: np.ndarray, window: Window) -> None:
    """Draw a curve from elsewhere as thirty points, so that the line under it is seen."""
    evenly = np.searchsorted(trace.t, np.linspace(*window, 30))
    some = np.unique(evenly[evenly < len(trace.t)])
    axes.plot(trace.t[some], values[some], **_trace_look(i))


def _trace_look(i: int) -> dict[str, Any]:
    """Return how the i-th curve from elsewhere is drawn, in the axes as in the legend."""
    return {
        "marker": "o",
        "ls": "",
        "ms": 5,
        "mfc": "none",
        "mew": 1.5,
        "color": _TRACES[i % len(_TRACES)],
        "zorder": 3,
    }


def _draw_trajectory(axes: Axes, shown: Sequence[Shown]) -> None:
    several = len(shown) > 1
    drawn: list[Any] = []
    for one in shown:
        shape = (one.run.scene.cone, one.run.scene.probe.tip_radius)
        if shape not in drawn:
            draw_cone(axes, one.run.scene)
            drawn.append(shape)
    for one in shown:
        draw_path(axes, one.run, one.colour)
        if several:
            axes.plot([], [], color=one.colour, lw=3.2, label=one.label)
    label_path(axes, style.GREY if several else shown[0].colour)
    frame_cone(axes, shown[0].run.scene)
    axes.legend(loc="upper right", fontsize=style.SMALL, framealpha=1.0).set_zorder(10)


def _label_runs(
    axes: Axes,
    shown: Sequence[Shown],
    traces: Sequence[Trace] = (),
    *,
    contact: bool = True,
    outside: bool = False,
) -> None:
    """Explain colours and dashes in a legend, in the axes or, of all axes, above the figure."""
    if len(shown) > 1:
        for one in shown:
            axes.plot([], [], color=one.colour, lw=2.6, label=one.label)
    tone = shown[0].colour if len(shown) == 1 else style.GREY
    if contact:
        axes.plot([], [], color=tone, lw=2.1, label="in contact")
        axes.plot([], [], color=tone, lw=1.4, ls=style.FREE_LINE, label="free")
    for i, trace in enumerate(traces):
        axes.plot([], [], label=trace.label, **_trace_look(i))
    figure = axes.get_figure(root=True)
    if outside and figure is not None:
        found = dict[str, Artist]()
        for each in figure.axes:
            handles, names = each.get_legend_handles_labels()
            found.update(zip(names, handles, strict=True))
        columns = max(min(len(found), int(figure.get_figwidth() // _ENTRY)), 1)
        figure.legend(
            list(found.values()),
            list(found),
            loc="outside upper center",
            ncols=columns,
            fontsize=style.SMALL,
        )
    else:
        axes.legend(fontsize=style.SMALL, framealpha=0.9, loc="best", handlelength=2.2)


def _finish_time_axis(axes: Axes, shown: Sequence[Shown], window: Window) -> None:
    """Set limits, grid and the label of the time axis; a touch at its start is off the frame."""
    length = window[1] - window[0]
    axes.set_xlim(window[0] - 0.01 * length, window[1])
    if length < 0.01:  # long numbers
        axes.locator_params(axis="x", nbins=5)
    grid(axes)
    axes.set_xlabel(f"{time_label(shown)}  [s]")


#: Name of the file and function of each figure.
FIGURES: dict[str, Callable[..., Figure]] = {
    **{name: partial(over_time, name) for name in PANELS},
    "trajectory": trajectory,
    "velocities": velocities,
    "load_stroke": load_stroke,
}
#: Those over time, which can be ``aligned``.
OVER_TIME = frozenset(FIGURES) - {"trajectory", "load_stroke"}
