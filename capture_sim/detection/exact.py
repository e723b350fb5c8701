"""Decisions of the capture detector, from poses and buffer state alone.

The same object judges an offline run, the live suite, a bag and a real bench: it needs
only what can be measured there.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from statistics import mean

from capture_sim.detection.tip_path import NoiseEstimate, Place, TipPath, third_difference
from capture_sim.model.geometry import nearest_on_wall
from capture_sim.scene.parts import Scene

# the detector works on measurements, a few hundred a second: no compiled code needed
_nearest_on_wall = nearest_on_wall.py_func  # type: ignore[attr-defined]

# time stamps are decimal fractions: 0.2 s may come out a rounding short
_TICK = 1e-9

#: Measurements of the buffer that are averaged where a single one scatters too much.
_SMOOTHED = 12
#: Poses that scatter never agree this closely, m and rad.
_SAME = 1e-12
#: A stand is looked for over this many ``still_time`` as well, where speeds scatter.
_LONGEST_STAND = 4.0

Planar = tuple[float, float, float]


class CaptureState(IntEnum):
    """State of the capture, as in msg/CaptureStatus.msg."""

    APPROACH = 0
    CONTACT = 1
    CAPTURED = 2
    REBOUND = 3
    MISSED = 4
    STUCK = 5

    @property
    def label(self) -> str:
        """The name used in messages and tables."""
        return self.name.lower()


@dataclass(frozen=True)
class Observation:
    """One consistent measurement; poses (x m, y m, theta rad) in the world.

    The rates (m/s, rad/s) may be missing: what measures poses seldom measures them.  They
    are used only where the measurements do not scatter.
    """

    t: float
    chaser: Planar
    target: Planar
    stroke: float  # m, h - rest length
    torsion: float  # rad, theta_P - theta_S
    chaser_rate: Planar | None = None
    target_rate: Planar | None = None
    stroke_rate: float = 0.0  # m/s
    torsion_rate: float = 0.0  # rad/s


@dataclass(frozen=True)
class CaptureStatus:
    """The detector's view; fields and units as in msg/CaptureStatus.msg."""

    t: float
    state: CaptureState
    final: bool
    distance: float
    axial_offset: float
    lateral_offset: float
    relative_attitude: float
    relative_speed: float
    nearest_distance: float
    time_in_state: float
    reason: str


@dataclass(frozen=True)
class _Tip:
    """The tip in the cone's frame, as measured."""

    axial: float
    lateral: float
    rigid: tuple[float, float]  # where it would be with the buffer at rest
    rate: tuple[float, float] | None


#: A verdict must hold for the measured place moved by so many standard deviations.
GUARD = 3.0
#: ... and for the borders of the capture zone, where too far out and too far in weigh alike.
ZONE_GUARD = 1.0
#: ... and for the buffer, which is asked at every measurement and answered by a single one.
BUFFER_GUARD = 6.0


