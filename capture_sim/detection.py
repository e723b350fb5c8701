"""Decisions of the capture detector, from poses and buffer state alone.

The same object judges an offline run, the live suite, a bag and a real bench: it needs
only what can be measured there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from capture_sim.dynamics.cone import nearest_on_wall
from capture_sim.scene import Scene

# the detector works on measurements, a few hundred a second: no compiled code needed
_nearest_on_wall = nearest_on_wall.py_func  # type: ignore[attr-defined]

# time stamps are decimal fractions: 0.2 s may come out a rounding short
_TICK = 1e-9


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
    """One consistent measurement; poses (x m, y m, theta rad) and their rates in the world."""

    t: float
    chaser: tuple[float, float, float]
    chaser_rate: tuple[float, float, float]
    target: tuple[float, float, float]
    target_rate: tuple[float, float, float]
    stroke: float  # m, h - rest length
    stroke_rate: float  # m/s
    torsion: float  # rad, theta_P - theta_S
    torsion_rate: float  # rad/s


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
    """The tip in the cone's frame."""

    axial: float
    lateral: float
    axial_rate: float
    lateral_rate: float

    @property
    def distance(self) -> float:
        return math.hypot(self.axial, self.lateral)

    @property
    def speed(self) -> float:
        return math.hypot(self.axial_rate, self.lateral_rate)


