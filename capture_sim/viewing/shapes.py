"""Shapes of the bench and the cone from above, m, for plots, report and rerun.

Shapes of the vehicles and the rail are in the world frame.  Shapes of the cone are in the cone's
frame: its origin is the centre of BE, its x and y point along the target's +x and +y.  The chaser
comes from -x, and the walls open towards -x.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from capture_sim.messages.urdf import chaser_box, target_box
from capture_sim.scene.parts import Cone, Scene
from capture_sim.viewing import style

#: Indices in the coordinates q (8,) and velocities v (8,), ordered as samples.COORDINATES: x, y and
#: angle of chaser and of target, angle of the probe, and distance ``h`` from the hinge to the tip.
CHASER = (0, 1, 2)
TARGET = (5, 6, 7)
THETA_P, H = 3, 4
#: Points of the arc round each end of a wall, see :func:`tip_bound`.
ARC_POINTS = 40

# for the eye only, m
_BALL_RADIUS = 0.009
_HALF_GAUGE = 0.03
_WALL_THICKNESS = 0.006
_HOUSING, _COLLAR, _COIL = 0.010, 0.012, 0.008  # half-widths of the buffer's parts
_TURNS = 8


class Shape(NamedTuple):
    """A line through points, or an outline that may be filled."""

    points: np.ndarray  # (n, 2), m
    line: str = style.BLACK  # its colour; empty for no line
    width: float = 1.5  # points
    fill: str = ""  # colour inside; empty for none
    dashed: bool = False
    order: float = 2.0  # a higher order is drawn over a lower one


def placed(points: np.ndarray, x: float, y: float, theta: float) -> np.ndarray:
    """Return points (n, 2), m, transformed from a body's frame to the world frame.

    ``x``, ``y`` (m) and ``theta`` (rad) are the pose of the body in the world frame.
    """
    c, s = np.cos(theta), np.sin(theta)
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + (x, y))


def hinge_in_world(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Return the positions of the probe's hinge in the world frame, (n, 2), m, from q (n, 8)."""
    heading = np.stack([np.cos(q[:, 2]), np.sin(q[:, 2])], axis=-1)
    return np.asarray(q[:, :2] + scene.buffer.hinge_offset * heading)


