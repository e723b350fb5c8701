"""Figures of the report, for plotly: they can be zoomed and show values under the pointer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from plotly.subplots import make_subplots

from capture_sim.viewing import style
from capture_sim.viewing.curves import (
    PANELS,
    Shown,
    common_window,
    energy_layers,
    has_ledger,
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


def over_time(name: str, shown: Sequence[Shown]) -> Drawn:
    """Draw one of :data:`capture_sim.viewing.curves.PANELS`."""
    panel = PANELS[name]
    figure = go.Figure()
    window = common_window(shown)
    for one in shown:
        run = resolved_or_not(one.run) if name == "intrusion" else one.run
        t, values = panel.curve(run)
        _add_curve(figure, one, t, values, window, sampled=panel.sampled)
    if name == "impact_force":
        for one in shown:
            for side, (_, marker, wall) in style.WALLS.items():
                touches = one.run.touches[one.run.touches["wall"] == side]
                figure.add_scatter(
                    x=touches["peak_time"] - one.origin,
                    y=touches["peak_force"],
                    mode="markers",
                    marker={"symbol": marker, "color": one.colour, "size": 7},
                    name=f"{one.label}, {wall}",
                    legendgroup=one.label,
                    showlegend=False,
                )
    if name == "distance":
        radius = max(one.run.scene.detector.capture_radius for one in shown) * 1e3
        figure.add_hrect(0.0, radius, fillcolor=style.ZONE, opacity=0.2, line_width=0)
    figure.update_xaxes(title=f"{time_label(shown)}  [s]", range=window)
    figure.update_yaxes(title=panel.axis, rangemode="tozero" if panel.from_zero else "normal")
    return drawn(figure, name, panel.title)


def trajectories(shown: Sequence[Shown]) -> Drawn:
    """Draw the ways of the tip's centre side by side, each in its own cone."""
    figure = make_subplots(1, len(shown), subplot_titles=[one.label for one in shown])
    for i, one in enumerate(shown, 1):
        for name, shape in cone_shapes(one.run.scene).items():
            x, y = shape.points.T * 1e3
            line = {"color": shape.line or shape.fill, "width": shape.width}
            line["dash"] = "dot" if shape.dashed else "solid"
            look: dict[str, Any] = {"line": line, "name": name, "hoverinfo": "name"}
            if shape.fill:
                look |= {"fill": "toself", "fillcolor": shape.fill}
            figure.add_scatter(x=x, y=y, mode="lines", showlegend=False, row=1, col=i, **look)
        way = tip_in_cone(one.run.samples) * 1e3
        near = np.abs(way).max(axis=1) < 150.0
        parts = split(way[near], one.touching[near])
        t = one.run.samples["t"][near]
        for part, dash, width in zip(parts, ("solid", "dash"), (3.5, 1.3), strict=True):
            kept = _some(part)
            figure.add_scatter(
                x=kept[:, 0],
                y=kept[:, 1],
                mode="lines",
                line={"color": one.colour, "dash": dash, "width": width},
                name=f"{one.label}, {'in contact' if dash == 'solid' else 'free'}",
                customdata=_some(t),
                hovertemplate="%{x:.2f}, %{y:.2f} mm at %{customdata:.3f} s",
                showlegend=False,
                row=1,
                col=i,
            )
        figure.update_yaxes(range=(-80, 80), scaleanchor=f"x{i}", row=1, col=i)
        figure.update_xaxes(range=(-90, 30), title="x from BE  [mm]", row=1, col=i)
    figure.update_yaxes(title="y in the cone's frame  [mm]", col=1)
    return drawn(figure, "trajectories", "Way of the tip's centre in the cone", "wide")


