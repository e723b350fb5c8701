"""Whether the chaser stands, by its measured poses: before a release, and after it was held.

A driver that ignores launcher/hold shows in nothing but the motion.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection
from statistics import median

Pose = tuple[float, float, float]  # x, y (m), heading (rad), in the world

#: The poses of this window are compared, s: the median of the first third with that of the newest.
WINDOW = 0.6
#: The newest poses.  Their median shows a sudden motion in the third pose, and ignores two wild
#: ones; by that of a third of the window, a chaser would stand for 0.1 s after it was pushed.
N_NEWEST = 5
#: The poses must cover this time, s, and there must be this many of them.
MIN_SPAN, MIN_POSES = 0.4, 6
#: A chaser stands if it moved by at most this, m and rad.  Noise of 1 mm stays below it.
MAX_DRIFT, MAX_TURN = 0.003, 0.03
#: It is back at its start within this distance, m.
MAX_START_ERROR = 0.05


class Standstill:
    """Compares the latest poses of the chaser, which must be finite and new."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Pose]] = deque()  # s, arrival

    def add(self, pose: Pose, now: float) -> None:
        """Note a pose at its arrival ``now``, s."""
        self._poses.append((now, pose))
        while self._poses[0][0] < now - WINDOW:
            self._poses.popleft()

    def pose(self, now: float) -> Pose | None:
        """Return the median of the latest poses; None without any."""
        poses = [pose for t, pose in self._poses if t >= now - WINDOW]
        return median_pose(poses) if poses else None

    def drift(self, now: float) -> tuple[float, float] | None:
        """Return how far the chaser has moved, m, and turned, rad; None while that is not known."""
        poses = [each for each in self._poses if each[0] >= now - WINDOW]
        if len(poses) < MIN_POSES or poses[-1][0] - poses[0][0] < MIN_SPAN:
            return None
        third = len(poses) // 3
        newest = poses[-min(third, N_NEWEST) :]
        first, last = (median_pose([pose for _, pose in p]) for p in (poses[:third], newest))
        turn = math.remainder(last[2] - first[2], 2.0 * math.pi)
        return math.dist(first[:2], last[:2]), abs(turn)

    def motion(self, now: float) -> str:
        """Return in words how the chaser moves; empty if it stands, or if too few poses tell."""
        drift = self.drift(now)
        if drift is None or (drift[0] <= MAX_DRIFT and drift[1] <= MAX_TURN):
            return ""
        length, turn = drift
        return (
            f"moves by {1e3 * length:.3g} mm and {math.degrees(turn):.2g} degrees within {WINDOW} s"
        )

    def stands(self, now: float) -> bool:
        """Return True if the poses show that it stands."""
        return self.drift(now) is not None and not self.motion(now)


class HeldWatch:
    """Follows whether a chaser that was let go stops once it is held again.

    ``timeout``: s, in which it must.  Otherwise :attr:`alarm` says so until it stands at its start.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._start: Pose | None = None  # where it was let go
        self._held: float = math.nan  # s, when it was held; NaN while nothing is watched
        self.alarm = ""

    def let_go(self, pose: Pose | None) -> None:
        """Note that it is let go at a pose."""
        self._start, self._held = pose, math.nan

    def hold(self, now: float) -> None:
        """Note that it is held from ``now`` on, s."""
        self._held = now

    def update(self, standstill: Standstill, now: float) -> None:
        """Look at the motion at ``now``, s."""
        stands = standstill.stands(now)
        if self.alarm:
            pose = standstill.pose(now)
            if stands and pose and (self._start is None or _is_near(pose, self._start)):
                self.alarm = ""
            return
        if math.isnan(self._held):
            return
        if stands and now > self._held + MIN_SPAN:
            self._held = math.nan
        elif now > self._held + self._timeout:
            self._held = math.nan
            if motion := standstill.motion(now):
                self.alarm = (
                    f"the chaser {motion}, {self._timeout:g} s after launcher/hold was set: its "
                    "driver does not hold it; nothing is let go before it stands at its start"
                )


def median_pose(poses: Collection[Pose]) -> Pose:
    """Return the pose of a vehicle at rest: the median of each coordinate."""
    x, y, heading = zip(*poses, strict=True)
    turn = median(math.remainder(each - heading[0], 2.0 * math.pi) for each in heading)
    return median(x), median(y), heading[0] + turn


def _is_near(pose: Pose, start: Pose) -> bool:
    return math.dist(pose[:2], start[:2]) <= MAX_START_ERROR
