"""The launch of a real bench, monitored from measured poses alone.

Between two poses 0.1 s apart, noise of 1 mm causes a speed error of 14 mm/s.  Therefore speed and
travel are computed from a straight line fitted to many poses.  The standard deviation of the poses
about the line gives the uncertainty of the speed.

The poses are stamped by the bench's clock, and a busy node processes poses late and in batches.
Therefore the time of the release is known only roughly, and the time to contact is counted from the
start of the motion.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from statistics import median
from typing import NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import plain
from capture_sim.launcher.state_machine import (
    Launcher,
    LauncherStatus,
    LaunchObservation,
)
from capture_sim.run.touches import unseen_impact
from capture_sim.scene.geometry import nearest_on_wall, tip_motion
from capture_sim.scene.launch_plan import expected_time, tip_at_release, travel_to_touch
from capture_sim.scene.parts import PlanarState, Scene
from capture_sim.trial.rest import WINDOW, Pose, Rest, median_of

#: Duration of a fit, s, and the minimum number of its poses.
FIT_WINDOW, MIN_FIT_POSES = 0.3, 12
#: Time between two fits, s.
FIT_PERIOD = 0.1
#: A fit restarts after a longer gap, or after the stamps step back by more than this, s.
MAX_FIT_GAP = 0.5
#: The start is the median of the poses that arrived in this time before the release, s.  The
#: interlocks require the chaser to be at rest in this time; earlier poses may show how it was
#: pulled back.  The second value is the minimum number of poses.  If there are fewer, the first
#: poses after the release are used as well.
START_WINDOW, MIN_START_POSES = WINDOW, 5
#: Poses that arrive within this time after the release count as poses at rest, s (wall): they were
#: delayed in the node, or show a chaser that has moved by less than 0.1 mm.
SETTLING_TIME = 0.05
#: If the first poses arrive later than this after the release, they do not show its start, s.
MAX_START_DELAY = 0.5
#: The motion has started once the chaser has travelled this far, m.
MIN_MOTION = 0.01
#: The tip has met the cone when the median of this many gaps or travels is within this distance of
#: contact, m, because poses of a bench are no more accurate.  A fit that includes the contact gives
#: a speed that is too low.
N_LATEST, CONTACT_DISTANCE = 5, 0.005
#: Motion of the target before the contact that noise of its poses does not explain, m and rad.
MAX_TARGET_MOTION, MAX_TARGET_TURN = 0.005, 0.03
#: The travel to the cone is predicted until the tip is this close to the cone, m.
MIN_PREDICTION_DISTANCE = 0.02


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
        self._fitted = -math.inf  # s, time of the last fit

    def add(self, t: float, travel: float) -> TravelEstimate | None:
        """Add a measured travel (m) at a stamp (s); return an estimate every :data:`FIT_PERIOD`."""
        points = self._points
        if points:
            last_t, last_travel = points[-1]
            if not -MAX_FIT_GAP <= t - last_t <= MAX_FIT_GAP:
                points.clear()
                self._fitted = -math.inf
            elif t <= last_t or travel == last_travel:
                return None  # out of order, repeated, or frozen because the source lost sight of it
        points.append((t, travel))
        while len(points) > MIN_FIT_POSES and points[0][0] < t - FIT_WINDOW:
            points.popleft()
        if len(points) < MIN_FIT_POSES or t - self._fitted < FIT_PERIOD:
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
    """Follows a launch on a real bench by measured poses; :class:`Launcher` decides."""

    def __init__(self, launcher: Launcher, scene: Scene) -> None:
        self._launcher, self._scene = launcher, scene
        self._at_rest: deque[tuple[float, Pose]] = deque()  # s, arrival
        self._stamps: deque[float] = deque(maxlen=MIN_START_POSES)  # s, of the last poses at rest
        self._start: Pose | None = None
        self._late_by = 0.0  # s, from the release to the first pose; 0 if poses arrived before
        self._target: Pose | None = None
        self._target_rest = Rest()
        self._target_start: tuple[float, ...] | None = None  # pose at the release
        #: How the target has moved between the release and the contact; empty if it has not.
        self.target_motion = ""
        self._deflection = (0.0, 0.0)  # of the buffer, m and rad
        self._zero = math.nan  # s, stamp of the release
        self._released = math.inf  # s, release by the clock of the arrivals
        self._delay = 0.0  # s, from the release to the start of the motion
        self.has_moved = False  # the chaser has started to move
        self._last = 0.0  # s, time of the latest pose since the release
        self._last_arrival = math.nan  # s
        self._observed = 0.0  # s, time of the last evaluation of the launch
        self._fit = TravelFit()
        self._fit_end = -math.inf  # m, travel up to which the speed is measured
        self._travels: deque[float] = deque(maxlen=N_LATEST)
        self._gaps: deque[float] = deque(maxlen=N_LATEST)
        self._furthest = 0.0  # m, largest median of the travels
        self._contact_travel = launcher.plan.travel
        self._has_touched = False

    @property
    def gap(self) -> float:
        """Gap between the tip and the cone by the latest poses, m; NaN while it is unknown."""
        return self._gaps[-1] if self._gaps else math.nan

    def release(self, arrival: float) -> None:
        """Note the release of the chaser; ``arrival``: s by the clock of :meth:`add_chaser`."""
        self._released = arrival
        self._target_start = self._target_rest.median(arrival)

    def add_target(self, pose: Pose, arrival: float) -> None:
        """Note the target's latest pose; a pose that is not finite is ignored.

        ``arrival`` as of :meth:`add_chaser`.
        """
        if not all(map(math.isfinite, pose)):
            return
        self._target = pose
        if self._has_touched:
            return
        self._target_rest.add(pose, arrival)
        if self._target_start is not None and not self.target_motion:
            self.target_motion = self._motion_of_target(arrival)

    def _motion_of_target(self, now: float) -> str:
        """Return how the target has moved since the release; empty if it is where it was."""
        newest = self._target_rest.newest()
        is_near = not self._gaps or min(self._gaps) < MIN_PREDICTION_DISTANCE
        if newest is None or self._target_start is None or is_near:  # near: the chaser may push it
            return ""
        moved = math.dist(newest[:2], self._target_start[:2])
        turned = abs(math.remainder(newest[2] - self._target_start[2], math.tau))
        if moved <= MAX_TARGET_MOTION and turned <= MAX_TARGET_TURN:
            return ""
        return (
            f"target: moved by {1e3 * moved:.3g} mm and {math.degrees(turned):.2g} degrees before "
            f"the contact, {now - self._released:.2f} s after the release: the speed of impact is "
            "not that of the chaser"
        )

    def add_buffer(self, stroke: float, torsion: float) -> None:
        """Note the buffer's latest stroke (m) and torsion (rad), if they are finite."""
        if math.isfinite(stroke) and math.isfinite(torsion):
            self._deflection = (stroke, torsion)

    def note_contact(self) -> None:
        """Note that the tip has met the cone, or may have met it, although no pose shows it."""
        self._has_touched = True

    def may_have_touched(self, silence: float) -> bool:
        """Return True if the tip may have met the cone.

        ``silence``: time since the last pose, s, in which the tip may have travelled on.
        """
        return self._has_touched or self._reaches(silence)

    def add_chaser(self, stamp: float, pose: Pose, arrival: float) -> LauncherStatus | None:
        """Add the chaser's pose; return the launcher's status if it was evaluated.

        ``stamp``: s by the bench's clock; ``arrival``: s by any steady clock.  A ``pose`` that is
        not finite is ignored.
        """
        if not all(map(math.isfinite, pose)):
            return None
        if self._target is not None:
            self._gaps.append(gap_to_cone(self._scene, pose, self._target, self._deflection))
        if self._start is None:
            self._find_start(stamp, pose, arrival)
        if self._start is None:
            self._last_arrival = arrival
            return None
        x, y, heading = self._start
        t = stamp - self._zero
        travel = (pose[0] - x) * math.cos(heading) + (pose[1] - y) * math.sin(heading)
        estimate = self._fit.add(t, travel)
        if estimate is not None:
            self._predict_contact(pose, travel)
        # an outlier of the stamps, or a busy node, is not a gap between poses
        silence = max(0.0, min(t - self._last, arrival - self._last_arrival))
        self._note_travel(travel, silence)
        follows = 0.0 <= t - self._last <= MAX_FIT_GAP
        self._last, self._last_arrival = t, arrival
        is_overdue = follows and t - self._observed >= MAX_FIT_GAP
        is_delivered = self._has_touched and self._launcher.is_under_way
        if estimate is None and not is_overdue and not is_delivered:
            return None
        self._observed = t
        return self._observe(estimate, t, travel)

    def _find_start(self, stamp: float, pose: Pose, arrival: float) -> None:
        """Collect poses at rest; set the start at the first pose after the release has settled."""
        if len(self._stamps) == MIN_START_POSES and arrival > self._released + SETTLING_TIME:
            x, y, heading = median_of([each for _, each in self._at_rest])
            self._start = x, y, heading
            self._zero = median(self._stamps) - self._late_by
            return
        at_rest = self._at_rest
        at_rest.append((arrival, pose))
        while at_rest[0][0] < arrival - START_WINDOW and len(at_rest) > MIN_START_POSES:
            at_rest.popleft()
        self._stamps.append(stamp)
        if arrival > self._released + MAX_START_DELAY:
            self._late_by = self._late_by or arrival - self._released

    def _note_travel(self, travel: float, silence: float) -> None:
        """Note a travel, m, and whether the tip has met the cone by now.

        ``silence``: time without poses before this pose, s; the tip may have met the cone in it.
        """
        self._has_touched = self._has_touched or self._reaches(silence)
        self._travels.append(travel)
        if len(self._travels) == N_LATEST:
            self._furthest = max(self._furthest, median(self._travels))
        is_at_cone = len(self._gaps) == N_LATEST and median(self._gaps) <= CONTACT_DISTANCE
        self._has_touched = self._has_touched or is_at_cone or self._reaches(0.0)

    def _reaches(self, silence: float) -> bool:
        """Return True if the tip, moving on from its furthest travel, can reach the cone.

        ``silence``: time for which the travel is extrapolated, s.
        """
        speed = max(self._launcher.status.measured_speed, 0.0)
        if silence > FIT_PERIOD:  # the mass may have accelerated the chaser meanwhile
            speed = max(speed, self._launcher.plan.landing_speed)
        return self._furthest + speed * silence > self._contact_travel - CONTACT_DISTANCE

    def _observe(self, estimate: TravelEstimate | None, t: float, travel: float) -> LauncherStatus:
        """Let the launcher evaluate an estimate; without an estimate, only time and contact."""
        launcher, is_late = self._launcher, self._late_by > 0.0
        plan = launcher.plan
        if estimate is None:
            # no estimates result from a chaser at rest, or from a source that has lost sight of it
            speed, speed_deviation = launcher.status.measured_speed, 0.0
            t, is_slack, fitted = t - self._delay, False, math.nan
        else:
            if estimate.travel > MIN_MOTION and not self.has_moved:
                self.has_moved = True
                self._delay = max(
                    0.0, estimate.t - expected_time(self._scene, plan, estimate.travel)
                )
            t, is_slack = estimate.t - self._delay, estimate.t - self._delay > plan.landing_time
            speed, speed_deviation = estimate.speed, estimate.speed_deviation
            fitted = math.nan if is_late else estimate.travel
        if is_late and self._late_by > (1.0 - launcher.tolerance) * plan.contact_time:
            t = math.nan  # the motion before the first pose is unknown
        unseen = self._unseen() if self._has_touched else ""
        if estimate is not None:
            self._fit_end = max(self._fit_end, travel)
        return launcher.observe(
            LaunchObservation(
                t, speed, fitted, is_slack, self._has_touched, speed_deviation, unseen
            )
        )

    def _unseen(self) -> str:
        """Return why the impact speed is unknown; empty if poses cover the approach."""
        if self._late_by > 0.0 and not math.isfinite(self._fit_end):
            return f"impact speed not measured: poses begin {self._late_by:.3g} s after the release"
        return unseen_impact(self._contact_travel - CONTACT_DISTANCE - self._fit_end)

    def _predict_contact(self, pose: Pose, travel: float) -> None:
        """Update the travel at which the tip meets the cone; infinite if the tip will miss it."""
        if self._target is None or travel > self._contact_travel - MIN_PREDICTION_DISTANCE:
            return
        initial = self._scene.initial
        measured = replace(
            initial, chaser=_at(initial.chaser, pose), target=_at(initial.target, self._target)
        )
        self._contact_travel = travel + travel_to_cone(replace(self._scene, initial=measured))


