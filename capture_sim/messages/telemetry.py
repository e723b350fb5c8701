"""Ordered streams of the messages of a run, made from blocks of samples, events and statuses.

Simulator, launcher and detector have one class each, which numbers and counts their messages.
The node publishes the messages that its class yields, and the offline writer writes them.  A live
run and a file therefore have the same messages in the same order.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby, repeat
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from capture_sim.dynamics.samples import SAMPLE, Event, EventKind
from capture_sim.errors import CaptureSimError
from capture_sim.messages import convert, topics
from capture_sim.messages.cdr import Columns
from capture_sim.messages.convert import (
    CHASER_FRAME,
    CONE_FRAME,
    TARGET_FRAME,
    TIP_FRAME,
    WORLD,
    LaunchAction,
    Messages,
    RunDescription,
)
from capture_sim.messages.topics import Stamp, Topic
from capture_sim.run.sensors import SimulatedSensors

if TYPE_CHECKING:
    from capture_sim.scene.launch_plan import LaunchPlan
    from capture_sim.scene.parts import Detector, Scene


class Sent(NamedTuple):
    """A serialised message of a topic, ready to be sent."""

    topic: Topic
    stamp: int | None  # ns; None for the counts, which come last
    data: bytes  # serialised


def samples_per_message(state_rate: float, rate: float) -> int:
    """Return the number of samples per periodic message.

    CaptureSimError is raised if ``state_rate`` is not an integer multiple of ``rate``.
    """
    every = round(state_rate / rate)
    if every < 1 or abs(every * rate - state_rate) > 1e-9 * state_rate:
        raise CaptureSimError(
            f"run.state_rate = {state_rate:g} Hz: must be a whole multiple of "
            f"run.rate = {rate:g} Hz"
        )
    return every


class ContactInterval:
    """Summary of the contact from one ContactState message to the next.

    Add every event and every sample in order, then call :meth:`take` for a message.

    The located peak of a touch is known when the touch ends.  If the touch ends after the message
    of the interval in which the peak lies, the next message reports the peak, one message late.
    If the touch lasts longer, only the sampled forces and its lift_off event represent it.  The
    result therefore depends only on data known at the time, and not on how the run is divided
    into blocks.
    """

    def __init__(self) -> None:
        self._peak = 0.0
        self._impulse = 0.0
        self._touches = 0
        self._last_message = -math.inf
        self._message_before = -math.inf

    def add_event(self, event: Event) -> None:
        """Add an event; only an event that ends a touch has an effect."""
        if event.touch is not None and event.touch["peak_time"] > self._message_before:
            self._peak = max(self._peak, float(event.touch["peak_force"]))

    def add_force(self, force: float) -> None:
        """Add the larger of both walls' normal forces in a sample, N."""
        self._peak = max(self._peak, force)

    def take(self, t: float, impulse: float, touches: int) -> tuple[float, float, int]:
        """Return peak force (N), impulse (N s) and touches begun since the last call; then reset.

        ``t`` (s) is the sample's time, ``impulse`` and ``touches`` are its totals, all since the
        release.
        """
        since = (self._peak, impulse - self._impulse, touches - self._touches)
        self._peak, self._impulse, self._touches = 0.0, impulse, touches
        self._message_before, self._last_message = self._last_message, t
        return since


