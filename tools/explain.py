"""Draws the pictures that introduce the bench: its geometry with every symbol, and a capture.

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

from capture_sim.base.files import whole_file
from capture_sim.run.first_contact import first_touch
from capture_sim.run.run import Run
from capture_sim.run.simulation import simulate
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.viewing import style
from capture_sim.viewing.canvas import draw_shapes, dress, new_figure, save
from capture_sim.viewing.curves import FORCE, PlottedRun, plotted_runs, time_label
from capture_sim.viewing.drawing import draw_path
from capture_sim.viewing.figures import state_at
from capture_sim.viewing.shapes import (
    CHASER,
    TARGET,
    THETA_P,
    H,
    Shape,
    circle,
    cone_shapes,
    hinge_in_world,
    placed,
    rail_shapes,
    state_shapes,
    tip_in_cone,
    tip_in_world,
    wall,
)
from capture_sim.viewing.source import decided_at, verdict

# of the drawing, so that small motions are seen
_STROKE, _TORSION = -0.035, 0.14  # m, rad
_THETA, _OFFSET = 0.17, 0.035  # rad, m
_STRING_Y = -0.175  # m, beside the bodies
_CENTRE: Any = {
    **{"marker": "o", "ms": 7, "color": style.BLACK, "mfc": "white", "mew": 2.0},
    **{"ls": "", "zorder": 9},
}
_FPS, _SLOWER = 12, 8  # pictures a second, times slower than real time


def draw_geometry(scene: Scene) -> Figure:
    """Draw the bench from above with every symbol of the model, from a scene with a string."""
    figure = new_figure(14.0, 9.6)
    launch, symbols = figure.subplots(2, 1, height_ratios=[1.0, 1.55])
    _draw_launch(launch, scene)
    _draw_symbols(symbols, scene)
    for axes in (launch, symbols):
        axes.set_aspect("equal")
        axes.set_axis_off()
    return figure


def _draw_launch(axes: Axes, scene: Scene) -> None:
    q = scene.initial_coordinates()[0]
    q[TARGET[1]], q[TARGET[2]] = q[CHASER[1]] - _OFFSET, _THETA
    chaser, target = q[:2], q[5:7]
    pulley = np.array([target[0] + 0.2, chaser[1] + _STRING_Y])
    axes.set_title(
        "At the release: the falling mass pulls the chaser along the rail "
        f"(offset {1e3 * _OFFSET:.0f} mm, theta {np.rad2deg(_THETA):.0f}°, for the drawing)",
        fontsize=15,
    )
    bridle = np.array([chaser[0] + 0.1, chaser[1] - 0.105])
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
        ("chaser", chaser[0] - 0.01, chaser[1] + 0.06),
        ("target", target[0] + 0.06, target[1] - 0.06),
        ("rail", chaser[0] + 0.2, chaser[1] - 0.05),
        ("string", target[0] - 0.3, pulley[1] + 0.015),
        ("pulley", pulley[0], pulley[1] + 0.03),
        ("mass (hangs)", pulley[0] + 0.07, pulley[1] + 0.035),
        ("buffer", chaser[0] + 0.2, chaser[1] + 0.05),
        ("probe", chaser[0] + 0.335, chaser[1] + 0.04),
        ("cone", target[0] - 0.17, target[1] - 0.05),
    ):
        _say(axes, text, (x, y), ha="left" if "mass" in text else "center")
    assert scene.supports is not None
    highest = np.array([max(scene.supports.target.balls, key=lambda ball: ball[1])])
    x, y = placed(highest, *q[list(TARGET)])[0]
    _point_to(axes, "ball wheel", (x + 0.07, y + 0.045), (x + 0.005, y + 0.008))
    _draw_approach(axes, chaser, target)
    axes.set_xlim(chaser[0] - 0.2, pulley[0] + 0.17)
    axes.set_ylim(pulley[1] - 0.04, chaser[1] + 0.15)
    corner = np.array([chaser[0] - 0.18, pulley[1] - 0.02])
    for end, name in (((0.06, 0.0), "x"), ((0.0, 0.06), "y")):
        axes.annotate(
            "", tuple(corner + end), tuple(corner), arrowprops={"arrowstyle": "->", "lw": 1.6}
        )
        _say(axes, name, corner + np.array(end) * 1.25)


def _draw_approach(axes: Axes, chaser: np.ndarray, target: np.ndarray) -> None:
    """Draw the chaser's path, its offset from the target's centre, and the target's turn."""
    behind = target[0] + 0.16
    dotted: Any = {"color": style.GREY, "lw": 1.0, "ls": ":", "zorder": 8}
    axes.plot([chaser[0] + 0.34, behind], [chaser[1]] * 2, **dotted)
    axes.plot([target[0], behind], [target[1]] * 2, **dotted)
    heading = 0.16 * np.array([np.cos(_THETA), np.sin(_THETA)])
    axes.plot(*np.stack([target, target + heading]).T, color=style.VERMILION, lw=1.2, zorder=8)
    axes.add_patch(
        Arc(
            tuple(target),
            *(0.26, 0.26),
            theta1=0,
            theta2=np.rad2deg(_THETA),
            color=style.VERMILION,
            lw=2.0,
            zorder=8,
        )
    )
    _say(axes, "theta > 0", (behind + 0.005, target[1] + 0.012), style.VERMILION, ha="left")
    _measure(axes, (target[0], target[1]), (target[0], chaser[1]), "offset", (-0.034, 0.0))
    axes.plot(*target, **_CENTRE)


