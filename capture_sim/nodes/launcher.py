"""The node that launches: plans mass and height, arms, releases, and watches the chaser."""

from __future__ import annotations

from functools import partial
from typing import Any

from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from capture_sim.launch.watch import Launcher, LauncherPhase
from capture_sim.messages.cdr import Numbers
from capture_sim.messages.convert import EPOCH_NS, LaunchAction, StringPhase, stamp_seconds
from capture_sim.messages.definitions import typestore
from capture_sim.messages.measurements import STAMP
from capture_sim.messages.telemetry import LauncherTelemetry
from capture_sim.messages.topics import (
    CHASER_ODOMETRY,
    CHASER_POSE,
    CONTACT_STATE,
    LAUNCHER,
    STRING_STATE,
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
#: The numbers that are read of each message besides its stamp.
NUMBERS = {
    STRING_STATE: ("chaser_speed", "phase"),
    CONTACT_STATE: ("in_touch", "touches"),
    CHASER_ODOMETRY: ("pose.pose.position.x", "pose.pose.position.y"),
    CHASER_POSE: ("pose.position.x", "pose.position.y"),
}
#: What is read of a simulator at each instant; of a bench it is the chaser's pose.
SIMULATED = (STRING_STATE, CONTACT_STATE, CHASER_ODOMETRY)
#: A bench's speed is that over this time, s: noise of its poses divides by it.
SPEED_WINDOW = 0.1
#: Stamps of which not every topic has come yet; the oldest is given up beyond.
MOST_WAITING = 1000


class LauncherNode(Participant):
    """Sends ARM and RELEASE, and its state with every periodic sample; ABORT if need be.

    What it decides stands in :class:`capture_sim.launch.watch.Launcher`.  ``~/launch`` releases
    an armed chaser, ``~/abort`` gives a launch up.
    """

    # of the run that is on, or the last one
    _launcher: Launcher | None = None
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
            "share of the wanted impact speed by which the chaser's speed may be off, 1",
            low=0.01,
            high=10.0,
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
        self._place: tuple[float, float] | None = None  # s and m, of a bench's chaser before
        self._zero: int | None = None  # ns, a bench's stamp when the chaser was let go
        self._now = 0.0  # s since the release, of the last state
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
            for topic in READ[LAUNCHER]
        }
        for topic in READ[LAUNCHER]:
            self.follow(topic, partial(self._take, topic), raw=True)
        self.create_service(Trigger, "~/launch", self._asked_to_launch)
        self.create_service(Trigger, "~/abort", self._asked_to_abort)
        self.add_post_set_parameters_callback(self._parameters_set)

    def begin(self, info: Any, scene: Scene) -> None:
        """Plan the launch and arm."""
        self._launcher = launcher = Launcher(scene, self._tolerance)
        self._telemetry = LauncherTelemetry(self.messages, info.run_id)
        self._parts = {}
        self._touched = False
        self._place = self._zero = None
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

    def _hold(self, hold: bool) -> None:
        if self._hold_output is not None and hold != self._held:
            self._held = hold
            self._hold_output.publish(self._bool(data=hold))

    def _release(self, launcher: Launcher) -> None:
        self.publish(self._telemetry.command(0.0, LaunchAction.RELEASE, launcher.plan))
        self._hold(False)
        self.publish(*self._telemetry.status(0.0, launcher.release()))

    def _abort(self, launcher: Launcher, t: float) -> None:
        """Publish that the launch is aborted."""
        self._hold(True)
        self.publish(self._telemetry.command(t, LaunchAction.ABORT, launcher.plan))
        self.publish(*self._telemetry.status(t, launcher.status))
        self.get_logger().error(f"{self.run.name}: aborted: {launcher.status.reason}")

    def _take(self, topic: Topic, data: bytes) -> None:
        sec, nanosec, *numbers = self._numbers[topic](data).item()
        stamp = sec * 1_000_000_000 + nanosec
        if not self.simulated:
            if topic in (CHASER_ODOMETRY, CHASER_POSE):
                self._watch_bench(stamp, *numbers)
        elif topic is not CHASER_POSE:
            self._collect(topic, stamp, numbers)

    def _watch_bench(self, stamp: int, x: float, y: float) -> None:
        """Watch a bench's chaser by its poses alone, each over the time since one before."""
        launcher = self._launcher
        if launcher is None or launcher.status.state is LauncherPhase.ARMED:
            return
        if self._zero is None:
            self._zero = stamp
        t = (stamp - self._zero) / 1e9
        travel = launcher.travelled(x, y)
        if self._place is None:
            self._place = t, travel
        since = t - self._place[0]
        if since < SPEED_WINDOW:
            return
        speed, middle = (travel - self._place[1]) / since, 0.5 * (travel + self._place[1])
        self._place = t, travel
        before = launcher.status.state
        slack, touched = t > launcher.plan.landing_time, travel > launcher.plan.travel
        status = launcher.observe(speed, slack, touched, t=t, travel=middle)
        self._now = own = t + (self._zero - EPOCH_NS) / 1e9
        if status.state is LauncherPhase.ABORTED and before is not LauncherPhase.ABORTED:
            self._abort(launcher, own)
        else:
            self.publish(*self._telemetry.status(own, status))

    def _collect(self, topic: Topic, stamp: int, numbers: list[Any]) -> None:
        parts = self._parts.setdefault(stamp, {})
        parts[topic] = numbers
        if len(parts) < len(SIMULATED) or self._launcher is None:
            if len(self._parts) > MOST_WAITING:
                del self._parts[min(self._parts)]
            return
        # each topic comes in the order of its stamps: an older set has lost a message
        self._parts = {other: kept for other, kept in self._parts.items() if other > stamp}
        (speed, phase), (in_touch, touches), (x, y) = (parts[topic] for topic in SIMULATED)
        self._touched = self._touched or in_touch or touches > 0
        self._now = t = stamp_seconds(stamp)
        before = self._launcher.status.state
        status = self._launcher.observe(
            speed,
            phase == StringPhase.SLACK,
            self._touched,
            t=t,
            travel=self._launcher.travelled(x, y),
        )
        if status.state is LauncherPhase.ABORTED and before is not LauncherPhase.ABORTED:
            self._abort(self._launcher, t)
        else:
            self.publish(*self._telemetry.status(t, status))

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
            elif parameter.name == "auto_release":
                self._auto_release = parameter.value
                launcher = self._launcher
                armed = launcher is not None and launcher.status.state is LauncherPhase.ARMED
                if self._auto_release and self.is_on and launcher is not None and armed:
                    self._release(launcher)


main = partial(run, LauncherNode)

if __name__ == "__main__":
    raise SystemExit(main())
