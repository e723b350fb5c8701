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
    split,
    time_label,
)
from capture_sim.viewing.shapes import cone_shapes, tip_in_cone
from capture_sim.viewing.source import resolved_or_not

_MOST = 4000  # points of a curve; no screen has more


class Drawn(NamedTuple):
    """A figure of the page: its element's name, caption, width, and plotly's JSON."""

    name: str
    caption: str
    kind: str
    data: Markup


def drawn(figure: go.Figure, name: str, caption: str, kind: str = "narrow") -> Drawn:
    """Return a figure for the page; a wide one has titles above, so its legend lies below."""
    above = {"y": 1.0, "yanchor": "bottom"}
    below = {"y": 0.0, "yref": "container", "yanchor": "bottom"}
    figure.update_layout(
        template="none",
        margin={"l": 62, "r": 12, "t": 30, "b": 46 if kind == "narrow" else 96},
        legend={"orientation": "h", **(above if kind == "narrow" else below)},
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
    _add_over_time(figure, [[quantity]], shown)
    if quantity is FORCE:
        for plotted in shown:
            for side, (_, marker, wall) in style.WALLS.items():
                touches = plotted.run.touches[plotted.run.touches["wall"] == side]
                figure.add_scatter(
                    x=touches["peak_time"] - plotted.origin,
                    y=touches["peak_force"],
                    mode="markers",
                    marker={"symbol": marker, "color": plotted.colour, "size": 7},
                    name=f"{plotted.label}, {wall}",
                    legendgroup=plotted.label,
                    showlegend=False,
                )
    return drawn(figure, name, quantity.title)


def trajectories(shown: Sequence[PlottedRun]) -> Drawn:
    """Draw the paths of the tip's centre side by side, each in its own cone."""
    figure = make_subplots(1, len(shown), subplot_titles=[plotted.label for plotted in shown])
    for i, plotted in enumerate(shown, 1):
        hidden: dict[str, Any] = {"showlegend": False, "row": 1, "col": i}
        for name, shape in cone_shapes(plotted.run.scene).items():
            look: dict[str, Any] = {"name": name, "hoverinfo": "name"}
            if shape.fill:
                look |= {"fill": "toself", "fillcolor": shape.fill}
            dash = "dot" if shape.dashed else "solid"
            line = (shape.line or shape.fill, dash, shape.width)
            _add_line(figure, shape.points.T * 1e3, line, **look, **hidden)
        path = tip_in_cone(plotted.run.samples) * 1e3
        near = np.abs(path).max(axis=1) < 150.0
        look = {
            "customdata": _some(plotted.run.samples["t"][near]),
            "hovertemplate": "%{x:.2f}, %{y:.2f} mm at %{customdata:.3f} s",
        }
        for word, part in split(path[near], plotted.holds[near]).items():
            style_of_line = style.LINES[word]
            line = (plotted.colour, style_of_line.plotly, 3.5 * style_of_line.width)
            name = f"{plotted.label}, {word}"
            _add_line(figure, _some(part).T, line, name=name, **look, **hidden)
        figure.update_yaxes(range=(-80, 80), scaleanchor=f"x{i}", row=1, col=i)
        figure.update_xaxes(range=(-90, 30), title="x from BE  [mm]", row=1, col=i)
    figure.update_yaxes(title="y in the cone's frame  [mm]", col=1)
    return drawn(figure, "trajectories", "Path of the tip's centre in the cone", "wide")


def load_stroke(shown: Sequence[PlottedRun]) -> Drawn:
    """Draw force over stroke of the axial buffer."""
    figure = go.Figure()
    for plotted in shown:
        stroke, force = STROKE.of(plotted.run.samples), plotted.run.samples["axial_force"]
        _add_line(
            figure,
            (_some(stroke), _some(force)),
            (plotted.colour, "solid", 1.5),
            name=plotted.label,
        )
    figure.update_xaxes(title=STROKE.axis)
    figure.update_yaxes(title="force of spring and damper  [N]")
    return drawn(figure, "load_stroke", "Force over stroke of the axial buffer")


def velocities(shown: Sequence[PlottedRun]) -> Drawn:
    """Draw horizontal, vertical and angular velocities of both vehicles."""
    heads = [quantity.title for quantity in VELOCITIES[0]]
    figure = make_subplots(3, 2, shared_xaxes=True, vertical_spacing=0.07, subplot_titles=heads)
    _add_over_time(figure, VELOCITIES, shown)
    for row, (quantity, _) in enumerate(VELOCITIES, 1):
        label = {"text": f"{quantity.label}<br>[{quantity.unit}]", "standoff": 4}
        figure.update_yaxes(title=label, automargin=True, row=row, col=1)
    figure.update_yaxes(title="", col=2)
    return drawn(figure, "velocities", "Velocities of both vehicles", "wide")


def energy(known: Sequence[PlottedRun]) -> Drawn:
    """Draw what the energy put in has become, layer on layer, of runs that have a ledger."""
    figure = make_subplots(1, len(known), subplot_titles=[plotted.label for plotted in known])
    named = set[str]()
    for i, plotted in enumerate(known, 1):
        place: dict[str, Any] = {"row": 1, "col": i}
        t, put_in, layers = energy_layers(plotted.run)
        for name, colour, layer in layers:
            look = {"name": name, "legendgroup": name, "showlegend": name not in named}
            look |= {"stackgroup": "energy", "fillcolor": colour}
            _add_line(figure, (t, layer), (colour, "solid", 0), **look, **place)
            named.add(name)
        line = (style.GREY, "dash", 2)
        _add_line(figure, (t, put_in), line, name="put in", showlegend=i == 1, **place)
        label = time_label([plotted._replace(origin=0.0)])
        figure.update_xaxes(title=f"{label}  [s]", row=1, col=i)
    figure.update_yaxes(title="energy  [mJ]", col=1)
    caption = "Where the energy is and goes: the layers' sum against what was put in"
    return drawn(figure, "energy", caption, "wide")


def _some(values: np.ndarray) -> np.ndarray:
    return np.asarray(values[:: max(len(values) // _MOST, 1)], dtype=np.float32)


def _add_line(
    figure: go.Figure, points: Iterable[np.ndarray], line: tuple[str, str, float], **look: Any
) -> None:
    """Add a line: its x and y, (n,) each; its colour, dash and width."""
    x, y = points
    named = dict(zip(("color", "dash", "width"), line, strict=True))
    figure.add_scatter(x=x, y=y, mode="lines", line=named, **look)


def _add_over_time(
    figure: go.Figure, rows: Sequence[Sequence[Quantity]], shown: Sequence[PlottedRun]
) -> None:
    """Draw quantities over one time, as far as they lie in the window."""
    window = common_window(shown)
    for row, quantities in enumerate(rows, 1):
        for col, quantity in enumerate(quantities, 1):
            place: dict[str, Any] = {"row": row, "col": col}
            for plotted in shown:
                t, values = quantity.curve(plotted.run)
                t = t - plotted.origin
                inside = (t >= window[0]) & (t <= window[1])
                sampled = quantity.located is None
                parts = split(values, plotted.holds) if sampled else {"in contact": values}
                named = "in contact" if "in contact" in parts else next(iter(parts))
                for word, part in parts.items():
                    seen = inside & np.isfinite(part).any()
                    _add_line(
                        figure,
                        (t[seen].astype(np.float32), part[seen].astype(np.float32)),
                        (plotted.colour, style.LINES[word].plotly, 1.8),
                        name=plotted.label,
                        legendgroup=plotted.label,
                        showlegend=row == col == 1 and word == named,
                        **place,
                    )
            # each once, in order: the same report gives the same bytes
            limits = (limit for plotted in shown for limit in quantity.limits(plotted.run.scene))
            for limit in dict.fromkeys(limits):
                if quantity.from_zero:
                    look: Any = {"fillcolor": limit.colour, "opacity": 0.2, "line_width": 0}
                    figure.add_hrect(0.0, limit.value, **look, **place)
                else:
                    figure.add_hline(
                        limit.value, line={"color": limit.colour, "dash": "dot"}, **place
                    )
            mode = "tozero" if quantity.from_zero else "normal"
            figure.update_yaxes(title=quantity.axis, rangemode=mode, **place)
    figure.update_xaxes(range=window)
    figure.update_xaxes(title=f"{time_label(shown)}  [s]", row=len(rows))
