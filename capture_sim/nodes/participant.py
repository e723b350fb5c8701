"""What launcher, detector, recorder and viewer have in common: they take part in trials.

A trial begins with a RunInfo and ends with the announcer's StreamCounts, with a RunInfo without
run, or when the announcer has gone.  The simulator announces its runs, a player those that were
recorded; on a real bench ``~/begin_trial`` of any participant does it for all.

The announcer sends a RunInfo before anything else of the run and waits for its acknowledgement, and
callbacks run in the order of arrival: so no message of a run comes before its RunInfo.  What comes
before the executor runs has no order (rclpy's events executor goes through a set), so the streams
are subscribed to in its first callback.
"""

from __future__ import annotations

import gc
import math
import threading
import time
import uuid
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from std_srvs.srv import Trigger

from capture_sim.control.simulation import QUITTING, RESET, STOPPED
from capture_sim.errors import CaptureSimError, MessageError, one_line
from capture_sim.interrupts import wait_for
from capture_sim.launch.scenes import load_scene, load_scene_text
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.topics import (
    BUFFER_STATE,
    CAPTURE_DETECTOR,
    CAPTURE_STATUS,
    CHASER_ODOMETRY,
    CHASER_POSE,
    CONTACT_STATE,
    JOINT_STATES,
    LAUNCH_COMMAND,
    LAUNCHER,
    LAUNCHER_STATE,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    STRING_STATE,
    TARGET_ODOMETRY,
    TARGET_POSE,
    TOPICS,
    Topic,
    topics_of,
)
from capture_sim.nodes.node import BenchNode, from_bytes, message_class
from capture_sim.nodes.parameters import ParameterError
from capture_sim.nodes.run_state import RunState, Stage
from capture_sim.nodes.start import FAILED, OK
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import shown
from capture_sim.srv import BeginTrial

RECORDER = "recorder"

#: What each participant reads of a simulator.
READ: dict[str, tuple[Topic, ...]] = {
    LAUNCHER: (STRING_STATE, CONTACT_STATE, CHASER_ODOMETRY, CHASER_POSE),
    CAPTURE_DETECTOR: (
        *(CHASER_ODOMETRY, TARGET_ODOMETRY, CHASER_POSE, TARGET_POSE),
        *(BUFFER_STATE, JOINT_STATES),
    ),
    RECORDER: tuple(topic for topic in TOPICS if topic is not RUN_INFO),
}
#: Why a run ends that Ctrl-C ended.
INTERRUPTED = "interrupted"
_EARLY = "ended early: "
#: ... and why one ends on request: nothing has failed.
_AS_ASKED = tuple(_EARLY + reason for reason in (RESET, STOPPED, QUITTING))
#: Characters of a run's name that are taken.
LONGEST_NAME = 200
#: A run begins without readers that are expected and not there after this long, s (wall).
MATCHING_TIMEOUT = 5.0
#: Ctrl-C mostly ends all nodes at once: a participant waits this long for the message on how the
#: run has ended, s (wall).
RUN_END_TIMEOUT = 3.0


def readers(topic: Topic, roles: Collection[str]) -> int:
    """Return how many of these roles subscribe to a topic."""
    return sum(topic in READ.get(role, ()) for role in roles)


