"""The launch of a bench without simulator, watched by measured poses alone.

Between two poses 0.1 s apart, noise of 1 mm makes a speed error of 14 mm/s.  So speed and travel
are those of a straight line fitted to many poses; the scatter of the poses around it gives the
uncertainty of the speed.
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
from capture_sim.launch.watch import Launcher, LauncherStatus
from capture_sim.scene.parts import PlanarState, Scene

#: A fit goes over this time, s, and over this many poses at least.
WINDOW, ENOUGH = 0.3, 12
#: Time between two fits, s.
PERIOD = 0.1
#: After a longer gap, or a step back of the stamps by more, a fit starts again, s.
MAX_GAP = 0.5
#: Poses before the release that give the start; without them, those just after it.
START, FIRST = 50, 5
#: Poses that begin later than this after the release do not show where it was, s.
LATEST_START = 0.5
#: The tip has met the cone when the median of this many travels is this close, m, as a bench's
#: poses are no better.  A fit that goes over the contact shows a speed that is too low, and of a
#: rebound it may never come that far.
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
        self._stamps: deque[float] = deque(maxlen=FIRST)  # s, of the poses before the fit
        self._start: Pose | None = None
        self._is_late = False
        self._target: Pose | None = None
        self._zero = math.nan  # s, stamp of the release
        self._released = math.inf  # s, its arrival
        self._last = 0.0  # s, the latest pose,
        self._observed = 0.0  # ... and when the launch was last evaluated
        self._fit = TravelFit()
        self._travels: deque[float] = deque(maxlen=LATEST)
        self._furthest = 0.0  # m, largest median of these
        self._contact_travel = launcher.plan.travel

    def release(self, arrival: float) -> None:
        """Note that the chaser was let go; ``arrival``: s by the clock of :meth:`add_chaser`."""
        self._released = arrival
        if len(self._stamps) == FIRST:
            self._begin()

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
            self._at_rest.append(pose)
            self._stamps.append(stamp)
            if arrival > self._released and len(self._stamps) == FIRST:
                self._begin()
                self._is_late = arrival > self._released + LATEST_START
            return None
        x, y, heading = self._start
        t = stamp - self._zero
        travel = (pose[0] - x) * math.cos(heading) + (pose[1] - y) * math.sin(heading)
        self._travels.append(travel)
        if len(self._travels) == LATEST:
            self._furthest = max(self._furthest, median(self._travels))
        estimate = self._fit.add(t, travel)
        follows, self._last = 0.0 <= t - self._last <= MAX_GAP, t
        if estimate is None:
            if follows and t - self._observed >= MAX_GAP:
                # a chaser that does not move, or a source that lost its view: only the time counts
                self._observed = t
                speed = self._launcher.status.measured_speed
                return self._launcher.observe(speed, False, False, t=t)
            return None
        self._observed = t
        self._predict_contact(pose, travel)
        return self._launcher.observe(
            estimate.speed,
            estimate.t > self._launcher.plan.landing_time,
            self._furthest > self._contact_travel - REACH,
            t=estimate.t,
            travel=None if self._is_late else estimate.travel,
            speed_deviation=estimate.speed_deviation,
        )

    def _begin(self) -> None:
        """Take the poses so far for those of the start."""
        self._start, self._zero = _median(self._at_rest), median(self._stamps)

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
