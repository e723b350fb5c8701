"""The node that launches: plans mass and height, arms, releases, and watches the chaser."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from capture_sim.detection.exact import CaptureState
from capture_sim.launch.bench_watch import BenchWatch, Pose
from capture_sim.launch.watch import Launcher, LauncherPhase, LauncherStatus
from capture_sim.messages.cdr import Numbers
from capture_sim.messages.convert import LaunchAction, StringPhase, stamp_seconds
from capture_sim.messages.definitions import typestore
from capture_sim.messages.measurements import POSE, STAMP, pose_values
from capture_sim.messages.telemetry import LauncherTelemetry
from capture_sim.messages.topics import (
    CAPTURE_VERDICT,
    CHASER_ODOMETRY,
    CHASER_POSE,
    CONTACT_STATE,
    LAUNCHER,
    STRING_STATE,
    TARGET_ODOMETRY,
    TARGET_POSE,
    Topic,
    topics_of,
)
from capture_sim.nodes.node import LATCHED, message_class
from capture_sim.nodes.participant import READ, Participant
from capture_sim.nodes.process import run
from capture_sim.nodes.run_state import Stage
from capture_sim.scene.parts import Scene

#: Output for a real release, such as a magnet's relay: std_msgs/Bool, true holds.
HOLD = "launcher/hold"
CHASER, TARGET = (CHASER_ODOMETRY, CHASER_POSE), (TARGET_ODOMETRY, TARGET_POSE)
#: The numbers that are read of each message besides its stamp.
NUMBERS = {
    STRING_STATE: ("chaser_speed", "phase"),
    CONTACT_STATE: ("in_touch", "touches"),
    **{
        topic: tuple(f"{path}.{name}" for name in POSE)
        for topics in (CHASER, TARGET)
        for topic, path in zip(topics, ("pose.pose", "pose"), strict=True)
    },
}
#: What is read of a simulator at each instant; of a bench it is the poses of both vehicles.
SIMULATED = (STRING_STATE, CONTACT_STATE, CHASER_ODOMETRY)
#: Largest number of stamps that wait for the rest of their topics; the oldest is dropped then.
MOST_WAITING = 1000


class LauncherNode(Participant):
    """Sends ARM and RELEASE, its state with every periodic sample, and ABORT if necessary.

    The decisions are those of :class:`capture_sim.launch.watch.Launcher`.  ``~/launch`` releases
    an armed chaser, ``~/abort`` aborts a launch.
    """

    # of the run that is on, or the last one
    _launcher: Launcher | None = None
    _watch: BenchWatch
    _used_poses: set[Topic]
    _telemetry: LauncherTelemetry
    _parts: dict[int, dict[Topic, Any]]  # numbers of one stamp (ns) that wait for the others
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
            "share of the planned impact speed by which the chaser's speed may deviate, 1",
            low=0.01,
            high=10.0,
            read_only=False,
        )
        self._aborts = self.declare(
            "abort_on_deviation",
            True,
            "abort a launch that differs from its plan: speed beyond speed_tolerance by 5 standard "
            "deviations, or contact too late; false only warns",
            read_only=False,
        )
        actuator = self.declare(
            "actuator",
            "simulated",
            "what lets the chaser go: the simulator, or the output launcher/hold",
            choices=("simulated", "output"),
        )
        self._scene = self.declare_scene(
            "of a bench without simulator: ~/launch begins a trial of it, ~/end_trial ends it"
        )
        self._asked = False  # to launch the trial that is begun
        self._now = 0.0  # s since the release, of the last state
        self._capture = CaptureState.APPROACH  # by the detector
        if self._scene is not None:
            self.listen(CAPTURE_VERDICT, self._note_capture)
        self.open(topics_of(LAUNCHER))
        self._hold_output: Any = None
        self._held: bool | None = None  # as last published
        if actuator == "output":
            # latched, so that a driver which starts late holds from its first message on
            self._bool = message_class("std_msgs/msg/Bool")
            self._hold_output = self.create_publisher(self._bool, HOLD, LATCHED)
            self._hold(True)
        self._numbers = {
            topic: Numbers(typestore(), topic.type_name, *STAMP, *NUMBERS[topic])
            for topic in NUMBERS
        }
        # a simulator sends where the tip touches; on a bench the target's pose shows it
        targets = TARGET if actuator == "output" else ()
        for topic in (*READ[LAUNCHER], *targets):
            self.follow(topic, partial(self._receive_measurement, topic), raw=True)
        self.create_service(Trigger, "~/launch", self._asked_to_launch)
        self.create_service(Trigger, "~/abort", self._asked_to_abort)
        self.add_post_set_parameters_callback(self._parameters_set)

    def begin(self, info: Any, scene: Scene) -> None:
        """Plan the launch and arm."""
        self._launcher = launcher = Launcher(scene, self._tolerance, aborts=self._aborts)
        self._watch = BenchWatch(launcher, scene)
        self._used_poses = set()
        self._capture = CaptureState.APPROACH
        self._telemetry = LauncherTelemetry(self.messages, info.run_id)
        self._parts = {}
        self._touched = False
        self._now = 0.0
        plan = launcher.plan
        self._hold(True)
        self.publish(self._telemetry.command(0.0, LaunchAction.ARM, plan))
        self.publish(*self._telemetry.status(0.0, launcher.status))
        how, speed = "no string", f"{plan.impact_speed:.6g} m/s"
        if plan.hanging_mass > 0.0:
            how = f"{plan.hanging_mass:.6g} kg at {plan.drop_height:.6g} m"
        self.get_logger().info(f"{info.name}: armed, {how} for {speed}")
        if self._auto_release or self._asked:
            self._release(launcher)

    def end(self, reason: str) -> list[str]:
        """Report the counts when all messages have arrived; hold a bench's chaser again."""
        self._hold(True)
        self._asked = False
        self.drain(1.0)
        self.publish(self._telemetry.end(complete=not reason, reason=reason))
        return super().end(reason)

    def trial_result(self) -> str:
        """Return the detector's verdict."""
        return f"verdict {self._capture.label}" if self._capture.is_verdict else "no verdict"

    def _note_capture(self, status: Any) -> None:
        before, self._capture = self._capture, CaptureState(status.state)
        if self.is_on and self._capture.is_verdict and self._capture is not before:
            self.get_logger().info(f"{self.run.name}: {self.trial_result()}")

    def _hold(self, hold: bool) -> None:
        if self._hold_output is not None and hold != self._held:
            self._held = hold
            self._hold_output.publish(self._bool(data=hold))

    def _release(self, launcher: Launcher) -> None:
        self.publish(self._telemetry.command(0.0, LaunchAction.RELEASE, launcher.plan))
        self._hold(False)
        self._watch.release(time.monotonic())
        self.publish(*self._telemetry.status(0.0, launcher.release()))

    def _abort(self, launcher: Launcher, t: float) -> None:
        """Publish that the launch is aborted."""
        self._hold(True)
        self.publish(self._telemetry.command(t, LaunchAction.ABORT, launcher.plan))
        self.publish(*self._telemetry.status(t, launcher.status))
        self.get_logger().error(f"{self.run.name}: aborted: {launcher.status.reason}")

    def _receive_measurement(self, topic: Topic, data: bytes) -> None:
        sec, nanosec, *numbers = self._numbers[topic](data).item()
        stamp = sec * 1_000_000_000 + nanosec
        if self.simulated:
            if topic in SIMULATED:
                self._collect(topic, stamp, numbers)
            return
        for topics in (CHASER, TARGET):
            # of each vehicle the first topic that comes in a trial is used
            if topic not in topics or not self._used_poses.isdisjoint({*topics} - {topic}):
                continue
            self._used_poses.add(topic)
            if topics is TARGET:
                self._watch.add_target(pose_values(*numbers))
            else:
                self._watch_bench(stamp, pose_values(*numbers))

    def _watch_bench(self, stamp: int, pose: Pose) -> None:
        """Watch a bench's chaser by the poses alone."""
        launcher = self._launcher
        if launcher is None:
            return
        before = launcher.status.state
        status = self._watch.add_chaser(stamp / 1e9, pose, time.monotonic())
        if status is not None:
            self._report(stamp_seconds(stamp), before, status)

    def _report(self, t: float, before: LauncherPhase, status: LauncherStatus) -> None:
        """Publish what a measurement has changed, and an abort that it has caused."""
        assert self._launcher is not None
        self._now = t
        if status.state is LauncherPhase.ABORTED and before is not LauncherPhase.ABORTED:
            self._abort(self._launcher, t)
            return
        self.publish(*self._telemetry.status(t, status))
        if self._launcher.deviation:
            text = f"{self.run.name}: {self._launcher.deviation}"
            self.get_logger().warning(text, throttle_duration_sec=1.0)

    def _collect(self, topic: Topic, stamp: int, numbers: list[Any]) -> None:
        parts = self._parts.setdefault(stamp, {})
        parts[topic] = numbers
        if len(parts) < len(SIMULATED) or self._launcher is None:
            if len(self._parts) > MOST_WAITING:
                del self._parts[min(self._parts)]
            return
        # each topic comes in the order of its stamps: an older set has lost a message
        self._parts = {other: kept for other, kept in self._parts.items() if other > stamp}
        (speed, phase), (in_touch, touches), (x, y, *_) = (parts[topic] for topic in SIMULATED)
        self._touched = self._touched or in_touch or touches > 0
        t = stamp_seconds(stamp)
        before = self._launcher.status.state
        status = self._launcher.observe(
            speed,
            phase == StringPhase.SLACK,
            self._touched,
            t=t,
            travel=self._launcher.travelled(x, y),
        )
        self._report(t, before, status)

    def _asked_to_launch(self, _: Any, response: Any) -> Any:
        launcher = self._launcher
        stage = self.state.stage
        if stage is Stage.NONE and self._scene is not None:
            self._asked = True
            self.announce(self._scene.name, self._scene)
            response.success, response.message = True, f"{self._scene.name}: trial begun"
        elif stage in (Stage.REQUESTED, Stage.ANNOUNCED):
            response.message = "a trial is being begun already"
        elif stage is Stage.NONE or launcher is None:
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
        if not self.is_on or launcher is None:
            response.message = "no run is on"
        elif launcher.abort("asked for").reason != "asked for":
            response.message = f"{self.run.name} is {launcher.status.state.name.lower()} already"
        else:
            self._abort(launcher, self._now)
            response.success, response.message = True, f"{self.run.name}: aborted"
        return response

    def _parameters_set(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == "speed_tolerance":
                self._tolerance = parameter.value
                if self._launcher is not None:
                    self._launcher.tolerance = parameter.value
            elif parameter.name == "abort_on_deviation":
                self._aborts = parameter.value
                if self._launcher is not None:
                    self._launcher.aborts = parameter.value
            elif parameter.name == "auto_release":
                self._auto_release = parameter.value
                launcher = self._launcher
                armed = launcher is not None and launcher.status.state is LauncherPhase.ARMED
                if self._auto_release and self.is_on and launcher is not None and armed:
                    self._release(launcher)


main = partial(run, LauncherNode)

if __name__ == "__main__":
    raise SystemExit(main())
