"""The frame of a trial's poses, and the same poses in the frame of the scene.

Only the relative motion of the vehicles counts, so the origin and the direction of the cameras'
frame are free.  A frame that is far from the scene's is estimated from the first poses, and taken
out: the search for the start poses begins at those of the scene.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from capture_sim.run.run import Run
from capture_sim.run.series import Series
from capture_sim.scene.parts import PlanarState, Scene

#: A frame is taken out if it is turned or moved by more than this, rad and m.
_TURNED, _MOVED = 0.05, 0.02
#: Time from the first pose over which the first poses are averaged, s.
_FIRST = 0.1


class Frame(NamedTuple):
    """A rigid motion in the plane: turn, rad, then shift, m."""

    angle: float = 0.0
    x: float = 0.0
    y: float = 0.0

    @property
    def is_far(self) -> bool:
        """True if it is no scatter of a placement."""
        return abs(self.angle) > _TURNED or math.hypot(self.x, self.y) > _MOVED

    @property
    def text(self) -> str:
        """The frame in words, e.g. for the note that it was taken out."""
        moved = 1e3 * math.hypot(self.x, self.y)
        return f"turned by {math.degrees(self.angle):+.3g} deg and moved by {moved:.3g} mm"

    def applied(self, poses: np.ndarray) -> np.ndarray:
        """Return poses (n, 3) moved by the frame, m, m and rad."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        x, y, theta = poses.T
        moved = [c * x - s * y + self.x, s * x + c * y + self.y, theta + self.angle]
        return np.column_stack(moved)

    def turned(self, rates: np.ndarray) -> np.ndarray:
        """Return rates (n, 3) turned by the frame, m/s, m/s and rad/s."""
        return Frame(self.angle).applied(rates) - [0.0, 0.0, self.angle]


#: The frame of the scene itself.
NO_FRAME = Frame()


def in_frame_of_scene(run: Run, scene: Scene) -> tuple[Run, Frame]:
    """Return a run with its poses in the frame of a scene, and what brings the poses there.

    A frame that is as near as a placement is, is left as it is; a run without poses of both
    vehicles too.
    """
    frame = _frame(run, scene)
    if not frame.is_far:
        return run, NO_FRAME
    changed = dict(run.series)
    for vehicle in ("chaser", "target"):
        for name, move in ((vehicle, frame.applied), (f"{vehicle}_rate", frame.turned)):
            if name in changed:
                changed[name] = {
                    topic: Series(each.t, move(each.values))
                    for topic, each in changed[name].items()
                }
    return run.replaced(series=changed), frame


def first_poses(run: Run) -> np.ndarray | None:
    """Return the first poses of chaser and target, (2, 3), m, m and rad; None if one has none."""
    first = []
    for vehicle in ("chaser", "target"):
        series = run.measured(vehicle)
        if not series.t.size:
            return None
        kept = series.values[series.t <= series.t[0] + _FIRST]
        theta = kept[:, 2]
        heading = math.atan2(np.sin(theta).mean(), np.cos(theta).mean())
        first.append([*np.median(kept[:, :2], axis=0), heading])
    return np.array(first)


def _frame(run: Run, scene: Scene) -> Frame:
    """Return the rigid motion of the first poses to the start poses of the scene."""
    measured = first_poses(run)
    if measured is None:
        return NO_FRAME
    starts = (scene.initial.chaser, scene.initial.target)
    known = np.array([_pose(state) for state in starts])
    # three directions: of both headings, and of the line between the vehicles; the median, because
    # a target that a trial has placed at another angle turns no frame
    angles = np.array([*(known[:, 2] - measured[:, 2]), _bearing(known) - _bearing(measured)])
    angle = angles[0] + float(np.median(_wrapped(angles - angles[0])))
    turned = Frame(angle).applied(measured)
    shift = (known - turned)[:, :2].mean(axis=0)
    return Frame(float(_wrapped(np.array(angle))), *shift.tolist())


def _pose(state: PlanarState) -> tuple[float, float, float]:
    return state.x, state.y, state.theta


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.asarray(np.arctan2(np.sin(angles), np.cos(angles)))


def _bearing(poses: np.ndarray) -> float:
    x, y = poses[1, :2] - poses[0, :2]
    return math.atan2(y, x)