class _Stream:
    """Stream of one publisher's messages, which it numbers and counts."""

    publisher: str

    def __init__(self, messages: Messages, run_id: str) -> None:
        self._messages = messages
        self._run_id = run_id
        #: Stamp of t = 0, ns: the release in simulated time, or a time of the bench's own clock.
        self.zero_ns = convert.EPOCH_NS
        #: Messages made so far, by topic.
        self.by_topic = {
            topic: 0
            for topic in topics.topics_of(self.publisher)
            if topic is not topics.STREAM_COUNTS
        }

    @property
    def counts(self) -> dict[str, int]:
        """Messages made so far, by topic name."""
        return {topic.name: count for topic, count in self.by_topic.items()}

    def end(self, reason: str = "", extremes: str = "") -> Sent:
        """Return the message with the counts of all topics, which ends the run.

        ``reason`` is given if the run ends early; the counts are then marked as not complete.
        """
        counts = self._messages.stream_counts(
            self.publisher,
            self._run_id,
            self.counts,
            complete=not reason,
            reason=reason,
            extremes=extremes,
        )
        return Sent(topics.STREAM_COUNTS, None, self._messages.serialise(counts))

    def _one(self, topic: Topic, t: float, frame: str, fields: Mapping[str, Any]) -> Sent:
        """Return one message, stamped with time ``t``, s since the release."""
        seq = {"seq": self.by_topic[topic]} if topic.sequenced else {}
        self.by_topic[topic] += 1
        header = self._messages.header(t, frame, self.zero_ns)
        message = self._messages.new(topic.type_name, header=header, **seq, **fields)
        stamp = convert.stamp_ns(t) - convert.EPOCH_NS + self.zero_ns
        return Sent(topic, stamp, self._messages.serialise(message))

    def _many(
        self, topic: Topic, t: np.ndarray, frame: str, columns: Columns, **fixed: Any
    ) -> Iterator[Sent]:
        """Return n messages, stamped with times ``t`` (n,), s since the release."""
        stamps = convert.stamps_ns(t) - convert.EPOCH_NS + self.zero_ns
        path = "clock" if topic.stamp is Stamp.CLOCK else "header.stamp"
        columns = {**convert.stamp_columns(path, stamps), **columns}
        if topic.sequenced:
            columns["seq"] = self.by_topic[topic] + np.arange(len(t))
        if frame:
            fixed["header.frame_id"] = frame
        self.by_topic[topic] += len(t)
        serialised = self._messages.many(topic.type_name, columns, **fixed)
        return map(Sent._make, zip(repeat(topic), stamps.tolist(), serialised))


class _StatusStream(_Stream):
    """Stream of every status on one topic, and of changes of state on a transient-local topic."""

    stream: Topic
    changes: Topic  # transient local
    frame: str
    names: tuple[str, ...]  # fields of a status, with their names in the message
    _last_state: Any = None

    def status(self, t: float, status: Any, **fields: Sequence[float]) -> list[Sent]:
        """Return the messages of one status at time ``t``, s since the release.

        ``fields`` are values of further fields; see :meth:`statuses`.
        """
        return next(self.statuses([(t, status)], {name: [v] for name, v in fields.items()}))

    def statuses(
        self, known: Iterable[tuple[float, Any]], further: Mapping[str, Any] | None = None
    ) -> Iterator[list[Sent]]:
        """Yield the messages of each status, from pairs of time (s since the release) and status.

        Each status gives one message on ``stream``, and one on ``changes`` if the state has
        changed.  ``further`` are additional columns, with one value for each status.
        """
        end = 0
        for (state, reason), group in groupby(known, key=lambda entry: self._text(entry[1])):
            times, some = zip(*group, strict=True)
            begin, end = end, end + len(some)
            columns: dict[str, Any] = dict(convert.statuses(some, *self.names))
            rows = (further or {}).items()
            columns |= {name: np.array(values[begin:end]) for name, values in rows}
            sent = self._many(self.stream, np.array(times), self.frame, columns, reason=reason)
            messages = [[message] for message in sent]
            if state != self._last_state:
                self._last_state = state
                first = {name: values[:1] for name, values in columns.items()}
                t = np.array(times[:1])
                messages[0] += self._many(self.changes, t, self.frame, first, reason=reason)
            yield from messages

    @staticmethod
    def _text(status: Any) -> tuple[Any, str]:
        """Return state and ``final`` of a status (None if it has no such field), and its reason."""
        return (status.state, getattr(status, "final", None)), status.reason


