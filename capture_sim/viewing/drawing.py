"""Parts of plots of runs: the cone with the tip's path in it, and quantities over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from capture_sim.scene.parts import Scene
from capture_sim.viewing import style
from capture_sim.viewing.canvas import draw_shapes
from capture_sim.viewing.curves import (
    PlottedRun,
    Quantity,
    Window,
    are_many,
    envelope,
    held_by,
    highest_touches,
    marked_points,
    path_length,
    split,
)
from capture_sim.viewing.shapes import (
    ARC_POINTS,
    cone_shapes,
    tip_bound,
    tip_in_cone,
    wall,
    wall_name_place,
)

_MM = 1e3  # in a metre: drawings are in mm
_PATH, CURVE = 3.2, 2.1  # widths in contact, points


def draw_trajectory(axes: Axes, shown: Sequence[PlottedRun]) -> None:
    """Draw the cone and the paths of the tip's centre of all runs in the cone's frame, mm.

    If the runs' cones, tip radii or capture radii differ, each combination is drawn once.  The
    drawn range is that of the first run's cone.
    """
    scenes = [plotted.scene for plotted in shown]
    drawn = {(s.cone, s.probe.tip_radius, s.detector.capture_radius): s for s in scenes}
    for scene in drawn.values():
        _draw_cone(axes, scene)
    (_draw_thin_paths if are_many(shown) else _draw_paths)(axes, shown)
    across, upwards = frame_bounds(scenes[0])
    axes.set(aspect="equal", xlim=across, ylim=upwards)
    axes.set_xlabel("x in the cone's frame, from BE  [mm]")
    axes.set_ylabel("y in the cone's frame  [mm]")
    axes.legend(loc="upper right", fontsize=style.SMALL, framealpha=1.0).set_zorder(10)


def draw_end(axes: Axes, plotted: PlottedRun) -> None:
    """Mark the tip's centre at the run's last drawn sample, with the time, s since the release.

    If it is then within three capture radii of the centre of BE, the mark is in an enlarged drawing
    of the surroundings of BE, which is added in the lower right corner.  Otherwise it is in
    ``axes`` (those of :func:`draw_trajectory`).  Nothing is drawn if the tip's centre is neither
    near BE nor in the drawn range.
    """
    path = tip_in_cone(plotted.samples) * _MM
    zone = plotted.scene.detector.capture_radius * _MM
    near = bool(np.hypot(*path[-1]) < 3.0 * zone)
    if not near and not _in_frame(plotted.scene, path)[-1]:
        return
    text = f"end, {plotted.samples['t'][-1]:.3g} s"
    look: dict[str, Any] = {"marker": "o", "ms": 8, "color": plotted.colour, "mec": style.BLACK}
    if near:
        axes = _draw_enlarged(axes, plotted, path[-1])
        axes.plot(0.08, 0.08, transform=axes.transAxes, **look)
        axes.text(0.15, 0.08, text, transform=axes.transAxes, va="center", fontsize=style.SMALL)
    else:
        side = 1 if path[-1, 1] > 0.0 else -1  # away from the axis, where no path is
        place: dict[str, Any] = {"textcoords": "offset points", "va": "center", "ha": "center"}
        axes.annotate(text, tuple(path[-1]), (0, 15 * side), fontsize=style.SMALL, **place)
    axes.plot(*path[-1], zorder=8, **look)


def _draw_enlarged(axes: Axes, plotted: PlottedRun, end: np.ndarray) -> Axes:
    """Draw the surroundings of BE once more, enlarged, in the lower right corner of ``axes``.

    ``end``, (2,), mm, is a place of the tip's centre that it must contain.  The result is the axes
    of the enlarged drawing.
    """
    right, low = frame_bounds(plotted.scene)[0][1], frame_bounds(plotted.scene)[1][0]
    side = 0.7 * right
    corner = (right - side - 3.0, low + 3.0, side, side)
    close = axes.inset_axes(corner, transform=axes.transData)
    draw_shapes(close, cone_shapes(plotted.scene).values(), _MM)
    close.plot(0, 0, marker="+", ms=10, mew=1.8, color=style.ZONE, zorder=4)
    draw_path(close, plotted.scene, plotted.samples, plotted.holds, plotted.colour)
    zone = plotted.scene.detector.capture_radius * _MM
    size, edge = 4.4 * zone, 0.4 * zone
    # moved where the end would be outside of it
    x, y = np.clip((-3.2 * zone, -2.2 * zone), end + edge - size, end - edge)
    close.set(xlim=(x, x + size), ylim=(y, y + size), xticks=[], yticks=[])
    close.set_title("near BE, enlarged", fontsize=style.SMALL)
    axes.indicate_inset_zoom(close, edgecolor=style.GREY)
    return close


def _draw_paths(axes: Axes, shown: Sequence[PlottedRun]) -> None:
    several = len(shown) > 1
    for number, plotted in enumerate(shown):
        draw_path(axes, plotted.scene, plotted.samples, plotted.holds, plotted.colour)
        if several:
            path = tip_in_cone(plotted.samples) * _MM
            path = path[_in_frame(plotted.scene, path)]
            draw_markers(axes, plotted, path, path_length(path), number, len(shown))
            axes.plot([], [], label=plotted.label, **run_look(plotted, _PATH))
    colour = style.GREY if several else shown[0].colour
    for name in held_by(shown):
        axes.plot([], [], color=colour, label=f"tip's centre, {name}", **line_look(name, _PATH))


def _draw_thin_paths(axes: Axes, shown: Sequence[PlottedRun]) -> None:
    """Draw the paths of many runs as thin lines of one colour, with one entry in the legend."""
    for plotted in shown:
        path = tip_in_cone(plotted.samples) * _MM
        path = path[_in_frame(plotted.scene, path, margin=50.0)]
        axes.plot(*path.T, color=style.BLUE, lw=0.8, alpha=0.4, zorder=5)
    axes.plot([], [], color=style.BLUE, lw=0.8, label=f"tip's centre, {len(shown)} runs")


def _draw_cone(axes: Axes, scene: Scene) -> None:
    """Draw walls, limit of the tip's centre and capture zone, with their names, and BE's centre."""
    draw_shapes(axes, cone_shapes(scene).values(), _MM)
    axes.plot(0, 0, marker="+", ms=10, mew=1.8, color=style.ZONE, zorder=4)
    outside = max(scene.detector.capture_radius, scene.probe.tip_radius) * _MM
    beside: dict[str, Any] = {"textcoords": "offset points", "fontsize": style.SMALL}
    axes.annotate(
        "capture zone",
        (outside, 0.0),
        (3, 0),
        color=style.ZONE,
        va="center",
        clip_on=True,
        **beside,
    )
    # between the limit and the wall, where no path is
    limit = tip_bound(scene.cone, scene.probe.tip_radius, 1)[ARC_POINTS - 1 : ARC_POINTS + 1]
    x, y = np.concatenate([limit, wall(scene.cone, 1)]).mean(axis=0) * _MM
    axes.text(
        x,
        y,
        "limit of the tip's centre",
        color=style.GREY,
        fontsize=style.SMALL - 0.5,
        rotation=-np.rad2deg(scene.cone.half_angle),
        rotation_mode="anchor",
        ha="center",
        va="center",
    )
    for side, (*_, name) in style.WALLS.items():
        x, y = wall_name_place(scene.cone, side) * _MM
        axes.text(
            x,
            y,
            name,
            color=style.DARK,
            fontsize=13,
            fontweight="bold",
            rotation=-side * np.rad2deg(scene.cone.half_angle),
            rotation_mode="anchor",
            ha="center",
            va="center",
        )


def draw_path(
    axes: Axes, scene: Scene, samples: np.ndarray, holds: np.ndarray, colour: str
) -> None:
    """Draw the path of the tip's centre in the cone's frame, mm, from samples (n,).

    The style of the line shows what holds the tip: ``holds`` (n,) are indices of
    :data:`capture_sim.viewing.curves.HOLDS`.
    """
    path = tip_in_cone(samples) * _MM
    near = _in_frame(scene, path, margin=50.0)  # beyond, no line is needed
    for name, part in split(path[near], holds[near]).items():
        axes.plot(*part.T, color=colour, zorder=5, **line_look(name, _PATH))


def _in_frame(scene: Scene, path: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Return for each point of a path whether it is in the drawn range, enlarged by a margin.

    ``path`` (n, 2) is in the cone's frame, mm, and ``margin`` in mm.  The result is (n,) bool.
    """
    (left, right), (low, high) = frame_bounds(scene)
    inside = (path > (left - margin, low - margin)).all(axis=1)
    return np.asarray(inside & (path < (right + margin, high + margin)).all(axis=1))


