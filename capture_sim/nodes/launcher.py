"""The node that launches: plans mass and height, arms, releases, and watches the chaser."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from rclpy.parameter import Parameter

from capture_sim.launching import Launcher
from capture_sim.messages import LaunchAction, StringPhase, stamp_seconds
from capture_sim.nodes.following import FOLLOWED, RunFollower
from capture_sim.nodes.receiving import StampMatcher, stamp_ns_of
from capture_sim.nodes.running import run
from capture_sim.scene_files import load_scene_text
from capture_sim.telemetry import LauncherTelemetry
from capture_sim.topics import CONTACT_STATE, LAUNCHER, STRING_STATE, topics_of


class LauncherNode(RunFollower):
    """Sends ARM and RELEASE, and its state with every periodic sample.

    What it decides stands in :class:`capture_sim.launching.Launcher`.
    """

    # of the run that is on
    _launcher: Launcher
    _telemetry: LauncherTelemetry
    _matcher: StampMatcher
    _observed: int
    _released: bool
    _touched: bool

    def __init__(self) -> None:
        super().__init__(LAUNCHER)
        self._auto_release = self.declare(
            "auto_release",
            True,
            "release as soon as armed; false holds the chaser until this is set to true",
            read_only=False,
        )
        self.open(topics_of(LAUNCHER))
        for topic in FOLLOWED[LAUNCHER]:
            self.follow(topic, partial(self._take, topic.name))
        self.add_post_set_parameters_callback(self._parameters_set)

    def begin(self, info: Any) -> None:
        """Plan the launch and arm."""
        self._launcher = Launcher(load_scene_text(info.scene))
        self._telemetry = LauncherTelemetry(self.messages, info.run_id)
        self._matcher = StampMatcher(topic.name for topic in FOLLOWED[LAUNCHER])
        self._observed = 0
        self._released = self._touched = False
        plan = self._launcher.plan
        self.send(*self._telemetry.command(0.0, LaunchAction.ARM, plan))
        self.send(*self._telemetry.state(0.0, self._launcher.status))
        self.get_logger().info(
            f"{info.name}: armed, {plan.hanging_mass:.6g} kg at {plan.drop_height:.6g} m "
            f"for {plan.impact_speed:.6g} m/s"
        )
        if self._auto_release:
            self._release()

    def end(self, reason: str) -> list[str]:
        """Tell how much was sent."""
        self.send(*self._telemetry.end(complete=not reason, reason=reason))
        return super().end(reason)

    def _release(self) -> None:
        self._released = True
        self.send(*self._telemetry.command(0.0, LaunchAction.RELEASE, self._launcher.plan))
        self.send(*self._telemetry.state(0.0, self._launcher.release()))

    def _take(self, name: str, message: Any) -> None:
        parts = self._matcher.add(name, message)
        if parts is None:
            return
        string, contact = parts[STRING_STATE.name], parts[CONTACT_STATE.name]
        self._touched = self._touched or contact.in_touch or contact.touches > 0
        status = self._launcher.observe(
            string.chaser_speed, string.phase == StringPhase.SLACK, self._touched
        )
        self.send(*self._telemetry.state(stamp_seconds(stamp_ns_of(message)), status))
        self.advance_past(self._observed)
        self._observed += 1

    def _parameters_set(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == "auto_release":
                self._auto_release = parameter.value
                if self._auto_release and self.run is not None and not self._released:
                    self._release()


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; return the exit status."""
    return run(LauncherNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