class CaptureDetector:
    """Follows one run from the approach to a verdict.

    The tip is *captured* when its centre stays within ``detector.radius`` of the centre of
    BE for ``detector.dwell``, or passes BE inside the throat; it has *rebounded* when it
    has been in contact and then retreats by ``detector.leave`` from its nearest approach;
    *missed* when it does so without contact or passes BE outside the throat; it is *stuck*
    when it stands still for ``detector.still_time`` outside the radius.

    Measurements may scatter, be missing and come late or in any order.  Where they scatter
    the path is smoothed (:mod:`capture_sim.detection.tip_path`): then the judgement comes up to
    ``detector.delay`` after the instant it is about, and allows for what is left of the
    noise.

    Parameters
    ----------
    scene
        Geometry of buffer and cone, and the ``detector`` part.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._criteria = limits = scene.detector
        self._path = TipPath(
            radius=limits.radius,
            delay=limits.delay,
            clean=limits.contact_gap / 4.0,
            gap=limits.gap,
            keep=_LONGEST_STAND * limits.still_time,
        )
        self._state = CaptureState.APPROACH
        self._final = False
        self._since = 0.0
        self._reason = "no contact yet"
        self._ahead = False  # of BE
        self._nearest = math.inf
        self._fastest = 0.0
        self._nearest_gap = math.inf  # to a wall, less what the noise may hide
        self._zone_since: float | None = None
        self._still_since: float | None = None
        self._judged: Place | None = None  # last
        self._last: tuple[Observation, _Tip] | None = None
        self._buffer_noise = (NoiseEstimate(), NoiseEstimate())
        self._buffer_seen: deque[tuple[float, float, float]] = deque(maxlen=_SMOOTHED)

    @property
    def delay(self) -> float:
        """How long after an instant it is judged at present, s; 0 without noise."""
        return self._path.half_window

    @property
    def scatter(self) -> tuple[float, float]:
        """Standard deviation of the tip's measured axial and lateral place, m."""
        return self._path.deviation

    def update(self, seen: Observation) -> CaptureStatus:
        """Take in a measurement and return the status."""
        tip = self._tip(seen)
        if self._final and tip.rate is not None and self._path.half_window == 0.0:
            # nothing is left to decide, and what was measured is what is told
            self._last = max(self._last or (seen, tip), (seen, tip), key=lambda of: of[0].t)
            self._nearest = min(self._nearest, math.hypot(tip.axial, tip.lateral))
            return self._status(seen, tip)
        if self._frozen(seen):
            return self._status(seen, tip)
        if self._last is None or seen.t > self._last[0].t:
            self._last = (seen, tip)
            self._buffer_seen.append((seen.t, seen.stroke, seen.torsion))
            if self._state is CaptureState.APPROACH:
                self._look_at_buffer(Place(seen.t, tip.axial, tip.lateral))
        for place in self._path.add(
            seen.t, (tip.axial, tip.lateral), tip.rigid, tip.rate, self._buffer_scatter()
        ):
            self._take(place)
        return self._status(seen, tip)

    def finish(self, *, cut: bool = False) -> CaptureStatus:
        """Close the run: a verdict is given even if none was reached.

        The status is that of the last measurement; without any, all of it is NaN.

        Parameters
        ----------
        cut
            The run was ended before its end: what was not decided by then stays so.
        """
        if self._last is None:
            if not cut:
                self._enter(CaptureState.MISSED, 0.0, "nothing was measured")
            nowhere = (math.nan,) * 3
            seen = Observation(0.0, nowhere, nowhere, math.nan, math.nan)
            return self._status(seen, self._tip(seen))
        for place in self._path.finish():
            self._take(place)
        if not self._final and self._judged is not None and not cut:
            self._judge_at_end(self._judged)
        return self._status(*self._last)

    def _frozen(self, seen: Observation) -> bool:
        """Whether a pose that scatters is repeated: its source has lost sight and says the last."""
        if self._path.half_window == 0.0 or self._last is None:
            return False
        last = self._last[0]
        return any(
            max(abs(a - b) for a, b in zip(new, old, strict=True)) < _SAME
            for new, old in ((seen.chaser, last.chaser), (seen.target, last.target))
        )

    def _enter(self, state: CaptureState, t: float, reason: str) -> None:
        self._state, self._since, self._reason = state, t, reason
        self._final = state not in (CaptureState.APPROACH, CaptureState.CONTACT)

    def _take(self, place: Place) -> None:
        if self._judged is not None and place.t - self._judged.t > self._path.gap:
            # nobody knows what happened meanwhile
            self._zone_since = self._still_since = None
        self._nearest = min(self._nearest, place.distance)
        self._fastest = max(self._fastest, place.speed)
        if not self._final:
            self._judge(place)
        self._judged = place

    def _judge(self, place: Place) -> None:
        limits, t = self._criteria, place.t
        gap, unsure = self._gap(place)
        self._nearest_gap = min(self._nearest_gap, gap - GUARD * unsure)
        if self._state is CaptureState.APPROACH and gap + GUARD * unsure < limits.contact_gap:
            self._enter(CaptureState.CONTACT, t, "tip at the cone")
        margin = GUARD * math.sqrt(place.variance[0])
        passed = self._ahead and place.axial + margin <= 0.0
        self._ahead = self._ahead or place.axial - margin > 0.0
        if passed and abs(place.lateral) < self._scene.cone.R_c:
            self._enter(CaptureState.CAPTURED, t, "tip passed BE")
            return
        if self._dwelt(place):
            self._enter(
                CaptureState.CAPTURED,
                t,
                f"within {limits.radius * 1e3:g} mm of BE for {limits.dwell:g} s",
            )
            return
        retreat = place.distance - self._nearest - GUARD * place.uncertainty
        if passed or retreat > limits.leave:
            if not passed and (self._state is CaptureState.CONTACT or self._hit_unseen()):
                reason = f"retreated {limits.leave * 1e3:g} mm from {self._nearest * 1e3:.2f} mm"
                self._enter(CaptureState.REBOUND, t, reason)
            else:
                self._enter(CaptureState.MISSED, t, "tip passed the cone by")
            return
        if self._stands(place):
            self._enter(CaptureState.STUCK, t, f"stands {place.distance * 1e3:.2f} mm short of BE")

    def _hit_unseen(self) -> bool:
        """Whether a tip that has turned round was so near a wall that it must have hit it.

        Vehicles that coast do not turn round by themselves.  A parabola rounds off the
        corner that a hit makes in the path, by 3/16 of the change of speed in half a window.
        """
        rounded = 3.0 / 16.0 * 2.0 * self._fastest * self._path.half_window
        return self._nearest_gap < self._criteria.contact_gap + rounded

    def _dwelt(self, place: Place) -> bool:
        """Whether the tip has stayed in the zone for the dwell."""
        limits = self._criteria
        # who is in is out only when that is sure, and the other way round
        side = ZONE_GUARD if self._zone_since is None else -ZONE_GUARD
        inside = place.distance + side * place.uncertainty <= limits.radius
        self._zone_since = _since(self._zone_since, place.t, inside)
        return self._zone_since is not None and place.t - self._zone_since >= limits.dwell - _TICK

    def _stands(self, place: Place) -> bool:
        """Whether the tip has stood still outside the zone for long enough."""
        limits, t = self._criteria, place.t
        outside = place.distance - ZONE_GUARD * place.uncertainty > limits.radius
        if place.count == 1:
            still = outside and place.speed < limits.still_speed
        else:
            # a speed is known only after a while: the same question for longer stretches
            still = outside and any(
                speed + GUARD * unsure < limits.still_speed
                for speed, unsure in (
                    self._path.rate_over(t - stretch * limits.still_time, t)
                    for stretch in (1.0, _LONGEST_STAND)
                )
            )
            if still:
                return True
        self._still_since = _since(self._still_since, t, still)
        return self._still_since is not None and t - self._still_since >= limits.still_time - _TICK

    def _judge_at_end(self, place: Place) -> None:
        t = place.t
        outwards = place.axial * place.axial_rate + place.lateral * place.lateral_rate > 0.0
        speed = place.speed
        if place.count > 1:
            # the end of a fit is its weakest place: one more of the last second
            last = self._path.fit(t, t - self._criteria.still_time, t, 1)
            outwards = last.axial * last.axial_rate + last.lateral * last.lateral_rate > 0.0
            speed = last.speed
        still = speed < self._criteria.still_speed
        at_wall = self._nearest_gap < self._criteria.contact_gap
        if self._state is CaptureState.APPROACH and not (
            (still and at_wall) or (outwards and self._hit_unseen())
        ):
            self._enter(CaptureState.MISSED, t, "no contact before the run ended")
        elif outwards and not still:
            self._enter(
                CaptureState.REBOUND,
                t,
                f"run ended with the tip {place.distance * 1e3:.2f} mm from BE and moving out",
            )
        else:
            self._enter(
                CaptureState.STUCK,
                t,
                f"run ended with the tip {place.distance * 1e3:.2f} mm short of BE",
            )

    def _look_at_buffer(self, place: Place) -> None:
        """Learn the buffer's noise while it is at rest; see when it has been pushed."""
        if len(self._buffer_seen) >= 4:
            four = list(self._buffer_seen)[-4:]
            weights = third_difference([seen[0] for seen in four])
            for i, noise in enumerate(self._buffer_noise):
                noise.add(sum(w * seen[1 + i] for w, seen in zip(weights, four, strict=True)))
        if not self._buffer_noise[0].known:
            return
        limit, arm = self._criteria.contact_gap, self._scene.rest_length
        t, stroke, torsion = self._buffer_seen[-1]
        scatter = max(self._buffer_scatter())
        if BUFFER_GUARD * scatter >= limit:
            # one measurement says nothing: the mean of some
            if len(self._buffer_seen) < _SMOOTHED:
                return
            stroke = mean(seen[1] for seen in self._buffer_seen)
            torsion = mean(seen[2] for seen in self._buffer_seen)
            scatter /= math.sqrt(_SMOOTHED)
        pushed = max(abs(stroke), abs(torsion) * arm) > limit + BUFFER_GUARD * scatter
        # a jerk of the launch pushes it as well
        if pushed and self._gap(place)[0] < self._scene.probe.tip_radius:
            self._enter(CaptureState.CONTACT, t, "tip at the cone")

    def _buffer_scatter(self) -> tuple[float, float]:
        """Return what the buffer's measurements add to the tip's scatter, m."""
        stroke, torsion = (noise.deviation for noise in self._buffer_noise)
        return stroke, torsion * self._scene.rest_length

    def _gap(self, place: Place) -> tuple[float, float]:
        """Return the tip's gap to the nearer wall and its standard deviation, m."""
        cone = self._scene.cone
        cos_b, sin_b = math.cos(cone.beta), math.sin(cone.beta)
        gap, n_u, n_Y = min(
            _nearest_on_wall(place.axial, side * place.lateral, cone.R_c, cone.L_c, cos_b, sin_b)
            for side in (1.0, -1.0)
        )
        variance = n_u**2 * place.variance[0] + n_Y**2 * place.variance[1]
        return gap - self._scene.probe.tip_radius, math.sqrt(variance)

    def _tip(self, seen: Observation) -> _Tip:
        """Return the tip in the cone's frame from the measured poses and buffer."""
        a, h = self._scene.buffer.a, self._scene.rest_length + seen.stroke
        x, y, theta = seen.chaser
        phi = theta + seen.torsion
        xt, yt, theta_t = seen.target
        c, s = math.cos(theta_t), math.sin(theta_t)
        rx = x + a * math.cos(theta) + h * math.cos(phi) - xt
        ry = y + a * math.sin(theta) + h * math.sin(phi) - yt
        px, py = c * rx + s * ry, c * ry - s * rx
        rate = None
        if seen.chaser_rate is not None and seen.target_rate is not None:
            vx, vy, omega = seen.chaser_rate
            spin = omega + seen.torsion_rate
            vxt, vyt, omega_t = seen.target_rate
            ux = vx - a * omega * math.sin(theta) - h * spin * math.sin(phi)
            uy = vy + a * omega * math.cos(theta) + h * spin * math.cos(phi)
            ux += seen.stroke_rate * math.cos(phi) - vxt
            uy += seen.stroke_rate * math.sin(phi) - vyt
            rate = (-(c * ux + s * uy + omega_t * py), c * uy - s * ux - omega_t * px)
        reach = a + self._scene.rest_length
        bx, by = x + reach * math.cos(theta) - xt, y + reach * math.sin(theta) - yt
        front = self._scene.cone.L_T
        return _Tip(
            axial=-(px + front),
            lateral=py,
            rigid=(-(c * bx + s * by + front), c * by - s * bx),
            rate=rate,
        )

    def _status(self, seen: Observation, tip: _Tip) -> CaptureStatus:
        rate = tip.rate
        if self._judged is not None and (rate is None or self._judged.count > 1):
            rate = (self._judged.axial_rate, self._judged.lateral_rate)
        return CaptureStatus(
            t=seen.t,
            state=self._state,
            final=self._final,
            distance=math.hypot(tip.axial, tip.lateral),
            axial_offset=tip.axial,
            lateral_offset=tip.lateral,
            relative_attitude=seen.chaser[2] - seen.target[2],
            relative_speed=math.nan if rate is None else math.hypot(*rate),
            nearest_distance=self._nearest,
            time_in_state=seen.t - self._since,
            reason=self._reason,
        )


def _since(start: float | None, t: float, holds: bool) -> float | None:
    """Return since when a condition has held without a break; None if it does not."""
    if not holds:
        return None
    return t if start is None else start
