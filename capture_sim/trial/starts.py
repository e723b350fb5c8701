"""Where a scene starts: the target's pose in the chaser's frame, and which other scenes are near.

Bodies that are where another scene starts would be launched by the wrong plan, and recorded under
the wrong name.  Therefore the tolerance of a start is at most a third of its distance to the
nearest other start: no pose is then within the tolerance of two scenes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from capture_sim.scene.parts import Scene
from capture_sim.trial.rest import MAX_START_ERROR, Pose

#: Maximum rotation of the target from its start, rad, if no other scene is near.
MAX_START_TURN = math.radians(10.0)
#: Starts within this distance of each other are one start, in units of the largest tolerance.
SAME_START = 1e-3


def relative(chaser: Sequence[float], target: Sequence[float]) -> Pose:
    """Return the target's pose in the chaser's frame; both are x, y (m) and heading (rad)."""
    x, y = target[0] - chaser[0], target[1] - chaser[1]
    s, c = math.sin(chaser[2]), math.cos(chaser[2])
    return c * x + s * y, c * y - s * x, math.remainder(target[2] - chaser[2], math.tau)


def start_of(scene: Scene) -> Pose:
    """Return the target's pose in the chaser's frame at the start of a scene."""
    chaser, target = scene.initial.chaser, scene.initial.target
    return relative((chaser.x, chaser.y, chaser.theta), (target.x, target.y, target.theta))


def differences(a: Pose, b: Pose) -> tuple[float, float]:
    """Return distance, m, and angle, rad, between two relative poses."""
    return math.dist(a[:2], b[:2]), abs(math.remainder(a[2] - b[2], math.tau))


def nearest_other(start: Pose, starts: Mapping[str, Pose], found: Pose) -> str:
    """Return the name of another start that ``found`` is nearer to than to ``start``, or empty.

    ``starts``: the relative poses of the known scenes by name.
    """
    own = _size(differences(found, start))
    others = {
        name: _size(differences(found, pose))
        for name, pose in starts.items()
        if _size(differences(start, pose)) > SAME_START
    }
    name = min(others, key=others.__getitem__, default="")
    return name if name and others[name] < own else ""


def tolerances(start: Pose, starts: Mapping[str, Pose]) -> tuple[float, float]:
    """Return the permitted distance, m, and rotation, rad, of the bodies from a scene's start.

    The one by which the nearest other start differs more is at most a third of that difference.
    """
    distance, turn = MAX_START_ERROR, MAX_START_TURN
    for pose in starts.values():
        apart = differences(start, pose)
        if _size(apart) <= SAME_START:
            continue
        if apart[0] / MAX_START_ERROR > apart[1] / MAX_START_TURN:
            distance = min(distance, apart[0] / 3.0)
        else:
            turn = min(turn, apart[1] / 3.0)
    return distance, turn


def shown(pose: Pose) -> str:
    """Return a relative pose in words."""
    return f"{pose[0]:.3f} m ahead, {pose[1]:.3f} m left, turned {math.degrees(pose[2]):.1f} deg"


def _size(apart: tuple[float, float]) -> float:
    return math.hypot(apart[0] / MAX_START_ERROR, apart[1] / MAX_START_TURN)