def load_stroke(shown: Sequence[Shown]) -> Drawn:
    """Draw force over stroke of the axial buffer."""
    figure = go.Figure()
    for one in shown:
        samples = one.run.samples
        figure.add_scatter(
            x=_some(style.STROKE.of(samples)),
            y=_some(samples["axial_force"]),
            mode="lines",
            line={"color": one.colour, "width": 1.5},
            name=one.label,
        )
    figure.update_xaxes(title=style.STROKE.axis)
    figure.update_yaxes(title="force of spring and damper  [N]")
    return drawn(figure, "load_stroke", "Force over stroke of the axial buffer")


def velocities(shown: Sequence[Shown]) -> Drawn:
    """Draw horizontal, vertical and angular velocities of both vehicles."""
    parts = ("x  [mm/s]", "y  [mm/s]", "turn  [mrad/s]")
    heads = ["chaser", "target"]
    figure = make_subplots(3, 2, shared_xaxes=True, vertical_spacing=0.07, subplot_titles=heads)
    window = common_window(shown)
    for column, first in enumerate((0, 5), 1):
        for row, name in enumerate(parts, 1):
            for one in shown:
                t, v = one.run.samples["t"], one.run.samples["v"][:, first + row - 1] * 1e3
                legend = row == column == 1
                _add_curve(figure, one, t, v, window, legend=legend, row=row, col=column)
            figure.update_yaxes(title=name, row=row, col=1)
        figure.update_xaxes(title=f"{time_label(shown)}  [s]", row=3, col=column)
    figure.update_xaxes(range=window)
    return drawn(figure, "velocities", "Velocities of both vehicles", "wide")


def energy(shown: Sequence[Shown]) -> Drawn | None:
    """Draw what the energy put in has become, layer on layer; None where none is known."""
    known = [one for one in shown if has_ledger(one.run)]
    if not known:
        return None
    figure = make_subplots(1, len(known), subplot_titles=[one.label for one in known])
    named = set[str]()
    for i, one in enumerate(known, 1):
        t, put_in, layers = energy_layers(one.run)
        for name, colour, layer in layers:
            figure.add_scatter(
                x=t,
                y=layer,
                stackgroup="energy",
                mode="lines",
                line={"width": 0, "color": colour},
                fillcolor=colour,
                name=name,
                legendgroup=name,
                showlegend=name not in named,
                row=1,
                col=i,
            )
            named.add(name)
        line = {"color": style.GREY, "dash": "dash", "width": 2}
        look: dict[str, Any] = {"line": line, "mode": "lines", "name": "put in"}
        figure.add_scatter(x=t, y=put_in, showlegend=i == 1, row=1, col=i, **look)
        figure.update_xaxes(title=f"{time_label([one._replace(origin=0.0)])}  [s]", row=1, col=i)
    figure.update_yaxes(title="energy  [mJ]", col=1)
    caption = "Where the energy is and goes: the layers' sum against what was put in"
    return drawn(figure, "energy", caption, "wide")


def _some(values: np.ndarray) -> np.ndarray:
    return np.asarray(values[:: max(len(values) // _MOST, 1)], dtype=np.float32)


def _add_curve(
    figure: go.Figure,
    one: Shown,
    t: np.ndarray,
    values: np.ndarray,
    window: tuple[float, float],
    *,
    sampled: bool = True,
    legend: bool = True,
    **place: int,
) -> None:
    """Add a curve, as far as it lies in the window: dashed, of samples, where the tip is free."""
    t = t - one.origin
    inside = (t >= window[0]) & (t <= window[1])
    parts = split(values, one.touching) if sampled else (values,)
    for part, dash in zip(parts, ("solid", "dash"), strict=False):
        seen = inside & np.isfinite(part).any()
        figure.add_scatter(
            x=np.asarray(t[seen], dtype=np.float32),
            y=np.asarray(part[seen], dtype=np.float32),
            mode="lines",
            line={"color": one.colour, "dash": dash, "width": 1.8},
            name=one.label,
            legendgroup=one.label,
            showlegend=legend and dash == "solid",
            **place,
        )
