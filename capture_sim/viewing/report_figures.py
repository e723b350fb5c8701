"""Figures of the report, for plotly: they can be zoomed and show values under the pointer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from plotly.subplots import make_subplots

from capture_sim.viewing import style
from capture_sim.viewing.curves import (
    FORCE,
    PANELS,
    PENETRATION,
    STROKE,
    VELOCITIES,
    PlottedRun,
    Quantity,
    common_window,
    energy_layers,
    marked_points,
    split,
    time_label,
)
from capture_sim.viewing.shapes import cone_shapes, tip_in_cone
from capture_sim.viewing.source import resolved_or_not

#: Deviation of a curve that its omitted points may cause, as a share of the axis.
_TOLERANCE = 7e-4


class Drawn(NamedTuple):
    """A figure of the page: its element's name, caption, kind, and plotly's JSON."""

    name: str
    caption: str
    kind: str  # class of the page that gives it its size
    data: Markup


def drawn(figure: go.Figure, name: str, caption: str, kind: str = "half") -> Drawn:
    """Return a figure for the page, which names the runs' colours itself."""
    figure.update_layout(
        template="none",
        margin={"l": 62, "r": 12, "t": 30, "b": 46},
        showlegend=False,
        hoverlabel={"namelength": -1},
    )
    # within a script, nothing may end it
    return Drawn(name, caption, kind, Markup(figure.to_json().replace("</", "<\\/")))


def over_time(name: str, shown: Sequence[PlottedRun]) -> Drawn:
    """Draw one of :data:`capture_sim.viewing.curves.PANELS`."""
    quantity = PANELS[name]
    if quantity is PENETRATION:
        shown = [plotted._replace(run=resolved_or_not(plotted.run)) for plotted in shown]
    figure = make_subplots()
    _add_over_time(figure, [quantity], shown)
    if quantity is FORCE:
        for plotted in shown:
            for side, (_, marker, wall) in {**style.WALLS, 0: style.NO_WALL}.items():
                touches = plotted.run.touches[plotted.run.touches["wall"] == side]
                figure.add_scatter(
                    x=touches["peak_time"] - plotted.origin,
                    y=touches["peak_force"],
                    mode="markers",
                    marker={"symbol": marker, "color": plotted.colour, "size": 7},
                    name=f"{plotted.label}, {wall}",
                    legendgroup=plotted.label,
                )
    return drawn(figure, name, quantity.title)


def trajectory(plotted: PlottedRun, number: int) -> Drawn:
    """Draw the path of a run's tip's centre in its cone."""
    figure = go.Figure()
    for name, shape in cone_shapes(plotted.run.scene).items():
        look: dict[str, Any] = {"name": name, "hoverinfo": "name"}
        if shape.fill:
            look |= {"fill": "toself", "fillcolor": shape.fill}
        dash = "dot" if shape.dashed else "solid"
        line = (shape.line or shape.fill, dash, shape.width)
        _add_line(figure, shape.points.T * 1e3, line, **look)
    path = tip_in_cone(plotted.run.samples) * 1e3
    near = np.abs(path).max(axis=1) < 150.0
    t = plotted.run.samples["t"][near]
    for word, part in split(path[near], plotted.holds[near]).items():
        x, y, at = simplified(part[:, 0], part[:, 1], (120.0, 160.0), t)
        line_style = style.LINES[word]
        look = {
            "customdata": at,
            "hovertemplate": "%{x:.2f}, %{y:.2f} mm at %{customdata:.3f} s",
            "name": f"{plotted.label}, {word}",
        }
        line = (plotted.colour, line_style.plotly, 3.5 * line_style.width)
        _add_line(figure, (x, y), line, **look)
    figure.update_yaxes(range=(-80, 80), scaleanchor="x", title="y  [mm]")
    figure.update_xaxes(range=(-90, 30), title="x from BE  [mm]")
    return drawn(figure, f"trajectory-{number}", f"{plotted.label}: path of the tip", "third")