class CaptureDetector:
    """Follows one run from the approach to a verdict.

    The tip is *captured* when its centre stays within ``detector.radius`` of the centre of
    BE for ``detector.dwell``, or passes BE inside the throat; it has *rebounded* when it
    has been in contact and then retreats by ``detector.leave`` from its nearest approach;
    *missed* when it does so without contact or passes BE outside the throat; it is *stuck*
    when it stands still for ``detector.still_time`` outside the radius.

    Parameters
    ----------
    scene
        Geometry of buffer and cone, and the ``detector`` part.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._criteria = scene.detector
        self._state = CaptureState.APPROACH
        self._final = False
        self._since = 0.0
        self._reason = "no contact yet"
        self._nearest = math.inf
        self._zone_since: float | None = None
        self._still_since: float | None = None
        self._last: tuple[Observation, _Tip] | None = None

    def update(self, seen: Observation) -> CaptureStatus:
        """Take in a measurement, later than the one before, and return the status."""
        tip = self._tip(seen)
        passed = self._last is not None and self._last[1].axial > 0.0 >= tip.axial
        self._last = (seen, tip)
        self._nearest = min(self._nearest, tip.distance)
        if not self._final:
            self._judge(seen, tip, passed)
        return self._status(seen, tip)

    def finish(self) -> CaptureStatus:
        """Close the run: a verdict is given even if none was reached.

        The status is that of the last measurement; without any, all of it is NaN.
        """
        if self._last is None:
            self._enter(CaptureState.MISSED, 0.0, "nothing was measured")
            nowhere = (math.nan,) * 3
            seen = Observation(0.0, nowhere, nowhere, nowhere, nowhere, *nowhere, math.nan)
            return self._status(seen, self._tip(seen))
        seen, tip = self._last
        if not self._final:
            self._judge_at_end(seen.t, tip)
        return self._status(seen, tip)

    def _enter(self, state: CaptureState, t: float, reason: str) -> None:
        self._state, self._since, self._reason = state, t, reason
        self._final = state not in (CaptureState.APPROACH, CaptureState.CONTACT)

    def _judge(self, seen: Observation, tip: _Tip, passed: bool) -> None:
        limits, t = self._criteria, seen.t
        if self._state is CaptureState.APPROACH and self._in_contact(seen, tip):
            self._enter(CaptureState.CONTACT, t, "tip at the cone")
        if passed and abs(tip.lateral) < self._scene.cone.R_c:
            self._enter(CaptureState.CAPTURED, t, "tip passed BE")
            return
        self._zone_since = _since(self._zone_since, t, tip.distance <= limits.radius)
        if self._zone_since is not None and t - self._zone_since >= limits.dwell - _TICK:
            self._enter(
                CaptureState.CAPTURED,
                t,
                f"within {limits.radius * 1e3:g} mm of BE for {limits.dwell:g} s",
            )
            return
        if passed or tip.distance > self._nearest + limits.leave:
            if self._state is CaptureState.CONTACT and not passed:
                reason = f"retreated {limits.leave * 1e3:g} mm from {self._nearest * 1e3:.2f} mm"
                self._enter(CaptureState.REBOUND, t, reason)
            else:
                self._enter(CaptureState.MISSED, t, "tip passed the cone by")
            return
        outside = tip.distance > limits.radius
        self._still_since = _since(self._still_since, t, outside and tip.speed < limits.still_speed)
        if self._still_since is not None and t - self._still_since >= limits.still_time - _TICK:
            self._enter(CaptureState.STUCK, t, f"stands {tip.distance * 1e3:.2f} mm short of BE")

    def _judge_at_end(self, t: float, tip: _Tip) -> None:
        if self._state is CaptureState.APPROACH:
            self._enter(CaptureState.MISSED, t, "no contact before the run ended")
        elif (
            tip.axial * tip.axial_rate + tip.lateral * tip.lateral_rate > 0.0
            and tip.speed >= self._criteria.still_speed
        ):
            self._enter(
                CaptureState.REBOUND,
                t,
                f"run ended with the tip {tip.distance * 1e3:.2f} mm from BE and moving out",
            )
        else:
            self._enter(
                CaptureState.STUCK,
                t,
                f"run ended with the tip {tip.distance * 1e3:.2f} mm short of BE",
            )

    def _in_contact(self, seen: Observation, tip: _Tip) -> bool:
        """Whether the tip is at a wall, or the buffer shows that it has been."""
        limit = self._criteria.contact_gap
        if abs(seen.stroke) > limit or abs(seen.torsion) * self._scene.rest_length > limit:
            return True
        cone = self._scene.cone
        cos_b, sin_b = math.cos(cone.beta), math.sin(cone.beta)
        gap = min(
            _nearest_on_wall(tip.axial, side * tip.lateral, cone.R_c, cone.L_c, cos_b, sin_b)[0]
            for side in (1.0, -1.0)
        )
        return bool(gap - self._scene.probe.tip_radius < limit)

    def _tip(self, seen: Observation) -> _Tip:
        """Return the tip in the cone's frame from the measured poses and buffer."""
        a, h = self._scene.buffer.a, self._scene.rest_length + seen.stroke
        x, y, theta = seen.chaser
        vx, vy, omega = seen.chaser_rate
        phi, spin = theta + seen.torsion, omega + seen.torsion_rate
        xt, yt, theta_t = seen.target
        vxt, vyt, omega_t = seen.target_rate
        rx = x + a * math.cos(theta) + h * math.cos(phi) - xt
        ry = y + a * math.sin(theta) + h * math.sin(phi) - yt
        ux = vx - a * omega * math.sin(theta) - h * spin * math.sin(phi)
        uy = vy + a * omega * math.cos(theta) + h * spin * math.cos(phi)
        ux += seen.stroke_rate * math.cos(phi) - vxt
        uy += seen.stroke_rate * math.sin(phi) - vyt
        c, s = math.cos(theta_t), math.sin(theta_t)
        px, py = c * rx + s * ry, c * ry - s * rx
        return _Tip(
            axial=-(px + self._scene.cone.L_T),
            lateral=py,
            axial_rate=-(c * ux + s * uy + omega_t * py),
            lateral_rate=c * uy - s * ux - omega_t * px,
        )

    def _status(self, seen: Observation, tip: _Tip) -> CaptureStatus:
        return CaptureStatus(
            t=seen.t,
            state=self._state,
            final=self._final,
            distance=tip.distance,
            axial_offset=tip.axial,
            lateral_offset=tip.lateral,
            relative_attitude=seen.chaser[2] - seen.target[2],
            relative_speed=tip.speed,
            nearest_distance=self._nearest,
            time_in_state=seen.t - self._since,
            reason=self._reason,
        )


def _since(start: float | None, t: float, holds: bool) -> float | None:
    """Return since when a condition has held without a break; None if it does not."""
    if not holds:
        return None
    return t if start is None else start
