"""The gate: a filter that rejects poses which a vehicle cannot have had, e.g. of swapped markers.

A new pose must agree with a prediction, the last accepted pose moved at the present velocity.  The
tolerance is the largest change of velocity by an impact times the elapsed time, plus the noise of
both poses.  An acceleration limit would be useless, because an impact changes the velocity within
0.3 ms, less than the time between two frames.  An impact never changes a position at once, so the
poses of a bounce are accepted.  This is the validation gate of a constant-velocity filter
(Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 2001), widened for
impacts.

Poses outside the tolerance are held back until later poses show which of them are the vehicle's.
The choice follows the longest consistent subsequence for bounded speed and unbounded acceleration
(Custers et al., Maximum Physically Consistent Trajectories, ACM Trans. Spatial Algorithms Syst.
7(4), 2021).  Wrong frames come in sequences, so the elements of the subsequence are not single
poses, but sequences of successive poses that agree with each other.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from capture_sim.detection.measurements import Counts, Reason, Source, Values
from capture_sim.detection.noise import NoiseEstimate, Resolution, third_difference
from capture_sim.scene.launch_plan import plan_launch
from capture_sim.scene.parts import Scene

#: Largest difference of a pose from its prediction that noise explains, in standard deviations.
GATE = 5.0
#: Safety factor on the largest relative speed, planned or present, from which the limits follow.
MARGIN = 2.0
#: Smallest relative speed assumed, m/s, because vehicles at rest may be pushed by hand.
MIN_SPEED = 0.05
#: Smaller differences from the prediction (m, rad) are always accepted, because steps of quantised
#: poses and delays of stamps cause them.
MIN_INNOVATION = (2e-3, 5e-3)
#: If poses agree at a new place for longer than this, s, the vehicle has moved there.
JUMP_TIME = 0.3
#: Longest time for which poses that contradict each other are held back, s.
_MAX_HOLD = 1.0
#: Number of consistent poses that confirm a return to the path, and the beginning of a path.
_CONFIRM, _START = 3, 6
#: The tolerance for a single pose grows with the time since the last pose only up to this time, s,
#: or up to the source's interval if that is longer.  A pose within this tolerance is near.
_NEAR_TIME = 0.02
#: A new place that agrees with one of the last accepted poses, this number of them, is no jump.  A
#: contact explains the shift, as wrong frames near a contact may have been accepted.
_SLIPPED = 6
#: Time over which the present velocity is averaged, s.
_VELOCITY_TIME = 0.1
#: Noise (m, m, rad) above which a source never repeats a pose by chance.
_MIN_NOISE = (5e-6, 5e-6, 2e-5)
#: Number of third differences for the noise.  It is small, because errors of stamps add noise only
#: while the vehicle moves.
_N_NOISE = 60
#: A source repeats poses often if this many of its last poses, the second number, are repeated.
_OFTEN, _N_EQUAL = 6, 20
_SQRT2 = math.sqrt(2.0)


class PoseLimits(NamedTuple):
    """Largest changes of a vehicle's velocity and spin by contacts, per m/s of relative speed."""

    velocity: float  # m/s
    spin: float  # rad/s

    @classmethod
    def of(cls, scene: Scene, source: Source) -> PoseLimits:
        """Return the limits of a vehicle, the chaser or the target of a scene.

        In the frame of the common centre of mass, a contact can only turn the velocities or make
        them smaller.  The energy of a spin is at most that of the relative motion.
        """
        vehicle, other = scene.chaser, scene.target
        if source is Source.TARGET:
            vehicle, other = other, vehicle
        share = other.mass / (vehicle.mass + other.mass)
        return cls(2.0 * share, math.sqrt(vehicle.mass * share / vehicle.inertia))


