"""The launcher's state machine: it compares a launch with its plan."""

from __future__ import annotations

import math
from dataclasses import dataclass

from capture_sim.launch.plan import LaunchPlan, plan_launch, rolling_force
from capture_sim.samples import Named
from capture_sim.scene.parts import Scene

#: A first touch may always be late by this much, s.
GRACE = 0.5
#: A speed is wrong only if it is so by this many of its standard deviations.
SPEED_GUARD = 5.0


def expected_speed(scene: Scene, plan: LaunchPlan, travel: float) -> float:
    """Return the chaser's speed (m/s) at a travel (m) from the release, before the first touch.

    By energy, so it needs no clock: ``v^2 = v_L^2 x / H`` while the mass sinks, then
    ``v_L^2 - 2 a_c (x - H)``.
    """
    landing, height = plan.landing_speed, plan.drop_height
    if travel < height:
        return landing * math.sqrt(max(travel, 0.0) / height)
    left = landing**2 - 2.0 * rolling_force(scene) / scene.chaser_total_mass * (travel - height)
    return math.sqrt(max(left, 0.0))


def expected_time(plan: LaunchPlan, travel: float) -> float:
    """Return when (s after the release) the chaser has this travel (m), if it then coasts freely.

    ``inf`` if it never moves.
    """
    landing, height = plan.landing_speed, plan.drop_height
    if landing == 0.0:
        return math.inf
    if travel < height:
        return plan.landing_time * math.sqrt(max(travel, 0.0) / height)
    return plan.landing_time + (travel - height) / landing


class LauncherPhase(Named):
    """State of the launcher, as in msg/LauncherState.msg."""

    IDLE = 0
    ARMED = 1
    RELEASED = 2
    LANDED = 3
    DELIVERED = 4
    ABORTED = 5


@dataclass(frozen=True)
class LauncherStatus:
    """What the launcher knows; fields as in msg/LauncherState.msg."""

    state: LauncherPhase
    hanging_mass: float
    drop_height: float
    wanted_speed: float
    landing_speed: float
    measured_speed: float
    reason: str = ""


class Launcher:
    """Follows one launch from arming to the first contact; without a string it only lets go.

    ``tolerance``: the share of the wanted impact speed by which the speed may differ, and of the
    time of the first touch (and :data:`GRACE`) by which that may be late; else the launch is
    aborted, or, without ``aborts``, only described.  ``deviation``: how the launch differed from
    the plan at the last measurement; empty if it did not.
    """

    def __init__(self, scene: Scene, tolerance: float = 0.2, *, aborts: bool = True) -> None:
        self.plan = plan_launch(scene)
        self.tolerance, self.aborts, self.deviation = tolerance, aborts, ""
        self._scene = scene
        self._state = LauncherPhase.ARMED
        self._speed = 0.0
        self._reason = ""

    @property
    def status(self) -> LauncherStatus:
        """The present status."""
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

    def release(self) -> LauncherStatus:
        """Note that the release has been sent."""
        if self._state is LauncherPhase.ARMED:
            self._state = LauncherPhase.RELEASED
        return self.status

    def abort(self, reason: str) -> LauncherStatus:
        """Give the launch up, for ``reason``; one that is over stays as it is."""
        if self._state not in (LauncherPhase.DELIVERED, LauncherPhase.ABORTED):
            self._state, self._reason = LauncherPhase.ABORTED, reason
        return self.status

    def travelled(self, x: float, y: float) -> float:
        """Return the travel of the chaser at (x, y), m, along its launch direction, m."""
        start = self._scene.initial.chaser
        return (x - start.x) * math.cos(start.theta) + (y - start.y) * math.sin(start.theta)

    def observe(
        self,
        chaser_speed: float,
        string_slack: bool,
        touched: bool,
        *,
        t: float | None = None,
        travel: float | None = None,
        speed_deviation: float = 0.0,
    ) -> LauncherStatus:
        """Take in a measurement; abort if the launch does not go as planned.

        ``chaser_speed`` (m/s, along the rail) has the standard deviation ``speed_deviation``;
        without ``travel`` (m, since the release) it is not evaluated, and without ``t`` (s) no
        delay.
        """
        if self._state in (LauncherPhase.RELEASED, LauncherPhase.LANDED):
            if touched:
                # the speed before the touch is the impact speed: keep the last one
                self._state = LauncherPhase.DELIVERED
            else:
                self._speed = chaser_speed
                if string_slack:
                    self._state = LauncherPhase.LANDED
                self.deviation = self._deviation(t, travel, speed_deviation)
                if self.deviation and self.aborts:
                    self.abort(self.deviation)
        return self.status

    def _deviation(self, t: float | None, travel: float | None, speed_deviation: float) -> str:
        """Return how the launch differs from the plan; empty if it does not."""
        plan = self.plan
        if not (math.isfinite(plan.contact_time) and plan.impact_speed > 0.0):
            return ""  # there is no impact to be launched for
        latest = (1.0 + self.tolerance) * plan.contact_time + GRACE
        if t is not None and t > latest:
            return (
                f"no contact after {t:.4g} s: expected after {plan.contact_time:.4g}, "
                f"must be at most {latest:.4g}"
            )
        if travel is None:
            return ""
        wanted = expected_speed(self._scene, plan, travel)
        slack = self.tolerance * plan.impact_speed
        if abs(self._speed - wanted) <= slack + SPEED_GUARD * speed_deviation:
            return ""
        known = f" +- {speed_deviation:.2g}" if speed_deviation > 0.0 else ""
        return (
            f"speed {self._speed:.4g}{known} m/s after {travel:.4g} m: "
            f"must be {max(wanted - slack, 0.0):.4g} to {wanted + slack:.4g}"
        )
