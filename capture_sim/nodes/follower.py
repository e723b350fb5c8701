"""How a node takes part in runs, one after another: announced, ready, on, ended, done.

A run begins with a RunInfo and ends with its announcer's StreamCounts, a trial of a bench with a
RunInfo without run.  What a node does with a run is in its :class:`RunPart`.
"""

from __future__ import annotations

import gc
import math
import time
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from capture_sim.control.simulation import CutKind
from capture_sim.errors import CaptureSimError, MessageError, one_line
from capture_sim.launch.scenes import load_scene_text
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.topics import (
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    RunSource,
    Topic,
    topics_of,
)
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.roll import DONE, READY, Roll, RunReport, run_key
from capture_sim.nodes.start import FAILED
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import shown

#: Participants of a run get this long to join it, s (wall).
JOIN_TIMEOUT = 10.0
#: s (wall) without a message, after which an ended run is closed as incomplete.
DRAIN_TIMEOUT = 5.0
#: Messages that were on their way when the announcer left are waited for this long, s (wall).
GONE_TIMEOUT = 0.5
#: Ctrl-C mostly ends all nodes at once: the end of the run is waited for this long, s (wall).
RUN_END_TIMEOUT = 3.0
#: Why a run ends that Ctrl-C ended.
INTERRUPTED = "interrupted"
#: Characters of a run's name that are taken.
LONGEST_NAME = 200
_POLL = 0.1


class EndKind(Enum):
    """How a run has ended for a participant."""

    COMPLETE = "complete"
    REQUESTED = "requested"  # reset, stopped, quitting, Ctrl-C
    CUT = "cut"  # the announcer has failed
    MISSING = "missing"  # messages that were sent have not come
    ABANDONED = "abandoned"  # the announcer has not ended it


@dataclass(frozen=True)
class RunEnd:
    """The end of a run, as a participant sees it; ``reason`` is empty if it is complete."""

    kind: EndKind
    reason: str = ""


@dataclass(frozen=True)
class AnnouncedRun:
    """A run that is announced: its RunInfo and scene."""

    info: Any
    scene: Scene

    @property
    def id(self) -> str:
        """The run's id."""
        return str(self.info.run_id)

    @property
    def key(self) -> str:
        """Key of the run in the roll."""
        return run_key(self.info)

    @property
    def name(self) -> str:
        """The run's name."""
        return str(self.info.name)

    @property
    def source(self) -> RunSource:
        """Who announces it."""
        return RunSource(self.info.source)

    @property
    def simulated(self) -> bool:
        """Whether its times are a simulator's, live or played: the release is t = 0."""
        return SIMULATOR in self.info.publishers


class RunPart(Protocol):
    """What a node does with a run."""

    def prepare(self, run: AnnouncedRun) -> None:
        """Get ready: messages may come from now on.  CaptureSimError if that is not possible."""

    def begin(self, run: AnnouncedRun) -> None:
        """Begin to publish: all participants are ready."""

    def is_complete(self) -> bool:
        """Return True if, after the followed streams, nothing else is waited for."""

    def end(self, run: AnnouncedRun, end: RunEnd) -> RunReport:
        """End the run: publish the rest, close files, report missing messages."""


