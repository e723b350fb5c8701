"""How a node takes part in runs, one after another: it joins, begins, follows and leaves a run.

A run begins with a RunInfo.  A simulated run, live or replayed, ends with the simulator's
StreamCounts.  A trial of a real bench ends with a RunInfo with an empty run_id.  A :class:`RunPart`
defines the work of a node in a run.
"""

from __future__ import annotations

import gc
import math
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Protocol

from capture_sim.base.exit_status import FAILED
from capture_sim.errors import CaptureSimError, MessageError, one_line
from capture_sim.messages.convert import LONGEST_NAME, RunDescription
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    LAUNCHER,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    RunSource,
    Topic,
    topics_of,
)
from capture_sim.nodes.base.endpoints import TRANSIT_TIME, is_own
from capture_sim.nodes.base.node import POLL, BenchNode
from capture_sim.nodes.protocol.ends import INTERRUPTED, CutKind, EndKind, RunEnd
from capture_sim.nodes.protocol.roll import (
    DONE,
    READY,
    Roll,
    RunReport,
    has_streams,
    node_of,
    run_key,
)
from capture_sim.recording.completeness import Completeness, counts_of
from capture_sim.scene.loading import load_scene_text
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import shown

#: Participants of a run get this long to join it, s (wall).
JOIN_TIMEOUT = 15.0
#: Time without a message after which a run that the announcer has ended is closed as incomplete,
#: s (wall).
DRAIN_TIMEOUT = 5.0
#: Longest wait for the end of the run after Ctrl-C, s (wall), because Ctrl-C mostly ends all nodes
#: at once.  After a trial, its recording and the client that asks for its result get as long.
RUN_END_TIMEOUT = 3.0

#: Topics that the nodes of this suite, not the drivers, publish in a trial.
_OF_NODES = {STREAM_COUNTS, *topics_of(LAUNCHER), *topics_of(CAPTURE_DETECTOR)}


@dataclass(frozen=True)
class AnnouncedRun:
    """A run that was announced: its RunInfo, and the scene that the RunInfo contains."""

    info: Any
    scene: Scene

    @property
    def id(self) -> str:
        """The run's id."""
        return str(self.info.run_id)

    @property
    def name(self) -> str:
        """The run's name."""
        return str(self.info.name)

    @cached_property
    def simulated(self) -> bool:
        """True for a run of a simulator, live or replayed; its stamps are simulated times.

        False for a trial of a real bench, live or replayed; its stamps are times of other clocks.
        """
        return SIMULATOR in self.info.publishers


class RunPart(Protocol):
    """The work of one node in a run."""

    def prepare(self, run: AnnouncedRun) -> None:
        """Prepare for a run: its messages may arrive after this call.

        CaptureSimError if the node cannot take part in it.
        """

    def begin(self, run: AnnouncedRun) -> None:
        """Begin to publish: all participants are ready, have timed out, or the run is under way."""

    def is_complete(self) -> bool:
        """Return True if the node needs nothing more of an ended run than the followed streams."""
        return True

    def end(self, run: AnnouncedRun, end: RunEnd) -> RunReport:
        """End a run that has begun: publish the rest, close files, return what is missing."""

    def cancel(self, run: AnnouncedRun, end: RunEnd) -> RunReport:
        """Leave a run that has not begun, or in which this node has failed: close files.

        The default returns ``end.reason``, if it is not empty, as the only problem.
        """
        del run
        return RunReport((end.reason,) if end.reason else ())