class BenchTelemetry(_Stream):
    """Messages of the simulator: begin, any number of blocks, rest, end.

    The messages of sample k are, in this order: the events before its time, BenchState, and the
    trace of the contact before its time.  If k is a multiple of ``state_rate / rate``, the clock
    and the periodic messages follow.  The readings of sensors that are due come last.  The
    messages do not depend on how the run is divided into blocks.
    """

    publisher = topics.SIMULATOR
    #: Topic of the last periodic message of a sample.
    LAST_PERIODIC = topics.JOINT_STATES

    def __init__(self, messages: Messages, scene: Scene, run: RunDescription) -> None:
        super().__init__(messages, run.run_id)
        self._run = run
        self._scene = scene
        self._every = samples_per_message(run.state_rate, run.rate)
        self._interval = ContactInterval()
        self._sensors = None if scene.sensors is None else SimulatedSensors(scene)
        self._pending: list[Event] = []
        self._trace = np.zeros(0, SAMPLE)  # points that are sent with a later sample

    def begin(self) -> Sent:
        """Return RunInfo, the message before the first sample."""
        self.by_topic[topics.RUN_INFO] += 1
        info = self._messages.run_info(self._run)
        return Sent(topics.RUN_INFO, convert.stamp_ns(0.0), self._messages.serialise(info))

    def block(
        self,
        samples: np.ndarray,
        events: Iterable[Event] = (),
        trace: np.ndarray | None = None,
    ) -> Iterator[list[Sent]]:
        """Yield the messages of each of the next samples, in order.

        They include the new events and trace points.  Events and trace points later than the last
        sample are kept for the next block.
        """
        self._pending.extend(events)
        if trace is not None and len(trace):
            self._trace = np.concatenate([self._trace, trace])
        times = samples["t"].tolist()
        before = self._events_before(times)
        periodic = range(
            -self.by_topic[topics.BENCH_STATE] % self._every, len(samples), self._every
        )
        sets = self._periodic(samples[periodic], self._since_last(samples, before, periodic))
        sensed = self._sensed(samples)
        states = self._many(topics.BENCH_STATE, samples["t"], WORLD, convert.bench_states(samples))
        for i, (t, state) in enumerate(zip(times, states, strict=True)):
            due = [self._event(event) for event in before.get(i, ())]
            due.append(state)
            if len(self._trace):
                # earlier points only: a step that ends at the sample itself may be known later
                due += self._traced(t, self._trace["t"].searchsorted(t))
            if i in periodic:
                due += next(sets)
            due += next(sensed, ())
            yield due

    def rest(self) -> Iterator[Sent]:
        """Yield the messages of the events and trace points after the last sample."""
        while self._pending:
            yield self._event(self._pending.pop(0))
        yield from self._traced(float(self._trace["t"].max(initial=0.0)), len(self._trace))

    def cut(self, made: Mapping[Topic, int], sent: Mapping[Topic, int]) -> None:
        """Discard messages made but not sent when a run ends early, so that no node waits for them.

        ``made`` are the counts by topic when sending began, ``sent`` the numbers of messages sent
        since then.
        """
        self._pending.clear()
        self._trace = self._trace[:0]
        self.by_topic = {topic: n + sent.get(topic, 0) for topic, n in made.items()}

    def _events_before(self, times: list[float]) -> dict[int, list[Event]]:
        """Remove the pending events of this block; return them by index of the next sample.

        Each event is sent before this sample.  A sample at the exact time of an event shows the
        state before the event, and is returned before the event is known.  The event therefore
        follows this sample, independent of the division into blocks.
        """
        found: dict[int, list[Event]] = {}
        place = 0
        while self._pending:
            event = self._pending[0]
            if event.kind is not EventKind.RELEASE:
                place = max(place, bisect_right(times, event.t))
            if place == len(times):
                break
            found.setdefault(place, []).append(self._pending.pop(0))
        return found

    def _since_last(
        self, samples: np.ndarray, before: Mapping[int, Sequence[Event]], periodic: range
    ) -> Columns:
        """Return the columns of the contact since the last message, for each periodic sample."""
        interval, since = self._interval, []
        impulses, touches = samples["impulse"].sum(axis=1).tolist(), samples["touches"].tolist()
        forces, times = samples["normal_force"].max(axis=1).tolist(), samples["t"].tolist()
        for i, force in enumerate(forces):
            for event in before.get(i, ()):
                interval.add_event(event)
            interval.add_force(force)
            if i in periodic:
                since.append(interval.take(times[i], impulses[i], touches[i]))
        peaks, sums, begun = np.array(since).reshape(-1, 3).T
        return {"peak_force": peaks, "impulse": sums, "touches": begun.astype(int)}

    def _event(self, event: Event) -> Sent:
        return self._one(topics.BENCH_EVENT, event.t, WORLD, convert.bench_event(event))

    def _traced(self, t: float, count: int) -> Iterator[Sent]:
        """Yield one ContactTrace of the first ``count`` pending points, stamped ``t``, s.

        If ``count`` is 0, nothing is yielded.
        """
        if count:
            points, self._trace = self._trace[:count], self._trace[count:]
            yield self._one(topics.CONTACT_TRACE, t, CONE_FRAME, convert.contact_trace(points))

    def _periodic(self, samples: np.ndarray, since: Columns) -> Iterator[tuple[Sent, ...]]:
        t, q, v = samples["t"], samples["q"], samples["v"]
        joints = {"name": [convert.HINGE_JOINT, convert.SLIDE_JOINT]}

        def of_body(topic: Topic, frame: str, body: slice) -> Iterator[Sent]:
            columns = convert.odometry(q[:, body], v[:, body])
            return self._many(topic, t, WORLD, columns, child_frame_id=frame)

        return zip(
            self._many(topics.CLOCK, t, "", {}),
            self._many(topics.BUFFER_STATE, t, CHASER_FRAME, convert.buffer_states(samples)),
            self._many(topics.CONTACT_STATE, t, CONE_FRAME, convert.contact_states(samples, since)),
            self._many(topics.STRING_STATE, t, WORLD, convert.string_states(samples, self._scene)),
            of_body(topics.CHASER_ODOMETRY, CHASER_FRAME, convert.CHASER),
            of_body(topics.TARGET_ODOMETRY, TARGET_FRAME, convert.TARGET),
            self._many(topics.CONTACT_WRENCH, t, TIP_FRAME, convert.contact_wrenches(samples)),
            self._many(topics.JOINT_STATES, t, "", convert.joint_states(samples), **joints),
            strict=True,
        )

    def _sensed(self, samples: np.ndarray) -> Iterator[list[Sent]]:
        """Yield the messages of the sensors at each sample; yield nothing without sensors."""
        if self._sensors is None:
            return
        read = [self._sensors.read(sample) for sample in samples]
        streams = []
        for topic, name in (
            (topics.CHASER_POSE, "chaser"),
            (topics.TARGET_POSE, "target"),
            (topics.LOAD_CELL, "wrench"),
        ):
            due = [i for i, reading in enumerate(read) if getattr(reading, name) is not None]
            values = np.array([getattr(read[i], name) for i in due]).reshape(-1, 3)
            columns, frame = convert.sensed_poses(values), WORLD
            if topic is topics.LOAD_CELL:
                columns, frame = convert.wrenches(values), TARGET_FRAME
            streams.append((set(due), self._many(topic, samples["t"][due], frame, columns)))
        for i in range(len(samples)):
            yield [next(stream) for due, stream in streams if i in due]


