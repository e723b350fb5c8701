"""The launcher's part in the runs of a simulator: it arms, releases, and watches the chaser."""

from __future__ import annotations

from functools import partial
from typing import Any

from capture_sim.launcher.state_machine import (
    Launcher,
    LauncherPhase,
    LaunchObservation,
    LaunchSettings,
)
from capture_sim.messages.cdr import Numbers
from capture_sim.messages.convert import LaunchAction, StringPhase, stamp_seconds
from capture_sim.messages.definitions import typestore
from capture_sim.messages.measurements import STAMP
from capture_sim.messages.telemetry import LauncherTelemetry
from capture_sim.messages.topics import (
    CHASER_ODOMETRY,
    CONTACT_STATE,
    LAUNCHER,
    STRING_STATE,
    RunSource,
    Topic,
    topics_of,
)
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.protocol.ends import RunEnd
from capture_sim.nodes.protocol.follower import AnnouncedRun, Follower, RunPart
from capture_sim.nodes.protocol.roll import RunReport

#: Topics of the simulator that the launcher reads, with the fields that it needs besides the stamp.
NUMBERS = {
    STRING_STATE: ("chaser_speed", "phase"),
    CONTACT_STATE: ("in_touch", "touches"),
    CHASER_ODOMETRY: ("pose.pose.position.x", "pose.pose.position.y"),
}


class SimulatedLaunch(RunPart):
    """Publishes the commands ARM, RELEASE and ABORT, and the launcher's state at ``run.rate``.

    :class:`capture_sim.launcher.state_machine.Launcher` makes the decisions.  With ``auto_release``
    the chaser is released as soon as it is armed, otherwise by :meth:`set_auto_release`.
    """

    # of the run that is on, or the last one
    _launcher: Launcher | None = None
    _telemetry: LauncherTelemetry
    _parts: dict[int, dict[Topic, Any]]  # numbers of one stamp (ns) that wait for the others
    _has_touched: bool
    _deviation: str  # the last that was logged

    def __init__(self, node: BenchNode, settings: LaunchSettings, *, auto_release: bool) -> None:
        self._node, self._settings, self._auto_release = node, settings, auto_release
        node.open(topics_of(LAUNCHER))
        self._follower = Follower(node, LAUNCHER, self, [RunSource.SIMULATION])
        for topic, names in NUMBERS.items():
            numbers = Numbers(typestore(), topic.type_name, *STAMP, *names)
            self._follower.follow(topic, partial(self._receive, topic, numbers), raw=True)
        self._follower.join()

    def work(self) -> int:
        """Take part in runs until the node is asked to end, which raises KeyboardInterrupt."""
        return self._follower.work()

    def set_auto_release(self, value: bool) -> None:
        """Set whether an armed chaser is released at once.

        If True, release a chaser that is armed now.  If False, hold the chaser of each run armed
        until it is set to True; a released chaser stays released.
        """
        self._auto_release = value
        launcher = self._launcher
        is_armed = launcher is not None and launcher.status.state is LauncherPhase.ARMED
        if value and self._follower.is_on and is_armed:
            self._release()

    def settings_changed(self) -> None:
        """Apply the changed settings to the current run; later runs use them in any case."""
        if self._launcher is not None:
            self._launcher.tolerance = self._settings.tolerance
            self._launcher.aborts = self._settings.aborts

    # a run, see RunPart

    def prepare(self, run: AnnouncedRun) -> None:
        """Plan the launch of the run's scene."""
        settings = self._settings
        self._launcher = Launcher(run.scene, settings.tolerance, aborts=settings.aborts)
        self._telemetry = LauncherTelemetry(self._node.messages, run.id)
        self._parts, self._has_touched, self._deviation = {}, False, ""

    def begin(self, run: AnnouncedRun) -> None:
        """Publish the command ARM, and RELEASE if ``auto_release`` is set."""
        assert self._launcher is not None
        launcher, plan = self._launcher, self._launcher.plan
        self._node.publish(self._telemetry.command(0.0, LaunchAction.ARM, plan))
        self._node.publish(*self._telemetry.status(0.0, launcher.status))
        self._node.get_logger().info(f"{run.name}: armed, {plan.text}")
        if self._auto_release:
            self._release()

    def end(self, run: AnnouncedRun, end: RunEnd) -> RunReport:
        """Publish how many messages the launcher has sent, as StreamCounts."""
        del run
        self._node.publish(self._telemetry.end(end.reason))
        return end.report

    def _release(self) -> None:
        assert self._launcher is not None
        launcher = self._launcher
        self._node.publish(self._telemetry.command(0.0, LaunchAction.RELEASE, launcher.plan))
        self._node.publish(*self._telemetry.status(0.0, launcher.release()))

    def _receive(self, topic: Topic, numbers: Numbers, data: bytes) -> None:
        """Collect the fields with one stamp; evaluate them when all three messages are there."""
        sec, nanosec, *values = numbers(data).item()
        stamp = sec * 1_000_000_000 + nanosec
        parts = self._parts.setdefault(stamp, {})
        parts[topic] = values
        if len(parts) == len(NUMBERS):
            # each topic comes in the order of its stamps: an older set has lost a message
            self._parts = {other: kept for other, kept in self._parts.items() if other > stamp}
            self._observe(stamp, parts)

    def _observe(self, stamp: int, parts: dict[Topic, Any]) -> None:
        assert self._launcher is not None
        assert self._follower.run is not None
        launcher, name = self._launcher, self._follower.run.name
        speed, phase = parts[STRING_STATE]
        is_in_touch, touches = parts[CONTACT_STATE]
        self._has_touched = self._has_touched or bool(is_in_touch) or touches > 0
        t = stamp_seconds(stamp)
        before = launcher.status.state
        status = launcher.observe(
            LaunchObservation(
                t=t,
                speed=speed,
                travel=launcher.travelled(*parts[CHASER_ODOMETRY]),
                is_slack=phase == StringPhase.SLACK,
                has_touched=self._has_touched,
            )
        )
        if status.state is LauncherPhase.ABORTED and before is not LauncherPhase.ABORTED:
            command = self._telemetry.command(t, LaunchAction.ABORT, launcher.plan)
            self._node.publish(command)
            self._node.get_logger().error(f"{name}: aborted: {status.reason}")
        elif launcher.deviation and not self._deviation:
            self._node.get_logger().warning(f"{name}: {launcher.deviation}")
        self._deviation = launcher.deviation
        self._node.publish(*self._telemetry.status(t, status))