def load_stroke(shown: Sequence[PlottedRun]) -> Drawn:
    """Draw force over stroke of the axial buffer."""
    figure = go.Figure()
    for number, plotted in enumerate(shown):
        stroke, force = STROKE.of(plotted.run.samples), plotted.run.samples["axial_force"]
        extent = float(np.ptp(stroke)), float(np.ptp(force))
        look = {"name": plotted.label, "legendgroup": plotted.label}
        x, y, _ = simplified(stroke, force, extent)
        _add_line(figure, (x, y), (plotted.colour, "solid", 1.5), **look)
        marked = marked_points(plotted.run.samples["t"], number, len(shown))
        _add_markers(figure, plotted, stroke[marked], force[marked])
    figure.update_xaxes(title=STROKE.axis)
    figure.update_yaxes(title="force of spring and damper  [N]")
    return drawn(figure, "load_stroke", "Force over stroke of the axial buffer")


def velocities(shown: Sequence[PlottedRun]) -> list[Drawn]:
    """Draw horizontal, vertical and angular velocities of each vehicle."""
    figures = []
    for quantities in zip(*VELOCITIES, strict=True):
        figure = make_subplots(3, 1, shared_xaxes=True, vertical_spacing=0.05)
        _add_over_time(figure, quantities, shown)
        for row, quantity in enumerate(quantities, 1):
            label = {"text": f"{quantity.label}<br>[{quantity.unit}]", "standoff": 4}
            figure.update_yaxes(title=label, automargin=True, row=row, col=1)
        vehicle = quantities[0].title
        caption = f"Velocities of the {vehicle}"
        figures.append(drawn(figure, f"velocities-{vehicle}", caption, "half tall"))
    return figures