def _draw_symbols(axes: Axes, scene: Scene) -> None:
    cone, probe, beta = scene.cone, scene.probe, scene.cone.half_angle
    cylinder = scene.cylinder.length
    h = scene.rest_length + _STROKE
    # the tip at the +y wall, the chaser straight
    along = np.array([np.cos(_TORSION), np.sin(_TORSION)])
    side = np.array([-along[1], along[0]])
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
    draw_shapes(axes, [*state_shapes(scene, q, style.BLUE), *walls])
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
    _measure(axes, be + (0.022, 0), be + (0.022, cone.R_c), "$R_c$", (0.012, 0.0))
    behind = -0.012 * inwards * (1.0, -1.0)
    _measure(axes, other[0] + behind, other[1] + behind, "$L_c$, wall", (-0.012, -0.042))
    outside = -0.013 * inwards
    _measure(axes, edge[0] + outside, face - (cone.L_T, 0.0) + outside, "b", (0.002, 0.012))
    below = -0.03 * side
    _measure(
        axes, hinge - cylinder * along + below, hinge + below, "$L_C$, cylinder", (0.0, -0.014)
    )
    # strokes and torsion with their signs
    _measure(axes, hinge + 0.062 * side, tip + 0.062 * side, "h = $h_0$ + stroke", 0.013 * side)
    arrow = {"arrowstyle": "->", "lw": 2.0, "color": style.VERMILION}
    end, start = (tuple(hinge + share * h * along + 0.022 * side) for share in (0.4, 0.72))
    axes.annotate("", end, start, arrowprops=arrow)
    at = hinge + 0.58 * h * along + 0.037 * side
    _say(axes, "stroke < 0: compression", at, style.VERMILION)
    degrees = np.rad2deg(_TORSION)
    reference = np.array([[0.07, 0.0], [0.105, 0.0]]) + hinge
    axes.plot(*reference.T, color=style.GREY, lw=0.9, ls=":")
    axes.add_patch(Arc(hinge, 0.18, 0.18, theta1=0, theta2=degrees, color=style.VERMILION, lw=2.0))
    _say(axes, "torsion > 0", hinge + (0.09, -0.022), style.VERMILION)
    _say(axes, "tip, radius $R_t$", tip + (-0.035, -0.025))
    axes.plot(*np.stack([other[0], other[0] - (0.036, 0)]).T, color=style.GREY, lw=0.9, ls=":")
    axes.add_patch(Arc(other[0], 0.06, 0.06, theta1=180, theta2=180 + np.rad2deg(beta), lw=1.5))
    _say(axes, r"$\beta$", other[0] + (-0.037, -0.014))
    axes.plot(*np.stack([edge[0], other[0]]).T, color=style.GREEN, lw=1.6, ls=style.FREE_LINE)
    for text, place, to in (
        ("hinge, torsional\nspring $k_T$, $c_T$", hinge + (-0.05, 0.085), hinge + (-0.002, 0.006)),
        (
            "axial spring and\ndamper $k_A$, $c_A$",
            hinge + (0.066, -0.07),
            hinge + 0.04 * along - 0.009 * side,
        ),
        ("+y wall", edge[1] + (0.038, 0.03), edge[1] + (0.004, 0.004)),
        ("-y wall", other[1] + (-0.03, 0.019), other[1] + (-0.002, 0.002)),
    ):
        _point_to(axes, text, place, to)
    axes.plot(*np.array([[q[0], q[1]], [0.0, 0.0]]).T, label="centre of mass", **_CENTRE)
    ball: Any = {"marker": "o", "ms": 15, "color": style.GREY, "mfc": "white", "ls": ""}
    axes.plot([], [], label="ball wheel", **ball)
    target: Any = {"ms": 11, "mew": 2.0, "color": style.GREEN, "ls": "", "zorder": 8}
    axes.plot(*be, marker="+", label="BE, inner edge of the cone: its centre", **target)
    axes.plot([], [], marker="o", mfc="none", label="capture zone", **target)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, -0.06), fontsize=13, frameon=False, ncols=4)
    axes.set_xlim(q[0] - 0.15, 0.145)
    axes.set_ylim(low - 0.05, 0.125)


