"""A simulated run's messages serialised by columns, thousands at a time.

Byte for byte those of :func:`capture_sim.recording.offline.run_stream`, which makes them one
by one as the nodes do, and in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from operator import attrgetter
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from capture_sim.launch.plan import Launcher
from capture_sim.messages import message_columns as columns_of
from capture_sim.messages.convert import (
    LaunchAction,
    Message,
    RunDescription,
    SinceLastMessage,
    StringPhase,
)
from capture_sim.messages.telemetry import LauncherTelemetry, Sent, samples_per_message
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    BUFFER_STATE,
    CAPTURE_CRITERIA,
    CAPTURE_DETECTOR,
    CAPTURE_STATUS,
    CHASER_ODOMETRY,
    CLOCK,
    CONTACT_STATE,
    CONTACT_TRACE,
    CONTACT_WRENCH,
    JOINT_STATES,
    LAUNCH_COMMAND,
    LAUNCHER,
    LAUNCHER_STATE,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    STRING_STATE,
    TARGET_ODOMETRY,
    Rate,
    Stamp,
    Topic,
    topics_of,
)
from capture_sim.recording.definitions import offline_messages, typestore
from capture_sim.recording.template import Template
from capture_sim.recording.writer import Rows
from capture_sim.samples import EventKind

if TYPE_CHECKING:
    from capture_sim.detection.exact import CaptureStatus
    from capture_sim.launch.plan import LauncherStatus
    from capture_sim.simulation import Result

_BY_COLUMNS = {
    BENCH_STATE,
    CLOCK,
    BUFFER_STATE,
    CONTACT_STATE,
    STRING_STATE,
    CHASER_ODOMETRY,
    TARGET_ODOMETRY,
    CONTACT_WRENCH,
    JOINT_STATES,
}
#: Samples whose messages are serialised at a time.
BLOCK = 8192


class ColumnStream:
    """The messages of :func:`run_stream`, those of the periodic topics by columns."""

    def __init__(self, result: Result, run: RunDescription) -> None:
        self._result = result
        self._run = run
        self._messages = offline_messages()
        self._store = typestore()
        self._every = samples_per_message(run.state_rate, run.rate)
        self._launcher = Launcher(result.scene)
        self._follower = LauncherTelemetry(self._messages, run.run_id)
        # events come before the first sample that is later; the release before all
        at = [-1 if event.kind is EventKind.RELEASE else event.t for event in result.events]
        places = np.searchsorted(result.samples["t"], at, side="right")
        self._event_places = np.maximum.accumulate(places) if len(places) else places
        # the trace is told with the first sample that is later
        self._trace = result.samples[:0] if result.trace is None else result.trace
        places = np.searchsorted(result.samples["t"], self._trace["t"], side="right")
        self._trace_places, self._trace_starts = np.unique(places, return_index=True)
        since = columns_of.since_last_message(result.samples, result.events, self._every)
        self._since = since
        # a judgement follows the first periodic sample that is not earlier; the verdict all
        self._judged = result.statuses[:-1]
        told = result.samples["t"][:: self._every]
        places = np.searchsorted(told, [status.t for status in self._judged], side="left")
        self._judged_places = np.maximum.accumulate(places) if len(places) else places

    @property
    def covers_all(self) -> bool:
        """Whether nothing of the run has to be serialised otherwise, as sensors' readings."""
        regular = {t for t in topics_of(SIMULATOR) if t.rate in (Rate.STATE, Rate.PERIODIC)}
        return regular <= _BY_COLUMNS and getattr(self._result.scene, "sensors", None) is None

    def head(self) -> Iterator[Sent]:
        """Yield what comes before the first sample."""
        plan = self._launcher.plan
        yield RUN_INFO, self._messages.run_info(self._run)
        yield self._follower.command(0.0, LaunchAction.ARM, plan)
        yield self._follower.state(0.0, self._launcher.status)
        yield self._follower.command(0.0, LaunchAction.RELEASE, plan)
        yield self._follower.state(0.0, self._launcher.release())
        limits = self._result.scene.detector
        criteria = self._messages.capture_criteria(self._run.run_id, limits)
        yield CAPTURE_CRITERIA, criteria

    def blocks(self) -> Iterator[tuple[list[Rows], np.ndarray]]:
        """Yield the messages of some thousand samples each, and their order."""
        samples = self._result.samples
        size = BLOCK // self._every * self._every or self._every
        for first in range(0, len(samples), size):
            yield self._block(first, samples[first : first + size])

    def tail(self) -> Iterator[Sent]:
        """Yield the events after the last sample, the verdict, and the counts of all streams."""
        make, result, run_id = self._messages, self._result, self._run.run_id
        count = len(result.samples)
        for seq, event in enumerate(result.events):
            if self._event_places[seq] == count:
                yield BENCH_EVENT, make.bench_event(seq, event)
        for seq in np.flatnonzero(self._trace_places == count).tolist():
            points = self._points(seq)
            yield CONTACT_TRACE, make.contact_trace(seq, float(points["t"][-1]), points)
        told = -(-count // self._every)

        def counts(publisher: str, sent: dict[str, int]) -> Sent:
            return STREAM_COUNTS, make.stream_counts(
                publisher, run_id, sent, complete=not result.failure, reason=result.failure
            )

        sent = {
            topic.name: {Rate.STATE: count, Rate.PERIODIC: told, Rate.ONCE: 1}.get(topic.rate, 0)
            for topic in topics_of(SIMULATOR)
            if topic is not STREAM_COUNTS
        }
        sent[BENCH_EVENT.name] = len(result.events)
        sent[CONTACT_TRACE.name] = len(self._trace_places)
        yield counts(SIMULATOR, sent)
        # two commands and two states at the release
        sent = {LAUNCH_COMMAND.name: 2, LAUNCHER_STATE.name: told + 2}
        yield counts(LAUNCHER, sent)
        placed = int((self._judged_places < told).sum())
        for seq, status in enumerate(result.statuses[placed:], placed):
            yield CAPTURE_STATUS, make.capture_status(seq, status.t, status)
        sent = {CAPTURE_CRITERIA.name: 1, CAPTURE_STATUS.name: len(result.statuses)}
        yield counts(CAPTURE_DETECTOR, sent)

    def _block(self, first: int, samples: np.ndarray) -> tuple[list[Rows], np.ndarray]:
        told = samples[:: self._every]
        begin = first // self._every
        judged = np.flatnonzero(
            (self._judged_places >= begin) & (self._judged_places < begin + len(told))
        )
        every_sample = np.arange(first, first + len(samples))
        every_set = every_sample[:: self._every]
        blocks: list[Rows] = []
        keys: list[tuple[np.ndarray, np.ndarray]] = []

        def add(rows: Iterable[Rows], places: np.ndarray, rank: int) -> None:
            done = 0
            for block in rows:
                blocks.append(block)
                its = places[done : done + len(block.times)]
                keys.append((its, np.full(len(its), rank)))
                done += len(its)

        chosen = np.flatnonzero(
            (self._event_places >= first) & (self._event_places < first + len(samples))
        )
        add(self._events(chosen), self._event_places[chosen], 0)
        add([self._rows(BENCH_STATE, samples, first, columns_of.bench_states)], every_sample, 1)
        chosen = np.flatnonzero(
            (self._trace_places >= first) & (self._trace_places < first + len(samples))
        )
        add(self._traced(chosen), self._trace_places[chosen], 2)
        for rank, rows in enumerate(self._periodic(told, begin), 3):
            add([rows], every_set, rank)
        add(self._launcher_states(told, begin), every_set, 98)
        if judged.size:
            places = self._judged_places[judged] * self._every
            add(self._capture_states(judged), places, 99)
        places = np.concatenate([key[0] for key in keys])
        ranks = np.concatenate([key[1] for key in keys])
        return blocks, np.lexsort((ranks, places))

    def _periodic(self, told: np.ndarray, begin: int) -> Iterator[Rows]:
        scene = self._result.scene
        since = {name: column[begin : begin + len(told)] for name, column in self._since.items()}

        def contact(samples: np.ndarray) -> columns_of.Columns:
            return columns_of.contact_states(samples, since)

        def string(samples: np.ndarray) -> columns_of.Columns:
            return columns_of.string_states(
                samples,
                has_string=scene.string is not None,
                rail_heading=scene.initial.chaser.theta,
            )

        yield self._rows(CLOCK, told, begin, lambda samples: {})
        yield self._rows(BUFFER_STATE, told, begin, columns_of.buffer_states)
        yield self._rows(CONTACT_STATE, told, begin, contact)
        yield self._rows(STRING_STATE, told, begin, string)
        yield self._rows(CHASER_ODOMETRY, told, begin, columns_of.chaser_odometry)
        yield self._rows(TARGET_ODOMETRY, told, begin, columns_of.target_odometry)
        yield self._rows(CONTACT_WRENCH, told, begin, columns_of.contact_wrenches)
        yield self._rows(JOINT_STATES, told, begin, columns_of.joint_states)

    def _rows(
        self,
        topic: Topic,
        samples: np.ndarray,
        seq: int,
        columns: Callable[[np.ndarray], columns_of.Columns],
    ) -> Rows:
        example = self._example(topic, samples[0])
        return self._filled(topic, example, samples["t"], seq, columns(samples))

    def _filled(
        self,
        topic: Topic,
        example: Message,
        t: np.ndarray,
        seq: int,
        columns: columns_of.Columns,
    ) -> Rows:
        stamps = columns_of.stamps_ns(t)
        path = "clock" if topic.stamp is Stamp.CLOCK else "header.stamp"
        columns = {**columns_of.stamp_columns(stamps, path), **columns}
        if topic.sequenced:
            columns["seq"] = np.arange(seq, seq + len(t))
        return Rows(topic, stamps, Template(self._store, topic.type_name, example).fill(columns))

    def _example(self, topic: Topic, sample: np.void) -> Message:
        make = self._messages
        if topic is CONTACT_STATE:
            return make.contact_state(0, sample, SinceLastMessage(0.0, 0.0, 0))
        if topic is STRING_STATE:
            return make.string_state(0, sample, has_string=True, rail_heading=0.0)
        if topic is CLOCK:
            return make.clock(0.0)
        if topic is BENCH_STATE or topic is BUFFER_STATE:
            of_seq = {BENCH_STATE: make.bench_state, BUFFER_STATE: make.buffer_state}
            return of_seq[topic](0, sample)
        plain = {
            CHASER_ODOMETRY: make.chaser_odometry,
            TARGET_ODOMETRY: make.target_odometry,
            CONTACT_WRENCH: make.contact_wrench,
            JOINT_STATES: make.joint_states,
        }
        return plain[topic](sample)

    def _events(self, chosen: np.ndarray) -> Iterator[Rows]:
        for seq in chosen.tolist():
            event = self._result.events[seq]
            data = self._store.serialize_cdr(
                self._messages.bench_event(seq, event), BENCH_EVENT.type_name
            )
            time = columns_of.stamps_ns(np.array([event.t]))
            yield Rows(BENCH_EVENT, time, np.frombuffer(data, dtype=np.uint8)[np.newaxis])

    def _traced(self, chosen: np.ndarray) -> Iterator[Rows]:
        times = self._result.samples["t"][self._trace_places[chosen]]
        stamps = columns_of.stamps_ns(times)
        for i, (seq, t) in enumerate(zip(chosen.tolist(), times.tolist(), strict=True)):
            data = self._store.serialize_cdr(
                self._messages.contact_trace(seq, t, self._points(seq)), CONTACT_TRACE.type_name
            )
            row = np.frombuffer(data, dtype=np.uint8)[np.newaxis]
            yield Rows(CONTACT_TRACE, stamps[i : i + 1], row)

    def _points(self, seq: int) -> np.ndarray:
        """Return the points of the trace's message of that number."""
        starts = [*self._trace_starts.tolist(), len(self._trace)]
        return self._trace[starts[seq] : starts[seq + 1]]

    def _launcher_states(self, told: np.ndarray, begin: int) -> Iterator[Rows]:
        scene = self._result.scene
        speeds = columns_of.speeds_along(scene.initial.chaser.theta, told["v"]).tolist()
        phases = columns_of.string_phases(told, has_string=scene.string is not None)
        slack = (phases == int(StringPhase.SLACK)).tolist()
        touched = (told["touches"] > 0).tolist()
        observe = self._launcher.observe
        statuses = [
            observe(speed, is_slack, touch)
            for speed, is_slack, touch in zip(speeds, slack, touched, strict=True)
        ]
        for start, some in _alike(statuses):
            example = self._messages.launcher_state(0, 0.0, some[0])
            t = told["t"][start : start + len(some)]
            # two states were sent at the release
            seq = begin + 2 + start
            columns = columns_of.launcher_states(some)
            yield self._filled(LAUNCHER_STATE, example, t, seq, columns)

    def _capture_states(self, judged: np.ndarray) -> Iterator[Rows]:
        first = int(judged[0])
        statuses = self._judged[first : first + len(judged)]
        for start, some in _alike(statuses):
            example = self._messages.capture_status(0, 0.0, some[0])
            t = np.array([status.t for status in some])
            columns = columns_of.capture_statuses(some)
            yield self._filled(CAPTURE_STATUS, example, t, first + start, columns)


_Status = TypeVar("_Status", "CaptureStatus", "LauncherStatus")


def _alike(statuses: Sequence[_Status]) -> Iterator[tuple[int, Sequence[_Status]]]:
    """Yield the stretches of statuses that give the same reason, and where each starts."""
    start = 0
    for _, group in groupby(statuses, key=attrgetter("reason")):
        some = list(group)
        yield start, some
        start += len(some)