def largest_speed(scene: Scene) -> float:
    """Return the largest relative speed of the vehicles that a scene plans, m/s.

    It follows from the initial motion and the launch plan, and is at least :data:`MIN_SPEED`.
    """
    chaser, target, plan = scene.initial.chaser, scene.initial.target, plan_launch(scene)
    relative = math.hypot(chaser.vx - target.vx, chaser.vy - target.vy)
    spins = abs(chaser.omega) * (scene.buffer.hinge_offset + scene.rest_length)
    spins += abs(target.omega) * (scene.cone.L_T + scene.cone.R_c)
    return max(MIN_SPEED, plan.landing_speed, plan.impact_speed, relative + spins)


class Pose(NamedTuple):
    """Pose of a vehicle at a time ``t``, s; its values are those of :class:`Source`."""

    t: float
    values: Values


class _Run:
    """Sequence of successive poses that are consistent with each other.

    ``is_reachable`` is True if the vehicle can have moved to the first of them from the last
    accepted pose.  ``is_far`` is True if only the time since that pose makes this possible.
    """

    def __init__(self, first: Pose, *, is_reachable: bool, is_far: bool) -> None:
        self.poses = [first]
        self.is_reachable = is_reachable
        self.is_far = is_far

    @property
    def is_confirmed(self) -> bool:
        """True if there are enough reachable poses to conclude that they are the vehicle's.

        Wrong frames often follow lost frames.  After a longer loss the vehicle may have moved as
        far as the distance of a wrong frame.  Poses that are reachable only because of this long
        time are confirmed by as many poses as the beginning of a path.
        """
        return self.is_reachable and len(self.poses) >= (_START if self.is_far else _CONFIRM)

    @property
    def duration(self) -> float:
        return self.poses[-1].t - self.poses[0].t


class Jump(NamedTuple):
    """Jump of a vehicle to a new place: time of its first pose there, s, and distance, m."""

    t: float
    distance: float