def _point_to(axes: Axes, text: str, place: Any, to: Any) -> None:
    """Name what is at ``to`` by a text with a line."""
    axes.annotate(
        text,
        tuple(to),
        tuple(place),
        fontsize=13,
        ha="center",
        va="center",
        zorder=9,
        arrowprops={"arrowstyle": "-", "lw": 0.8, "color": style.GREY},
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.8},
    )


def _measure(axes: Axes, start: Any, end: Any, text: str, offset: Any = (0.0, 0.012)) -> None:
    """Draw a length with its symbol beside its middle."""
    arrow = {"arrowstyle": "<->", "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tuple(end), tuple(start), arrowprops=arrow, zorder=7)
    _say(axes, text, (np.asarray(start) + end) / 2 + offset)


def _say(axes: Axes, text: str, at: Any, colour: str = style.BLACK, ha: str = "center") -> None:
    axes.text(at[0], at[1], text, color=colour, fontsize=14, ha=ha, va="center", zorder=9)


def save_capture_gif(run: Run, path: Path | str, pictures: int | None = None) -> Path:
    """Save a capture as a moving picture: the bench, the buffer, the tip in the cone, the force.

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
    path = Path(path)
    touch, decided = first_touch(run.events), decided_at(run)
    begin = 0.0 if touch is None else max(touch.t - 0.15, 0.0)
    end = float(run.samples["t"][-1]) if decided is None else decided
    count = pictures or int((end - begin) * _FPS * _SLOWER) + 1
    [plotted] = plotted_runs(run)
    window = (begin, end)
    frames = [_draw_frame(plotted, float(t), window) for t in np.linspace(begin, end, count)]
    palette = frames[-1].quantize(48)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    times = [1000 // _FPS] * (len(small) - 1) + [2500]
    with whole_file(path) as part:
        small[0].save(part, save_all=True, append_images=small[1:], duration=times, loop=0)
    return path


def _draw_frame(plotted: PlottedRun, t: float, window: tuple[float, float]) -> Image.Image:
    """Draw the bench, the buffer, the tip in the cone and the force at one instant of a window."""
    run, scene = plotted.run, plotted.scene
    figure = new_figure(9.6, 7.0)
    shares = {"width_ratios": [1.7, 1.0], "height_ratios": [1.25, 1.0, 0.9]}
    grid = figure.add_gridspec(3, 2, **shares)
    places = grid[0, 0], grid[1, 0], grid[:2, 1], grid[2, :]
    bench, buffer, cone, force = map(figure.add_subplot, places)
    q = state_at(run, t)
    draw_shapes(bench, [*rail_shapes(scene), *state_shapes(scene, q, plotted.colour)])
    middle = scene.initial.target.x
    bench.set(xlim=(middle - 0.66, middle + 0.24), ylim=(-0.18, 0.17), aspect="equal")
    draw_scale(bench, (middle - 0.35, -0.165), 0.1, "100 mm")
    word = verdict(run) if t >= window[1] else f"1/{_SLOWER} of real time"
    bench.set_title(f"{scene.name}, {t:.2f} s: {word}", fontsize=14, loc="left")
    _draw_buffer(buffer, scene, q, plotted.colour)
    draw_shapes(cone, cone_shapes(scene).values(), 1e3)
    before = run.samples["t"] <= t
    samples = run.samples[before]
    draw_path(cone, scene, samples, plotted.holds[before], plotted.colour)
    outline = circle(tip_in_cone(samples)[-1], scene.probe.tip_radius)
    draw_shapes(cone, [Shape(outline, style.BLACK, 1.0, plotted.colour, order=3.0)], 1e3)
    cone.set(xlim=(-85, 40), ylim=(-80, 80), aspect="equal")
    cone.set_title("the tip in the cone", fontsize=14)
    draw_scale(cone, (10.0, -72.0), 20.0, "20 mm")
    _draw_force(force, plotted, t, window)
    for axes in (bench, buffer, cone):
        axes.set_axis_off()
    figure.set_dpi(72)
    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")  # type: ignore[attr-defined]


def draw_scale(axes: Axes, start: tuple[float, float], length: float, text: str) -> None:
    """Draw a bar of a length in the units of the axes, with its name."""
    x, y = start
    axes.plot([x, x + length], [y, y], color=style.BLACK, lw=3.0, solid_capstyle="butt")
    above = {"xytext": (0, 4), "textcoords": "offset points"}
    axes.annotate(text, (x + length / 2, y), ha="center", fontsize=12, **above)


def _draw_force(axes: Axes, plotted: PlottedRun, t: float, window: tuple[float, float]) -> None:
    """Draw the contact force up to an instant, with the peak of every touch."""
    times, force = plotted.curve(FORCE)
    axes.plot(times[times <= t], force[times <= t], color=plotted.colour, lw=1.8)
    axes.axvline(t, color=style.GREY, lw=1.0)
    dress(axes, font=13.0)
    axes.set(xlim=window, ylim=(0.0, 1.1 * force.max()))
    axes.set_xlabel(f"{time_label([plotted])}  [s]")
    axes.set_ylabel("force  [N]")
    axes.set_title("contact force, with every touch", fontsize=14, loc="left")


def _draw_buffer(axes: Axes, scene: Scene, q: np.ndarray, colour: str) -> None:
    """Draw the buffer large, as seen from the chaser, with the tip's rest position dashed."""
    at_rest = np.zeros(8)
    at_rest[H] = scene.rest_length
    in_chaser = at_rest.copy()
    in_chaser[THETA_P], in_chaser[H] = q[THETA_P] - q[CHASER[2]], q[H]
    rest_tip = circle(tip_in_world(scene, at_rest[None])[0], scene.probe.tip_radius)
    chaser = state_shapes(scene, in_chaser, colour, both=False)
    draw_shapes(axes, [Shape(rest_tip, style.GREY, 1.2, dashed=True, order=3.5), *chaser])
    hinge = scene.buffer.hinge_offset
    axes.set(xlim=(hinge - 0.07, hinge + 0.26), ylim=(-0.05, 0.05), aspect="equal")
    draw_scale(axes, (hinge + 0.15, -0.045), 0.02, "20 mm")
    stroke, torsion = (q[H] - scene.rest_length) * 1e3, in_chaser[THETA_P] * 1e3
    text = f"the buffer: stroke {stroke:+.1f} mm, torsion {torsion:+.1f} mrad"
    axes.set_title(text, fontsize=14, loc="left")


def main(folder: Path) -> None:
    """Write both pictures."""
    print(save(draw_geometry(load_scene("tilt_0")), folder / "geometry.svg"))
    print(save_capture_gif(simulate(load_scene("tilt_p10")), folder / "capture.gif"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
