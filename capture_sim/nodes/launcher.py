"""The node that launches: plans mass and height, arms, releases, and watches the chaser."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from capture_sim.launch.plan import Launcher, LauncherPhase
from capture_sim.launch.scenes import load_scene_text
from capture_sim.messages.convert import LaunchAction, StringPhase, stamp_seconds
from capture_sim.messages.telemetry import LauncherTelemetry
from capture_sim.messages.topics import (
    CHASER_ODOMETRY,
    CONTACT_STATE,
    LAUNCHER,
    STRING_STATE,
    topics_of,
)
from capture_sim.nodes.actuator import KINDS, check_kind, make_actuator
from capture_sim.nodes.following import FOLLOWED, RunFollower
from capture_sim.nodes.receiving import StampMatcher, stamp_ns_of
from capture_sim.nodes.running import run


class LauncherNode(RunFollower):
    """Sends ARM and RELEASE, and its state with every periodic sample; ABORT if need be.

    What it decides stands in :class:`capture_sim.launch.plan.Launcher`.  ``~/launch`` releases
    an armed chaser, ``~/abort`` gives a launch up.
    """

    # of the run that is on, or the last one
    _launcher: Launcher | None = None
    _telemetry: LauncherTelemetry
    _matcher: StampMatcher
    _observed: int
    _touched: bool

    def __init__(self) -> None:
        super().__init__(LAUNCHER)
        self._auto_release = self.declare(
            "auto_release",
            True,
            "release as soon as armed; false holds the chaser until ~/launch is called, or this "
            "is set to true",
            read_only=False,
        )
        self._tolerance = self.declare(
            "speed_tolerance",
            0.2,
            "share of the wanted impact speed by which the chaser's speed may be off, 1",
            low=0.01,
            high=10.0,
            read_only=False,
        )
        kind = self.declare(
            "actuator",
            "simulated",
            "what lets the chaser go: the simulator, or the output launcher/hold",
            allowed=" or ".join(KINDS),
            check=check_kind,
        )
        self.open(topics_of(LAUNCHER))
        self._actuator = make_actuator(kind, self)
        for topic in FOLLOWED[LAUNCHER]:
            self.follow(topic, partial(self._take, topic.name))
        self.create_service(Trigger, "~/launch", self._asked_to_launch)
        self.create_service(Trigger, "~/abort", self._asked_to_abort)
        self.add_post_set_parameters_callback(self._parameters_set)

    def begin(self, info: Any) -> None:
        """Plan the launch and arm."""
        self._launcher = launcher = Launcher(load_scene_text(info.scene), self._tolerance)
        self._telemetry = LauncherTelemetry(self.messages, info.run_id)
        self._matcher = StampMatcher(topic.name for topic in FOLLOWED[LAUNCHER])
        self._observed = 0
        self._touched = False
        plan = launcher.plan
        self._actuator.hold()
        self.publish(self._telemetry.command(0.0, LaunchAction.ARM, plan))
        self.publish(self._telemetry.state(0.0, launcher.status))
        how, speed = "no string", f"{plan.impact_speed:.6g} m/s"
        if plan.hanging_mass > 0.0:
            how = f"{plan.hanging_mass:.6g} kg at {plan.drop_height:.6g} m"
        self.get_logger().info(f"{info.name}: armed, {how} for {speed}")
        if self._auto_release:
            self._release(launcher)

    def end(self, reason: str) -> list[str]:
        """Tell how much was sent."""
        self.publish(self._telemetry.end(complete=not reason, reason=reason))
        return super().end(reason)

    def _release(self, launcher: Launcher) -> None:
        self.publish(self._telemetry.command(0.0, LaunchAction.RELEASE, launcher.plan))
        self._actuator.release()
        self.publish(self._telemetry.state(0.0, launcher.release()))

    def _abort(self, launcher: Launcher, t: float) -> None:
        """Tell everybody that the launch is given up."""
        self._actuator.hold()
        self.publish(self._telemetry.command(t, LaunchAction.ABORT, launcher.plan))
        self.publish(self._telemetry.state(t, launcher.status))
        self.get_logger().error(f"{self.run.name}: aborted: {launcher.status.reason}")

    def _take(self, name: str, message: Any) -> None:
        parts = self._matcher.add(name, message)
        if parts is None or self._launcher is None:
            return
        string, contact = parts[STRING_STATE.name], parts[CONTACT_STATE.name]
        place = parts[CHASER_ODOMETRY.name].pose.pose.position
        self._touched = self._touched or contact.in_touch or contact.touches > 0
        t = stamp_seconds(stamp_ns_of(message))
        before = self._launcher.status.state
        status = self._launcher.observe(
            string.chaser_speed,
            string.phase == StringPhase.SLACK,
            self._touched,
            t=t,
            travel=self._launcher.travelled(place.x, place.y),
        )
        if status.state is LauncherPhase.ABORTED and before is not LauncherPhase.ABORTED:
            self._abort(self._launcher, t)
        else:
            self.publish(self._telemetry.state(t, status))
        self.advance_past(self._observed)
        self._observed += 1

    def _asked_to_launch(self, _: Any, response: Any) -> Any:
        launcher = self._launcher
        if self.run is None or launcher is None:
            response.message = "no run is announced: play or reset the simulation first"
        elif launcher.status.state is not LauncherPhase.ARMED:
            state = launcher.status.state.name.lower()
            response.message = f"{self.run.name} is {state}, not armed: reset the simulation first"
        else:
            self._release(launcher)
            response.success, response.message = True, f"{self.run.name}: released"
        return response

    def _asked_to_abort(self, _: Any, response: Any) -> Any:
        launcher = self._launcher
        if self.run is None or launcher is None:
            response.message = "no run is on"
        elif launcher.abort("asked for").reason != "asked for":
            response.message = f"{self.run.name} is {launcher.status.state.name.lower()} already"
        else:
            self._abort(launcher, 0.0)
            response.success, response.message = True, f"{self.run.name}: aborted"
        return response

    def _parameters_set(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == "speed_tolerance":
                self._tolerance = parameter.value
                if self._launcher is not None:
                    self._launcher.tolerance = parameter.value
            elif parameter.name == "auto_release":
                self._auto_release = parameter.value
                launcher = self._launcher
                armed = launcher is not None and launcher.status.state is LauncherPhase.ARMED
                if self._auto_release and self.run is not None and launcher is not None and armed:
                    self._release(launcher)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; return the exit status."""
    return run(LauncherNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
