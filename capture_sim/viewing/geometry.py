"""Shapes to draw, as plain arrays in m.

Cone's frame here: x from the centre of BE along the target's +x, y along its +y.  The
chaser comes from -x; the walls open towards it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from capture_sim.scene.parts import Cone, Scene

#: Where the parts of q and v stand, see samples.COORDINATES.
CHASER = (0, 1, 2)
TARGET = (5, 6, 7)
THETA_P, H = 3, 4


# Bodies are drawn as boxes; the scene gives their masses, not their sizes.
_HALF_WIDTH = 0.11  # m
_REAR = 0.13  # m, centre of mass to the rear


class Box(NamedTuple):
    """Extent of a vehicle's body in its own frame, m."""

    back: float
    front: float
    half_width: float

    @property
    def corners(self) -> np.ndarray:
        """Closed outline, (5, 2), m."""
        x0, x1, y = self.back, self.front, self.half_width
        return np.array([[x0, -y], [x1, -y], [x1, y], [x0, y], [x0, -y]])


def chaser_box(scene: Scene) -> Box:
    """Return the chaser's body: up to just behind the hinge."""
    return Box(-_REAR, 0.9 * scene.buffer.a, _HALF_WIDTH)


def target_box(scene: Scene) -> Box:
    """Return the target's body: from just behind BE."""
    return Box(-0.9 * scene.cone.L_T, _REAR, _HALF_WIDTH)


def placed(points: np.ndarray, x: float, y: float, theta: float) -> np.ndarray:
    """Return points of a body's frame, (n, 2), in the world, m."""
    c, s = np.cos(theta), np.sin(theta)
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + (x, y))


def tip_in_cone(samples: np.ndarray) -> np.ndarray:
    """Return the tip's centre in the cone's frame, (n, 2), m."""
    return np.stack([-samples["tip_axial"], samples["tip_lateral"]], axis=-1)


def tip_in_world(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Return the tip's centre in the world, (n, 2), m, from q (n, 8)."""
    hinge = hinge_in_world(scene, q)
    probe = np.stack([np.cos(q[:, THETA_P]), np.sin(q[:, THETA_P])], axis=-1)
    return np.asarray(hinge + q[:, H, None] * probe)


def hinge_in_world(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Return the hinge in the world, (n, 2), m, from q (n, 8)."""
    heading = np.stack([np.cos(q[:, 2]), np.sin(q[:, 2])], axis=-1)
    return np.asarray(q[:, :2] + scene.buffer.a * heading)


def wall(cone: Cone, side: int) -> np.ndarray:
    """Return the wall on side +1 or -1: inner edge and outer lip, (2, 2), m."""
    inner = np.array([0.0, side * cone.R_c])
    along = np.array([-np.cos(cone.beta), side * np.sin(cone.beta)])
    return np.stack([inner, inner + cone.L_c * along])


def tip_bound(cone: Cone, tip_radius: float, side: int, count: int = 40) -> np.ndarray:
    """Return where the tip's centre is when the tip just touches a wall, (k, 2), m.

    A line along the wall's face, and an arc round each of its ends.
    """
    inner, lip = wall(cone, side)
    # the face looks to the axis and to the chaser
    normal = np.array([-np.sin(cone.beta), -side * np.cos(cone.beta)])
    facing = np.arctan2(normal[1], normal[0])
    # round the inner edge on into the throat, round the lip outwards
    throat = _nearest(-side * np.pi / 2, facing)
    at_edge = np.linspace(throat, facing, count)
    at_lip = np.linspace(facing, facing - side * np.pi / 2, count)
    arcs = [
        centre + tip_radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        for centre, angle in ((inner, at_edge), (lip, at_lip))
    ]
    return np.concatenate(arcs)


def _nearest(angle: float, reference: float) -> float:
    """Return the angle, by whole turns, that is nearest to the reference, rad."""
    return float(angle + 2 * np.pi * np.round((reference - angle) / (2 * np.pi)))


def circle(centre: np.ndarray, radius: float, count: int = 73) -> np.ndarray:
    """Return a closed circle, (count, 2), m."""
    angle = np.linspace(0.0, 2 * np.pi, count)
    return np.asarray(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