class Gate:
    """Filter of the poses of one vehicle, which passes on the poses that it can have had.

    Poses are added and passed on in the order of their stamps.
    """

    def __init__(self, source: Source, limits: PoseLimits, counts: Counts) -> None:
        #: The last jump after which the vehicle stayed at its new place; None if there was none.
        self.jump: Jump | None = None
        #: Time up to which every pose is passed on or rejected, s.
        self.decided = -math.inf
        #: Present velocity (m/s, m/s, rad/s) of the vehicle.
        self.velocity = (0.0, 0.0, 0.0)
        self._source, self._limits, self._counts = source, limits, counts
        self._noise = tuple(NoiseEstimate(_N_NOISE) for _ in range(3))
        self._steps = tuple(Resolution() for _ in range(3))
        self._raw: deque[Pose] = deque(maxlen=4)  # the last poses that are not frozen
        self._equal: deque[tuple[bool, bool]] = deque(maxlen=_N_EQUAL)  # all, any coordinates
        self._distinct: deque[Pose] = deque(maxlen=4)  # the last poses that differ from each other
        self._of_distinct = NoiseEstimate(_N_EQUAL)  # m, of x and y of these
        self._repeated = 0  # number of times that a noisy source has repeated its last pose
        self._early: list[Pose] = []  # poses before the noise is known
        self._held: list[_Run] = []
        self._last: Pose | None = None  # the last pose that was passed on
        self._recent: deque[Pose] = deque()
        self._speed = 0.0  # m/s, largest relative speed

    @property
    def resolution(self) -> tuple[float, float]:
        """Steps of a quantised position, m, and heading, rad; 0 if they are not quantised."""
        x, y, theta = (step.value for step in self._steps)
        return max(x, y), theta

    def add(self, t: float, values: Values, speed: float) -> list[Pose]:
        """Add a pose at time ``t``, s; return the poses that are accepted with it, in order.

        They are the new pose, or poses that were held back until this one confirmed them; the list
        is empty while poses contradict each other.  ``speed`` is the vehicles' largest relative
        speed, m/s, which limits the change of velocity by an impact.
        """
        pose = Pose(t, values)
        self._speed = MARGIN * speed
        if self._is_frozen(pose):
            self._counts.reject(self._source, Reason.FROZEN)
        else:
            self._learn(pose)
            self._early.append(pose)
        passed: list[Pose] = []
        if self._noise[0].known:
            for each in self._early:
                passed += self._add(each)
            self._early.clear()
        if not self._held and not self._early:
            self.decided = t
        return passed

    def finish(self) -> list[Pose]:
        """Return the poses still held back that can be the vehicle's, and reject the others."""
        if not self._noise[0].known:
            passed, self._early = self._early, []
            return passed
        if self._held and self._last is None:
            return self._choose(max(self._held, key=lambda run: len(run.poses)))
        reachable = [
            run for run in self._held if run.is_confirmed or (run.is_reachable and not run.is_far)
        ]
        return self._choose(reachable[-1] if reachable else None)

    def _is_frozen(self, pose: Pose) -> bool:
        """Return True if a pose repeats the last pose although the source's noise prevents this.

        The noise does so if it exceeds the resolution.  A first repetition may be chance, unless
        the source often repeats a pose, as a driver does that sends at a higher rate than it
        measures.
        """
        if not self._distinct:
            self._distinct.append(pose)
            return False
        if not self._note_equal(pose):
            self._repeated = 0
            return False
        in_all, in_any = (sum(column) for column in zip(*self._equal, strict=True))
        # steps of a quantised source are equal in one coordinate where another one changes
        if in_all >= _OFTEN and in_any <= in_all + 1 and self._of_distinct.latest > _MIN_NOISE[0]:
            return True
        if self._repeated or any(
            step.is_noisy and noise.latest > max(step.value, least)
            for noise, step, least in zip(self._noise, self._steps, _MIN_NOISE, strict=True)
        ):
            self._repeated += 1
        return self._repeated > 1

    def _note_equal(self, pose: Pose) -> bool:
        """Note which coordinates are those of the last pose; return True if all are."""
        same = [a == b for a, b in zip(pose.values[:3], self._distinct[-1].values, strict=False)]
        self._equal.append((all(same), any(same)))
        if not all(same):
            self._distinct.append(pose)
            if len(self._distinct) == 4:
                weights = third_difference([each.t for each in self._distinct])
                for k in (0, 1):
                    values = (each.values[k] for each in self._distinct)
                    self._of_distinct.add(sum(w * x for w, x in zip(weights, values, strict=True)))
        return all(same)

    def _learn(self, pose: Pose) -> None:
        """Update the estimates of noise and resolution with a pose.

        Poses that are rejected later also count, because they are too few to matter.
        """
        if self._raw:
            for step, a, b in zip(self._steps, pose.values, self._raw[-1].values, strict=False):
                step.add(a - b)
        self._raw.append(pose)
        if len(self._raw) == 4:
            weights = third_difference([each.t for each in self._raw])
            heading = self._raw[0].values[2]
            sums = [0.0, 0.0, 0.0]
            for weight, (_, (x, y, theta, *_rates)) in zip(weights, self._raw, strict=True):
                sums[0] += weight * x
                sums[1] += weight * y
                sums[2] += weight * math.remainder(theta - heading, math.tau)
            for noise, total in zip(self._noise, sums, strict=True):
                noise.add(total)

    def _add(self, pose: Pose) -> list[Pose]:
        last, held = self._last, self._held
        is_near = last is not None and self._agrees(last, pose, self._near_time)
        if is_near and not held:
            self._accept(pose)
            return [pose]
        is_reachable = is_near or (last is not None and self._agrees(last, pose))
        if held and self._agrees(held[-1].poses[-1], pose):
            # a wrong frame may be so near that it agrees with both
            is_return = is_reachable and not held[-1].is_reachable
            before = held[-1].poses[-1]
            if is_return and last is not None and self._is_nearer(pose, last, before):
                held.append(_Run(pose, is_reachable=True, is_far=not is_near))
            else:
                held[-1].poses.append(pose)
        else:
            held.append(_Run(pose, is_reachable=is_reachable, is_far=not is_near))
        run = held[-1]
        if last is None:
            return self._choose(run) if len(run.poses) >= _START else []
        if run.is_reachable:
            return self._choose(run) if run.is_confirmed else []
        if run.duration > JUMP_TIME or pose.t - held[0].poses[0].t > _MAX_HOLD:
            first = run.poses[0]
            if not any(self._agrees(pose, first) for pose in list(self._recent)[-_SLIPPED:]):
                self.jump = Jump(first.t, math.dist(first.values[:2], last.values[:2]))
                self.velocity = (0.0, 0.0, 0.0)
                self._recent.clear()
            return self._choose(run)
        return []

    def _innovation(self, a: Pose, b: Pose) -> tuple[float, float]:
        """Return the difference of pose ``b`` from its prediction from pose ``a``, m and rad."""
        dt = b.t - a.t
        x, y, theta = (
            new - old - rate * dt
            for new, old, rate in zip(b.values[:3], a.values[:3], self.velocity, strict=True)
        )
        return math.hypot(x, y), abs(math.remainder(theta, math.tau))

    def _is_nearer(self, pose: Pose, a: Pose, b: Pose) -> bool:
        """Return True if a pose is nearer to the prediction from pose ``a`` than from ``b``."""
        arm = 1.0 / max(self._limits.spin, 1e-3)  # m, to compare angles with lengths
        of_a, of_b = self._innovation(a, pose), self._innovation(b, pose)
        return of_a[0] + arm * of_a[1] < of_b[0] + arm * of_b[1]

    @property
    def _near_time(self) -> float:
        """Longest time for which the tolerance for a single pose grows, s; see ``_NEAR_TIME``."""
        recent = self._recent
        if len(recent) < 2:
            return _NEAR_TIME
        return max(_NEAR_TIME, (recent[-1].t - recent[0].t) / (len(recent) - 1))

    def _agrees(self, a: Pose, b: Pose, longest: float = math.inf) -> bool:
        """Return True if the vehicle can move from pose ``a`` to the later pose ``b``.

        The tolerance for an impact grows with the time between them, up to ``longest``, s.
        """
        distance, turn = self._innovation(a, b)
        change = self._speed * min(b.t - a.t, longest)
        x, y, theta = (GATE * _SQRT2 * noise.deviation for noise in self._noise)
        return distance <= max(self._limits.velocity * change + max(x, y), MIN_INNOVATION[0]) and (
            turn <= max(self._limits.spin * change + theta, MIN_INNOVATION[1])
        )

    def _accept(self, pose: Pose) -> None:
        self._last = pose
        recent = self._recent
        recent.append(pose)
        while len(recent) > _SLIPPED and recent[1].t < pose.t - _VELOCITY_TIME:
            recent.popleft()
        if len(recent) >= 3:
            (x0, y0, theta0), (x, y, theta) = recent[0].values[:3], pose.values[:3]
            dt = pose.t - recent[0].t
            turn = math.remainder(theta - theta0, math.tau)
            self.velocity = ((x - x0) / dt, (y - y0) / dt, turn / dt)

    def _choose(self, chosen: _Run | None) -> list[Pose]:
        """Return the poses of the chosen sequence and of those on the way to it; reject the others.

        A sequence is on the way if it is reachable and the chosen one can be reached from it.  With
        None all poses that are held back are rejected.
        """
        passed: list[Pose] = []
        for run in self._held:
            is_between = (
                chosen is not None
                and self._last is not None
                and run.is_reachable
                and self._agrees(self._last, run.poses[0])
                and self._agrees(run.poses[-1], chosen.poses[0])
            )
            if run is not chosen and not is_between:
                self._counts.reject(self._source, Reason.OUTLIER, len(run.poses))
                continue
            passed += run.poses
            for pose in run.poses:
                self._accept(pose)
        self._held.clear()
        return passed
