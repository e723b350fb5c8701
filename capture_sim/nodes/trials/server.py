"""Server of the action launcher/run_trial: trials of a real bench, one at a time.

Only a goal of this action can make the launcher let a real chaser go.  The trial decides in the
callbacks of :class:`capture_sim.nodes.trials.bench.TrialBench`.  Messages to the other nodes, which
may have to wait for a slow reader, are sent between callbacks.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse

from capture_sim.action import RunTrial
from capture_sim.errors import CaptureSimError, one_line
from capture_sim.launcher.state_machine import Launcher, LaunchSettings
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    LAUNCHER,
    RECORDER,
    RUN_INFO,
    RunSource,
    topics_of,
)
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.protocol.follower import RUN_END_TIMEOUT
from capture_sim.nodes.protocol.roll import Roll
from capture_sim.nodes.trials.announcement import TrialAnnouncement
from capture_sim.nodes.trials.bench import TICK, TrialBench
from capture_sim.scene.files import scene_names
from capture_sim.scene.loading import load_requested, load_scene
from capture_sim.scene.parts import Scene
from capture_sim.trial.interlocks import TrialLimits
from capture_sim.trial.rest import Pose
from capture_sim.trial.starts import start_of
from capture_sim.trial.trial import (
    Trial,
    TrialGoal,
    TrialPhase,
)

#: Shortest time between two feedback messages of the action, s (wall).
FEEDBACK_PERIOD = 0.1
INTERRUPTED = "launcher interrupted"


@dataclass(frozen=True)
class TrialSettings:
    """Settings of all trials that a launcher serves; the launcher's parameters set them.

    ``has_actuator``: True if launcher/hold lets the chaser go, False if a person does so by hand.
    ``limits``: limits of every trial.
    ``needs_client``: the chaser is let go only once the goal's client has asked for the result.
    ``driver``: name of the node that must read launcher/hold; empty accepts any other node.
    ``required``: roles of nodes, e.g. ``recorder``, that must take part before the chaser is let
    go; not used without an actuator.
    ``waived``: names of rules that do not refuse a release.
    ``scene``: scene of goals that name none; None: such goals are refused.
    ``scene_folder``: folder of scenes that a goal may name, besides the packaged scenes.
    """

    has_actuator: bool
    limits: TrialLimits
    needs_client: bool = True
    driver: str = ""
    required: tuple[str, ...] = ()
    waived: tuple[str, ...] = ()
    scene: Scene | None = None
    scene_folder: Path | None = None


class _Server(ActionServer):
    """An action server that reports when a client asks for the result of a goal.

    ``on_result_request`` is called with the goal's id.  An accepted goal is not executed at once,
    but when its trial is over, by :meth:`end`.  Reason: rclpy would resume an execution that waits
    for the trial after every callback.
    """

    def __init__(self, *arguments: Any, on_result_request: Callable[[bytes], None], **more: Any):
        self._on_result_request = on_result_request
        super().__init__(*arguments, **more)

    async def execute(self, taken_data: Any) -> None:
        """Serve requests, and report one for a result, as rclpy has no callback for it."""
        if "result" in taken_data:
            self._on_result_request(bytes(taken_data["result"][1].goal_id.uuid))
        await super().execute(taken_data)

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Do nothing when a goal is accepted, because :meth:`end` has it executed later."""

    def end(self, handle: Any) -> None:
        """Let the executor execute a goal; its result is then sent to each client that asks."""
        super().notify_execute(handle, None)