def draw_markers(
    axes: Axes, plotted: PlottedRun, curve: np.ndarray, length: np.ndarray, number: int, count: int
) -> None:
    """Draw the marker of run ``number`` of ``count`` runs at some points of the run's curve.

    ``curve`` has points (n, 2) in the units of the axes; ``length`` is the time or length of the
    curve up to each point, (n,).  ``number`` counts from 0.  Nothing is drawn if the run has no
    marker, or if it is the only run.
    """
    if plotted.marker is None or count == 1:
        return
    some = marked_points(length, number, count)
    look = run_look(plotted) | {"ls": "", "zorder": 6}
    axes.plot(*curve[some].T, **look)


def run_look(plotted: PlottedRun, width: float = CURVE) -> dict[str, Any]:
    """Return matplotlib's arguments for a line or an entry of a legend that stands for a run.

    They set the run's colour, its marker if it has one, and ``width``, of the line, points.
    """
    look: dict[str, Any] = {"color": plotted.colour, "lw": width}
    if plotted.marker is not None:
        look |= {"marker": plotted.marker, "ms": 9.0, "mec": "white", "mew": 0.5}
    return look


def line_look(name: str, width: float = CURVE) -> dict[str, Any]:
    """Return matplotlib's arguments for the line style of a name in :data:`.curves.HOLDS`.

    ``width`` is the width of a line in contact, points; the other styles are thinner.
    """
    line = style.LINES[name]
    cap = {"solid_capstyle": "butt"} if line.dashes == "solid" else {}
    return {"ls": line.dashes, "lw": width * line.width, **cap}


