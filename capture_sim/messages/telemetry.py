"""The ordered stream of messages that a run is, made from blocks of core data.

Each node of the suite has one class here; it numbers and counts what it sends.  The node
publishes what the class yields and the offline writer writes it, so both have the same
messages in the same order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from capture_sim.errors import CaptureSimError
from capture_sim.messages.convert import (
    TARGET_FRAME,
    ContactInterval,
    LaunchAction,
    Message,
    Messages,
    Row,
    RunDescription,
    row_of,
)
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    BUFFER_STATE,
    CAPTURE_CRITERIA,
    CAPTURE_DETECTOR,
    CAPTURE_STATUS,
    CHASER_ODOMETRY,
    CHASER_POSE,
    CLOCK,
    CONTACT_STATE,
    CONTACT_TRACE,
    CONTACT_WRENCH,
    JOINT_STATES,
    LAUNCH_COMMAND,
    LAUNCHER,
    LAUNCHER_STATE,
    LOAD_CELL,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    STRING_STATE,
    TARGET_ODOMETRY,
    TARGET_POSE,
    Topic,
    topics_of,
)
from capture_sim.samples import SAMPLE, Event, EventKind
from capture_sim.sensors import Sensors

if TYPE_CHECKING:
    from capture_sim.detection.exact import CaptureStatus
    from capture_sim.launch.plan import LaunchPlan
    from capture_sim.launch.watch import LauncherStatus
    from capture_sim.scene.parts import Detector, Scene


class Sent(NamedTuple):
    """A message that is sent."""

    topic: Topic
    t: float  # s since the release
    data: bytes  # serialised


def samples_per_message(state_rate: float, rate: float) -> int:
    """Return how many samples lie between two periodic messages.

    Raises
    ------
    CaptureSimError
        ``state_rate`` is no whole multiple of ``rate``.
    """
    every = round(state_rate / rate)
    if every < 1 or abs(every * rate - state_rate) > 1e-9 * state_rate:
        raise CaptureSimError(
            f"run.state_rate = {state_rate:g} Hz: must be a whole multiple of "
            f"run.rate = {rate:g} Hz"
        )
    return every


class _Stream:
    """Numbers and counts the messages of one publisher."""

    publisher: str

    def __init__(self, messages: Messages, run_id: str) -> None:
        self._messages = messages
        self._run_id = run_id
        self._t = 0.0  # of the last message, s
        #: Messages made so far, by topic.
        self.by_topic = {
            topic: 0 for topic in topics_of(self.publisher) if topic is not STREAM_COUNTS
        }

    @property
    def counts(self) -> dict[str, int]:
        """Messages made so far, by topic name."""
        return {topic.name: count for topic, count in self.by_topic.items()}

    def _sent(self, topic: Topic, t: float, message: Message) -> Sent:
        self.by_topic[topic] += 1
        self._t = t
        return Sent(topic, t, self._messages.serialise(message))

    def end(self, *, complete: bool = True, reason: str = "") -> Sent:
        """Return the counts of all streams, which end the run."""
        counts = self._messages.stream_counts(
            self.publisher, self._run_id, self.counts, complete=complete, reason=reason
        )
        return Sent(STREAM_COUNTS, self._t, self._messages.serialise(counts))


class BenchTelemetry(_Stream):
    """What the simulator sends: begin, any number of blocks, rest, end.

    For every sample k come, in this order, the events before its time, BenchState, the trace
    of the contact before its time, and when k is a multiple of ``state_rate / rate`` the clock
    and the periodic messages.  Nothing depends on how the run is cut into blocks.

    Parameters
    ----------
    messages
        Makes the messages.
    scene
        What is on the bench.
    run
        The run's description; its rates are used.
    """

    publisher = SIMULATOR
    #: The topic that ends the set of periodic messages of a sample.
    LAST_PERIODIC = JOINT_STATES

    def __init__(self, messages: Messages, scene: Scene, run: RunDescription) -> None:
        super().__init__(messages, run.run_id)
        self._run = run
        self._scene = scene
        self._every = samples_per_message(run.state_rate, run.rate)
        self._interval = ContactInterval()
        self._sensors = None if scene.sensors is None else Sensors(scene)
        self._pending: list[Event] = []
        self._trace = np.zeros(0, SAMPLE)  # points that wait for a later sample

    def begin(self) -> Sent:
        """Return what comes before the first sample."""
        return self._sent(RUN_INFO, 0.0, self._messages.run_info(self._run))

    def block(
        self,
        samples: np.ndarray,
        events: Iterable[Event] = (),
        trace: np.ndarray | None = None,
    ) -> Iterator[Sent]:
        """Yield the messages of the next samples and of new events.

        Parameters
        ----------
        samples
            The samples that follow the last block's, (n,) of dtype SAMPLE.
        events
            Events since the last block, in order; those later than the last
            sample wait for the next block.
        trace
            The contact since the last block, (m,) of dtype SAMPLE, in order; likewise.
        """
        self._pending.extend(events)
        if trace is not None and len(trace):
            self._trace = np.concatenate([self._trace, trace])
        first = self.by_topic[BENCH_STATE]
        times = samples["t"].tolist()
        unseen = 0  # first sample the contact's interval has not taken in
        states = self._messages.bench_states(first, samples)
        for i, (t, state) in enumerate(zip(times, states, strict=True)):
            while self._pending and _precedes(self._pending[0], t):
                yield self._event(self._pending.pop(0))
            yield self._sent(BENCH_STATE, t, state)
            if len(self._trace):
                # a step that ends with the sample itself may be known only later
                yield from self._traced(t, self._trace["t"].searchsorted(t))
            if (first + i) % self._every == 0:
                self._interval.add_samples(samples[unseen : i + 1])
                unseen = i + 1
                yield from self._periodic(row_of(samples[i]))
            if self._sensors is not None:
                yield from self._sensed(samples[i], self._sensors)
        self._interval.add_samples(samples[unseen:])

    def rest(self) -> Iterator[Sent]:
        """Yield the events and trace after the last sample."""
        while self._pending:
            yield self._event(self._pending.pop(0))
        yield from self._traced(float(self._trace["t"].max(initial=0.0)), len(self._trace))

    def cut(self, made: Mapping[Topic, int], sent: Mapping[Topic, int]) -> None:
        """Forget what was made ahead when a run is cut: nobody is to wait for it.

        Parameters
        ----------
        made
            The counts when sending began.
        sent
            How many of each topic have been sent since.
        """
        self._pending.clear()
        self._trace = self._trace[:0]
        self.by_topic = {topic: n + sent.get(topic, 0) for topic, n in made.items()}

    def _event(self, event: Event) -> Sent:
        self._interval.add_event(event)
        seq = self.by_topic[BENCH_EVENT]
        return self._sent(BENCH_EVENT, event.t, self._messages.bench_event(seq, event))

    def _traced(self, t: float, count: int) -> Iterator[Sent]:
        """Yield the first ``count`` points that wait, stamped ``t``."""
        if count:
            points, self._trace = self._trace[:count], self._trace[count:]
            seq = self.by_topic[CONTACT_TRACE]
            yield self._sent(CONTACT_TRACE, t, self._messages.contact_trace(seq, t, points))

    def _periodic(self, row: Row) -> Iterator[Sent]:
        make, t, seq = self._messages, row.t, self.by_topic[BUFFER_STATE]
        yield self._sent(CLOCK, t, make.clock(t))
        yield self._sent(BUFFER_STATE, t, make.buffer_state(seq, row))
        since = self._interval.take(row)
        yield self._sent(CONTACT_STATE, t, make.contact_state(seq, row, since))
        yield self._sent(STRING_STATE, t, make.string_state(seq, row, self._scene))
        yield self._sent(CHASER_ODOMETRY, t, make.chaser_odometry(row))
        yield self._sent(TARGET_ODOMETRY, t, make.target_odometry(row))
        yield self._sent(CONTACT_WRENCH, t, make.contact_wrench(row))
        yield self._sent(JOINT_STATES, t, make.joint_states(row))

    def _sensed(self, sample: np.void, sensors: Sensors) -> Iterator[Sent]:
        t, make, read = float(sample["t"]), self._messages, sensors.read(sample)
        if read.chaser is not None and read.target is not None:
            yield self._sent(CHASER_POSE, t, make.sensed_pose(t, read.chaser))
            yield self._sent(TARGET_POSE, t, make.sensed_pose(t, read.target))
        if read.wrench is not None:
            yield self._sent(LOAD_CELL, t, make.wrench(t, TARGET_FRAME, read.wrench))


def _precedes(event: Event, t: float) -> bool:
    """Tell whether an event is sent before the sample at ``t``.

    A sample taken at the very instant of an event shows the state before it, and is
    handed out before the event is known; so the event follows it, however the run is cut.
    """
    return event.t < t or event.kind is EventKind.RELEASE


class LauncherTelemetry(_Stream):
    """What the launcher sends: commands and its state."""

    publisher = LAUNCHER

    def command(self, t: float, action: LaunchAction, plan: LaunchPlan) -> Sent:
        """Return a command that follows the plan, at a time since the release, s."""
        message = self._messages.launch_command(t, self._run_id, action, plan)
        return self._sent(LAUNCH_COMMAND, t, message)

    def state(self, t: float, status: LauncherStatus) -> Sent:
        """Return the launcher's state at a time since the release, s."""
        seq = self.by_topic[LAUNCHER_STATE]
        return self._sent(LAUNCHER_STATE, t, self._messages.launcher_state(seq, t, status))


class DetectorTelemetry(_Stream):
    """What the capture detector sends: its limits, then its status at every instant."""

    publisher = CAPTURE_DETECTOR

    def begin(self, limits: Detector) -> Sent:
        """Return the detector's limits."""
        message = self._messages.capture_criteria(self._run_id, limits)
        return self._sent(CAPTURE_CRITERIA, 0.0, message)

    def status(self, t: float, status: CaptureStatus) -> Sent:
        """Return the status of the sample at a time since the release, s."""
        seq = self.by_topic[CAPTURE_STATUS]
        return self._sent(CAPTURE_STATUS, t, self._messages.capture_status(seq, t, status))
