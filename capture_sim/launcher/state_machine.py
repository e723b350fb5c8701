"""The launcher's state machine: it compares a launch with its plan.

Python runs, the ROS 2 nodes and trials of a real bench all evaluate a launch by
:meth:`Launcher.observe`, so the same measurements give the same status.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from capture_sim.dynamics.samples import Named
from capture_sim.scene.launch_plan import LaunchPlan, expected_speed, plan_launch
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Range, quantity

#: Time, s, by which the first touch may be late in addition to the tolerance.
GRACE = 0.5
#: A speed deviates only if it exceeds the tolerance by this many of its standard deviations.
SPEED_GUARD = 5.0


def is_predicted(scene: Scene, plan: LaunchPlan) -> bool:
    """Return True if the plan predicts the time and speed of the first touch.

    It does if the initial velocity of the chaser is zero or along its heading, without rotation,
    if the target is at rest, and if the plan has the chaser reach the cone.
    """
    chaser, target = scene.initial.chaser, scene.initial.target
    along = chaser.vx * math.cos(chaser.theta) + chaser.vy * math.sin(chaser.theta)
    across = chaser.vy * math.cos(chaser.theta) - chaser.vx * math.sin(chaser.theta)
    is_straight = along >= 0.0 and abs(across) <= 1e-12 * max(1.0, along) and chaser.omega == 0.0
    is_target_at_rest = not (target.vx or target.vy or target.omega)
    has_impact = math.isfinite(plan.contact_time) and plan.impact_speed > 0.0
    return is_straight and is_target_at_rest and has_impact


class LauncherPhase(Named):
    """State of the launcher; msg/LauncherState.msg explains the values."""

    IDLE = 0
    ARMED = 1
    RELEASED = 2
    LANDED = 3
    DELIVERED = 4
    ABORTED = 5


@dataclass(frozen=True)
class LauncherStatus:
    """The status of a launcher; msg/LauncherState.msg explains the fields and their units."""

    state: LauncherPhase
    hanging_mass: float
    drop_height: float
    wanted_speed: float
    landing_speed: float
    measured_speed: float
    reason: str = ""


class LaunchObservation(NamedTuple):
    """One measurement of a launch, for :meth:`Launcher.observe`."""

    t: float  # s, since the release; NaN: not known, so that no delay is evaluated
    speed: float  # m/s, of the chaser along the rail
    travel: float  # m, since the release; NaN: not known, so that the speed is not evaluated
    is_slack: bool  # the mass has landed
    has_touched: bool  # the tip has met the cone
    speed_deviation: float = 0.0  # m/s, standard deviation of ``speed``
    unseen: str = ""  # why the speed at the first touch is unknown; empty: it is known


@dataclass
class LaunchSettings:
    """Settings of a launch that can change while the launcher runs; see :class:`Launcher`."""

    tolerance: float = quantity(
        "1",
        Range(0.01, 10.0),
        default=0.2,
        doc="share of the planned impact speed by which the chaser's speed may deviate",
    )
    aborts: bool = quantity(
        "",
        default=True,
        doc="abort a launch that differs from its plan: speed beyond speed_tolerance by 5 "
        "standard deviations, or contact too late; false only warns",
    )


class Launcher:
    """Follows one launch from arming to the first touch; in a scene without string too.

    ``tolerance`` is a share.  The chaser's speed may differ from the plan by this share of the
    planned impact speed, plus :data:`SPEED_GUARD` standard deviations of the measurement.  The
    first touch may be late by this share of its planned time, plus :data:`GRACE`.  A launch that
    differs more is aborted; if ``aborts`` is False, only ``deviation`` is set.

    ``deviation`` says in words how the launch differed from the plan at the last measurement.  It
    is empty if the launch did not differ, after the first touch, and if the plan does not predict
    the launch (:func:`is_predicted`).
    """

    def __init__(
        self, scene: Scene, tolerance: float = LaunchSettings.tolerance, *, aborts: bool = True
    ) -> None:
        self.plan = plan_launch(scene)
        self.tolerance, self.aborts, self.deviation = tolerance, aborts, ""
        self._scene = scene
        self._is_predicted = is_predicted(scene, self.plan)
        self._state = LauncherPhase.ARMED
        self._speed = 0.0
        self._reason = ""

    @property
    def status(self) -> LauncherStatus:
        """The present status; ``measured_speed`` is 0 before the first measurement."""
        p = self.plan
        return LauncherStatus(
            self._state,
            p.hanging_mass,
            p.drop_height,
            p.impact_speed,
            p.landing_speed,
            self._speed,
            self._reason,
        )

    @property
    def is_under_way(self) -> bool:
        """True from the release to the first touch or the abort."""
        return self._state in (LauncherPhase.RELEASED, LauncherPhase.LANDED)

    @property
    def latest_contact(self) -> float:
        """Latest time at which the first touch is not late, s since the release.

        ``inf`` if the plan predicts no touch.
        """
        return (1.0 + self.tolerance) * self.plan.contact_time + GRACE

    def release(self) -> LauncherStatus:
        """Note that the release has been sent; return the status.  Nothing changes unless armed."""
        if self._state is LauncherPhase.ARMED:
            self._state = LauncherPhase.RELEASED
        return self.status

    def abort(self, reason: str) -> LauncherStatus:
        """Abort the launch, with a ``reason`` in words; return the status.

        A launch that is already delivered or aborted stays as it is.
        """
        if self._state not in (LauncherPhase.DELIVERED, LauncherPhase.ABORTED):
            self._state, self._reason = LauncherPhase.ABORTED, reason
        return self.status

    def travelled(self, x: float, y: float) -> float:
        """Return how far the chaser has travelled along its initial heading, m.

        ``x``, ``y``: position of the chaser in the world frame, m.  The travel counts from the
        chaser's initial position in the scene.
        """
        start = self._scene.initial.chaser
        return (x - start.x) * math.cos(start.theta) + (y - start.y) * math.sin(start.theta)

    def observe(self, observed: LaunchObservation) -> LauncherStatus:
        """Evaluate a measurement, and return the status after it.

        If the plan predicts the launch, ``deviation`` describes how the launch differs, and a
        launch that differs is aborted if ``aborts`` is True.  With ``has_touched`` the launch is
        delivered; its impact speed is that of the previous measurement, NaN if ``unseen`` is
        given.  Before the release, and once the launch is over, a measurement changes nothing.
        """
        if not self.is_under_way:
            return self.status
        if observed.has_touched:
            # the last speed before the touch is the impact speed
            self._state, self.deviation = LauncherPhase.DELIVERED, ""
            if observed.unseen:
                self._speed, self._reason = math.nan, observed.unseen
            return self.status
        self._speed = observed.speed
        if observed.is_slack:
            self._state = LauncherPhase.LANDED
        self.deviation = self._deviation(observed) if self._is_predicted else ""
        if self.deviation and self.aborts:
            self.abort(self.deviation)
        return self.status

    def _deviation(self, observed: LaunchObservation) -> str:
        """Return how the launch differs from the plan, in words; empty if it does not."""
        plan, latest = self.plan, self.latest_contact
        if observed.t > latest:
            return (
                f"no contact after {observed.t:.4g} s: expected after {plan.contact_time:.4g}, "
                f"must be at most {latest:.4g}"
            )
        if math.isnan(observed.travel):
            return ""
        wanted = expected_speed(self._scene, plan, observed.travel)
        slack, deviation = self.tolerance * plan.impact_speed, observed.speed_deviation
        if abs(observed.speed - wanted) <= slack + SPEED_GUARD * deviation:
            return ""
        known = f" +- {deviation:.2g}" if deviation > 0.0 else ""
        return (
            f"speed {observed.speed:.4g}{known} m/s after {observed.travel:.4g} m: "
            f"must be {max(wanted - slack, 0.0):.4g} to {wanted + slack:.4g}"
        )