def frame_bounds(scene: Scene) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the drawn range of x and of y in plots of the cone, mm, in the cone's frame.

    It contains the cone and a margin for the tip; behind BE it contains space for legends.
    """
    lip = wall(scene.cone, 1)[1] * _MM
    margin = scene.probe.tip_radius * _MM + 4.0
    top = float(lip[1] + 0.6 * margin)
    # room for legends behind BE, where nothing else is
    return (float(lip[0] - 1.5 * margin), float(lip[1] + 0.1 * margin)), (-top, top)


def draw_quantity(
    axes: Axes, quantity: Quantity, shown: Sequence[PlottedRun], window: Window
) -> None:
    """Draw a quantity of runs over time with its limits, and label the axis of its values.

    ``window`` is in seconds on the time axis.  What lies outside it is not drawn, so that the axis
    of the values fits what lies inside.  More than ten runs are drawn as an envelope.
    """
    limits = {limit for plotted in shown for limit in quantity.limits(plotted.scene)}
    for limit in sorted(limits, key=lambda limit: limit.value):
        if quantity.from_zero:
            axes.axhspan(0.0, limit.value, color=limit.colour, alpha=0.2, lw=0)
        else:
            axes.axhline(limit.value, color=limit.colour, lw=1.6, ls=":")
        # on the left, where the tip is still far from BE; within the axes
        above = quantity.from_zero or limit.value < 0.0
        axes.annotate(
            f"{limit.name}, {limit.value:g} {quantity.unit}",
            (0.01, limit.value),
            (0, 2 if above else -2),
            xycoords=axes.get_yaxis_transform(),
            textcoords="offset points",
            color=style.DARK if limit.colour == style.GREY else limit.colour,
            fontsize=style.SMALL - 1.5,
            va="bottom" if above else "top",
            clip_on=True,
        )
    if quantity.sign:
        axes.axhline(0.0, color=style.GREY, lw=0.8)
    if are_many(shown):
        _draw_envelope(axes, quantity, shown, window)
    else:
        for number, plotted in enumerate(shown):
            _draw_curve(axes, quantity, plotted, window, number, len(shown))
    if quantity.from_zero:
        axes.set_ylim(bottom=0.0)
    axes.set_ylabel(quantity.axis)


def _draw_curve(
    axes: Axes, quantity: Quantity, plotted: PlottedRun, window: Window, number: int, count: int
) -> None:
    """Draw a quantity of run ``number`` of ``count``, with the run's marker if it has one."""
    t, values = plotted.curve(quantity)
    inside = (t - plotted.origin >= window[0]) & (t - plotted.origin <= window[1])
    t, values = t[inside] - plotted.origin, values[inside]
    if quantity.located is None:
        for name, part in split(values, plotted.holds[inside]).items():
            axes.plot(t, part, color=plotted.colour, **line_look(name))
        draw_markers(axes, plotted, np.stack([t, values], axis=-1), t, number, count)
        return
    axes.plot(t, values, color=plotted.colour, lw=1.5)
    if plotted.marker is not None and count > 1:
        some = highest_touches(t, values, plotted)
        axes.plot(t[some], values[some], **run_look(plotted) | {"ls": "", "zorder": 6})


def _draw_envelope(
    axes: Axes, quantity: Quantity, shown: Sequence[PlottedRun], window: Window
) -> None:
    """Draw the range of a quantity over many runs, of their middle half, and their median."""
    t, bounds = envelope(quantity, shown, window)
    least, first_quartile, median, third_quartile, greatest = bounds.T
    look: dict[str, Any] = {"color": style.BLUE, "lw": 0}
    axes.fill_between(t, least, greatest, alpha=0.2, label=f"range of {len(shown)} runs", **look)
    label = "middle half of the runs"
    axes.fill_between(t, first_quartile, third_quartile, alpha=0.35, label=label, **look)
    axes.plot(t, median, color=style.BLUE, lw=1.5, label="median")
