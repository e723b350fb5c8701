"""Draws the diagrams of the pages: nodes and topics, states, the timing of the loop, one touch.

python -m tools.diagrams docs
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

from capture_sim.launch.scenes import load_scene
from capture_sim.messages.topics import CAPTURE_DETECTOR, LAUNCHER, SIMULATOR, topics_of
from capture_sim.run import Run
from capture_sim.simulation import simulate
from capture_sim.viewing import style
from capture_sim.viewing.canvas import new_figure, save, subplots
from capture_sim.viewing.source import resolved

_FONT = 12.0
_MARGIN = 4e-5  # s, drawn before and after the touch


class _Box(NamedTuple):
    """A box with a text: centre, width and height, in units of the drawing."""

    text: str
    x: float
    y: float
    width: float = 2.0
    height: float = 0.7
    colour: str = style.PALE


def _diagram(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure, inches, and its empty axes, of one unit an inch."""
    figure = new_figure(width, height, arranged=False)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    axes.set_axis_off()
    return figure, axes


def _draw_box(axes: Axes, box: _Box, size: float = _FONT) -> None:
    corner = box.x - box.width / 2, box.y - box.height / 2
    look = {"facecolor": box.colour, "edgecolor": style.DARK, "lw": 1.2}
    outline = FancyBboxPatch(corner, box.width, box.height, boxstyle="round,pad=0.03", **look)
    axes.add_patch(outline)
    axes.text(box.x, box.y, box.text, ha="center", va="center", fontsize=size)


def _draw_arrow(
    axes: Axes,
    ends: Sequence[tuple[float, float]],
    text: str = "",
    at: tuple[float, float] | None = None,
    bend: float = 0.0,
) -> None:
    """Draw an arrow from the first to the last end, with a text in its middle or at a place."""
    look = {"arrowstyle": "-|>", "mutation_scale": 14.0, "color": style.DARK, "lw": 1.3}
    curve = f"arc3,rad={bend}"
    axes.add_patch(FancyArrowPatch(*ends, connectionstyle=curve, shrinkA=0, shrinkB=0, **look))
    if text:
        x, y = np.mean(ends, axis=0) if at is None else at
        axes.text(x, y, text, ha="center", va="center", fontsize=_FONT - 1.5)


def draw_nodes() -> Figure:
    """Draw the nodes and the topics between them, as the table of topics has them."""
    figure, axes = _diagram(12.5, 7.4)
    publishers = {SIMULATOR: 1.6, LAUNCHER: 6.3, CAPTURE_DETECTOR: 10.8}
    top, below = 6.0, 1.38
    for node, x in publishers.items():
        _draw_box(axes, _Box(node, x, top, 2.3, 0.7, style.CONE))
        names = [f"/{topic.name}" for topic in topics_of(node)]
        axes.text(x, top - 0.9, "\n".join(names), ha="center", va="top", fontsize=_FONT - 1.0)
        end = top - 0.95 - 0.205 * len(names)
        axes.plot([x, x], [top - 0.38, top - 0.8], color=style.DARK, lw=1.3)
        _draw_arrow(axes, [(x, end), (x, below)])
    readers = "recorder: writes all topics\nviewer: shows them live\nyour own node"
    _draw_box(axes, _Box(readers, 6.25, 0.75, 12.0, 1.1, style.LIGHT))
    _draw_arrow(axes, [(5.12, top + 0.12), (2.78, top + 0.12)], "/launcher/command", (3.95, 6.36))
    _draw_arrow(axes, [(2.78, top - 0.12), (5.12, top - 0.12)], "/bench/..., poses", (3.95, 5.62))
    axes.plot([1.6, 1.6, 10.8], [top + 0.38, 7.0, 7.0], color=style.DARK, lw=1.3)
    text = "poses, /bench/buffer, /bench/contact, /bench/event"
    _draw_arrow(axes, [(10.8, 7.0), (10.8, top + 0.38)], text, (6.3, 7.2))
    return figure


