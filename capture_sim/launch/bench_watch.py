"""The launch of a bench without simulator, watched by measured poses alone.

Between two poses 0.1 s apart, noise of 1 mm makes a speed error of 14 mm/s.  So speed and travel
are those of a straight line fitted to many poses; the scatter of the poses around it gives the
uncertainty of the speed.

The stamps of the poses are those of the bench's clock, and a busy node evaluates poses late and in
clumps.  So the moment of the release is known only roughly, and the time to the contact counts from
the beginning of the motion.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection
from dataclasses import replace
from statistics import median
from typing import NamedTuple

import numpy as np

from capture_sim.launch.plan import travel_to_touch
from capture_sim.launch.watch import Launcher, LauncherStatus, expected_time
from capture_sim.scene.parts import PlanarState, Scene

#: A fit goes over this time, s, and over this many poses at least.
WINDOW, ENOUGH = 0.3, 12
#: Time between two fits, s.
PERIOD = 0.1
#: After a longer gap, or a step back of the stamps by more, a fit starts again, s.
MAX_GAP = 0.5
#: Poses before the release that give the start; without them, the first ones after it.
START, FIRST = 50, 5
#: Poses that arrive within this time after the release have waited for the node, s (wall): the
#: chaser was still at rest, or has moved by less than 0.1 mm.
SETTLE = 0.05
#: Poses that begin later than this after the release do not show where it was, s.
LATEST_START = 0.5
#: A chaser that has travelled this far has begun to move, m.
MOVED = 0.01
#: The tip has met the cone when the median of this many travels is this close, m, as a bench's
#: poses are no better, or comes this close at the last speed in a gap between two poses.  A fit
#: that goes over the contact shows a speed that is too low.
LATEST, REACH = 5, 0.005
#: The travel to the cone is predicted until the tip is this close to it, m.
CLOSE = 0.02

Pose = tuple[float, float, float]  # x, y (m), heading (rad), in the world


class TravelEstimate(NamedTuple):
    """Travel (m) and speed (m/s) at a time (s), and the speed's standard deviation."""

    t: float
    travel: float
    speed: float
    speed_deviation: float


