"""Pictures for who sees the bench for the first time: its geometry with every symbol, a capture.

    python -m tools.explain docs

writes ``geometry.svg`` and ``capture.gif``.
"""

# ruff: noqa: RUF005

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc
from PIL import Image

from capture_sim.files import whole_file
from capture_sim.launch.scenes import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.simulation import simulate
from capture_sim.viewing import style
from capture_sim.viewing.canvas import draw_shapes, new_figure, save
from capture_sim.viewing.drawing import draw_path
from capture_sim.viewing.figures import state_at
from capture_sim.viewing.shapes import (
    Shape,
    circle,
    cone_shapes,
    hinge_in_world,
    rail_shapes,
    state_shapes,
    tip_in_cone,
    tip_in_world,
    wall,
)
from capture_sim.viewing.source import ViewableRun, decided_at, first_touch, in_contact, verdict

# of the drawing, so that small motions are seen
_STROKE, _TORSION = -0.035, 0.14  # m, rad
_STRING_Y = -0.15  # m, beside the bodies
_FPS, _SLOWER = 12, 8  # pictures a second, times slower than real time


def draw_geometry(scene: Scene) -> Figure:
    """Draw the bench from above with every symbol of the model, from a scene with a string."""
    figure = new_figure(14.0, 9.6)
    whole, close = figure.subplots(2, 1, height_ratios=[1.0, 1.55])
    _draw_launch(whole, scene)
    _draw_symbols(close, scene)
    for axes in (whole, close):
        axes.set_aspect("equal")
        axes.set_axis_off()
    return figure


def _draw_launch(axes: Axes, scene: Scene) -> None:
    q = scene.initial_coordinates()[0]
    chaser, target = q[:2], q[5:7]
    pulley = np.array([target[0] + 0.2, chaser[1] + _STRING_Y])
    axes.set_title("At the release: the falling mass pulls the chaser along the rail", fontsize=15)
    bridle = np.array([chaser[0] + 0.1, chaser[1] - 0.11])
    draw_shapes(
        axes,
        [
            *rail_shapes(scene),
            *state_shapes(scene, q, style.BLUE),
            Shape(np.array([bridle, [bridle[0], pulley[1]], pulley]), style.DARK, 1.3),
            Shape(circle(pulley, 0.014), style.DARK, 1.5, style.LIGHT, order=3.0),
            Shape(np.array([pulley + (0.014, 0), pulley + (0.05, 0)]), style.DARK, 1.3),
            Shape(
                pulley + np.array([[0.05, -0.02], [0.09, -0.02], [0.09, 0.02], [0.05, 0.02]]),
                style.BLACK,
                1.0,
                style.DARK,
                order=3.0,
            ),
        ],
    )
    for text, x, y in (
        ("chaser", chaser[0] - 0.01, chaser[1] + 0.05),
        ("target", target[0] + 0.04, target[1] + 0.06),
        ("rail", chaser[0] + 0.19, chaser[1] - 0.055),
        ("string", target[0] - 0.15, pulley[1] + 0.015),
        ("pulley", pulley[0], pulley[1] + 0.03),
        ("mass (hangs)", pulley[0] + 0.07, pulley[1] + 0.035),
        ("probe", chaser[0] + 0.26, chaser[1] + 0.02),
        ("cone", target[0] - 0.15, target[1] + 0.075),
    ):
        _say(axes, text, (x, y), ha="left" if "mass" in text else "center")
    axes.set_xlim(chaser[0] - 0.16, pulley[0] + 0.17)
    axes.set_ylim(pulley[1] - 0.04, chaser[1] + 0.14)
    corner = np.array([chaser[0] - 0.1, pulley[1] - 0.02])
    for end, name in (((0.06, 0.0), "x"), ((0.0, 0.06), "y")):
        axes.annotate(
            "", tuple(corner + end), tuple(corner), arrowprops={"arrowstyle": "->", "lw": 1.6}
        )
        _say(axes, name, corner + np.array(end) * 1.2)


