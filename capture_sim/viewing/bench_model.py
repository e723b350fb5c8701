"""The bench in three dimensions: static shapes of its parts for the 3D view, in m.

The motion is plane; heights are for the eye only.  The buffer lies at z = 0, the bodies
below it, so that everything can be seen from above.
"""

from __future__ import annotations

import numpy as np

from capture_sim.scene.parts import Cone, Scene

BODY_TOP = -0.03
BODY_HEIGHT = 0.06
BALL_RADIUS = 0.014
FLOOR = BODY_TOP - BODY_HEIGHT - 2 * BALL_RADIUS

#: The string runs beside the bodies, over a pulley behind the target.
STRING_Y = -0.17
PULLEY_RADIUS = 0.02
_PULLEY_BEHIND_TARGET = 0.18


def cone_mesh(cone: Cone, count: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower half of the cone as a mesh in the target's frame.

    The upper half is left out, so that the tip can be seen in it.

    Returns
    -------
    vertices : ndarray (2 count, 3)
        m.
    triangles : ndarray (2 count - 2, 3)
        Indices into the vertices, three each.
    """
    angle = np.linspace(np.pi, 2 * np.pi, count)
    lip_radius = cone.R_c + cone.L_c * np.sin(cone.half_angle)
    lip_x = -cone.L_T - cone.L_c * np.cos(cone.half_angle)
    rings = [
        np.stack([np.full(count, x), r * np.cos(angle), r * np.sin(angle)], axis=-1)
        for x, r in ((-cone.L_T, cone.R_c), (lip_x, lip_radius))
    ]
    first = np.arange(count - 1)
    quads = np.stack([first, first + 1, first + count, first + count + 1], axis=-1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [1, 3, 2]]])
    return np.concatenate(rings), triangles


def pulley_place(scene: Scene) -> np.ndarray:
    """Return the pulley's centre in the world, (3,), m."""
    x = scene.initial.target.x + _PULLEY_BEHIND_TARGET
    return np.array([x, scene.initial.chaser.y + STRING_Y, BODY_TOP - BODY_HEIGHT / 2])


def string_ends(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Return both ends of the string's level part, (n, 2, 3), m, from q (n, 8)."""
    pulley = pulley_place(scene)
    ends = np.empty((len(q), 2, 3))
    ends[:, 0, 0] = q[:, 0]
    ends[:, 0, 1:] = pulley[1:]
    ends[:, 1] = pulley
    ends[:, :, 2] += PULLEY_RADIUS  # it runs over the pulley's top
    return ends


def mass_places(scene: Scene, height: np.ndarray) -> np.ndarray:
    """Return the hanging mass's centre, (n, 3), m, from its heights above the landing (n,)."""
    places = np.tile(pulley_place(scene), (len(height), 1))
    places[:, 0] += PULLEY_RADIUS
    drop = float(height.max(initial=0.0))
    places[:, 2] += height - drop - 0.05
    return places


def yaw_quaternions(angle: np.ndarray) -> np.ndarray:
    """Return turns about z as quaternions x, y, z, w, (n, 4), from rad (n,)."""
    half = 0.5 * np.asarray(angle)
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def helix(radius: float, turns: int = 9, per_turn: int = 16) -> np.ndarray:
    """Return a coil round x from 0 to 1, (n, 3); its radius is in m."""
    angle = np.linspace(0.0, 2 * np.pi * turns, turns * per_turn + 1)
    x = angle / angle[-1]
    return np.stack([x, radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