def tip_in_world(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Return the positions of the tip's centre in the world frame, (n, 2), m, from q (n, 8)."""
    probe = np.stack([np.cos(q[:, THETA_P]), np.sin(q[:, THETA_P])], axis=-1)
    return np.asarray(hinge_in_world(scene, q) + q[:, H, None] * probe)


def wall(cone: Cone, side: int) -> np.ndarray:
    """Return the two ends of a wall's face in the cone's frame, (2, 2), m: inner edge, then lip.

    ``side`` is +1 for the wall on the side of +y, and -1 for the wall on the side of -y.
    """
    inner = np.array([0.0, side * cone.R_c])
    along = np.array([-np.cos(cone.half_angle), side * np.sin(cone.half_angle)])
    return np.stack([inner, inner + cone.L_c * along])


def circle(centre: np.ndarray, radius: float, count: int = 73) -> np.ndarray:
    """Return points on a circle, (count, 2), m; the last is the first again."""
    angle = np.linspace(0.0, 2 * np.pi, count)
    return np.asarray(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def rail_shapes(scene: Scene) -> list[Shape]:
    """Return the two lines of the rail in the world frame; an empty list if the scene has no rail.

    The rail lies along the chaser's initial pose.  It guides the chaser's centre over
    ``rail.length`` but is drawn longer, because it carries the whole chaser: at both ends by the
    distance from the chaser's centre to its rear.
    """
    if scene.rail is None:
        return []
    start, box = scene.initial.chaser, chaser_box(scene)
    ends = np.array([[box.back, 1.0], [scene.rail.length - box.back, 1.0]])
    return [
        Shape(placed(ends * (1.0, y), start.x, start.y, start.theta), style.GREY, 2.0, order=0.5)
        for y in (_HALF_GAUGE, -_HALF_GAUGE)
    ]


def state_shapes(
    scene: Scene, q: np.ndarray, colour: str, *, ghost: bool = False, both: bool = True
) -> list[Shape]:
    """Return the vehicles in the world frame at the coordinates q (8,).

    Parameters
    ----------
    colour
        Colour that fills the tip, i.e. the colour of the run.
    ghost
        True for an outline of the vehicles at another time than the main drawing's: the lines are
        grey and dashed, nothing is filled, a line from the hinge to the tip's centre replaces the
        buffer, and the balls that support the vehicles are left out.
    both
        True for chaser and target, False for the chaser alone.
    """
    pose = q[list(CHASER)]
    line = style.GREY if ghost else style.BLACK
    width, fill = (1.0, "") if ghost else (1.5, style.LIGHT)
    hinge, tip = hinge_in_world(scene, q[None])[0], tip_in_world(scene, q[None])[0]
    body = placed(chaser_box(scene).corners, *pose)
    tip_fill = "" if ghost else colour
    shapes = [
        Shape(body, line, width, fill, ghost, 1.0),
        Shape(circle(tip, scene.probe.tip_radius, 37), line, 1.0, tip_fill, ghost, 3.0),
    ]
    if ghost:
        shapes.append(Shape(np.stack([hinge, tip]), line, 1.0, dashed=True))
    else:
        shapes += buffer_shapes(scene, q)
    if scene.supports is not None and not ghost:
        shapes += _balls(scene.supports.chaser.balls, pose)
    if not both:
        return shapes
    pose = q[list(TARGET)]
    shapes.append(Shape(placed(target_box(scene).corners, *pose), line, width, fill, ghost, 1.0))
    for side in style.WALLS:
        face = wall(scene.cone, side) - (scene.cone.L_T, 0.0)
        shapes.append(Shape(placed(face, *pose), style.DARK, 3.0, dashed=ghost))
    if scene.supports is not None and not ghost:
        shapes += _balls(scene.supports.target.balls, pose)
    return shapes


def buffer_shapes(scene: Scene, q: np.ndarray) -> list[Shape]:
    """Return cylinder, rod, spring, collar and hinge pin of the buffer, at the coordinates q (8,).

    They are in the world frame.  The rod slides in the cylinder.  The spring reaches from the hinge
    to the collar, which is fixed to the rod, so the spring is drawn shorter when the probe is
    pushed in.
    """
    x, y = hinge_in_world(scene, q[None])[0].tolist()
    h, probe = float(q[H]), scene.probe
    front = h - probe.tip_radius
    collar = h - (probe.tip_radius + 0.5 * probe.length)
    share = np.linspace(0.0, 1.0, 4 * _TURNS + 1)
    coil = np.stack([share * collar, _COIL * np.sin(2 * np.pi * _TURNS * share)], axis=-1)
    rod = np.array([[front - probe.length, 0.0], [front, 0.0]])
    ring = np.array([[collar, -_COLLAR], [collar, _COLLAR]])
    housing = np.array([[-1.0, -1.0], [0.0, -1.0], [0.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    housing *= (max(scene.cylinder.length, _HOUSING), _HOUSING)
    pin = circle(np.zeros(2), 0.4 * _HOUSING, 19)
    return [
        Shape(placed(points, x, y, float(q[THETA_P])), line, width, fill, order=order)
        for points, line, width, fill, order in (
            (housing, style.GREY, 1.0, "#FFFFFF", 2.0),
            (rod, style.BLACK, 2.4, "", 2.1),
            (coil, style.BROWN, 1.2, "", 2.2),
            (ring, style.BLACK, 2.4, "", 2.3),
            (pin, style.BLACK, 1.0, style.DARK, 2.4),
        )
    ]


def _balls(balls: Iterable[Sequence[float]], pose: np.ndarray) -> list[Shape]:
    centres = placed(np.array(list(balls)), *pose)
    return [
        Shape(circle(centre, _BALL_RADIUS, 25), style.GREY, 0.9, "#FFFFFF", order=1.5)
        for centre in centres
    ]


def tip_in_cone(samples: np.ndarray) -> np.ndarray:
    """Return the positions of the tip's centre in the cone's frame, (n, 2), m, at samples (n,)."""
    return np.stack([-samples["tip_axial"], samples["tip_lateral"]], axis=-1)


def tip_bound(cone: Cone, tip_radius: float, side: int) -> np.ndarray:
    """Return the line on which the tip's centre is when the tip just touches a wall, (k, 2), m.

    It is in the cone's frame and consists of an arc round the wall's inner edge, a straight line
    along the wall's face, and an arc round the lip, in this order.  Each arc has ``ARC_POINTS``
    points.  ``side`` is +1 or -1, as for :func:`wall`.
    """
    inner, lip = wall(cone, side)
    # the face looks to the axis and to the chaser: against side * y, turned by the half-angle
    facing = -side * (np.pi / 2 + cone.half_angle)
    at_edge = np.linspace(-side * np.pi / 2, facing, ARC_POINTS)  # from the throat on
    at_lip = np.linspace(facing, facing - side * np.pi / 2, ARC_POINTS)
    arcs = [
        centre + tip_radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        for centre, angle in ((inner, at_edge), (lip, at_lip))
    ]
    return np.concatenate(arcs)


def cone_shapes(scene: Scene) -> dict[str, Shape]:
    """Return the shapes of the cone in the cone's frame, by name.

    They are the body and the face of each wall, the line on which the tip's centre is when the tip
    just touches the wall, and the capture zone.
    """
    cone = scene.cone
    shapes = {}
    for side, (*_, name) in style.WALLS.items():
        face = wall(cone, side)
        body = np.concatenate([face, (face + _outwards(cone, side) * _WALL_THICKNESS)[::-1]])
        shapes[f"body of the {name}"] = Shape(body, "", 0.0, style.LIGHT, order=1.0)
        shapes[name] = Shape(face, style.DARK, 4.0)
        bound = tip_bound(cone, scene.probe.tip_radius, side)
        shapes[f"centre when touching the {name}"] = Shape(bound, style.GREY, 1.0, dashed=True)
    zone = circle(np.zeros(2), scene.detector.capture_radius)
    shapes["capture zone"] = Shape(zone, style.ZONE, 2.3, order=4.0)
    return shapes


def _outwards(cone: Cone, side: int) -> np.ndarray:
    """Return the unit vector from a wall's face into the wall's body, (2,), in the cone's frame."""
    return np.array([np.sin(cone.half_angle), side * np.cos(cone.half_angle)])


def wall_name_place(cone: Cone, side: int) -> np.ndarray:
    """Return the place of a wall's name, (2,), m, in the cone's frame.

    It is beside the wall's body, where the plots have neither a legend nor the list of the instants
    at which the tip is drawn.
    """
    share = 0.6 if side > 0 else 0.15
    inner, lip = wall(cone, side)
    middle = (1.0 - share) * inner + share * lip
    return np.asarray(middle + 1.9 * _WALL_THICKNESS * _outwards(cone, side))
