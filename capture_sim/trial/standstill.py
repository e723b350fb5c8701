"""Detection of a chaser at rest from its measured poses, before a release and after a hold.

Only the chaser's motion shows that a driver ignores launcher/hold.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection
from statistics import median

Pose = tuple[float, float, float]  # x, y (m), heading (rad), in the world

#: Window of the compared poses, s: the median of its first third is compared with the median of
#: the newest poses.
WINDOW = 0.6
#: Maximum number of newest poses.  Their median shows a sudden motion at the third pose and ignores
#: two outliers.  With the last third of the window, a chaser would count as at rest for 0.1 s after
#: a push.
N_NEWEST = 5
#: Minimum time that the poses must cover, s, and minimum number of poses.
MIN_SPAN, MIN_POSES = 0.4, 6
#: Maximum motion of a chaser at rest, m and rad.  Noise of 1 mm stays below it.
MAX_DRIFT, MAX_TURN = 0.003, 0.03
#: A chaser within this distance of its start is back at its start, m.
MAX_START_ERROR = 0.05


class Standstill:
    """Compares the latest poses of the chaser; the caller adds only finite, new poses."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Pose]] = deque()  # s, arrival

    def add(self, pose: Pose, now: float) -> None:
        """Add a pose that arrived at ``now``, s."""
        self._poses.append((now, pose))
        while self._poses[0][0] < now - WINDOW:
            self._poses.popleft()

    def pose(self, now: float) -> Pose | None:
        """Return the median of the poses in the window before ``now``, s; None without any."""
        poses = [pose for t, pose in self._poses if t >= now - WINDOW]
        return median_pose(poses) if poses else None

    def drift(self, now: float) -> tuple[float, float] | None:
        """Return how far the chaser has moved, m, and turned, rad.

        None if there are fewer than :data:`MIN_POSES`, or if they cover less than :data:`MIN_SPAN`.
        """
        poses = [each for each in self._poses if each[0] >= now - WINDOW]
        if len(poses) < MIN_POSES or poses[-1][0] - poses[0][0] < MIN_SPAN:
            return None
        third = len(poses) // 3
        newest = poses[-min(third, N_NEWEST) :]
        first, last = (median_pose([pose for _, pose in p]) for p in (poses[:third], newest))
        turn = math.remainder(last[2] - first[2], 2.0 * math.pi)
        return math.dist(first[:2], last[:2]), abs(turn)

    def motion(self, now: float) -> str:
        """Return the chaser's motion in words; empty if it is at rest or has too few poses."""
        drift = self.drift(now)
        if drift is None or (drift[0] <= MAX_DRIFT and drift[1] <= MAX_TURN):
            return ""
        length, turn = drift
        return (
            f"moves by {1e3 * length:.3g} mm and {math.degrees(turn):.2g} degrees within {WINDOW} s"
        )

    def stands(self, now: float) -> bool:
        """Return True if the poses show that the chaser is at rest."""
        return self.drift(now) is not None and not self.motion(now)


class HeldWatch:
    """Checks that a chaser stops once it is held again after a release.

    ``timeout``: time in which the chaser must stop, s.  Otherwise :attr:`alarm` reports the motion
    until the chaser is at rest at its start.  If too few poses arrive to tell at that time, the
    check is made as soon as there are enough.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._start: Pose | None = None  # pose at the release
        self._held: float = math.nan  # s, time of the hold; NaN while nothing is checked
        self.alarm = ""

    def let_go(self, pose: Pose | None) -> None:
        """Note that the chaser is released at this pose."""
        self._start, self._held = pose, math.nan

    def hold(self, now: float) -> None:
        """Note that the chaser is held from ``now`` on, s."""
        self._held = now

    def update(self, standstill: Standstill, now: float) -> None:
        """Check the motion at ``now``, s, and set or clear :attr:`alarm`."""
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
        elif now > self._held + self._timeout and (motion := standstill.motion(now)):
            # with too few poses to tell, as in a dropout, the check goes on
            self._held = math.nan
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
