"""The action launcher/run_trial: trials of a real bench, one at a time.

Nothing but a goal of this action lets a real chaser go.  The decisions are those of
:class:`capture_sim.launch.trial.Trial`: measurements, verdicts and a timer reach it in callbacks,
and launcher/hold follows it there; commands to the other nodes are sent between callbacks.  Every
callback sends launcher/hold if that is due, so it is late by the longest of them at most.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.qos import QoSCompatibility, qos_check_compatible

from capture_sim.action import RunTrial
from capture_sim.detection.criteria import CaptureState
from capture_sim.errors import CaptureSimError, one_line
from capture_sim.launch.hold import HoldOutput, HoldReaders
from capture_sim.launch.interlocks import Interlocks, Sensor, TrialLimits
from capture_sim.launch.scenes import load_requested
from capture_sim.launch.trial import (
    Trial,
    TrialGoal,
    TrialPhase,
    TrialStep,
)
from capture_sim.launch.watch import Launcher, LaunchSettings
from capture_sim.messages.cdr import Numbers
from capture_sim.messages.convert import stamp_in
from capture_sim.messages.definitions import typestore
from capture_sim.messages.measurements import TOPICS_OF_SOURCE, MeasurementReader
from capture_sim.messages.topics import (
    CAPTURE_VERDICT,
    HOLD,
    LAUNCHER,
    LOAD_CELL,
    RUN_INFO,
    Topic,
    topics_of,
)
from capture_sim.nodes.endpoints import TRANSIENT_LOCAL, full_name, message_class, qos_of
from capture_sim.nodes.follower import RUN_END_TIMEOUT
from capture_sim.nodes.node import LOOK_UP_PERIOD, BenchNode
from capture_sim.nodes.roll import Roll
from capture_sim.nodes.trial_announcement import TrialAnnouncement
from capture_sim.scene.parts import Scene

#: Time limits are looked at this often, s (wall).
TICK = 0.02
#: A timer that is later by more than this shows that this node was busy: messages wait for it.
#: It gets as long to read them before it decides by them, s (wall).
MAX_LATENESS = 0.1
#: Feedback is sent this often, s (wall).
FEEDBACK_PERIOD = 0.1
BOOL = "std_msgs/msg/Bool"
#: Name of a node that DDS does not know, or not any more.
UNKNOWN = "_NODE_NAME_UNKNOWN_"
#: What measures, by sensor.
MEASURES = {Sensor(source.value): topics for source, topics in TOPICS_OF_SOURCE.items()}
INTERRUPTED = "launcher interrupted"


@dataclass(frozen=True)
class TrialSettings:
    """How trials are run.

    ``has_actuator``: launcher/hold lets the chaser go; else it is let go by hand.
    ``needs_client``: the chaser is let go only once the client has asked for the result.
    ``driver``: the node that must read launcher/hold, empty for any.
    ``scene``: of goals that name none; ``scene_folder``: whose files a goal may name besides the
    packaged scenes.
    """

    has_actuator: bool
    limits: TrialLimits
    needs_client: bool = True
    driver: str = ""
    scene: Scene | None = None
    scene_folder: Path | None = None


class _Server(ActionServer):
    """An action server that reports which goal's result a client has asked for.

    A goal is executed at its end: an execution that waits would be resumed after every callback.
    """

    def __init__(self, *arguments: Any, on_result_request: Callable[[bytes], None], **more: Any):
        self._on_result_request = on_result_request
        super().__init__(*arguments, **more)

    async def execute(self, taken_data: Any) -> None:
        """Serve requests: rclpy has no callback for this one."""
        if "result" in taken_data:
            self._on_result_request(bytes(taken_data["result"][1].goal_id.uuid))
        await super().execute(taken_data)

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Leave the execution of an accepted goal to :meth:`end`."""

    def end(self, handle: Any) -> None:
        """Have the executor execute a goal, whose result is then sent to who asks for it."""
        super().notify_execute(handle, None)