class _Participation:
    """The state of this node's part in a run: the messages received, and whether it has ended."""

    def __init__(self, run: AnnouncedRun, followed: Sequence[Topic]) -> None:
        self.run = run
        self.streams = Completeness([SIMULATOR] if run.simulated else [], followed)
        self.counts: Any = None  # StreamCounts by which the simulator has ended it
        self.failure = ""  # why the launcher has ended a trial early, if it has
        self.is_ready = self.has_begun = self.has_ended = False
        self.is_closed = False  # the announcer has announced that no run is on
        self.since = time.monotonic()
        # Polls since a message or a sign of the announcer. Each poll reads waiting messages even if
        # this node was stopped meanwhile; by wall time a run would end while its messages wait.
        self.quiet = 0
        self.logged: set[str] = set()  # problems

    def note_sign(self) -> None:
        """Restart the time limit of a run without messages and without its announcer."""
        self.quiet = 0

    def note_message(self, topic: Topic) -> None:
        """Restart the time limit if a message on this topic shows that the run continues.

        In a simulated run, each message on a topic of this suite does.  After the end of a run,
        each message of launcher or detector does as well.  The messages of a real bench's drivers
        do not, because drivers send whether or not the announcer is running.
        """
        is_of_simulator = self.run.simulated and is_own(topic)
        if is_of_simulator or (self.has_ended and topic in _OF_NODES):
            self.note_sign()

    def missing(self) -> RunEnd:
        """Return the end of a run with messages missing; its reason lists them."""
        missing = "; ".join(self.streams.problems())
        return RunEnd(EndKind.MISSING, f"ended with messages missing: {missing}")


