"""The real bench of a trial: measurements and verdict are read, launcher/hold is published.

:class:`capture_sim.trial.trial.Trial` makes the decisions.  Messages and a timer reach it in the
node's callbacks.  The timer and the callbacks of measurements publish launcher/hold whenever it is
due, so that no queue of waiting measurements delays it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks

from capture_sim.detection.criteria import CaptureState
from capture_sim.detection.measurements import Source
from capture_sim.errors import MessageError, one_line
from capture_sim.messages.cdr import Numbers
from capture_sim.messages.convert import stamp_in
from capture_sim.messages.definitions import typestore
from capture_sim.messages.measurements import TOPICS_OF_SOURCE, MeasurementReader
from capture_sim.messages.topics import (
    CAPTURE_VERDICT,
    EMERGENCY_STOP,
    HOLD,
    LOAD_CELL,
    Topic,
)
from capture_sim.nodes.base.diagnostics import PERIOD, Diagnostics, DiagnosticStatus, Level
from capture_sim.nodes.base.endpoints import (
    ANYONE,
    BOOL,
    TRANSIENT_LOCAL,
    full_name,
    message_class,
    qos_of,
    qos_problem,
)
from capture_sim.nodes.base.node import LOOK_UP_PERIOD, BenchNode
from capture_sim.nodes.trials.evidence import Evidence, refusing
from capture_sim.plausibility.rules import Doubt
from capture_sim.scene.parts import Scene
from capture_sim.trial.hold import HoldOutput, HoldPublishers, HoldReaders
from capture_sim.trial.interlocks import Interlocks, TrialLimits
from capture_sim.trial.rest import Pose
from capture_sim.trial.trial import Trial, TrialStep

#: Period of the timer by which time limits are checked, s (wall).
TICK = 0.02
#: If the timer is later than this, s (wall), this node was busy and messages wait to be read.  The
#: node then reads them for as long before the trial decides.
MAX_LATENESS = 0.1
#: Examples that convert a driver's type of message to PoseStamped.
RELAYS = {
    "geometry_msgs/msg/TransformStamped": "relay_transform.py",
    "tf2_msgs/msg/TFMessage": "relay_tf.py",
    "geometry_msgs/msg/PoseArray": "relay_pose_array.py",
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": "relay_rigid_bodies.py",
    "mocap4r2_msgs/msg/RigidBodies": "relay_rigid_bodies.py",
}
#: Node name that rclpy gives if DDS does not know it yet, or no longer.
UNKNOWN = "_NODE_NAME_UNKNOWN_"


class TrialBench:
    """Passes measurements and verdict to the present trial, and holds or releases the chaser.

    With an actuator, it also checks the measurements between trials, and reports on /diagnostics
    what would refuse a release.

    Parameters
    ----------
    node
        Node whose callbacks read the topics and publish launcher/hold.
    limits
        Limits of every trial.
    driver
        Name or full name of the node that must read launcher/hold.  If it is empty, any node except
        those of ``suite``, ``ros2 topic`` and ``ros2 bag`` is accepted.
    waived
        Names of rules that do not refuse a release.
    scene
        Scene by which measurements are checked while no trial is on; None: without a scene.
    suite
        Function that returns the full names of the other nodes of capture_sim.
    has_actuator
        True if launcher/hold lets the chaser go.  False: launcher/hold is not published, and the
        chaser is released by hand.
    starts
        Relative poses at the start of the known scenes, by name.

    Attributes
    ----------
    steps
        Steps that the trial has decided and its server has yet to take.
    stamp
        Stamp of the latest pose of the chaser in a trial, ns.
    interlocks
        Conditions for a release, with the latest measurements.
    """

    def __init__(
        self,
        node: BenchNode,
        limits: TrialLimits,
        driver: str,
        waived: Collection[str],
        scene: Scene | None,
        suite: Callable[[], set[str]],
        *,
        has_actuator: bool,
        starts: Mapping[str, Pose],
    ) -> None:
        self.steps: list[TrialStep] = []
        self.stamp = 0
        self._node, self._suite = node, suite
        self._trial: Trial | None = None
        self._is_held = True  # as decided last
        self._alarm = ""  # of a chaser that does not stop, as last logged
        self._conflict = ""  # of the publishers of launcher/hold, as last logged
        topics = {
            source: [topic.name for topic in measuring]
            for source, measuring in TOPICS_OF_SOURCE.items()
        }
        self._evidence, self._scene = Evidence(waived), scene
        # in another thread: this one does nothing that may delay launcher/hold
        self._checker = ThreadPoolExecutor(1, "plausibility")
        self._check: Future[tuple[Doubt, ...]] | None = None  # the one that is on
        self._check_began = 0.0  # s
        self._doubted = ""  # as last logged
        self._last_tick = self._caught_up = now = time.monotonic()
        publishers = HoldPublishers(node.get_fully_qualified_name(), now)
        self.interlocks = Interlocks(limits, topics, HoldReaders(driver), publishers, waived)
        self.interlocks.starts = starts
        self._hold: HoldOutput | None = None
        if has_actuator:
            self.interlocks.note_check((), now)
            self.interlocks.request_check = self._request_check
            self._hold = self._open_hold()
            self._output_hold()
            self._listen_for_hands()
            self._diagnostics = Diagnostics(node)
            node.every(PERIOD, self._diagnose)
        names = (f"wrench.force.{axis}" for axis in "xyz")
        self._force = Numbers(typestore(), LOAD_CELL.type_name, *names)
        self._listen_for_measurements()
        node.listen(CAPTURE_VERDICT, self._receive_verdict)
        node.every(TICK, self._tick)
        node.every(LOOK_UP_PERIOD, self._look_up_others)

    def _open_hold(self) -> HoldOutput:
        """Return the output of launcher/hold."""
        kind = message_class(BOOL)
        # transient local, so that a driver which starts late holds from its first message on
        output = self._node.create_publisher(kind, HOLD, TRANSIENT_LOCAL)
        return HoldOutput(lambda is_held: output.publish(kind(data=is_held)))

    def _listen_for_hands(self) -> None:
        """Subscribe to the emergency stop, and to launcher/hold for other publishers of it."""
        node, kind = self._node, message_class(BOOL)
        # it matches every publisher: another hand is found at once
        watch = SubscriptionEventCallbacks(matched=node.guarded(self._hear_publisher))
        node.create_subscription(
            kind, HOLD, node.guarded(self._hear_hold), ANYONE, event_callbacks=watch
        )
        # twice: one that is latched, and one that no publisher's quality of service excludes
        for qos in (TRANSIENT_LOCAL, ANYONE):
            node.create_subscription(
                kind, EMERGENCY_STOP, node.guarded(self._hear_emergency_stop), qos
            )

    def _listen_for_measurements(self) -> None:
        for source, measuring in TOPICS_OF_SOURCE.items():
            for topic in measuring:
                take = partial(self._receive, source, topic, MeasurementReader(topic))
                self._node.listen(topic, take, raw=True)
        self._node.listen(LOAD_CELL, self._receive_force, raw=True)

    def begin(self, trial: Trial) -> None:
        """Pass measurements and verdicts to this trial from now on; discard earlier steps."""
        self._look_up_others()
        self.steps.clear()
        self._trial = trial

    def end(self) -> None:
        """Pass measurements to no trial from now on, and hold the chaser."""
        self._trial = None
        self._output_hold()

    def close(self) -> None:
        """Hold the chaser, and end the thread that checks plausibility."""
        self.end()
        self._checker.shutdown(cancel_futures=True)

    def take_steps(self) -> list[TrialStep]:
        """Return the steps that the trial has decided since the last call."""
        steps, self.steps = self.steps, []
        return steps

    def decide(self) -> None:
        """Let the trial decide now, e.g. when it is cancelled, and publish launcher/hold.

        If this node was busy, the trial decides at a later callback instead, after the measurements
        that have waited; see :data:`MAX_LATENESS`.
        """
        self._decide(time.monotonic())

    # callbacks

    def _receive(
        self, source: Source, topic: Topic, reader: MeasurementReader, data: bytes
    ) -> None:
        self._output_hold()
        now = time.monotonic()
        self._evidence.add(topic, data, int(now * 1e9))
        try:
            stamp, values = reader(data)
        except MessageError as error:
            self.interlocks.monitors[topic.name].add_empty(str(error), now)
            raise
        # rates are not used: a driver without velocities may send NaN
        values = values[: source.size]
        self.interlocks.add(topic.name, stamp, values, now)
        if self._trial is None:
            return
        if source is Source.BUFFER:
            self._trial.add_buffer(topic.name, values[0], values[1])
            return
        self._trial.add_pose(source, topic.name, stamp, (values[0], values[1], values[2]), now)
        if source is Source.CHASER:
            self.stamp = stamp
            self._decide(now)

    def _receive_force(self, data: bytes) -> None:
        self._output_hold()
        self._evidence.add(LOAD_CELL, data, time.monotonic_ns())
        if self._trial is not None:
            self._trial.add_force(*self._force(data).item())

    def _hear_emergency_stop(self, message: Any) -> None:
        now = time.monotonic()
        self.interlocks.emergency_stop.note(is_pressed=bool(message.data), now=now)
        self._decide(now)
        self._output_hold()

    def _receive_verdict(self, status: Any) -> None:
        if self._trial is None:
            return
        label = CaptureState(status.state).label
        self._trial.add_verdict(label, status.reason, is_final=status.final, stamp=stamp_in(status))
        self._decide(time.monotonic())

    def _tick(self) -> None:
        now = time.monotonic()
        if self._is_late(now):
            self._caught_up = now + MAX_LATENESS
        self._last_tick = now
        self._take_check()
        if self.interlocks.publishers.has_nameless:
            self._look_up_publishers_of_hold()
        self._decide(now)
        self._output_hold()
        if self._hold is not None:
            self.interlocks.watch_held(now)
            if self.interlocks.held.alarm != self._alarm:
                self._alarm = self.interlocks.held.alarm
                log = self._node.get_logger()
                if self._alarm:
                    log.error(self._alarm)
                else:  # a line of its own: rclpy wants one severity a place
                    log.info("the chaser is at rest at its start again")

    def _diagnose(self) -> None:
        """Publish on /diagnostics whether the chaser could be let go now, else why not.

        The level is OK also after a trial's release, and ERROR if another node publishes
        launcher/hold or a held chaser does not stop.
        """
        now = time.monotonic()
        error = self._conflict or self._alarm
        level, text = Level.OK, "ready to let go"
        if error:
            level, text = Level.ERROR, error
        elif self._trial is not None and self._trial.is_released:
            text = "a trial is on"
        elif refusal := self.interlocks.refusal(now):
            level, text = Level.WARN, refusal
        waived = ", ".join(sorted(self.interlocks.waived)) or "none"
        self._diagnostics.publish(
            DiagnosticStatus("release", level, text, {"waived rules": waived})
        )

    def _is_late(self, now: float) -> bool:
        return now > self._last_tick + TICK + MAX_LATENESS

    def _hear_hold(self, message: Any) -> None:
        lets_go = self._trial is not None and not self._trial.holds
        self.interlocks.publishers.hear(message.data, lets_go, time.monotonic())
        self._output_hold()

    def _hear_publisher(self, _: Any) -> None:
        self._look_up_publishers_of_hold()
        self._decide(time.monotonic())

    def _look_up_publishers_of_hold(self) -> None:
        """Note which nodes publish launcher/hold; log a conflict with another node once."""
        if self._hold is None:
            return
        ends = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(HOLD))
        ends = [end for end in ends if end.topic_type == BOOL]
        named = [full_name(end) for end in ends if UNKNOWN not in end.node_name]
        now, publishers = time.monotonic(), self.interlocks.publishers
        publishers.note(named, len(ends) - len(named), now)
        conflict = publishers.conflict(now)
        if conflict and conflict != self._conflict:
            self._node.get_logger().error(conflict)
        self._conflict = conflict

    def _request_check(self) -> None:
        """Have the last seconds checked by the rules of plausibility, unless that is being done."""
        if self._check is not None:
            return
        scene = self._scene if self._trial is None else self._trial.scene
        self._check_began = time.monotonic()
        latest = self._evidence.latest(int(self._check_began * 1e9))
        self._check = self._checker.submit(self._evidence.before_release, latest, scene)

    def _take_check(self) -> None:
        """Note the result of a check of plausibility, if one is done.

        Broken rules that refuse a release are noted for the interlocks.  The others are logged each
        time a different set of them is broken.
        """
        if self._check is None or not self._check.done():
            return
        check, self._check = self._check, None
        doubts = check.result()
        grave = refusing(doubts)
        self.interlocks.note_check([doubt.line for doubt in grave], self._check_began)
        noted = [doubt for doubt in doubts if doubt not in grave]
        kinds = ", ".join(doubt.rule.name for doubt in noted)
        if kinds != self._doubted:
            self._doubted = kinds
            if noted:
                lines = "; ".join(doubt.line for doubt in noted)
                self._node.get_logger().warning(one_line(lines))

    def _look_up_others(self) -> None:
        """Note which nodes publish the measurements, and which read and publish launcher/hold.

        Unless a chaser is released, also have the plausibility of the last seconds checked.
        """
        if self._hold is not None and (self._trial is None or not self._trial.is_released):
            self._request_check()
        self.interlocks.machine_clock = time.time() - time.monotonic()
        self._look_up_publishers_of_hold()
        nodes, mismatches = {}, {}
        for topic in (topic for measuring in TOPICS_OF_SOURCE.values() for topic in measuring):
            name = self._node.resolve_topic_name(topic.name)
            ends = self._node.get_publishers_info_by_topic(name)
            nodes[topic.name] = sorted(_names(ends))
            for end in ends:
                if problem := _mismatch(topic, end):
                    mismatches[topic.name] = problem
        self.interlocks.note_publishers(nodes, mismatches)
        readers = self._node.get_subscriptions_info_by_topic(self._node.resolve_topic_name(HOLD))
        problems = {full_name(end): _hold_problem(end) for end in readers}
        wrong = {node: problem for node, problem in problems.items() if problem}
        drivers = _names(readers) - self._suite() - {self._node.get_fully_qualified_name()}
        self.interlocks.readers.note(drivers - wrong.keys(), wrong, time.monotonic())

    def _decide(self, now: float) -> None:
        """Let the trial decide at time ``now``, s, and publish launcher/hold if that changes it.

        If this node was busy, do nothing: it must first read the measurements that have waited.
        """
        if self._trial is not None and now >= self._caught_up and not self._is_late(now):
            self.steps += self._trial.advance(now)
            self._output_hold()

    def _output_hold(self) -> None:
        """Publish launcher/hold if its value has changed or its period has elapsed.

        Without an actuator nothing is published.
        """
        if self._hold is None:
            return
        now = time.monotonic()
        if self._trial is not None:
            self._trial.note_silence(self._hold.silence(now), now)
        is_held = self._trial is None or self._trial.holds
        if is_held is not self._is_held:
            self._is_held = is_held
            self.interlocks.note_hold(is_held, now)
        self._hold.update(is_held, now)


def _names(ends: Sequence[Any]) -> set[str]:
    """Return the full names of the nodes of publishers or readers, without unknown names.

    If a process was killed, DDS forgets the name of its node before it forgets its publishers.
    """
    return {full_name(end) for end in ends if UNKNOWN not in end.node_name}


def _hold_problem(reader: Any) -> str:
    """Return why no message of launcher/hold can reach a reader; empty if messages can.

    Reasons are another type of message, or a requested quality of service that the publisher of
    launcher/hold does not offer, e.g. a deadline.
    """
    if reader.topic_type != BOOL:
        return f"reads {reader.topic_type}"
    reason = qos_problem(TRANSIENT_LOCAL, reader.qos_profile)
    return reason and f"requests another quality of service: {reason}"


def _mismatch(topic: Topic, publisher: Any) -> str:
    """Return why no message of this publisher of a topic can arrive; empty if messages can.

    A best-effort publisher is no reason, because the topic is then read best effort.
    """
    if publisher.topic_type != topic.type_name:
        text = f"{full_name(publisher)} publishes {publisher.topic_type}, not {topic.type_name}"
        relay = RELAYS.get(publisher.topic_type)
        is_pose = topic.type_name == "geometry_msgs/msg/PoseStamped"
        return f"{text}: relay it, as in examples/{relay}" if relay and is_pose else text
    wanted = qos_of(topic)
    wanted.reliability = publisher.qos_profile.reliability
    reason = qos_problem(publisher.qos_profile, wanted)
    return reason and f"{full_name(publisher)} offers another quality of service: {reason}"