class TrialServer:
    """Serves launcher/run_trial for a node; call :meth:`work` as the node's work."""

    def __init__(self, node: BenchNode, settings: TrialSettings, launch: LaunchSettings) -> None:
        self._node, self._settings, self._launch = node, settings, launch
        topics = {
            sensor: [topic.name for topic in measuring] for sensor, measuring in MEASURES.items()
        }
        self._interlocks = Interlocks(settings.limits, topics, HoldReaders(settings.driver))
        self._trial: Trial | None = None
        self._steps: list[TrialStep] = []
        self._handle: Any = None  # of the goal that is served, until its result is sent
        self._outcome: tuple[str, Any]  # of that goal: method of the handle, result
        self._last_tick = self._caught_up = time.monotonic()
        self._last_stamp = 0  # ns
        self._said = ""  # the last deviation that was logged
        self._goal_id = b""  # of the goal that is served
        self._awaited = b""  # id of the goal whose result a client has asked for last
        self._hold: HoldOutput | None = None
        if settings.has_actuator:
            # transient local, so that a driver which starts late holds from its first message on
            kind = message_class(BOOL)
            output = node.create_publisher(kind, HOLD, TRANSIENT_LOCAL)
            self._hold = HoldOutput(lambda is_held: output.publish(kind(data=is_held)))
            self._output_hold()
        self._force = Numbers(
            typestore(), LOAD_CELL.type_name, *(f"wrench.force.{axis}" for axis in "xyz")
        )
        for sensor, measuring in MEASURES.items():
            for topic in measuring:
                take = partial(self._receive, sensor, topic, MeasurementReader(topic))
                node.listen(topic, take, raw=True)
        node.listen(LOAD_CELL, self._receive_force, raw=True)
        node.listen(CAPTURE_VERDICT, self._receive_verdict)
        node.listen(RUN_INFO, self._hear_announcement)
        node.open([*topics_of(LAUNCHER), RUN_INFO])
        self._server = _Server(
            node,
            RunTrial,
            "~/run_trial",
            execute_callback=self._execute,
            goal_callback=node.guarded(self._receive_goal),
            handle_accepted_callback=node.guarded(self._accept),
            cancel_callback=node.guarded(self._cancel),
            on_result_request=node.guarded(self._note_result_request),
        )
        node.every(TICK, self._tick)
        node.every(LOOK_UP_PERIOD, self._look_up_others)
        # takes part in no run that another node announces
        self._roll = Roll(node, LAUNCHER)

    def work(self) -> int:
        """Serve goals until the node is asked to end; return the exit status."""
        self._node.freeze_objects()
        actuator = "launcher/hold" if self._settings.has_actuator else "none: let go by hand"
        self._node.get_logger().info(f"ready for trials, actuator {actuator}")
        try:
            while True:
                self._node.wait(lambda: self._handle is not None)
                self._serve()
        finally:
            self._trial = None
            self._output_hold()
            if self._goal_id:
                self._answer_last_goal()

    def settings_changed(self) -> None:
        """Use settings that have been changed, also in the trial that is on."""
        if self._trial is not None:
            self._trial.set_launch(self._launch.tolerance, aborts=self._launch.aborts)

    # what comes in, in callbacks

    def _receive(
        self, sensor: Sensor, topic: Topic, reader: MeasurementReader, data: bytes
    ) -> None:
        self._output_hold()
        stamp, values = reader(data)
        now = time.monotonic()
        # rates are not used: a driver without velocities may send NaN
        if sensor is Sensor.BUFFER:
            self._interlocks.add(topic.name, stamp, values[:2], now)
            if self._trial is not None:
                self._trial.add_buffer(topic.name, values[0], values[1])
            return
        pose = values[0], values[1], values[2]
        self._interlocks.add(topic.name, stamp, pose, now)
        if self._trial is None:
            return
        self._trial.add_pose(sensor, topic.name, stamp, pose, now)
        if sensor is Sensor.CHASER:
            self._last_stamp = stamp
            self._decide(now)

    def _receive_force(self, data: bytes) -> None:
        self._output_hold()
        if self._trial is not None:
            self._trial.add_force(*self._force(data).item())

    def _receive_verdict(self, status: Any) -> None:
        if self._trial is None:
            return
        label = CaptureState(status.state).label
        self._trial.add_verdict(label, status.reason, is_final=status.final, stamp=stamp_in(status))
        self._decide(time.monotonic())

    def _hear_announcement(self, info: Any) -> None:
        """Name once who announces runs here: they move nothing."""
        if info.run_id and info.announcer != self._roll.id:
            self._roll.report_ignored(info, "only a goal of ~/run_trial begins a trial here")

    def _tick(self) -> None:
        now = time.monotonic()
        if self._is_late(now):
            self._caught_up = now + MAX_LATENESS
        self._last_tick = now
        self._decide(now)
        self._output_hold()

    def _is_late(self, now: float) -> bool:
        return now > self._last_tick + TICK + MAX_LATENESS

    def _look_up_others(self) -> None:
        """Note who publishes the measurements, and who reads launcher/hold."""
        nodes, mismatches = {}, {}
        for topic in (topic for measuring in MEASURES.values() for topic in measuring):
            name = self._node.resolve_topic_name(topic.name)
            ends = self._node.get_publishers_info_by_topic(name)
            nodes[topic.name] = sorted(_names(ends))
            for end in ends:
                if problem := _mismatch(topic, end):
                    mismatches[topic.name] = problem
        self._interlocks.note_publishers(nodes, mismatches)
        readers = self._node.get_subscriptions_info_by_topic(self._node.resolve_topic_name(HOLD))
        wrong = {full_name(e): f"reads {e.topic_type}" for e in readers if e.topic_type != BOOL}
        drivers = _names(readers) - {part.node for part in self._roll.parts.values()}
        self._interlocks.readers.note(drivers - wrong.keys(), wrong, time.monotonic())

    # goals, in callbacks

    def _receive_goal(self, request: Any) -> GoalResponse:
        if self._handle is None:
            return GoalResponse.ACCEPT
        name = one_line(request.name or request.scene)[:100]
        on = "a trial" if self._trial is None else self._trial.goal.name
        self._node.get_logger().error(f"goal {name}: rejected, {on} is on: cancel it first")
        return GoalResponse.REJECT

    def _accept(self, handle: Any) -> None:
        self._handle = handle
        self._goal_id = bytes(handle.goal_id.uuid)
        handle.execute()

    def _execute(self, handle: Any) -> Any:
        outcome, result = self._outcome
        getattr(handle, "canceled" if handle.is_cancel_requested else outcome)()
        return result

    def _note_result_request(self, goal_id: bytes) -> None:
        self._awaited = goal_id
        if self._trial is not None and goal_id == self._goal_id:
            self._trial.note_result_request()

    def _cancel(self, _: Any) -> CancelResponse:
        if self._trial is not None:
            self._trial.cancel()
            self._decide(time.monotonic())
        return CancelResponse.ACCEPT

    # decisions

    def _decide(self, now: float) -> None:
        """Let the trial decide; the chaser is let go or held at once.

        Measurements that wait for a node that was busy come first.
        """
        if self._trial is not None and now >= self._caught_up and not self._is_late(now):
            self._steps += self._trial.advance(now)
            self._output_hold()

    def _output_hold(self) -> None:
        """Publish whether the chaser is held, if that has changed or is due."""
        if self._hold is None:
            return
        now = time.monotonic()
        if self._trial is not None:
            self._trial.note_silence(self._hold.silence(now), now)
        self._hold.update(self._trial is None or self._trial.holds, now)

    # a trial, between callbacks

    def _serve(self) -> None:
        """Run the trial of the goal that was accepted."""
        handle = self._handle
        try:
            goal, scene = self._checked(handle.request)
            trial = Trial(
                goal,
                scene,
                Launcher(scene, self._launch.tolerance, aborts=self._launch.aborts),
                self._interlocks,
                has_actuator=self._settings.has_actuator,
                needs_client=self._settings.needs_client,
                now=time.monotonic(),
            )
        except CaptureSimError as error:
            self._refuse(str(error))
            return
        self._roll.await_heard()
        self._look_up_others()
        run = TrialAnnouncement(self._node, self._roll, trial)
        self._steps.clear()
        self._said = ""
        self._trial = trial
        if self._awaited == self._goal_id:
            trial.note_result_request()
        if handle.is_cancel_requested:
            trial.cancel()
        try:
            self._follow(handle, run)
        except KeyboardInterrupt:
            trial.cancel(INTERRUPTED)
            self._follow(handle, run, RUN_END_TIMEOUT)
            raise
        except Exception as error:
            trial.failure = f"launcher failed: {error}"
            raise
        finally:
            self._trial = None
            self._output_hold()
            self._finish(run)

    def _follow(self, handle: Any, run: TrialAnnouncement, limit: float = math.inf) -> None:
        trial, deadline, reported = run.trial, time.monotonic() + limit, -math.inf
        while trial.phase is not TrialPhase.OVER and time.monotonic() < deadline:
            self._node.wait(lambda: bool(self._steps), TICK)
            steps, self._steps = self._steps, []
            for step in steps:
                run.perform(step, self._last_stamp)
            run.report_launch()
            trial.set_others(**run.state_of_others())
            now = time.monotonic()
            if now >= reported + FEEDBACK_PERIOD:
                reported = now
                handle.publish_feedback(_feedback(trial, now))
            if trial.deviation != self._said:  # what it is, once
                if trial.deviation.split(" ")[0] != self._said.split(" ")[0] and trial.deviation:
                    self._node.get_logger().warning(f"{trial.goal.name}: {trial.deviation}")
                self._said = trial.deviation

    def _checked(self, request: Any) -> tuple[TrialGoal, Scene]:
        """Return goal and scene of a request; CaptureSimError if they cannot be used."""
        if request.scene:
            scene = load_requested(request.scene, folder=self._settings.scene_folder)
        elif self._settings.scene is not None:
            scene = self._settings.scene
        else:
            raise CaptureSimError(
                "scene = '': must be given, as the launcher has no parameter scene"
            )
        return TrialGoal(request.name or scene.name, request.note, request.expected), scene

    def _refuse(self, reason: str) -> None:
        self._node.get_logger().error(one_line(f"trial refused: {reason}"))
        nothing = dict.fromkeys(
            ("impact_speed", "max_force", "max_stroke", "max_torsion"), math.nan
        )
        self._send_result("abort", RunTrial.Result(reason=reason, **nothing))

    def _finish(self, run: TrialAnnouncement) -> None:
        """Send the result to the client."""
        trial, result = run.trial, RunTrial.Result(**run.result())
        log = self._node.get_logger()
        if trial.failure:
            text = "aborted" if trial.is_released else "refused"
            log.error(one_line(f"{trial.goal.name}: {text}: {trial.failure}"))
        else:
            log.info(one_line(f"{trial.goal.name}: {result.verdict}, {result.reason}"))
        if not result.as_expected:
            log.warning(f"{trial.goal.name}: {result.verdict}, expected {trial.goal.expected}")
        for problem in result.problems:
            log.warning(one_line(f"{trial.goal.name}: {problem}"))
        self._send_result("abort" if trial.failure else "succeed", result)

    def _send_result(self, outcome: str, result: Any) -> None:
        """Have the result of the goal that is served sent."""
        self._outcome = outcome, result
        self._server.end(self._handle)
        while self._handle.is_active:
            self._node.serve(TICK)
        self._handle = None

    def _answer_last_goal(self) -> None:
        """Send the last result at the node's end, though its client may yet have to ask for it."""
        if self._handle is not None:
            self._refuse(INTERRUPTED)
        deadline = time.monotonic() + RUN_END_TIMEOUT
        while self._awaited != self._goal_id and time.monotonic() < deadline:
            self._node.serve(TICK)
        response = self._node.executor.create_task(lambda: None)  # behind that which sends it
        while not response.done():
            self._node.serve(TICK)


def _feedback(trial: Trial, now: float) -> Any:
    """Return the feedback of a trial for its operator."""
    return RunTrial.Feedback(
        phase=int(trial.phase),
        waiting_for=trial.waiting_for(now),
        t=now - trial.released,
        gap=trial.gap,
    )


def _names(ends: Sequence[Any]) -> set[str]:
    """Return the full names of the nodes; of a process that was killed the name goes first."""
    return {full_name(end) for end in ends if UNKNOWN not in end.node_name}


def _mismatch(topic: Topic, publisher: Any) -> str:
    """Return why no message of a publisher can come; empty if messages can.

    Reliability is no reason: a topic of a driver is read as it is published.
    """
    if publisher.topic_type != topic.type_name:
        return f"{full_name(publisher)} publishes {publisher.topic_type}, not {topic.type_name}"
    wanted = qos_of(topic)
    wanted.reliability = publisher.qos_profile.reliability
    is_possible, reason = qos_check_compatible(publisher.qos_profile, wanted)
    if is_possible is not QoSCompatibility.ERROR:
        return ""
    return f"{full_name(publisher)} offers another quality of service: {reason}"
