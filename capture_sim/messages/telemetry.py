"""The ordered stream of messages that a run is, made from blocks of core data.

Each node of the suite has one class here; it numbers and counts what it sends.  The node
publishes what the class yields and the offline writer writes it, so both have the same
messages in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np

from capture_sim.errors import CaptureSimError
from capture_sim.messages.convert import (
    ContactInterval,
    LaunchAction,
    Message,
    Messages,
    RunDescription,
    SinceLastMessage,
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
    from capture_sim.launch.plan import LauncherStatus, LaunchPlan
    from capture_sim.scene.parts import Detector, Scene

Sent = tuple[Topic, Message]


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
        self._counts = {
            topic: 0 for topic in topics_of(self.publisher) if topic is not STREAM_COUNTS
        }

    @property
    def counts(self) -> dict[str, int]:
        """Messages sent so far, by topic name."""
        return {topic.name: count for topic, count in self._counts.items()}

    @property
    def by_topic(self) -> dict[Topic, int]:
        """Messages made so far, by topic."""
        return dict(self._counts)

    def _sent(self, topic: Topic, message: Message) -> Sent:
        self._counts[topic] += 1
        return topic, message

    def _end(self, *, complete: bool, reason: str) -> Sent:
        return STREAM_COUNTS, self._messages.stream_counts(
            self.publisher, self._run_id, self.counts, complete=complete, reason=reason
        )


#: The periodic messages of a sample, in the order in which they are sent.
PERIODIC = (
    CLOCK,
    BUFFER_STATE,
    CONTACT_STATE,
    STRING_STATE,
    CHASER_ODOMETRY,
    TARGET_ODOMETRY,
    CONTACT_WRENCH,
    JOINT_STATES,
)


class BlockMaker(Protocol):
    """Makes the messages of a block of samples, in whatever form the transport takes."""

    def states(self, first_seq: int, samples: np.ndarray) -> Iterator[Message]:
        """Yield BenchState of each sample, (n,) of dtype SAMPLE; the first has ``first_seq``."""

    def sets(
        self, first_seq: int, samples: np.ndarray
    ) -> Iterator[Callable[[SinceLastMessage], list[Message]]]:
        """Yield for each sample what makes the messages of PERIODIC, once it is known what
        the contact did since the set before; the first ones have ``first_seq``.
        """


class OneByOne:
    """Makes message objects.

    Parameters
    ----------
    messages
        Makes the objects.
    scene
        What is on the bench.
    """

    def __init__(self, messages: Messages, scene: Scene) -> None:
        self._messages = messages
        self._has_string = scene.string is not None
        self._rail_heading = scene.initial.chaser.theta

    def states(self, first_seq: int, samples: np.ndarray) -> Iterator[Message]:
        """Yield BenchState of each sample, see :class:`BlockMaker`."""
        return self._messages.bench_states(first_seq, samples)

    def sets(
        self, first_seq: int, samples: np.ndarray
    ) -> Iterator[Callable[[SinceLastMessage], list[Message]]]:
        """Yield what makes the periodic messages of each sample, see :class:`BlockMaker`."""
        for seq, sample in enumerate(samples, first_seq):
            yield partial(self._set, seq, sample)

    def _set(self, seq: int, sample: np.void, since: SinceLastMessage) -> list[Message]:
        make = self._messages
        return [
            make.clock(float(sample["t"])),
            make.buffer_state(seq, sample),
            make.contact_state(seq, sample, since),
            make.string_state(
                seq, sample, has_string=self._has_string, rail_heading=self._rail_heading
            ),
            make.chaser_odometry(sample),
            make.target_odometry(sample),
            make.contact_wrench(sample),
            make.joint_states(sample),
        ]


class BenchTelemetry(_Stream):
    """What the simulator sends: begin, any number of blocks, end.

    For every sample k come, in this order, the events before its time, BenchState, the trace
    of the contact before its time, and when k is a multiple of ``state_rate / rate`` the clock
    and the periodic messages.  Nothing depends on how the run is cut into blocks.

    Parameters
    ----------
    messages
        Makes the message objects.
    scene
        What is on the bench.
    run
        The run's description; its rates are used.
    blocks
        Makes the messages of samples; as objects unless given.
    """

    publisher = SIMULATOR
    #: The topic that ends the set of periodic messages of a sample.
    LAST_PERIODIC = PERIODIC[-1]

    def __init__(
        self,
        messages: Messages,
        scene: Scene,
        run: RunDescription,
        blocks: BlockMaker | None = None,
    ) -> None:
        super().__init__(messages, run.run_id)
        self._blocks = OneByOne(messages, scene) if blocks is None else blocks
        self._run = run
        self._every = samples_per_message(run.state_rate, run.rate)
        self._interval = ContactInterval()
        self._sensors = None if scene.sensors is None else Sensors(scene)
        self._pending: list[Event] = []
        self._trace = np.zeros(0, SAMPLE)  # points that wait for a later sample

    def begin(self) -> Iterator[Sent]:
        """Yield what comes before the first sample."""
        yield self._sent(RUN_INFO, self._messages.run_info(self._run))

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
        first = self._counts[BENCH_STATE]
        times = samples["t"].tolist()
        states = self._blocks.states(first, samples)
        told = samples[-first % self._every :: self._every]
        sets = self._blocks.sets(-(-first // self._every), told)
        unseen = 0  # first sample the contact's interval has not taken in
        for i, state in enumerate(states):
            while self._pending and _precedes(self._pending[0], times[i]):
                yield self._event(self._pending.pop(0))
            yield self._sent(BENCH_STATE, state)
            if len(self._trace):
                # a step that ends with the sample itself may be known only later
                yield from self._traced(times[i], self._trace["t"].searchsorted(times[i]))
            if (first + i) % self._every == 0:
                self._interval.add_samples(samples[unseen : i + 1])
                unseen = i + 1
                yield from self._periodic(samples[i], next(sets))
            if self._sensors is not None:
                yield from self._sensed(samples[i], self._sensors)
        self._interval.add_samples(samples[unseen:])

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
        self._counts = {topic: n + sent.get(topic, 0) for topic, n in made.items()}

    def end(self, *, complete: bool = True, reason: str = "") -> Iterator[Sent]:
        """Yield the events and trace after the last sample, and the counts of all streams."""
        while self._pending:
            yield self._event(self._pending.pop(0))
        yield from self._traced(float(self._trace["t"].max(initial=0.0)), len(self._trace))
        yield self._end(complete=complete, reason=reason)

    def _event(self, event: Event) -> Sent:
        self._interval.add_event(event)
        seq = self._counts[BENCH_EVENT]
        return self._sent(BENCH_EVENT, self._messages.bench_event(seq, event))

    def _traced(self, t: float, count: int) -> Iterator[Sent]:
        """Yield the first ``count`` points that wait, told at time ``t``."""
        if count:
            points, self._trace = self._trace[:count], self._trace[count:]
            seq = self._counts[CONTACT_TRACE]
            yield self._sent(CONTACT_TRACE, self._messages.contact_trace(seq, t, points))

    def _periodic(
        self, sample: np.void, make: Callable[[SinceLastMessage], list[Message]]
    ) -> Iterator[Sent]:
        for topic, message in zip(PERIODIC, make(self._interval.take(sample)), strict=True):
            yield self._sent(topic, message)

    def _sensed(self, sample: np.void, sensors: Sensors) -> Iterator[Sent]:
        t, read = float(sample["t"]), sensors.read(sample)
        if read.chaser is not None and read.target is not None:
            yield self._sent(CHASER_POSE, self._messages.sensed_pose(t, read.chaser))
            yield self._sent(TARGET_POSE, self._messages.sensed_pose(t, read.target))
        if read.wrench is not None:
            yield self._sent(LOAD_CELL, self._messages.sensed_wrench(t, read.wrench))


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
        message = self._messages.launch_command(
            t,
            self._run_id,
            action,
            hanging_mass=plan.hanging_mass,
            drop_height=plan.drop_height,
            impact_speed=plan.impact_speed,
        )
        return self._sent(LAUNCH_COMMAND, message)

    def state(self, t: float, status: LauncherStatus) -> Sent:
        """Return the launcher's state at a time since the release, s."""
        seq = self._counts[LAUNCHER_STATE]
        return self._sent(LAUNCHER_STATE, self._messages.launcher_state(seq, t, status))

    def end(self, *, complete: bool = True, reason: str = "") -> Sent:
        """Return the counts of the launcher's streams."""
        return self._end(complete=complete, reason=reason)


class DetectorTelemetry(_Stream):
    """What the capture detector sends: its limits, then its judgement of every instant."""

    publisher = CAPTURE_DETECTOR

    def begin(self, limits: Detector) -> Sent:
        """Return what the run is judged by."""
        message = self._messages.capture_criteria(self._run_id, limits)
        return self._sent(CAPTURE_CRITERIA, message)

    def status(self, t: float, status: CaptureStatus) -> Sent:
        """Return the judgement of the sample at a time since the release, s."""
        seq = self._counts[CAPTURE_STATUS]
        return self._sent(CAPTURE_STATUS, self._messages.capture_status(seq, t, status))

    def end(self, *, complete: bool = True, reason: str = "") -> Sent:
        """Return the counts of the detector's streams."""
        return self._end(complete=complete, reason=reason)
