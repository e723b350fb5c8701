"""Draws the diagrams of the pages: nodes, states, timing of the loop, frames of a rig, one touch.

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

from capture_sim.detection.criteria import CaptureState
from capture_sim.launcher.state_machine import LauncherPhase
from capture_sim.messages import topics
from capture_sim.run.run import Run
from capture_sim.run.simulation import simulate
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.viewing import style
from capture_sim.viewing.canvas import draw_shapes, new_figure, save, subplots
from capture_sim.viewing.shapes import CHASER, TARGET, state_shapes
from capture_sim.viewing.source import resolved

_FONT = 12.0
_IN_THE_ZONE = "in the zone for min_dwell, or past BE in the throat"
_AT_REST = "at rest outside the zone for min_still_time"
_BESIDE = "past BE beside the throat"
_NO_VERDICT = "the run ends before a verdict, or a source fails"
#: What leads from one state of the launcher to another.
LAUNCHER = {
    (LauncherPhase.IDLE, LauncherPhase.ARMED): "scene, mass\nand height",
    (LauncherPhase.ARMED, LauncherPhase.RELEASED): "release",
    (LauncherPhase.RELEASED, LauncherPhase.LANDED): "mass has\nlanded",
    (LauncherPhase.LANDED, LauncherPhase.DELIVERED): "tip at\nthe cone",
    (LauncherPhase.RELEASED, LauncherPhase.DELIVERED): "tip at the cone while the mass sinks",
    (LauncherPhase.ARMED, LauncherPhase.ABORTED): "from armed on: cancelled, or poses not fresh",
    (LauncherPhase.RELEASED, LauncherPhase.ABORTED): (
        "from released on: also a wrong speed or a late touch"
    ),
    (LauncherPhase.LANDED, LauncherPhase.ABORTED): (
        "from released on: also a wrong speed or a late touch"
    ),
}
#: What leads from one state of the detector to another.
DETECTOR = {
    (CaptureState.APPROACH, CaptureState.CONTACT): "tip at a wall, or buffer pushed near one",
    (CaptureState.APPROACH, CaptureState.CAPTURED): _IN_THE_ZONE,
    (CaptureState.APPROACH, CaptureState.REBOUND): "turned round where noise may hide a touch",
    (CaptureState.APPROACH, CaptureState.MISSED): f"min_retreat away, or {_BESIDE}",
    (CaptureState.APPROACH, CaptureState.STUCK): _AT_REST,
    (CaptureState.APPROACH, CaptureState.UNDECIDED): _NO_VERDICT,
    (CaptureState.CONTACT, CaptureState.CAPTURED): _IN_THE_ZONE,
    (CaptureState.CONTACT, CaptureState.REBOUND): "min_retreat away from its closest approach",
    (CaptureState.CONTACT, CaptureState.MISSED): _BESIDE,
    (CaptureState.CONTACT, CaptureState.STUCK): _AT_REST,
    (CaptureState.CONTACT, CaptureState.UNDECIDED): _NO_VERDICT,
}
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
    head: str = "-|>",
    colour: str = style.DARK,
) -> None:
    """Draw an arrow from the first to the last end, with a text in its middle or at a place."""
    look = {"arrowstyle": head, "mutation_scale": 14.0, "color": colour, "lw": 1.3, "zorder": 7}
    curve = f"arc3,rad={bend}"
    axes.add_patch(FancyArrowPatch(*ends, connectionstyle=curve, shrinkA=0, shrinkB=0, **look))
    if text:
        x, y = np.mean(ends, axis=0) if at is None else at
        axes.text(x, y, text, ha="center", va="center", fontsize=_FONT - 1.5)


def draw_nodes() -> Figure:
    """Draw the nodes and the topics between them, as the table of topics has them."""
    figure, axes = _diagram(12.5, 7.4)
    publishers = {topics.SIMULATOR: 1.6, topics.LAUNCHER: 6.3, topics.CAPTURE_DETECTOR: 10.8}
    top, below = 6.0, 1.38
    for node, x in publishers.items():
        _draw_box(axes, _Box(node, x, top, 2.3, 0.7, style.CONE))
        names = [f"/{topic.name}" for topic in topics.topics_of(node)]
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
    """Draw every state of the launcher and of the detector, and what leads from one to another."""
    figure, axes = _diagram(12.5, 8.6)
    _draw_launcher_states(axes)
    _draw_detector_states(axes)
    return figure


def _draw_launcher_states(axes: Axes) -> None:
    axes.text(0.2, 8.35, "Launcher", fontsize=_FONT + 2, fontweight="bold", va="center")
    row, low, width = 7.0, 5.8, 1.4
    chain = [state for state in LauncherPhase if state is not LauncherPhase.ABORTED]
    places = {state: (1.0 + 2.6 * i, row) for i, state in enumerate(chain)}
    places[LauncherPhase.ABORTED] = (6.2, low)
    for state, (x, y) in places.items():
        colour = "#F7D9D2" if state is LauncherPhase.ABORTED else style.PALE
        _draw_box(axes, _Box(state.label, x, y, width, 0.6, colour))
    for (before, after), text in LAUNCHER.items():
        (x, y), (x_after, y_after) = places[before], places[after]
        if y_after < y:
            end = x_after + np.clip(x - x_after, -1.0, 1.0) * 0.25 * width
            _draw_arrow(axes, [(x, y - 0.33), (end, low + 0.33)])
        elif chain.index(after) > chain.index(before) + 1:
            ends = (x, y + 0.33), (x_after, y_after + 0.33)
            _draw_arrow(axes, ends, text, ((x + x_after) / 2, y + 1.05), bend=-0.22)
        else:
            ends = (x + width / 2 + 0.03, y), (x_after - width / 2 - 0.03, y)
            _draw_arrow(axes, ends, text, ((x + x_after) / 2, y + 0.36))
    texts = dict.fromkeys(text for (_, after), text in LAUNCHER.items() if places[after][1] == low)
    axes.text(7.1, low, "\n".join(texts), fontsize=_FONT - 1.5, va="center")


def _draw_detector_states(axes: Axes) -> None:
    """Draw a row for each verdict, with what leads to it without and after a contact."""
    axes.text(0.2, 5.0, "Detector", fontsize=_FONT + 2, fontweight="bold", va="center")
    rows = {
        state: 3.4 - 0.66 * i
        for i, state in enumerate(state for state in CaptureState if state > CaptureState.CONTACT)
    }
    columns = {CaptureState.APPROACH: 0.85, CaptureState.CONTACT: 11.65}
    middle, height, width, verdict = 2.4, 3.9, 1.3, 6.25
    for state, x in columns.items():
        colour = style.STATES[state.label]
        _draw_box(axes, _Box(state.label, x, middle, width, height, colour))
    for state, y in rows.items():
        _draw_box(axes, _Box("", verdict - 0.58, y, 0.2, 0.2, style.STATES[state.label]))
        axes.text(verdict - 0.4, y, state.label, fontsize=_FONT - 0.5, va="center")
    for (before, after), text in DETECTOR.items():
        edge = (width / 2 + 0.03) * (1 if before is CaptureState.APPROACH else -1)
        start = columns[before] + edge
        if after is CaptureState.CONTACT:
            y = middle + height / 2 - 0.3
            ends = (start, y), (columns[after] - width / 2 - 0.03, y)
            _draw_arrow(axes, ends, text, (verdict, y + 0.17))
            continue
        end = verdict - 0.75 if edge > 0 else verdict + 0.65
        ends = (start, rows[after]), (end, rows[after])
        _draw_arrow(axes, ends, text, ((start + end) / 2, rows[after] + 0.15))
    text = "At the end of a run, further rules apply: see its section in the detector's page."
    axes.text(verdict, 0.2, text, ha="center", va="center", fontsize=_FONT - 1.5)


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


def draw_rig(scene: Scene) -> Figure:
    """Draw the frames and lengths that a rig needs, at the start of a scene, from above, mm."""
    figure, [[axes]] = subplots(12.5, 5.0, grid=None)
    q = scene.initial_coordinates()[0]
    q[CHASER[1]] = q[TARGET[1]] = q[CHASER[2]] = q[TARGET[2]] = 0.0
    draw_shapes(axes, state_shapes(scene, q, style.BLUE), 1e3)
    hinge = scene.buffer.hinge_offset
    frame, far = q[CHASER[0]], q[TARGET[0]]
    places = [0.0, hinge, hinge + scene.rest_length, far - frame - scene.cone.L_T, far - frame]
    x = [1e3 * (frame + place) for place in places]
    axes.plot([x[2], x[3]], [0.0, 0.0], color=style.GREY, ls="-.", lw=1.0)
    level, below = -140.0, -178.0
    for at, low in zip(x, (below, level, level, level, below), strict=True):
        axes.plot([at, at], [0.0, low - 5.0], color=style.GREY, lw=1.0, zorder=6)
    for start, end, y in [*((a, b, level) for a, b in itertools.pairwise(x)), (x[0], x[-1], below)]:
        _draw_arrow(axes, [(start, y), (end, y)], head="<|-|>")
        axes.text((start + end) / 2, y + 6.0, f"{end - start:g}", ha="center", fontsize=_FONT)
    for at, name in ((x[0], "chaser's"), (x[-1], "target's")):
        for dx, dy, letter, colour in (
            (58.0, 0.0, "x", style.VERMILION),
            (0.0, 58.0, "y", style.GREEN),
        ):
            _draw_arrow(axes, [(at, 0.0), (at + dx, dy)], colour=colour)
            axes.text(
                *(at + dx + 8.0, dy + 5.0, letter),
                color=colour,
                fontsize=_FONT,
                zorder=9,
                ha="center",
            )
        axes.text(at, 132.0, f"{name} base frame", ha="center", fontsize=_FONT)
    for at, text, place in (
        (x[1], "hinge", (x[1] + 4.0, 132.0)),
        (x[2], "centre of the tip", (x[2], 70.0)),
        (x[3], "centre of BE,\nthe cone's inner edge", (x[3] - 68.0, 100.0)),
    ):
        line = {"arrowstyle": "-", "lw": 0.9, "color": style.GREY}
        axes.annotate(text, (at, 0.0), place, fontsize=_FONT, ha="center", arrowprops=line)
        axes.plot(at, 0.0, "o", color=style.BLACK, ms=6.0, zorder=9)
    middle = (x[1] + x[2]) / 2
    _draw_arrow(axes, [(middle + 30.0, -32.0), (middle - 30.0, -32.0)], colour=style.BLUE)
    blue = {"color": style.BLUE, "fontsize": _FONT, "ha": "center"}
    axes.text(middle, -52.0, "buffer_slide < 0", **blue)
    turn = [(x[1] + 60.0, 0.0), (x[1] + 46.0, 38.0)]
    _draw_arrow(axes, turn, colour=style.BLUE, bend=0.2)
    axes.text(middle + 20.0, 34.0, "buffer_hinge > 0", **blue)
    axes.set_title(
        f"Lengths in mm, {scene.name} at the release; both headings are 0", fontsize=_FONT
    )
    axes.set(aspect="equal", ylim=(below - 12.0, 150.0))
    axes.set_axis_off()
    return figure


def draw_touch(run: Run) -> Figure:
    """Draw the force and the penetration of the first touch of a run, at the integrator's steps."""
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
        f"peak {peak[1]:.1f} N", peak, xytext=(10, 6), textcoords="offset points", fontsize=_FONT
    )
    lasted = (float(touch["end"]) - start) * 1e3
    for axes, label in ((force, "normal force  [N]"), (depth, "penetration  [µm]")):
        axes.axvspan(0.0, lasted, color=style.CONTACT, alpha=0.3, lw=0)
        axes.set_ylabel(label)
        axes.set_ylim(0.0, 1.15 * axes.get_ylim()[1])
    force.text(lasted / 2, 2.0, "in contact", ha="center", va="bottom", fontsize=_FONT)
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
        ("your_rig", draw_rig(load_scene("tilt_0"))),
        ("touch", draw_touch(simulate(load_scene("tilt_p10")))),
    ):
        print(save(figure, folder / f"{name}.svg"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