class Follower:
    """Takes part in runs for a node.

    Call :meth:`follow` for each stream, then :meth:`join`, in the node's constructor, and
    :meth:`work` as its work.  ``sources``: of the runs that the node takes part in.  A replay also
    has to name the node if it has streams of its own, as the recorded ones may be played.  No run
    waits for a node that is not ``on_roll``.
    """

    def __init__(
        self,
        node: BenchNode,
        role: str,
        part: RunPart,
        sources: Sequence[RunSource],
        *,
        on_roll: bool = True,
    ) -> None:
        self.roll: Roll
        self.run: AnnouncedRun | None = None  # that is announced or on
        self._node = node
        self._role = role
        self._part = part
        self._sources = sources
        self._on_roll = on_roll
        self._has_streams = len(topics_of(role)) > 1  # besides the counts
        self._followed: list[Topic] = []
        self._received: Counter[str] = Counter()
        self._counts: Any = None  # StreamCounts by which the run was ended
        self._ended = False
        self._closed = False  # the announcer has announced that no run is on
        self._begun = False
        self._last_message = -math.inf
        self._last_key = ""  # of the last run that was announced
        self._next: AnnouncedRun | None = None
        self._logged: set[str] = set()  # problems of the run

    # set-up, in this order

    def follow(
        self,
        topic: Topic,
        callback: Callable[[Any], None],
        *,
        raw: bool = False,
        watch: Callable[[Any], None] | None = None,
    ) -> None:
        """Subscribe to a stream; its messages are counted until the run's end.

        ``raw``: the callback takes the message's bytes.  ``watch`` is called with the messages of a
        bench, also those that no run is on for.
        """

        def take(message: Any) -> None:
            if watch is not None and (self.run is None or not self.run.simulated):
                watch(message)
            if self.run is not None:
                self.begin()
                self.receive(topic)
                callback(message)

        self._followed.append(topic)
        self._node.listen(topic, take, raw=raw)

    def join(self) -> None:
        """Subscribe to announcements and join the roll, after all else; see :class:`Roll`."""
        self._node.listen(STREAM_COUNTS, self._hear_counts)
        self._node.listen(RUN_INFO, self._hear_announcement)
        self.roll = Roll(self._node, self._role, self._sources, is_listed=self._on_roll)

    # a run

    @property
    def is_on(self) -> bool:
        """Whether a run has begun here."""
        return self.run is not None and self._begun

    @property
    def has_ended(self) -> bool:
        """Whether the announcer has ended the run; messages may be on their way."""
        return self._ended

    @property
    def was_cut(self) -> bool:
        """Whether the simulator has not reported the run as complete."""
        cut = self._counts is None or not self._counts.complete
        return self.run is not None and self.run.simulated and cut

    def begin(self) -> None:
        """Begin the run, if that has not been done: its first message may come."""
        if not self._begun and self.run is not None:
            self._begun = True
            self._part.begin(self.run)

    def receive(self, topic: Topic) -> None:
        """Count a message of the run."""
        self._received[topic.name] += 1
        self._last_message = time.monotonic()

    def work(self) -> int:
        """Take part in runs until the node is asked to end; return the exit status."""
        self._node.freeze_objects()
        self._node.get_logger().info("ready, waiting for a run")
        while True:
            self._node.wait(lambda: self._next is not None)
            self.run, self._next = self._next, None
            assert self.run is not None
            try:
                self._take_part(self.run)
            finally:
                self.run = None
            gc.collect()

    def _take_part(self, run: AnnouncedRun) -> None:
        """Join a run, follow it to its end and leave it."""
        self._received.clear()
        self._counts, self._ended, self._closed, self._begun = None, False, False, False
        self._logged.clear()
        interrupted = False
        try:
            self._part.prepare(run)
            self._await_participants(run)
            end = self._await_end(run)
        except CaptureSimError as error:
            if error is self._node.failure:
                raise
            end = RunEnd(EndKind.CUT, str(error))
            self._begun = False
        except KeyboardInterrupt:
            interrupted = True
            is_own = run.info.announcer == self.roll.id  # no other node ends it
            end = self._await_end(run, 0.0 if is_own else RUN_END_TIMEOUT)
            if end.kind is EndKind.ABANDONED:
                end = RunEnd(EndKind.REQUESTED, INTERRUPTED)
        report = self._part.end(run, end) if self._begun else RunReport((end.reason,))
        problems = [] if end.kind is EndKind.REQUESTED else report.problems
        if end.kind is EndKind.REQUESTED:
            self._node.get_logger().info(f"{run.name}: ended early: {end.reason}")
        for problem in problems:
            self.fail(problem)
        self.roll.report(DONE, run.info, report)
        if interrupted:
            raise KeyboardInterrupt

    def fail(self, problem: str) -> None:
        """Log a problem of the run that is on, once; the node will end with status 1."""
        self._node.exit_status = FAILED
        if self.run is not None and problem not in self._logged:
            self._logged.add(problem)
            self._node.get_logger().error(one_line(f"{self.run.name}: {problem}"))

    def _await_participants(self, run: AnnouncedRun) -> None:
        """Report that this node is ready, and wait until all others are; then begin."""
        participants = list(run.info.participants)
        self._node.wait(lambda: self._ended or self.roll.heard(participants), JOIN_TIMEOUT)
        self.roll.report(READY, run.info)

        def all_ready() -> bool:
            return self._begun or self._ended or not self.roll.not_ready(run.key, participants)

        if not self._node.wait(all_ready, JOIN_TIMEOUT):
            names = ", ".join(self.roll.not_ready(run.key, participants))
            self._node.get_logger().warning(f"{run.name}: {names} has not joined the run")
        self.begin()

    def _await_end(self, run: AnnouncedRun, limit: float = math.inf) -> RunEnd:
        """Follow a run until it is over; return how it has ended."""
        deadline = time.monotonic() + limit
        gone_since = math.inf
        while not self._node.wait(self._is_over, _POLL):
            now = time.monotonic()
            if self._next is not None:
                text = f"another run, {self._next.name}, was announced meanwhile"
                return RunEnd(EndKind.ABANDONED, text)
            if self._ended:
                if now > self._last_message + DRAIN_TIMEOUT:
                    missing = "; ".join(self.missing())
                    return RunEnd(EndKind.MISSING, f"ended with messages missing: {missing}")
            elif not self._closed and self.roll.is_present(run.info.announcer):
                gone_since = math.inf
            else:
                gone_since = min(gone_since, now)
                if now > max(gone_since, self._last_message) + GONE_TIMEOUT:
                    text = "the simulator has gone without ending the run"
                    return RunEnd(EndKind.ABANDONED, text)
            if now > deadline:
                return RunEnd(EndKind.ABANDONED, "no end of the run")
        if self._counts is None or self._counts.complete:
            return RunEnd(EndKind.COMPLETE)
        reason = str(self._counts.reason)
        requested = reason in {kind.value for kind in CutKind if kind.is_requested}
        requested = requested or (reason == INTERRUPTED and self._node.end_request.is_set())
        return RunEnd(EndKind.REQUESTED if requested else EndKind.CUT, reason)

    def missing(self) -> list[str]:
        """Return which of the followed streams lack messages that were sent, a line each."""
        if self._counts is None:
            return []
        sent = dict(zip(self._counts.topics, self._counts.counts, strict=True))
        return [
            f"{topic.name}: {self._received[topic.name]} of {sent[topic.name]} messages received"
            for topic in self._followed
            if self._received[topic.name] < sent.get(topic.name, 0)
        ]

    def _is_over(self) -> bool:
        return self._ended and not self.missing() and self._part.is_complete()

    # announcements

    def _hear_announcement(self, info: Any) -> None:
        if not info.run_id:
            run = self.run
            if run is not None and info.announcer == run.info.announcer and not self._ended:
                self._ended, self._closed = not run.simulated, True
                self._last_message = time.monotonic()
            return
        if run_key(info) == self._last_key:
            return
        scene = _scene_of(info)
        if info.source not in self._sources or (
            info.source == RunSource.REPLAY
            and self._has_streams
            and self.roll.id not in info.participants
        ):
            self.roll.report_ignored(info, f"this node does not take part in a {info.source}")
        elif self.run is not None and info.announcer != self.run.info.announcer:
            self.roll.report_ignored(info, f"this node takes part in {self.run.name}")
        else:
            self._last_key = run_key(info)
            self._next = AnnouncedRun(info, scene)

    def _hear_counts(self, counts: Any) -> None:
        if len(counts.topics) != len(counts.counts):
            raise MessageError(f"{len(counts.counts)} counts of {len(counts.topics)} topics")
        if counts.publisher == SIMULATOR and self.run is not None and counts.run_id == self.run.id:
            self._counts, self._ended = counts, True
            self._last_message = time.monotonic()

    def assume(self, scene: Scene) -> None:
        """Take part in a trial that no node announces, until the node is asked to end."""
        run = RunDescription.of(
            scene,
            uuid.uuid4().hex,
            [self._role],
            source=RunSource.TRIAL,
            announcer=self.roll.id,
        )
        self._next = AnnouncedRun(self._node.messages.run_info(run), scene)


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
    if info.source not in list(RunSource):
        raise MessageError(f"source = {shown(info.source)}: must be {', '.join(RunSource)}")
    return scene