def _draw_symbols(axes: Axes, scene: Scene) -> None:
    cone, probe, beta = scene.cone, scene.probe, scene.cone.half_angle
    h = scene.rest_length + _STROKE
    # the tip at the +y wall, the chaser straight
    along = np.array([np.cos(_TORSION), np.sin(_TORSION)])
    lip = wall(cone, 1)[1]
    face = 0.45 * lip + 0.55 * wall(cone, 1)[0]
    inwards = -np.array([np.sin(beta), np.cos(beta)])
    tip = face + probe.tip_radius * inwards - (cone.L_T, 0.0)
    hinge = tip - h * along
    q = np.array([hinge[0] - scene.buffer.hinge_offset, hinge[1], 0.0, _TORSION, h, 0.0, 0.0, 0.0])
    assert np.allclose(tip_in_world(scene, q[None])[0], tip)
    assert np.allclose(hinge_in_world(scene, q[None])[0], hinge)
    walls = [
        s._replace(points=s.points - (cone.L_T, 0.0))
        for n, s in cone_shapes(scene).items()
        if "centre" not in n
    ]
    spring = _spring(hinge + 0.25 * h * along, hinge + 0.62 * h * along)
    draw_shapes(axes, [*state_shapes(scene, q, style.BLUE), *walls, spring])
    be, edge = np.array([-cone.L_T, 0.0]), wall(cone, 1) - (cone.L_T, 0.0)
    other = wall(cone, -1) - (cone.L_T, 0.0)
    axes.set_title(
        f"Buffer, probe and cone (drawn with a stroke of {1e3 * _STROKE:.0f} mm and a torsion of "
        f"{1e3 * _TORSION:+.0f} mrad, more than a run has)",
        fontsize=15,
    )
    low = hinge[1] - 0.135
    _measure(axes, (q[0], low), (hinge[0], low), "a")
    _measure(axes, (be[0], low), (0.0, low), "$L_T$")
    _measure(axes, be + (0.022, 0), be + (0.022, cone.R_c), "$R_c$", (0.010, 0.0))
    off = -0.012 * inwards
    _measure(axes, edge[0] + off, edge[1] + off, "$L_c$", (0.008, 0.008))
    # strokes and torsion with their signs
    side = np.array([-along[1], along[0]])
    beside = 0.012 * side - 0.19 * h * along
    _measure(axes, hinge + 0.03 * side, tip + 0.03 * side, "h = $h_0$ + stroke", beside)
    arrow = {"arrowstyle": "->", "lw": 2.0, "color": style.VERMILION}
    end, start = (tuple(hinge + share * h * along - 0.018 * side) for share in (0.3, 0.6))
    axes.annotate("", end, start, arrowprops=arrow)
    at = hinge + 0.45 * h * along - 0.031 * side
    _say(axes, "stroke < 0: compression", at, style.VERMILION)
    axes.plot(*np.stack([hinge, hinge + (0.16, 0.0)]).T, color=style.GREY, lw=0.9, ls=":")
    degrees = np.rad2deg(_TORSION)
    axes.add_patch(Arc(hinge, 0.26, 0.26, theta1=0, theta2=degrees, color=style.VERMILION, lw=2.0))
    _say(axes, "torsion > 0", hinge + (0.165, -0.009), style.VERMILION)
    axes.plot(*np.stack([other[0], other[0] - (0.05, 0)]).T, color=style.GREY, lw=0.9, ls=":")
    axes.add_patch(Arc(other[0], 0.06, 0.06, theta1=180, theta2=180 + np.rad2deg(beta), lw=1.5))
    _say(axes, r"$\beta$", other[0] + (-0.037, -0.014))
    axes.plot(*np.stack([edge[0], other[0]]).T, color=style.GREEN, lw=1.6, ls=style.FREE_LINE)
    for text, at, to in (
        ("chaser's centre of mass", (q[0], q[1] + 0.05), q[:2]),
        ("hinge, torsional\nspring $k_T$, $c_T$", hinge + (-0.055, 0.085), hinge),
        (
            "axial spring and\ndamper $k_A$, $c_A$",
            hinge + 0.43 * h * along + (-0.035, 0.082),
            hinge + 0.43 * h * along + (0, 0.01),
        ),
        ("tip, radius $R_t$", tip + (-0.05, 0.064), tip + (-0.007, 0.008)),
        ("+y wall", edge[1] + (0.022, 0.024), edge[1]),
        ("-y wall", other[1] + (-0.035, -0.008), other[1]),
        ("BE: inner edge, its centre\nis where the tip shall come", (0.045, -0.088), be),
        ("target's centre of mass", (0.045, 0.055), (0.0, 0.0)),
        ("capture zone", be + (-0.02, -0.1), be + (-0.001, -0.005)),
    ):
        axes.annotate(
            text,
            tuple(to),
            tuple(at),
            fontsize=13,
            ha="center",
            va="center",
            zorder=9,
            arrowprops={"arrowstyle": "-", "lw": 0.8, "color": style.GREY},
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.8},
        )
    for x, y in ((q[0], q[1]), (0.0, 0.0)):
        axes.plot(x, y, "o", ms=7, color=style.BLACK, mfc="white", mew=2.0, zorder=8)
    axes.plot(*be, "+", ms=11, mew=2.0, color=style.GREEN, zorder=8)
    axes.plot(*hinge, "o", ms=8, color=style.DARK, zorder=8)
    axes.set_xlim(q[0] - 0.06, 0.11)
    axes.set_ylim(low - 0.02, 0.125)