class Follower:
    """Takes part in runs on behalf of a node.

    In the node's constructor call :meth:`follow` for each stream, then :meth:`join`; call
    :meth:`work` as the node's work.  ``part`` defines what the node does in a run.  ``sources`` are
    the sources of the runs in which the node takes part.  A node that publishes streams takes part
    in a replay only if the RunInfo lists it in ``participants``, because otherwise the player may
    publish the recorded messages of these streams.  With ``on_roll`` False, the node does not
    report on bench/roll, and no run waits for it.
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
        self._node = node
        self._role = role
        self._part = part
        self._sources = sources
        self._on_roll = on_roll
        self._followed: list[Topic] = []
        self._present: _Participation | None = None  # in the run that is announced or on
        self._next: AnnouncedRun | None = None
        self._last_key = ""  # of the last run that was announced

    # set-up, in this order

    def follow(
        self,
        topic: Topic,
        callback: Callable[[Any], None],
        *,
        raw: bool = False,
        watch: Callable[[Any], None] | None = None,
    ) -> None:
        """Subscribe to a stream; in each run, count its messages and pass them to ``callback``.

        With ``raw`` both functions receive a message's bytes.  Messages of a trial are taken from
        the moment on at which this node reports that it is ready, as the launcher may then let go.
        ``watch`` is called with every message outside of runs, and in runs that are not simulated.
        """

        def take(message: Any) -> None:
            present = self._present
            if watch is not None and (present is None or not present.run.simulated):
                watch(message)
            if present is not None:
                if present.run.info.source == RunSource.TRIAL:
                    if not present.is_ready:  # drivers send in any case
                        return
                else:
                    self._begin(present)
                present.streams.add(topic, None)
                present.note_message(topic)
                callback(message)

        self._followed.append(topic)
        self._node.listen(topic, take, raw=raw)

    def join(self) -> None:
        """Subscribe to announcements and join bench/roll.

        Call this after all publishers and other subscriptions of the node are created, see
        :class:`Roll`.
        """
        self._node.listen(STREAM_COUNTS, self._hear_counts)
        # volatile: a node on the roll joins no run that was announced before it came
        latched = None if not self._on_roll else False
        self._node.listen(RUN_INFO, self._hear_announcement, transient_local=latched)
        self.roll = Roll(self._node, self._role, self._sources, is_listed=self._on_roll)

    # a run

    @property
    def run(self) -> AnnouncedRun | None:
        """The run that this node takes part in, from its announcement on; None without one."""
        return None if self._present is None else self._present.run

    @property
    def is_on(self) -> bool:
        """True from the begin of a run in this node until the node has left it."""
        return self._present is not None and self._present.has_begun

    @property
    def has_ended(self) -> bool:
        """True if the announcer has ended the present run; its last messages may still arrive."""
        return self._present is not None and self._present.has_ended

    @property
    def was_cut(self) -> bool:
        """True if the simulator has not reported the present run as complete.

        False without a run, and in a run that is not simulated.
        """
        present = self._present
        if present is None or not present.run.simulated:
            return False
        return present.counts is None or not present.counts.complete

    @property
    def failure(self) -> str:
        """Why the launcher has ended the present trial early; empty if it has not."""
        return "" if self._present is None else one_line(self._present.failure)

    def note_message(self, topic: Topic) -> None:
        """Note a message of the run, if any, on a topic not subscribed by :meth:`follow`."""
        if self._present is not None:
            self._present.note_message(topic)

    def fail(self, problem: str) -> None:
        """Set the node's exit status to 1; log a problem of the present run, once a run."""
        self._node.exit_status = FAILED
        present = self._present
        if present is not None and problem not in present.logged:
            present.logged.add(problem)
            self._node.get_logger().error(one_line(f"{present.run.name}: {problem}"))

    def work(self) -> int:
        """Take part in runs until the node is asked to end, which raises KeyboardInterrupt."""
        self._node.freeze_objects()
        self._node.get_logger().info("ready, waiting for a run")
        while True:
            self._node.wait(lambda: self._next is not None)
            assert self._next is not None
            self._present, self._next = _Participation(self._next, self._followed), None
            try:
                self._take_part(self._present)
            except Exception as error:
                # a node that leaves the network has closed its files
                reason = one_line(str(error)) or type(error).__name__
                self._part.cancel(self._present.run, RunEnd(EndKind.CUT, reason))
                raise
            finally:
                self._present = None
            gc.collect()

    def _take_part(self, present: _Participation) -> None:
        """Join a run, follow it to its end and leave it.

        After Ctrl-C, leave the run in order, then raise KeyboardInterrupt.
        """
        run, interrupted = present.run, False
        try:
            self._part.prepare(run)
            self._await_participants(present)
            end = self._await_end(present)
        except CaptureSimError as error:
            if error is self._node.failure:
                raise
            end = RunEnd(EndKind.CUT, str(error))
            present.has_begun = False
        except KeyboardInterrupt:
            interrupted = True
            is_own = run.info.announcer == self.roll.id  # no other node ends it
            end = self._await_end(present, 0.0 if is_own else RUN_END_TIMEOUT)
            if end.kind is EndKind.ABANDONED:
                is_late = present.counts is not None and present.counts.complete
                end = present.missing() if is_late else RunEnd(EndKind.REQUESTED, INTERRUPTED)
        report = (self._part.end if present.has_begun else self._part.cancel)(run, end)
        if end.kind is EndKind.REQUESTED:
            self._node.get_logger().info(f"{run.name}: ended early: {end.reason}")
        else:
            for problem in report.problems:
                self.fail(problem)
        self.roll.report(DONE, run.info, report)
        if interrupted:
            raise KeyboardInterrupt

    def _await_participants(self, present: _Participation) -> None:
        """Wait for the other participants, report that this node is ready, and begin the run.

        First each must have been heard, then each must be ready; each wait lasts JOIN_TIMEOUT at
        most.  The run begins earlier with its first message or its end.
        """
        run, key = present.run, run_key(present.run.info)
        pending = partial(self.roll.pending, list(run.info.participants))

        def is_late() -> bool:
            return present.has_begun or present.has_ended

        def not_ready() -> list[str]:
            return pending(lambda part: part.is_ready(key))

        self._node.wait(lambda: is_late() or not pending(), JOIN_TIMEOUT)
        present.is_ready = True
        self.roll.report(READY, run.info)
        if not self._node.wait(lambda: is_late() or not not_ready(), JOIN_TIMEOUT):
            names = ", ".join(not_ready())
            self._node.get_logger().warning(f"{run.name}: {names} has not joined the run")
        self._begin(present)

    def begin(self) -> None:
        """Begin the present run, whether or not all have joined: a launcher has let go."""
        if self._present is not None and self._present.is_ready:
            self._begin(self._present)

    def _begin(self, present: _Participation) -> None:
        """Begin the run, unless it has begun already."""
        if not present.has_begun:
            present.has_begun = True
            self._part.begin(present.run)

    def _await_end(self, present: _Participation, limit: float = math.inf) -> RunEnd:
        """Follow a run until it is over, at most ``limit`` s (wall); return how it has ended."""

        def is_over() -> bool:
            return present.has_ended and present.streams.satisfied and self._part.is_complete()

        present.note_sign()
        deadline = time.monotonic() + limit
        while not self._node.wait(is_over, POLL):
            present.quiet += 1
            if self._next is not None:
                text = f"another run, {self._next.name}, was announced meanwhile"
                return RunEnd(EndKind.ABANDONED, text)
            is_open = not (present.has_ended or present.is_closed)
            if is_open and self._may_go_on(present):
                present.note_sign()
            if present.quiet * POLL > (DRAIN_TIMEOUT if present.has_ended else TRANSIT_TIME):
                if not present.has_ended:
                    who = node_of(present.run.info.announcer)
                    who = "the simulator" if present.run.simulated else who
                    text = f"{who} has gone without ending the run"
                    return RunEnd(EndKind.ABANDONED, text)
                return present.missing()
            if time.monotonic() > deadline:
                return RunEnd(EndKind.ABANDONED, "no end of the run")
        if present.counts is None or present.counts.complete:
            return RunEnd(EndKind.COMPLETE)
        reason = str(present.counts.reason)
        requested = reason in {kind.value for kind in CutKind if kind.is_requested}
        requested = requested or (reason == INTERRUPTED and self._node.end_request.is_set())
        return RunEnd(EndKind.REQUESTED if requested else EndKind.CUT, reason)

    def _may_go_on(self, present: _Participation) -> bool:
        """Return True if the announcer is present, or may not have been discovered yet.

        It may be undiscovered for JOIN_TIMEOUT after the announcement.
        """
        announcer = present.run.info.announcer
        is_early = time.monotonic() < present.since + JOIN_TIMEOUT
        return self.roll.is_there(announcer) or (is_early and self.roll.may_be_there(announcer))

    # announcements

    def _hear_announcement(self, info: Any) -> None:
        present = self._present
        is_own = present is not None and info.announcer == present.run.info.announcer
        if not info.run_id:
            if present is not None and is_own and not present.has_ended:
                present.is_closed, present.has_ended = True, not present.run.simulated
                present.note_sign()
            return
        if run_key(info) == self._last_key:
            return
        scene = _scene_of(info)
        if info.source not in self._sources or (
            info.source == RunSource.REPLAY
            and has_streams(self._role)
            and self.roll.id not in info.participants
        ):
            self.roll.report_ignored(info, f"this node does not take part in a {info.source}")
        elif (
            self._on_roll
            and self.roll.id not in info.participants
            and info.announcer in self.roll.parts  # not so if `ros2 bag play` repeats a run
        ):
            self.roll.report_ignored(info, "it was announced before this node had come")
        elif present is not None and not is_own:
            self.roll.report_ignored(info, f"this node takes part in {present.run.name}")
        else:
            self._last_key = run_key(info)
            self._next = AnnouncedRun(info, scene)

    def _hear_counts(self, counts: Any) -> None:
        sent, present = counts_of(counts), self._present
        if present is None or counts.run_id != present.run.id:
            return
        if counts.publisher == LAUNCHER:
            present.failure = str(counts.reason)
        if counts.publisher != SIMULATOR:
            return
        present.streams.end(SIMULATOR, sent)
        present.counts, present.has_ended = counts, True
        present.note_sign()

    def assume(self, scene: Scene) -> None:
        """Let :meth:`work` take part in a trial that no node announces, until Ctrl-C."""
        run = RunDescription.of(
            scene,
            uuid.uuid4().hex,
            [self._role],
            source=RunSource.TRIAL,
            announcer=self.roll.id,
        )
        self._next = AnnouncedRun(self._node.messages.run_info(run), scene)


def _scene_of(info: Any) -> Scene:
    """Return the scene of an announced run; MessageError if its RunInfo is not valid."""
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
