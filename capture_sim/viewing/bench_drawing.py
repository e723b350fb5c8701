"""The whole bench from above, drawn with matplotlib in the world."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from capture_sim.scene import Scene
from capture_sim.viewing import palette
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
from capture_sim.viewing.source import ViewableRun, first_touch


def draw_bench(axes: Axes, run: ViewableRun) -> None:
    """Draw the vehicles at the release (dashed) and at the first touch (solid), m."""
    scene, start = run.scene, run.samples["q"][0]
    touch = first_touch(run)
    at_touch = run.samples["q"][-1] if touch is None else touch.q
    if np.linalg.norm(at_touch[:2] - start[:2]) > 0.01:
        _draw_chaser(axes, scene, start, ghost=True)
    _draw_chaser(axes, scene, at_touch, ghost=False)
    _draw_target(axes, scene, at_touch)
    axes.set_aspect("equal")
    axes.margins(0.03)
    axes.set_xlabel("x in the world  [m]")
    axes.set_ylabel("y  [m]")


def _draw_chaser(axes: Axes, scene: Scene, q: np.ndarray, *, ghost: bool) -> None:
    colour, line = (palette.GREY, "--") if ghost else (palette.BLACK, "-")
    outline = placed(chaser_box(scene).corners, *q[list(CHASER)])
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
    if not ghost:
        axes.add_patch(Polygon(outline, facecolor=palette.LIGHT, edgecolor="none", zorder=0))
        _label(axes, "chaser", outline)


def _draw_target(axes: Axes, scene: Scene, q: np.ndarray) -> None:
    pose = q[list(TARGET)]
    outline = placed(target_box(scene).corners, *pose)
    axes.add_patch(Polygon(outline, facecolor=palette.LIGHT, edgecolor="none", zorder=0))
    axes.plot(*outline.T, color=palette.BLACK)
    for side, colour in ((1, palette.PLUS_WALL), (-1, palette.MINUS_WALL)):
        face = wall(scene.cone, side) - (scene.cone.L_T, 0.0)
        axes.plot(*placed(face, *pose).T, color=colour, lw=3.0, solid_capstyle="round")
    degrees = round(float(np.rad2deg(pose[2])))
    _label(axes, f"target {degrees:+d}°" if degrees else "target 0°", outline)


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
        fontsize=12,
        rotation=turn,
        bbox={"facecolor": palette.LIGHT, "edgecolor": "none", "pad": 2.0},  # over the ghost's line
    )