def _spring(start: np.ndarray, end: np.ndarray) -> Shape:
    along = end - start
    side = np.array([-along[1], along[0]]) / np.linalg.norm(along) * 0.009
    share = np.linspace(0.0, 1.0, 18)
    swing = np.where(np.arange(18) % 2, 1.0, -1.0) * ((share > 0) & (share < 1))
    return Shape(
        start + share[:, None] * along + swing[:, None] * side, style.BROWN, 2.0, order=4.0
    )


def _measure(axes: Axes, start: Any, end: Any, text: str, offset: Any = (0.0, 0.012)) -> None:
    """Draw a length with its symbol beside its middle."""
    arrow = {"arrowstyle": "<->", "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tuple(end), tuple(start), arrowprops=arrow, zorder=7)
    _say(axes, text, (np.asarray(start) + end) / 2 + offset)


def _say(axes: Axes, text: str, at: Any, colour: str = style.BLACK, ha: str = "center") -> None:
    axes.text(at[0], at[1], text, color=colour, fontsize=14, ha=ha, va="center", zorder=9)


def save_capture_gif(run: ViewableRun, path: Path | str, pictures: int | None = None) -> Path:
    """Save a capture as a moving picture: the bench from above, and the tip in the cone.

    Parameters
    ----------
    run, path
        What, and where to.
    pictures
        How many; None for 12 a second at an eighth of real time.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    scene, path = run.scene, Path(path)
    touch, decided = first_touch(run), decided_at(run)
    begin = 0.0 if touch is None else max(touch.t - 0.15, 0.0)
    end = float(run.samples["t"][-1]) if decided is None else decided
    frames, touching = [], in_contact(run)
    count = pictures or int((end - begin) * _FPS * _SLOWER) + 1
    for t in np.linspace(begin, end, count):
        figure = new_figure(9.6, 4.0)
        bench, cone = figure.subplots(1, 2, width_ratios=[1.9, 1.0])
        q = state_at(run, float(t))
        draw_shapes(bench, [*rail_shapes(scene), *state_shapes(scene, q, style.BLUE)])
        bench.set(xlim=(q[0] - 0.16, q[5] + 0.16), ylim=(-0.17, 0.17), aspect="equal")
        bench.set_xlim(scene.initial.target.x - 0.66, scene.initial.target.x + 0.24)
        word = verdict(run) if t >= end else f"1/{_SLOWER} of real time"
        bench.set_title(f"{scene.name}, {t:.2f} s: {word}", fontsize=14, loc="left")
        draw_shapes(cone, cone_shapes(scene).values(), 1e3)
        upto = run.samples["t"] <= t
        samples = run.samples[upto]
        draw_path(cone, scene, samples, touching[upto], style.BLUE)
        tip = Shape(
            circle(tip_in_cone(samples)[-1], scene.probe.tip_radius),
            style.BLACK,
            1.0,
            style.BLUE,
            order=3.0,
        )
        draw_shapes(cone, [tip], 1e3)
        cone.set(xlim=(-85, 40), ylim=(-80, 80), aspect="equal")
        cone.set_title("the tip in the cone", fontsize=14)
        for axes in (bench, cone):
            axes.set_axis_off()
        figure.set_dpi(72)
        figure.canvas.draw()
        frames.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB"))  # type: ignore[attr-defined]
    palette = frames[-1].quantize(48)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    times = [1000 // _FPS] * (len(small) - 1) + [2500]
    with whole_file(path) as part:
        small[0].save(part, save_all=True, append_images=small[1:], duration=times, loop=0)
    return path


def main(folder: Path) -> None:
    """Write both pictures."""
    print(save(draw_geometry(load_scene("tilt_0")), folder / "geometry.svg"))
    print(save_capture_gif(simulate(load_scene("tilt_p10")), folder / "capture.gif"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