def travel_to_cone(scene: Scene) -> float:
    """Return the chaser's travel to the first touch or into the throat, m; ``inf`` for a miss.

    A tip that moves along the cone's axis passes BE, the cone's inner edge, without a touch.
    """
    travel = travel_to_touch(scene)
    if math.isfinite(travel):
        return travel
    px, py, ux, uy = tip_at_release(scene)
    to_BE = -(px + scene.cone.L_T) / ux if ux > 0.0 else math.inf
    passes = to_BE >= 0.0 and abs(py + uy * to_BE) <= scene.cone.R_c
    return to_BE if passes else math.inf


def gap_to_cone(
    scene: Scene, chaser: Pose, target: Pose, deflection: tuple[float, float] = (0.0, 0.0)
) -> float:
    """Return the gap between the tip and the cone's walls, m; <= 0 in contact and in the throat.

    ``deflection``: stroke (m) and torsion (rad) of the buffer.
    """
    stroke, torsion = deflection
    theta, phi, theta_T = chaser[2], chaser[2] + torsion, target[2]
    q = (*chaser, phi, scene.rest_length + stroke, *target)
    sines = (math.sin(theta), math.cos(theta), math.sin(phi), math.cos(phi))
    px, py, _, _ = plain(tip_motion)(
        (*q, *8 * (0.0,)), scene.buffer.hinge_offset, *sines, math.sin(theta_T), math.cos(theta_T)
    )
    ahead_of_BE = -(px + scene.cone.L_T)
    gap = min(
        plain(nearest_on_wall)(ahead_of_BE, side * py, *scene.cone.wall)[0] for side in (1.0, -1.0)
    )
    gap -= scene.probe.tip_radius
    return min(gap, 0.0) if ahead_of_BE <= 0.0 and abs(py) <= scene.cone.R_c else gap


def _at(state: PlanarState, pose: Pose) -> PlanarState:
    x, y, theta = pose
    return replace(state, x=x, y=y, theta=math.remainder(theta, 2.0 * math.pi))