class Participant(BenchNode):
    """A node that takes part in trials, one after another.

    A subclass calls :meth:`follow` for its topics and fills in :meth:`begin` and :meth:`end`.
    Callbacks run one at a time.  ``role`` is the node's name unless it is remapped, and its role
    in a run whatever its name.
    """

    def __init__(self, role: str) -> None:
        super().__init__(role)
        self.role = role
        self._exit_when_done = self.declare(
            "exit_when_done", False, "end this process when the announcer has left after a run"
        )
        drain_timeout = self.declare(
            "drain_timeout",
            5.0,
            "s (wall) without a message, after which an ended run is closed as incomplete",
            low=0.1,
            high=600.0,
        )
        self.state = RunState(drain_timeout)
        self._scene_of_run: Scene
        self._followed: list[Topic] = []
        self._held_back: list[Callable[[], None]] = []  # messages of a run that is not begun yet
        self._begin_deadline = math.inf  # wall, when a run begins without all of its readers
        self._waiting: list[Callable[[], None]] = []  # subscriptions, for the executor's start
        self._ready = threading.Event()
        self._leaving = False  # after Ctrl-C
        self._over = threading.Event()
        self._status = OK
        self._announced_run: RunDescription | None = None  # the last trial that was begun here
        watch = SubscriptionEventCallbacks(matched=self._announcers_changed)
        # the first subscription: an executor without order of arrival goes by this one
        super().listen(RUN_INFO, self._announced, event_callbacks=watch)
        self.listen(STREAM_COUNTS, self._counted, raw=True)
        self.create_service(BeginTrial, "~/begin_trial", self._asked_to_begin)
        self.create_service(Trigger, "~/end_trial", self._asked_to_end)
        # a steady clock: this must also run when simulated time does not
        self.create_timer(0.1, self._look_at_clock, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # what a subclass fills in

    def begin(self, info: Any, scene: Scene) -> None:
        """Begin a run."""

    def end(self, reason: str) -> list[str]:
        """End the run; return its problems, one line each.

        ``reason``: why it ended early; empty if all that was sent has arrived.
        """
        return [reason] if reason else []

    def trial_result(self) -> str:
        """Return what the response to ``~/end_trial`` reports of the trial that is on."""
        return f"{self.role} is ready for the next trial"

    def complete(self) -> bool:
        """Return True if all messages that the announcer has reported have arrived."""
        return not self.missing()

    # what a subclass calls

    def declare_scene(self, description: str) -> Scene | None:
        """Declare ``scene`` and ``overrides`` of a bench; return the scene if one is given."""
        name = self.declare("scene", "", f"{description}; name in config/scenes, or file")
        overrides = self.declare("overrides", list, "changes of that scene (SI)")
        if overrides and not name:
            raise ParameterError(
                f"parameter overrides = {overrides!r}: must be empty without a scene"
            )
        return load_scene(name, overrides) if name else None

    @property
    def run(self) -> Any:
        """RunInfo of the run that is announced or on; None without one."""
        return self.state.info

    @property
    def is_on(self) -> bool:
        """Whether this node has begun a run."""
        return self.state.stage in (Stage.ON, Stage.ENDED)

    @property
    def simulated(self) -> bool:
        """Whether the run that is on is one of a simulator, live or played."""
        return SIMULATOR in self.run.publishers

    @property
    def cut(self) -> bool:
        """Whether the simulator has not reported the current run as complete."""
        counts = self.state.counts
        return self.simulated and (counts is None or not counts.complete)

    def missing(self) -> list[str]:
        """Return which of the followed streams lack messages that were sent."""
        return self.state.missing(topic.name for topic in self._followed)

    def listen(self, topic: Topic, callback: Callable[[Any], None], **options: Any) -> None:
        """Subscribe to a topic once callbacks run."""
        subscribe = partial(super().listen, topic, callback, **options)
        if self._ready.is_set():
            subscribe()
        else:
            self._waiting.append(subscribe)

    def follow(self, topic: Topic, callback: Callable[[Any], None], *, raw: bool = False) -> None:
        """Subscribe to a stream; it is counted until the run's end.

        ``raw``: the callback takes the message's bytes.
        """

        def take(message: Any) -> None:
            if self.state.stage is Stage.ANNOUNCED:
                self._held_back.append(partial(take, message))
            elif self.run is not None:
                self.state.receive(topic.name)
                callback(message)
                self.end_if_complete()

        self._followed.append(topic)
        self.listen(topic, take, raw=raw)

    def end_if_complete(self) -> None:
        """End the run if its announcer has ended it and nothing is missing."""
        if self.state.stage is Stage.ENDED and self.complete():
            counts = self.state.counts
            self._finish("" if counts.complete else f"{_EARLY}{counts.reason}")

    def announce(self, name: str, scene: Scene) -> None:
        """Begin a trial for all participants.

        CaptureSimError if a run is on, or its announcement is on its way.
        """
        if self.state.stage is Stage.REQUESTED:
            raise CaptureSimError("a trial is being announced already")
        if self.run is not None:
            raise CaptureSimError(f"{self.run.name} is on: end it first")
        if self._announced_run is None:
            self.open((RUN_INFO,))
        publishers = [
            role
            for role, topic in ((LAUNCHER, LAUNCHER_STATE), (CAPTURE_DETECTOR, CAPTURE_STATUS))
            if self.publishers_of(topic)
        ]
        run = replace(RunDescription.of(scene, uuid.uuid4().hex, publishers), name=name)
        self._announced_run = run
        self.state.request(run.run_id)
        self.send_run_info(run)

    def end_trial(self) -> None:
        """End the trial that was begun here, for all participants."""
        assert self._announced_run is not None
        self.send_run_info(replace(self._announced_run, run_id=""))

    # the life of a run

    def work(self) -> int:
        """Take part until the process is to end; return the exit status."""
        # what is there now is left out of all later sweeps: over it one takes longer than a tick
        gc.collect()
        gc.freeze()
        wait_for(self._ready)
        self.get_logger().info("ready, waiting for a run")
        wait_for(self._over)
        return self._status

    def await_run_end(self) -> None:
        """Let the run that is on end as its announcer says, if that is ended too."""
        self._leaving = True
        deadline = time.monotonic() + RUN_END_TIMEOUT
        while self.run is not None and time.monotonic() < deadline:
            if not self.state.has_announcer and self.state.counts is None:
                break  # no node is left to end it; after the counts others may still send
            time.sleep(0.02)

    def interrupted(self) -> None:
        """End the run that is on."""
        if self.is_on:
            self._finish(INTERRUPTED)

    def readers_changed(self) -> None:
        """Begin the run that is announced when its readers are there."""
        if self.state.stage is Stage.ANNOUNCED and not self._expected_readers():
            self._begin()

    def _announced(self, info: Any) -> None:
        if not info.run_id and self.run is not None and not self.simulated:
            # of a simulated run the counts report how it has ended
            kind = message_class(STREAM_COUNTS.type_name)
            self._end(kind(run_id=self.run.run_id, complete=True))
        if not self.state.is_new(info.run_id):
            return
        try:
            scene = _scene_of(info)
        except MessageError:
            self.state.reject(info.run_id)
            raise
        if self.state.stage is Stage.ANNOUNCED:
            self._begin()
        if self.run is not None:
            self._finish(f"another run, {info.name}, was announced meanwhile")
        self.state.announce(info)
        self._scene_of_run = scene
        self._begin_deadline = time.monotonic() + MATCHING_TIMEOUT
        self.readers_changed()

    def _expected_readers(self) -> list[str]:
        """Return the topics of this node that not all nodes read yet which the run waits for."""
        of_simulator = SIMULATOR in self.run.publishers
        return [
            topic.name
            for topic in topics_of(self.role)
            if self.matched(topic)
            < readers(topic, set(self.run.consumers)) + (topic is LAUNCH_COMMAND and of_simulator)
        ]

    def _begin(self) -> None:
        self.state.begin()
        self._begin_deadline = math.inf
        early, self._held_back = self._held_back, []
        try:
            self.begin(self.run, self._scene_of_run)
        except Exception:
            self.state.drop()
            raise
        for take in early:
            take()
        self.end_if_complete()

    def _counted(self, data: bytes) -> None:
        counts = from_bytes(STREAM_COUNTS, data)
        if len(counts.topics) != len(counts.counts):
            raise MessageError(f"{len(counts.counts)} counts of {len(counts.topics)} topics")
        if counts.publisher == SIMULATOR:
            self._end(counts)

    def _end(self, counts: Any) -> None:
        self.state.end(counts)
        self.end_if_complete()

    def _announcers_changed(self, event: Any) -> None:
        self.state.set_announcers(event.current_count)
        self._leave_if_alone()

    def _leave_if_alone(self) -> None:
        alone = self.run is None and not self.state.has_announcer
        if self._exit_when_done and alone and self.state.finished:
            self._over.set()

    def _look_at_clock(self) -> None:
        if not self._ready.is_set():
            for subscribe in self._waiting:
                subscribe()
            self._ready.set()
        if self.failure is not None:
            return
        if self.state.stage is Stage.ANNOUNCED and time.monotonic() > self._begin_deadline:
            unread = ", ".join(self._expected_readers())
            self.get_logger().warning(
                f"{self.run.name}: not all nodes that the run waits for read {unread}: "
                "begun without them"
            )
            self._begin()
        elif self.state.is_overdue:
            if self.state.stage is Stage.ON:
                self._finish("the simulator has gone without ending the run")
            else:
                self._finish("; ".join(["ended with messages missing", *self.missing()]))

    def _finish(self, reason: str) -> None:
        problems = self.end(reason)
        if reason == INTERRUPTED:
            problems = [reason]  # that something is missing goes without saying
        elif reason in _AS_ASKED or (self._leaving and reason == _EARLY + INTERRUPTED):
            self.get_logger().info(f"{self.run.name}: {reason}")
            problems = []
        for problem in problems:
            self._status = FAILED
            self.get_logger().error(one_line(f"{self.run.name}: {problem}"))
        self.state.finish()
        gc.collect()
        self._leave_if_alone()

    # services

    def _asked_to_begin(self, request: Any, response: Any) -> Any:
        try:
            scene = load_scene(request.scene, list(request.overrides))
            self.announce(request.name or scene.name, scene)
            response.success = True
        except CaptureSimError as error:
            response.message = str(error)
        return response

    def _asked_to_end(self, _: Any, response: Any) -> Any:
        begun_here = self._announced_run is not None and self._announced_run.run_id
        if self.run is None or self.run.run_id != begun_here:
            response.message = "no trial is on that was begun here"
        else:
            name, known = self.run.name, self.trial_result()
            self.end_trial()
            response.success, response.message = True, f"{name}: ended, {known}"
        return response


def _scene_of(info: Any) -> Scene:
    """Return the scene of an announced run; MessageError if a node cannot take part in it."""
    try:
        scene = load_scene_text(info.scene)
        described = RunDescription.of_message(info)
    except CaptureSimError as error:
        raise MessageError(str(error)) from None
    if described.rate > described.state_rate:
        raise MessageError(f"rate = {info.rate:g} Hz: must be <= {info.state_rate:g}")
    if not info.name.isprintable() or len(info.name) > LONGEST_NAME:
        raise MessageError(
            f"name = {shown(info.name)}: must be at most {LONGEST_NAME} printable characters"
        )
    return scene
