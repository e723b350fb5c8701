"""The whole bench from above, drawn with matplotlib in the world."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from capture_sim.scene.parts import BallSupport, Scene
from capture_sim.viewing import palette
from capture_sim.viewing.canvas import SMALL
from capture_sim.viewing.geometry import (
    CHASER,
    TARGET,
    chaser_box,
    hinge_in_world,
    placed,
    target_box,
    tip_in_world,
    wall,
)
from capture_sim.viewing.source import ViewableRun, first_touch, start_word

_BALL_RADIUS = 0.009  # m, for the eye only
_HALF_GAUGE = 0.03  # m, half of the rail's width


def draw_bench(axes: Axes, run: ViewableRun) -> str:
    """Draw the vehicles at the start (dashed) and at the first touch (solid), m.

    Returns
    -------
    str
        What is seen, in words.
    """
    scene, start = run.scene, run.samples["q"][0]
    touch = first_touch(run)
    then = run.samples["q"][-1] if touch is None else touch.q
    moved = bool(np.linalg.norm(then[:2] - start[:2]) > 0.01)
    _draw_rail(axes, scene)
    if moved:
        _draw_chaser(axes, scene, start, ghost=True)
    draw_state(axes, scene, then, named=True)
    finish_bench(axes)
    when = "end of the run" if touch is None else "first touch"
    return f"at the {start_word(scene)} and at the {when}" if moved else f"at the {when}"


def draw_state(axes: Axes, scene: Scene, q: np.ndarray, *, named: bool = False) -> None:
    """Draw both vehicles at the coordinates q (8,)."""
    _draw_chaser(axes, scene, q, ghost=False, named=named)
    _draw_target(axes, scene, q, named=named)


def finish_bench(axes: Axes) -> None:
    """Set scale, margins and labels."""
    axes.set_aspect("equal")
    axes.margins(0.03)
    axes.set_xlabel("x in the world  [m]")
    axes.set_ylabel("y  [m]")


def _draw_rail(axes: Axes, scene: Scene) -> None:
    """Draw the rail as far as it guides the chaser's centre."""
    if scene.rail is None:
        return
    start = scene.initial.chaser
    for side in (_HALF_GAUGE, -_HALF_GAUGE):
        ends = np.array([[0.0, side], [scene.rail.length, side]])
        line = placed(ends, start.x, start.y, start.theta)
        axes.plot(*line.T, color=palette.ORANGE, lw=2.0, solid_capstyle="butt", zorder=0.5)


def _draw_chaser(
    axes: Axes, scene: Scene, q: np.ndarray, *, ghost: bool, named: bool = False
) -> None:
    colour, line = (palette.GREY, "--") if ghost else (palette.BLACK, "-")
    pose = q[list(CHASER)]
    outline = placed(chaser_box(scene).corners, *pose)
    axes.plot(*outline.T, color=colour, ls=line, lw=1.0 if ghost else 1.5)
    hinge, tip = hinge_in_world(scene, q[None])[0], tip_in_world(scene, q[None])[0]
    axes.plot(*np.stack([hinge, tip]).T, color=colour, ls=line, lw=1.0 if ghost else 3.0)
    axes.add_patch(
        Circle(
            (tip[0], tip[1]),
            scene.probe.tip_radius,
            facecolor="none" if ghost else palette.SKY,
            edgecolor=colour,
            ls=line,
            zorder=3,
        )
    )
    if ghost:
        return
    axes.add_patch(Polygon(outline, facecolor=palette.LIGHT, edgecolor="none", zorder=0))
    if scene.supports is not None:
        _draw_balls(axes, scene.supports.chaser, pose)
    if named:
        _label(axes, "chaser", outline)


def _draw_target(axes: Axes, scene: Scene, q: np.ndarray, *, named: bool) -> None:
    pose = q[list(TARGET)]
    outline = placed(target_box(scene).corners, *pose)
    axes.add_patch(Polygon(outline, facecolor=palette.LIGHT, edgecolor="none", zorder=0))
    axes.plot(*outline.T, color=palette.BLACK)
    for side, colour in ((1, palette.PLUS_WALL), (-1, palette.MINUS_WALL)):
        face = wall(scene.cone, side) - (scene.cone.L_T, 0.0)
        axes.plot(*placed(face, *pose).T, color=colour, lw=3.0, solid_capstyle="round")
    if scene.supports is not None:
        _draw_balls(axes, scene.supports.target, pose)
    if named:
        degrees = round(float(np.rad2deg(pose[2])))
        _label(axes, f"target\n{degrees:+d}°" if degrees else "target\n0°", outline)


def _draw_balls(axes: Axes, support: BallSupport, pose: np.ndarray) -> None:
    for ball in placed(np.array(support.balls), *pose):
        axes.add_patch(
            Circle(
                (ball[0], ball[1]), _BALL_RADIUS, facecolor="white", edgecolor=palette.GREY, lw=0.9
            )
        )


def _label(axes: Axes, text: str, outline: np.ndarray) -> None:
    """Write along a body's front-to-rear axis, in its middle."""
    middle = outline[:4].mean(axis=0)
    along = outline[1] - outline[0]
    turn = float(np.rad2deg(np.arctan2(along[1], along[0])))
    axes.text(
        middle[0],
        middle[1],
        text,
        ha="center",
        va="center",
        fontsize=SMALL,
        rotation=turn,
        zorder=4,  # over the ghost and the balls
        bbox={"facecolor": palette.LIGHT, "edgecolor": "none", "pad": 2.0},
    )