def energies(known: Sequence[PlottedRun]) -> tuple[list[Drawn], dict[str, str]]:
    """Draw where the energy that was put in is, layer on layer, for each run with a ledger.

    Return the figures, of one scale, and the colours of the layers by name.
    """
    figures, colours = [], dict[str, str]()
    ledgers = [energy_layers(plotted.run) for plotted in known]
    highest = 1.05 * max((put_in.max() for _, put_in, _ in ledgers), default=1.0)
    for number, (plotted, (t, put_in, layers)) in enumerate(zip(known, ledgers, strict=True)):
        figure = go.Figure()
        few = slice(None, None, max(len(t) // 200, 1))
        for name, colour, layer in layers:
            look = {"name": name, "stackgroup": "energy", "fillcolor": colour}
            values = layer[few].astype(np.float32)
            _add_line(figure, (t[few].astype(np.float32), values), (colour, "solid", 0), **look)
            colours[name] = colour
        x, y, _ = simplified(t, put_in, (float(np.ptp(t)), highest))
        _add_line(figure, (x, y), (style.GREY, "dash", 2), name="put in")
        label = time_label([plotted._replace(origin=0.0)])
        figure.update_xaxes(title=f"{label}  [s]")
        figure.update_yaxes(title="energy  [mJ]", range=(0.0, highest))
        figures.append(drawn(figure, f"energy-{number}", plotted.label, "third"))
    return figures, colours


def simplified(
    x: np.ndarray, y: np.ndarray, extent: tuple[float, float], also: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a curve without the points that lie on the line through their neighbours.

    No point (x, y), (n,) each, is farther from the new curve than ``_TOLERANCE`` of the axes,
    whose width and height are ``extent``, or 1 for a curve without any.  Pieces are separated by
    NaN, before and after.  The values ``also``, (n,), go with their points.  All are returned in
    single precision, (k,).
    """
    points = np.stack([x / (extent[0] or 1.0), y / (extent[1] or 1.0)], axis=-1)
    finite = np.isfinite(points).all(axis=1)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], finite.astype(np.int8), [0]])))
    pieces = [np.zeros(0, int)]
    for first, last in zip(ends[::2], ends[1::2] - 1, strict=True):
        pieces += [_needed(points, int(first), int(last)), np.array([-1])]  # -1: the gap after it
    index = np.concatenate(pieces[:-1] if len(pieces) > 1 else pieces)
    values = (np.where(index < 0, np.nan, v[index]) for v in (x, y, x if also is None else also))
    new_x, new_y, new_also = (v.astype(np.float32) for v in values)
    return new_x, new_y, new_also


def _needed(points: np.ndarray, first: int, last: int) -> np.ndarray:
    """Return the indices of a piece's points that are kept, by Ramer, Douglas and Peucker."""
    kept, pending = {first, last}, [(first, last)]
    while pending:
        a, b = pending.pop()
        if b - a < 2:
            continue
        inside, chord = points[a + 1 : b] - points[a], points[b] - points[a]
        length = float(np.hypot(*chord))
        along = np.clip(inside @ chord / max(length**2, 1e-30), 0.0, 1.0)
        distance = np.hypot(*(inside - along[:, None] * chord).T)
        farthest = int(distance.argmax())
        if distance[farthest] > _TOLERANCE:
            middle = a + 1 + farthest
            kept.add(middle)
            pending += [(a, middle), (middle, b)]
    return np.array(sorted(kept), int)


def _add_line(
    figure: go.Figure, points: Iterable[np.ndarray], line: tuple[str, str, float], **look: Any
) -> None:
    """Add a line: its x and y, (n,) each; its colour, dash and width."""
    x, y = points
    named = dict(zip(("color", "dash", "width"), line, strict=True))
    figure.add_scatter(x=x, y=y, mode="lines", line=named, **look)


def _add_markers(
    figure: go.Figure, plotted: PlottedRun, x: np.ndarray, y: np.ndarray, **look: Any
) -> None:
    """Add the marker of a run at points (k,) of its curve, if it has one."""
    if plotted.marker is not None:
        marker = {"symbol": plotted.marker[1], "color": plotted.colour, "size": 9}
        look |= {"name": plotted.label, "legendgroup": plotted.label, "hoverinfo": "skip"}
        figure.add_scatter(x=x, y=y, mode="markers", marker=marker, **look)


def _add_over_time(
    figure: go.Figure, quantities: Sequence[Quantity], shown: Sequence[PlottedRun]
) -> None:
    """Draw quantities over one time, a row each, as far as they lie in the window."""
    window = common_window(shown)
    for row, quantity in enumerate(quantities, 1):
        place: dict[str, Any] = {"row": row, "col": 1}
        curves = []
        for plotted in shown:
            t, values = quantity.curve(plotted.run)
            t = t - plotted.origin
            inside = (t >= window[0]) & (t <= window[1])
            # with located touches in it, a curve has more points than the run has samples
            holds = plotted.holds[inside] if quantity.located is None else None
            curves.append((t[inside], values[inside], holds))
        low = min((np.nanmin(values, initial=0.0) for _, values, _ in curves), default=0.0)
        high = max((np.nanmax(values, initial=0.0) for _, values, _ in curves), default=0.0)
        extent = window[1] - window[0], float(high - low)
        for number, (plotted, (t, values, holds)) in enumerate(zip(shown, curves, strict=True)):
            parts = {"in contact": values} if holds is None else split(values, holds)
            for word, part in parts.items():
                x, y, _ = simplified(t, part, extent)
                line = (plotted.colour, style.LINES[word].plotly, 1.8)
                named = {"name": plotted.label, "legendgroup": plotted.label}
                _add_line(figure, (x, y), line, **named, **place)
            if holds is not None:
                marked = marked_points(t, number, len(shown))
                _add_markers(figure, plotted, t[marked], values[marked], **place)
        # each once, in order: the same report gives the same bytes
        limits = (limit for plotted in shown for limit in quantity.limits(plotted.run.scene))
        for limit in dict.fromkeys(limits):
            if quantity.from_zero:
                look: Any = {"fillcolor": limit.colour, "opacity": 0.2, "line_width": 0}
                figure.add_hrect(0.0, limit.value, **look, **place)
            else:
                figure.add_hline(limit.value, line={"color": limit.colour, "dash": "dot"}, **place)
        mode = "tozero" if quantity.from_zero else "normal"
        figure.update_yaxes(title=quantity.axis, rangemode=mode, **place)
    figure.update_xaxes(range=window)
    figure.update_xaxes(title=f"{time_label(shown)}  [s]", row=len(quantities))