def draw_states() -> Figure:
    """Draw the states of the launcher and of the detector."""
    figure, axes = _diagram(12.5, 6.2)
    axes.text(0.2, 5.9, "Launcher", fontsize=_FONT + 2, fontweight="bold", va="center")
    states = ("idle", "armed", "released", "landed", "delivered")
    events = ("mass and height\nchosen", "release", "mass has\nlanded", "tip at\nthe cone")
    places = [1.1 + 2.6 * i for i in range(len(states))]
    for x, state in zip(places, states, strict=True):
        _draw_box(axes, _Box(state, x, 5.1, 1.3, 0.6))
    for (a, b), event in zip(itertools.pairwise(places), events, strict=True):
        _draw_arrow(axes, [(a + 0.7, 5.1), (b - 0.7, 5.1)], event, ((a + b) / 2, 5.68))
    _draw_box(axes, _Box("aborted", places[2] + 1.3, 3.75, 1.4, 0.6, "#F7D9D2"))
    for x in places[1:4]:
        end = places[2] + 1.3 + 0.25 * np.sign(x - places[2])
        _draw_arrow(axes, [(x, 4.78), (end, 4.08)])
    text = "cancelled, late or wrong speed, poses not fresh"
    axes.text(places[2] + 2.3, 3.75, text, fontsize=_FONT - 1.5, va="center")
    axes.text(0.2, 3.1, "Detector", fontsize=_FONT + 2, fontweight="bold", va="center")
    _draw_box(axes, _Box("approach", 1.3, 1.6, 1.6, 0.7, style.STATES["approach"]))
    _draw_box(axes, _Box("contact", 4.6, 1.6, 1.6, 0.7, style.STATES["contact"]))
    _draw_arrow(axes, [(2.13, 1.6), (3.77, 1.6)], "first touch", (2.95, 1.9))
    verdicts = (
        ("captured", "tip in the zone for the dwell time"),
        ("rebound", "tip moves out of the cone again"),
        ("stuck", "tip is at rest outside of the zone"),
        ("missed", "tip passes beside the cone"),
        ("undecided", "the run ends, or a source is lost"),
    )
    for i, (verdict, meaning) in enumerate(verdicts):
        y = 2.7 - 0.56 * i
        _draw_box(axes, _Box("", 8.0, y, 0.3, 0.3, style.STATES[verdict]))
        axes.text(8.3, y, f"{verdict}: {meaning}", fontsize=_FONT - 1.0, va="center")
        _draw_arrow(axes, [(5.43, 1.6), (7.8, y)])
    # a verdict of a run without contact
    _draw_arrow(axes, [(1.3, 1.22), (7.8, 0.98)], "no contact", (4.0, 0.45), bend=0.12)
    return figure