class TravelFit:
    """A straight line through the latest travels of the chaser (least squares)."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, float]] = deque()
        self._fitted = -math.inf  # s, the last fit

    def add(self, t: float, travel: float) -> TravelEstimate | None:
        """Add a measured travel (m) at a stamp (s); return an estimate every :data:`PERIOD`."""
        points = self._points
        if points:
            last_t, last_travel = points[-1]
            if not -MAX_GAP <= t - last_t <= MAX_GAP:
                points.clear()
                self._fitted = -math.inf
            elif t <= last_t or travel == last_travel:
                return None  # overtaken, repeated, or frozen by a source that lost its view
        points.append((t, travel))
        while len(points) > ENOUGH and points[0][0] < t - WINDOW:
            points.popleft()
        if len(points) < ENOUGH or t - self._fitted < PERIOD:
            return None
        self._fitted = t
        times, travels = np.array(points).T
        middle, mean = times.mean(), travels.mean()
        times = times - middle
        square = float(times @ times)
        speed = float(times @ travels) / square
        rest = travels - mean - speed * times
        scatter = math.sqrt(float(rest @ rest) / (len(points) - 2))
        return TravelEstimate(float(middle), float(mean), speed, scatter / math.sqrt(square))


class BenchWatch:
    """Follows a launch on a bench from its poses; see :class:`Launcher` for what it decides."""

    def __init__(self, launcher: Launcher, scene: Scene) -> None:
        self._launcher, self._scene = launcher, scene
        self._at_rest: deque[Pose] = deque(maxlen=START)
        self._stamps: deque[float] = deque(maxlen=FIRST)  # s, of the last of these
        self._start: Pose | None = None
        self._is_late = False
        self._target: Pose | None = None
        self._zero = math.nan  # s, stamp of the release
        self._released = math.inf  # s, its arrival
        self._delay = 0.0  # s, from the release to the beginning of the motion
        self._has_moved = False
        self._last = 0.0  # s, the latest pose,
        self._observed = 0.0  # ... and when the launch was last evaluated
        self._fit = TravelFit()
        self._travels: deque[float] = deque(maxlen=LATEST)
        self._furthest = 0.0  # m, largest median of these
        self._contact_travel = launcher.plan.travel
        self._has_touched = False

    def release(self, arrival: float) -> None:
        """Note that the chaser was let go; ``arrival``: s by the clock of :meth:`add_chaser`."""
        self._released = arrival

    def add_target(self, pose: Pose) -> None:
        """Note the target's latest pose; one that is not finite is left out."""
        if all(map(math.isfinite, pose)):
            self._target = pose

    def add_chaser(self, stamp: float, pose: Pose, arrival: float) -> LauncherStatus | None:
        """Take the chaser's pose; return the launcher's status if it was evaluated.

        ``stamp``: s by the bench's clock; ``arrival``: s by any steady clock.  A ``pose`` that is
        not finite is left out.
        """
        if not all(map(math.isfinite, pose)):
            return None
        if self._start is None:
            self._find_start(stamp, pose, arrival)
        if self._start is None:
            return None
        x, y, heading = self._start
        t = stamp - self._zero
        travel = (pose[0] - x) * math.cos(heading) + (pose[1] - y) * math.sin(heading)
        estimate = self._fit.add(t, travel)
        if estimate is not None:
            self._predict_contact(pose, travel)
        follows = 0.0 <= t - self._last <= MAX_GAP
        had_touched = self._has_touched
        self._note_travel(travel, t - self._last if follows else 0.0)
        self._last = t
        is_overdue = follows and t - self._observed >= MAX_GAP
        if estimate is None and not is_overdue and self._has_touched is had_touched:
            return None
        self._observed = t
        if estimate is not None:
            return self._observe(estimate)
        # a chaser at rest gives no estimates, nor does a source that has lost its view
        speed = self._launcher.status.measured_speed
        return self._launcher.observe(speed, False, self._has_touched, t=t - self._delay)

    def _find_start(self, stamp: float, pose: Pose, arrival: float) -> None:
        """Collect poses of the start; the first one after the release ends that."""
        if len(self._stamps) == FIRST and arrival > self._released + SETTLE:
            self._start, self._zero = _median(self._at_rest), median(self._stamps)
            return
        self._at_rest.append(pose)
        self._stamps.append(stamp)
        self._is_late = arrival > self._released + LATEST_START

    def _note_travel(self, travel: float, since_last: float) -> None:
        """Note whether the tip has met the cone by now, or since the last pose, s before."""
        self._travels.append(travel)
        if len(self._travels) == LATEST:
            self._furthest = max(self._furthest, median(self._travels))
        unseen = max(self._launcher.status.measured_speed, 0.0) * since_last
        if self._furthest + unseen > self._contact_travel - REACH:
            self._has_touched = True

    def _observe(self, estimate: TravelEstimate) -> LauncherStatus:
        """Let the launcher evaluate an estimate."""
        plan = self._launcher.plan
        if estimate.travel > MOVED and not self._has_moved:
            self._has_moved = True
            self._delay = max(0.0, estimate.t - expected_time(plan, estimate.travel))
        t = estimate.t - self._delay
        return self._launcher.observe(
            estimate.speed,
            t > plan.landing_time,
            self._has_touched,
            t=t,
            travel=None if self._is_late else estimate.travel,
            speed_deviation=estimate.speed_deviation,
        )

    def _predict_contact(self, pose: Pose, travel: float) -> None:
        """Update the travel at which the tip meets the cone; infinite if it will miss it."""
        if self._target is None or travel > self._contact_travel - CLOSE:
            return
        initial = self._scene.initial
        measured = replace(
            initial, chaser=_at(initial.chaser, pose), target=_at(initial.target, self._target)
        )
        self._contact_travel = travel + travel_to_touch(replace(self._scene, initial=measured))


def _median(poses: Collection[Pose]) -> Pose:
    """Return the pose of a vehicle at rest: the median of each coordinate."""
    x, y, heading = zip(*poses, strict=True)
    turned = median(math.remainder(each - heading[0], 2.0 * math.pi) for each in heading)
    return median(x), median(y), heading[0] + turned


def _at(state: PlanarState, pose: Pose) -> PlanarState:
    x, y, theta = pose
    return replace(state, x=x, y=y, theta=math.remainder(theta, 2.0 * math.pi))