class TrialServer:
    """Serves the action launcher/run_trial for a launcher node, which calls :meth:`work` once.

    ``launch``: settings of the launch; the caller may change them at any time and then calls
    :meth:`settings_changed`.
    """

    def __init__(self, node: BenchNode, settings: TrialSettings, launch: LaunchSettings) -> None:
        self._node, self._settings, self._launch = node, settings, launch
        self._bench = TrialBench(
            node,
            settings.limits,
            settings.driver,
            settings.waived,
            settings.scene,
            lambda: {part.node for part in self._roll.parts.values()},
            has_actuator=settings.has_actuator,
            starts=_starts(settings),
        )
        self._trial: Trial | None = None
        self._handle: Any = None  # of the goal that is served, until its result is sent
        self._outcome: tuple[str, Any]  # of that goal: method of the handle, result
        self._said = ""  # the last deviation that was logged
        self._goal_id = b""  # of the goal that is served
        self._awaited = b""  # id of the goal whose result a client has asked for last
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
        # takes part in no run that another node announces
        self._roll = Roll(node, LAUNCHER)

    def work(self) -> int:
        """Serve goals until the node is asked to end.

        It ends only by an exception, e.g. KeyboardInterrupt.  A client that has not yet received
        the last result then gets it, if it asks for it soon.
        """
        self._node.freeze_objects()
        self._node.get_logger().info(f"ready for trials: {self._mode}")
        try:
            while True:
                self._node.wait(lambda: self._handle is not None)
                self._serve()
        finally:
            self._bench.close()
            if self._goal_id:
                self._answer_last_goal()

    @property
    def _mode(self) -> str:
        """What a trial does to the bench, as the operator must know it."""
        if self._settings.has_actuator:
            return "releases hardware by launcher/hold"
        return "dry run, nothing is released (actuator none): let go by hand"

    def settings_changed(self) -> None:
        """Apply the changed settings of the launch to the present trial, if there is one."""
        if self._trial is not None:
            self._trial.set_launch(self._launch.tolerance, aborts=self._launch.aborts)

    # goals, in callbacks

    def _hear_announcement(self, info: Any) -> None:
        """Log once for each other node that announces runs: the launcher ignores these runs."""
        if info.run_id and info.announcer != self._roll.id:
            self._roll.report_ignored(info, "only a goal of ~/run_trial begins a trial here")

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
            self._bench.decide()
        return CancelResponse.ACCEPT

    # a trial, between callbacks

    def _serve(self) -> None:
        """Run the trial of the accepted goal to its end, and send the result.

        A goal with an unusable scene or field is refused.  If the node is asked to end, the trial
        is cancelled and the chaser held.
        """
        handle = self._handle
        try:
            goal, scene = self._checked(handle.request)
            trial = Trial(
                goal,
                scene,
                Launcher(scene, self._launch.tolerance, aborts=self._launch.aborts),
                self._bench.interlocks,
                has_actuator=self._settings.has_actuator,
                needs_client=self._settings.needs_client,
                now=time.monotonic(),
            )
        except CaptureSimError as error:
            self._refuse(str(error))
            return
        self._roll.await_heard()
        required = self._settings.required if self._settings.has_actuator else ()
        if not {RECORDER, CAPTURE_DETECTOR} <= set(required):  # else the trial waits for them
            self._roll.await_free(RunSource.TRIAL, lambda: handle.is_cancel_requested)
        run = TrialAnnouncement(self._node, self._roll, trial, required)
        trial.set_others(**run.state_of_others())  # before a callback decides
        self._said = ""
        self._trial = trial
        self._bench.begin(trial)
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
            self._bench.end()
            self._finish(run)

    def _follow(self, handle: Any, run: TrialAnnouncement, limit: float = math.inf) -> None:
        trial, deadline, reported = run.trial, time.monotonic() + limit, -math.inf
        has_said_mode = False
        while trial.phase is not TrialPhase.OVER and time.monotonic() < deadline:
            self._node.wait(lambda: bool(self._bench.steps), TICK)
            for step in self._bench.take_steps():
                run.perform(step, self._bench.stamp)
            run.report_launch()
            trial.set_others(**run.state_of_others())
            now = time.monotonic()
            if now >= reported + FEEDBACK_PERIOD:
                reported = now
                handle.publish_feedback(_feedback(trial, now, "" if has_said_mode else self._mode))
                has_said_mode = True
            if trial.deviation != self._said:  # what it is, once
                if trial.deviation.split(" ")[0] != self._said.split(" ")[0] and trial.deviation:
                    self._node.get_logger().warning(f"{trial.goal.name}: {trial.deviation}")
                self._said = trial.deviation

    def _checked(self, request: Any) -> tuple[TrialGoal, Scene]:
        """Return the goal and the scene of a request; CaptureSimError if one cannot be used."""
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
        """Log the result of a trial that is over, and send it to the client."""
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
        """Send the result of the present goal, and wait until the goal is closed.

        ``outcome``: name of the method that closes it, ``abort`` or ``succeed``; a goal whose
        client has cancelled it is closed as cancelled instead.
        """
        self._outcome = outcome, result
        self._server.end(self._handle)
        while self._handle.is_active:
            self._node.serve(TICK)
        self._handle = None

    def _answer_last_goal(self) -> None:
        """Before the node ends, wait until the client has received the result of its last goal.

        The wait is at most 3 s (RUN_END_TIMEOUT), because a client may never ask for its result.
        A goal that was accepted but has no result yet is refused first.
        """
        if self._handle is not None:
            self._refuse(INTERRUPTED)
        deadline = time.monotonic() + RUN_END_TIMEOUT
        while self._awaited != self._goal_id and time.monotonic() < deadline:
            self._node.serve(TICK)
        response = self._node.executor.create_task(lambda: None)  # behind that which sends it
        while not response.done():
            self._node.serve(TICK)


def _starts(settings: TrialSettings) -> dict[str, Pose]:
    """Return the relative poses at the start of all scenes that a goal may name, by name.

    A file of the folder that is no scene is left out: it is refused when a goal names it.
    """
    scenes = {name: load_scene(name) for name in scene_names()}
    for path in sorted(settings.scene_folder.glob("*.yaml")) if settings.scene_folder else ():
        with suppress(CaptureSimError):
            scenes[path.stem] = load_scene(path)
    if settings.scene is not None:
        scenes[settings.scene.name] = settings.scene
    return {name: start_of(scene) for name, scene in scenes.items()}


def _feedback(trial: Trial, now: float, mode: str) -> Any:
    """Return the feedback message of a trial; ``now``: present time of the steady clock, s.

    ``mode``: what a trial does to the bench, in the first feedback.
    """
    return RunTrial.Feedback(
        phase=int(trial.phase),
        waiting_for="; ".join(filter(None, (mode, trial.waiting_for(now)))),
        t=now - trial.released,
        gap=trial.gap,
    )