def draw_loop_timing() -> Figure:
    """Draw one exchange of the loop through hardware: latency, whole lag and the held wrench."""
    figure, axes = _diagram(12.5, 5.0)
    lanes = {"loop_simulator": 4.0, "transport": 3.1, "load cell": 2.2, "robot": 1.3}
    begin, step, sends, uses = 2.6, 1.1, 2, 4  # the steps that send and use
    for name, y in lanes.items():
        axes.text(0.2, y, name, fontsize=_FONT, va="center")
        axes.plot([begin - 0.3, 12.2], [y, y], color=style.LIGHT, lw=1.0, zorder=0)
    for k in range(8):
        x, colour = begin + step * (k + 0.5), style.CONE if k >= uses else style.PALE
        _draw_box(axes, _Box(f"step {k}", x, lanes["loop_simulator"], step - 0.1, 0.5, colour))
    sent, used = begin + sends * step, begin + uses * step
    read, arrived, cell, servo = sent + 0.9, used - 0.15, 0.75, 1.45
    for start, end, lane, text, colour in (
        (sent - cell - servo, read - cell - servo, "transport", "/loop/tip", style.LIGHT),
        (sent, read, "transport", "/loop/tip", style.LIGHT),
        (read, arrived, "transport", "/loop/wrench", style.LIGHT),
        (read - cell, read, "load cell", "cell lag", "#D6EAD9"),
        (read - cell - servo, read - cell, "robot", "servo lag", "#F3DDBB"),
    ):
        y = lanes[lane]
        axes.add_patch(Rectangle((start, y - 0.22), end - start, 0.44, fc=colour, ec=style.DARK))
        axes.text((start + end) / 2, y, text, ha="center", va="center", fontsize=_FONT - 2)
    earlier = read - cell - servo
    _draw_arrow(axes, [(earlier, lanes["transport"] - 0.22), (earlier, lanes["robot"] + 0.22)])
    for x, low, high in ((read - cell, "robot", "load cell"), (read, "load cell", "transport")):
        _draw_arrow(axes, [(x, lanes[low] + 0.22), (x, lanes[high] - 0.22)])
    for x in (sent - cell - servo, sent):
        _draw_arrow(axes, [(x, lanes["loop_simulator"] - 0.28), (x, lanes["transport"] + 0.22)])
    _draw_arrow(axes, [(arrived, lanes["transport"] + 0.22), (used + 0.05, 3.72)])
    for start, end, y, text in (
        (sent, used, 0.65, "latency, by the stamps"),
        (
            sent - cell - servo,
            used + step / 2,
            0.25,
            "whole lag: latency, servo, cell, half a step",
        ),
    ):
        ends = {"arrowstyle": "<->", "lw": 1.3, "color": style.DARK, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (end, y), (start, y), arrowprops=ends)
        axes.text(end + 0.15, y, text, fontsize=_FONT - 1, va="center")
    text = "these steps use this wrench, until a newer one arrives"
    axes.text(used, 4.6, text, fontsize=_FONT - 1, va="center")
    return figure


def draw_touch(run: Run) -> Figure:
    """Draw the first touch of a run: force and penetration over 0.3 ms, with the samples."""
    touch = run.touches[np.argmin(run.touches["start"])]
    start = float(touch["start"])
    fine = resolved(run, (start - _MARGIN, float(touch["end"]) + _MARGIN)).samples
    t = (fine["t"] - start) * 1e3
    figure, rows = subplots(8.4, 6.0, 2, 1, sharex=True)
    force, depth = rows[:, 0]
    force.plot(t, fine["normal_force"].sum(axis=1), color=style.BLUE, lw=2.0)
    depth.plot(t, np.maximum(fine["penetration"].max(axis=1), 0.0) * 1e6, color=style.BLUE, lw=2.0)
    peak = (float(touch["peak_time"]) - start) * 1e3, float(touch["peak_force"])
    force.plot(*peak, "o", color=style.BLACK)
    force.annotate(
        f"peak {peak[1]:.1f} N", peak, xytext=(8, -4), textcoords="offset points", fontsize=_FONT
    )
    lasted = (float(touch["end"]) - start) * 1e3
    for axes, label in ((force, "normal force  [N]"), (depth, "penetration  [µm]")):
        axes.axvspan(0.0, lasted, color=style.CONTACT, alpha=0.3, lw=0)
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0.0)
    depth.set_xlabel("time since the start of the touch  [ms]")
    speed = float(touch["approach_speed"])
    impulse = float(touch["impulse"]) * 1e3
    force.set_title(
        f"First touch of {run.scene.name}: {lasted:.3f} ms, approach {speed:.3f} m/s, "
        f"impulse {impulse:.1f} mN s",
        fontsize=_FONT,
    )
    return figure


def main(folder: Path) -> None:
    """Write all diagrams."""
    for name, figure in (
        ("nodes", draw_nodes()),
        ("states", draw_states()),
        ("loop_timing", draw_loop_timing()),
        ("touch", draw_touch(simulate(load_scene("tilt_p10")))),
    ):
        print(save(figure, folder / f"{name}.svg"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