class LauncherTelemetry(_StatusStream):
    """Messages of the launcher: its commands and its state."""

    publisher = topics.LAUNCHER
    stream, changes, frame = topics.LAUNCHER_STATE, topics.LAUNCHER_PHASE, WORLD
    names = (
        *("state", "hanging_mass", "drop_height", "wanted_speed", "landing_speed"),
        "measured_speed",
    )

    def command(self, t: float, action: LaunchAction, plan: LaunchPlan) -> Sent:
        """Return the command for an action with the plan's values; ``t``: s since the release."""
        fields = convert.launch_command(self._run_id, action, plan)
        return self._one(topics.LAUNCH_COMMAND, t, WORLD, fields)


class DetectorTelemetry(_StatusStream):
    """Messages of the capture detector: its criteria, then its status at every evaluated time."""

    publisher = topics.CAPTURE_DETECTOR
    stream, changes, frame = topics.CAPTURE_STATUS, topics.CAPTURE_VERDICT, CONE_FRAME
    names = (
        *("state", "final", "distance", "axial_offset", "lateral_offset", "relative_attitude"),
        *("relative_speed", "nearest_distance", "time_in_state", "nearest_deviation"),
        *("may_precede", "may_follow"),
    )

    def begin(self, criteria: Detector) -> Sent:
        """Return the message with the detector's criteria."""
        fields = convert.capture_criteria(self._run_id, criteria)
        return self._one(topics.CAPTURE_CRITERIA, 0.0, CONE_FRAME, fields)
