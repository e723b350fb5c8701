"""A recording: a file or a folder of files, with its topics as columns, clock and losses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from rosbags.typesys.store import Typestore

from capture_sim.base.software import newer_line, newer_version
from capture_sim.detection.criteria import CaptureState, CaptureStatus
from capture_sim.detection.measurements import Counts, Reason, Source
from capture_sim.dynamics.samples import (
    SAMPLE,
    TOUCH,
    TRACE,
    Event,
    EventKind,
    Extremes,
    Phase,
)
from capture_sim.errors import MessageError, RecordingError, one_line
from capture_sim.messages.cdr import Layout, columns, sequence_of
from capture_sim.messages.convert import CRITERIA, LaunchAction, RunDescription
from capture_sim.messages.definitions import NO_DEFINITION, store_of
from capture_sim.messages.evolution import absent_fields, completed
from capture_sim.messages.measurements import OF_A_BENCH, MeasurementReader, NoJointsError
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    CAPTURE_CRITERIA,
    CAPTURE_STATUS,
    CHASER_ODOMETRY,
    CHASER_POSE,
    CONTACT_TRACE,
    LAUNCH_COMMAND,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    TARGET_ODOMETRY,
    TARGET_POSE,
    Topic,
    topic_named,
)
from capture_sim.recording.clock import Clock, Logged, find_clock, has_stamps, stamps_of
from capture_sim.recording.completeness import Completeness
from capture_sim.recording.contents import Contents, read_contents, rename_topics
from capture_sim.recording.scan import UNPACKED_RATIO
from capture_sim.recording.write import (
    END_METADATA,
    REMAPS,
    RUN_METADATA,
    SCENE_ATTACHMENT,
    describing,
)
from capture_sim.run.results import extremes_from_text, with_forces_of_touches
from capture_sim.run.series import Series, in_order
from capture_sim.scene.loading import load_scene_text
from capture_sim.scene.parts import Detector

if TYPE_CHECKING:
    from capture_sim.scene.parts import Scene

Columns = Mapping[str, np.ndarray]

_T = TypeVar("_T")
# events that end a touch
_ENDED = (EventKind.LIFT_OFF.label, EventKind.END.label)


def read_bag(
    path: Path | str,
    ratio: float = UNPACKED_RATIO,
    *,
    remaps: Mapping[str, str] | None = None,
    release: float | None = None,
) -> Bag:
    """Read a recording, a file or a bag's folder; checksums are checked.

    It may be a bag of a real bench with the same topics, without a scene, or with several runs:
    a topic that is not in it is empty.  A truncated or damaged file is read up to the damage, and
    marked by ``complete`` and ``damage``.  Messages are sorted by their log times.

    Parameters
    ----------
    path
        The file or folder.
    ratio
        Upper limit of the unpacked size, as a multiple of the file's size.
    remaps
        Recorded names of topics by the bench's names, e.g.
        ``{"chaser/odom": "/mocap/rb1/odom"}``, in addition to those that the recorder has noted.
    release
        Release time, s after the first pose; None to find it, see :attr:`Bag.clock`.

    Raises
    ------
    RecordingError
        The file cannot be read or is not an MCAP file, or a topic of ``remaps`` is not in it.
    """
    path = Path(path)
    contents = read_contents(path, ratio)
    try:
        remap(contents, remaps or {})
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None
    return Bag(path, contents, release)


def remap(contents: Contents, remaps: Mapping[str, str]) -> None:
    """Give topics the bench's names, by the recorder's notes and ``remaps``."""
    noted = contents.metadata.get(RUN_METADATA, {}).get(REMAPS, "").splitlines()
    pairs = [line.partition(":=")[::2] for line in noted]
    rename_topics(contents, {name: topic for name, topic in pairs if topic in contents.types})
    names = {f"/{n.lstrip('/')}": f"/{topic.lstrip('/')}" for n, topic in remaps.items()}
    rename_topics(contents, names)


def remap_of(text: str) -> tuple[str, str]:
    """Return the bench's name and the recorded one of ``TOPIC:=RECORDED_TOPIC``."""
    name, separator, recorded_name = text.partition(":=")
    if not separator or not recorded_name.strip("/") or topic_named(name) is None:
        raise RecordingError(
            f"remap {text!r}: must be TOPIC:=RECORDED_TOPIC, e.g. chaser/odom:=/mocap/rb1/odom"
        )
    return name, recorded_name


class Bag:
    """A recording.  Topics are decoded at their first use; times are s since the release."""

    def __init__(self, path: Path, contents: Contents, release: float | None = None) -> None:
        self.path = path
        #: A line for each file that could not be read to its end.
        self.damage = contents.damage
        self._contents = contents
        self._given_release = release
        self._columns: dict[str, Columns] = {}  # as in the file
        self._completed: dict[Topic, Columns] = {}
        self._measured: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    @property
    def complete(self) -> bool:
        """Whether the file was closed properly and no message is missing from it."""
        return not self.problems

    @property
    def problems(self) -> tuple[str, ...]:
        """One line for everything that is wrong with the recording; empty when complete."""
        return tuple(map(one_line, (*self.damage, *self.missing)))

    @property
    def left_out(self) -> tuple[str, ...]:
        """One line for every topic that is left out, and one for a recording by a newer version."""
        newer = [] if not self.newer_version else [newer_line(self.newer_version)]
        reasons = dict(self._contents.left_out)
        for name, messages in self._contents.messages.items():
            topic, type_name = topic_named(name), self._contents.types[name]
            if topic is not None and messages and topic.type_name != type_name:
                reasons[name] = f"type = {type_name or 'none'}: must be {topic.type_name}"
        left_out = (f"{topic}: left out: {reason}" for topic, reason in reasons.items())
        return *newer, *left_out

    @property
    def newer_version(self) -> str:
        """Version of this package that made the recording, if it is above ours; else empty."""
        return newer_version(self.metadata.get("software", "").split("\n"))

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """A line for each loss and early end, by sequence numbers and reported counts."""
        if len(self.run_ids) > 1:
            return (f"contains {len(self.run_ids)} runs: lost messages cannot be counted",)
        recorded = {
            topic: messages
            for name, messages in self._contents.messages.items()
            if (topic := topic_named(name)) and self._contents.types[name] == topic.type_name
        }
        # when the recording was cut, their counts are missing too
        publishers = self._publishers if self._contents.has_verified_end else ()
        completeness = Completeness(publishers, list(recorded))
        uncounted = []
        for topic, messages in recorded.items():
            try:
                if messages and topic.sequenced:
                    self.store_of_topic(topic)  # with other fields, the number stands elsewhere
                for data in messages:
                    completeness.add(topic, sequence_of(topic, data))
            except MessageError as error:
                raise RecordingError(f"{self.path}: {error}") from None
            except RecordingError as error:
                reason = str(error).removeprefix(f"{self.path}: ")
                uncounted.append(f"lost messages cannot be counted: {reason}")
        ends = self._of_its_type(STREAM_COUNTS)
        for i, publisher in enumerate(ends.get("publisher", ())):
            topics, counts = ends["topics"][i], ends["counts"][i].tolist()
            if len(topics) != len(counts):
                raise RecordingError(
                    f"{self.path}: {STREAM_COUNTS.name}: {len(topics)} topics, {len(counts)} counts"
                )
            completeness.end(
                publisher,
                dict(zip(topics, counts, strict=True)),
                complete=bool(ends["complete"][i]),
                reason=ends["reason"][i],
            )
        return (*uncounted, *completeness.problems())

    @property
    def cut(self) -> bool:
        """Whether the end of a simulator's run is missing: ended early, or not all recorded."""
        if SIMULATOR not in self._publishers:
            return False
        ends = self._of_its_type(STREAM_COUNTS)
        ended = zip(ends.get("publisher", ()), ends.get("complete", ()), strict=True)
        return not any(publisher == SIMULATOR and complete for publisher, complete in ended)

    @property
    def _publishers(self) -> list[str]:
        return list(filter(None, self.metadata.get("publishers", "").split("\n")))

    def has(self, topic: str | Topic) -> bool:
        """Return True if a topic has messages, of whatever type."""
        name = topic if isinstance(topic, str) else topic.name
        return bool(self._contents.messages.get(self._resolved(name)))

    def _of_its_type(self, topic: Topic) -> Columns:
        """Return a topic's columns; empty if the file has it with another type."""
        return self.columns(topic) if self.holds(topic) else {}

    def holds(self, topic: Topic) -> bool:
        """Return True if the file holds messages of the topic, and of its type."""
        name = self._resolved(topic.name)
        is_typed = self._contents.types.get(name) == topic.type_name
        return is_typed and bool(self._contents.messages[name])

    @property
    def metadata(self) -> dict[str, str]:
        """How the run was made: run_id, name, scene_sha256, software, rates."""
        stored = self._contents.metadata.get(RUN_METADATA, {})
        # unlike a metadata record, a message has a checksum in every file
        return {**stored, **({} if self.announced is None else describing(self.announced))}

    @property
    def name(self) -> str:
        """Name of the experiment; of the file if that has none."""
        return self.metadata.get("name", self.path.stem)

    @property
    def run_id(self) -> str:
        """Unique id of the run; empty if the file has none."""
        return self.metadata.get("run_id", "")

    @property
    def run_ids(self) -> tuple[str, ...]:
        """Ids of the announced runs, in order."""
        return tuple(dict.fromkeys(self._of_its_type(RUN_INFO).get("run_id", ())))

    @property
    def wall_time(self) -> float | None:
        """Duration of the run, s of wall time; None if the recording ended before it."""
        return self._known_at_end("wall_time", _seconds, "must be a number of seconds >= 0")

    @property
    def extremes(self) -> Extremes | None:
        """Strokes, torsion and forces between the samples too; None if not recorded."""
        extremes = self._known_at_end("extremes", extremes_from_text, "not as written")
        if extremes is None or not self.holds(BENCH_EVENT):
            return extremes
        return with_forces_of_touches(extremes, self.touches, self.events)

    def _known_at_end(self, name: str, parse: Callable[[str], _T], otherwise: str) -> _T | None:
        text = self._contents.metadata.get(END_METADATA, {}).get(name)
        if text is None or not self._contents.has_verified_end:
            return None
        try:
            return parse(text)
        except ValueError:
            raise RecordingError(f"{self.path}: {name} = {text[:40]!r}: {otherwise}") from None

    @property
    def has_scene(self) -> bool:
        """Whether the file contains the scene that made the run."""
        return SCENE_ATTACHMENT in self._contents.attachments or self.announced is not None

    @property
    def scene_text(self) -> str:
        """The resolved scene, YAML; RecordingError if the file contains none."""
        if self.announced is not None:
            return self.announced.scene
        if SCENE_ATTACHMENT in self._contents.attachments:
            try:
                return self._contents.attachments[SCENE_ATTACHMENT].decode()
            except UnicodeDecodeError:
                raise RecordingError(f"{self.path}: {SCENE_ATTACHMENT}: is not text") from None
        raise RecordingError(f"{self.path}: contains no scene")

    @cached_property
    def announced(self) -> RunDescription | None:
        """The announcement, which `ros2 bag record` keeps; None unless it is of one run."""
        if len(self.run_ids) != 1:
            return None
        fields = {name: column[0] for name, column in self.columns(RUN_INFO).items()}
        return RunDescription.of_message(SimpleNamespace(**fields))

    @cached_property
    def scene(self) -> Scene:
        """The scene that made the run.

        RecordingError if the file contains none, SceneError if it is not one of this version.
        """
        return load_scene_text(self.scene_text, only_known=bool(self.newer_version))

    @property
    def is_simulated(self) -> bool:
        """Whether a simulator sent the run: one clock stamps all of it."""
        is_announced = self.announced is not None and SIMULATOR in self.announced.publishers
        return is_announced or self.holds(BENCH_STATE)

    @cached_property
    def clock(self) -> Clock:
        """The release, and the clocks that times count from it by.

        That is the given release, else that of a simulated run, else that of the launcher's
        command, by its stamp or by its arrival, else the announcement of the trial, else the
        first pose, else the first message.  RecordingError if the given release is not between the
        first and the last pose.
        """
        motion = (CHASER_POSE, CHASER_ODOMETRY, TARGET_POSE, TARGET_ODOMETRY, BENCH_STATE)
        release = self._logged(LAUNCH_COMMAND)
        if release is not None:
            is_release = self.columns(LAUNCH_COMMAND)["action"] == LaunchAction.RELEASE
            release = Logged(*(times[is_release] for times in release))
        if release is None or not release.stamps.size:
            release = self._logged(RUN_INFO)
        return find_clock(
            next(filter(None, map(self._logged, motion)), None),
            release,
            min((times[0] for times in self._contents.log_times.values() if times), default=0),
            is_simulated=self.is_simulated,
            given_release=self._given_release,
        )

    def _logged(self, topic: Topic) -> Logged | None:
        """Return stamps and log times of a topic; None if it has no readable message."""
        with suppress(RecordingError):  # reported where the messages themselves are used
            if fields := self._of_its_type(topic):
                return Logged(stamps_of(fields), self.log_times(topic))
        return None

    def times(self, topic: str | Topic) -> np.ndarray:
        """Return when a topic's messages were stamped, else logged, (n,), s since the release."""
        fields = self.columns(topic)
        if not has_stamps(fields):
            return self.clock.since_by_log(self.log_times(topic))
        bench_topic = topic if isinstance(topic, Topic) else topic_named(topic)
        if bench_topic is None or (
            SIMULATOR in bench_topic.publishers and bench_topic is not RUN_INFO
        ):
            return self.clock.since(stamps_of(fields))
        return self.clock.since_by_trial(stamps_of(fields))

    @property
    def topics(self) -> dict[str, int]:
        """Number of messages by topic, as named in the file."""
        return {name: len(messages) for name, messages in self._contents.messages.items()}

    @property
    def types(self) -> dict[str, str]:
        """Type of every topic (``package/msg/Name``), as named in the file."""
        return self._contents.types

    def log_times(self, topic: str | Topic) -> np.ndarray:
        """Return the log times of a topic's messages, (n,) int64, ns, ascending."""
        return np.array(self._contents.log_times.get(self._resolved(topic), ()), dtype=np.int64)

    def raw(self, topic: str | Topic) -> list[bytes]:
        """Return the serialised messages of a topic, in the order of their log times.

        RecordingError if the topic is one of the bench's and has another type in the file.
        """
        return list(self._contents.messages.get(self._resolved(topic), ()))

    def columns(self, topic: str | Topic) -> Columns:
        """Return a topic's fields by path, see :func:`capture_sim.messages.cdr.columns`.

        Empty for a topic without messages.  A topic of the bench has all fields of its type: those
        that came after the recording have their defaults; a topic given by name has those in the
        file.  RecordingError if the messages do not fit their definition, if that lacks a field
        without a default, or if a topic of the bench has another type in the file.
        """
        name = self._resolved(topic)
        if isinstance(topic, Topic) and self._contents.messages.get(name):
            self.store_of_topic(topic)
        if name not in self._columns:
            self._columns[name] = self._decoded(name)
        if isinstance(topic, str) or not self._columns[name]:
            return self._columns[name]
        if topic not in self._completed:
            of_type = self.store_of_topic(topic), topic.type_name
            self._completed[topic] = completed(self._columns[name], *of_type)
        return self._completed[topic]

    def _decoded(self, name: str) -> Columns:
        messages = self._contents.messages.get(name)
        if not messages:
            return {}
        type_name = self._contents.types[name]
        try:
            return columns(self.store_for(type_name), type_name, messages)
        except RecursionError:
            raise RecordingError(
                f"{self.path}: definition of type {type_name!r} contains itself"
            ) from None
        except MessageError as error:
            raise self._unreadable(name, error) from None

    def store_of_topic(self, topic: Topic) -> Typestore:
        """Return the store of a topic's type; RecordingError if that lacks a field without default.

        All that reads fields of the bench's topics comes by here.
        """
        store = self.store_for(topic.type_name)
        try:
            absent_fields(store, topic.type_name)
        except MessageError as error:
            raise RecordingError(f"{self.path}: {topic.name}: {error}") from None
        return store

    def _unreadable(self, name: str, error: MessageError) -> MessageError:
        return MessageError(f"{self.path}: {name.lstrip('/')}: {error}")

    def series(self, topic: Topic, values: Callable[[Columns], np.ndarray]) -> Series:
        """Return the series of a topic's stamped messages.

        ``values`` computes (n,) or (n, m) values from the columns of n messages.  Messages that
        cannot be decoded are left out; MessageError if none can be decoded.
        """
        columns, log_times = self._readable(topic)
        return self.in_order(stamps_of(columns), values(columns), log_times)

    def in_order(
        self,
        stamps: np.ndarray,
        values: np.ndarray,
        log_times: np.ndarray,
        angle: int | None = None,
    ) -> Series:
        """Return messages with stamps and log times, (n,), ns, as a series.

        ``angle`` is the column of an angle, which is unwrapped.
        """
        times = self.clock.since(stamps), values, self.clock.since_by_log(log_times)
        return in_order(*times, angle)

    def measured(self, topic: Topic) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return stamps (n,), ns, values (n, m) and log times (n,), ns, of a detector's source.

        Rates that a message lacks are NaN.  Messages that cannot be decoded, and those of other
        joints, are left out; MessageError if none can be decoded.
        """
        if topic.name not in self._measured:
            self._measured[topic.name] = self._measurements(topic)
        return self._measured[topic.name]

    def _measurements(self, topic: Topic) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        messages = self.raw(topic)
        store = self.store_of_topic(topic) if messages else self.store_for(topic.type_name)
        read = MeasurementReader(topic, store)
        rows, size, first_error = [], OF_A_BENCH[topic].size, None
        for log_time, data in zip(self.log_times(topic).tolist(), messages, strict=True):
            try:
                stamp, values = read(data)
            except NoJointsError:
                continue
            except MessageError as error:  # a damaged message must not hide the others
                first_error = first_error or error
                continue
            values += (math.nan,) * (2 * size - len(values))
            rows.append((stamp, log_time, values))
        if first_error is not None and not rows:
            raise self._unreadable(topic.name, first_error)
        stamps, log_times = (np.array([row[i] for row in rows], dtype=np.int64) for i in (0, 1))
        return stamps, np.array([row[2] for row in rows]).reshape(-1, 2 * size), log_times

    def _readable(self, topic: Topic) -> tuple[Columns, np.ndarray]:
        """Return columns and log times, ns, of the messages of a topic that fit its type."""
        log_times = self.log_times(topic)
        try:
            return self.columns(topic), log_times
        except MessageError:  # a damaged message must not hide the others
            messages = self.raw(topic)
            fits = [self._fits(topic, data) for data in messages]
            if not any(fits):
                raise
            store = self.store_for(topic.type_name)
            kept = [data for data, is_kept in zip(messages, fits, strict=True) if is_kept]
            fields = columns(store, topic.type_name, kept)
            return completed(fields, store, topic.type_name), log_times[np.array(fits)]

    def _fits(self, topic: Topic, data: bytes) -> bool:
        try:
            Layout(self.store_for(topic.type_name), topic.type_name, data)
        except MessageError:
            return False
        return True

    @cached_property
    def samples(self) -> np.ndarray:
        """The recorded BenchStates, (n,) of dtype SAMPLE; bit-identical if t = 0 at 1 s."""
        recorded = self.columns(BENCH_STATE)
        samples = np.zeros(len(recorded.get("t", ())), dtype=SAMPLE)
        if len(samples):
            for name in SAMPLE.names or ():
                samples[name] = recorded[name]
            self._check_numbers(BENCH_STATE, "phase", samples["phase"], Phase)
            samples["t"] -= self.clock.t_release
        samples.flags.writeable = False
        return samples

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """The recorded BenchEvents, in order."""
        recorded = self.columns(BENCH_EVENT)
        kinds = {kind.label: kind for kind in EventKind}
        labels = recorded.get("kind", ())
        unknown = [label for label in labels if label not in kinds]
        if unknown and not self.newer_version:
            raise RecordingError(f"{self.path}: event of unknown kind {unknown[0]!r}")
        t_release = self.clock.t_release
        return tuple(
            Event(
                kind=kinds[label],
                t=float(recorded["t"][i]) - t_release,
                q=recorded["q"][i],
                v=recorded["v"][i],
                wall=int(recorded["wall"][i]),
                detail=recorded["detail"][i],
                touch=_touch(recorded, i, t_release),
            )
            for i, label in enumerate(labels)
            if label in kinds
        )

    @cached_property
    def touches(self) -> np.ndarray:
        """The touches that ended, (n,) of dtype TOUCH, in the order in which they ended."""
        ended = [event.touch for event in self.events if event.touch is not None]
        return np.array(ended, dtype=TOUCH)

    @cached_property
    def trace(self) -> np.ndarray:
        """The contact at the integrator's own steps, (n,) of dtype TRACE.

        Empty unless the scene requests it (``run.trace``).
        """
        recorded = self.columns(CONTACT_TRACE.name)
        counts = [len(t) for t in recorded.get("t", ())]
        trace = np.zeros(sum(counts), dtype=TRACE)
        for name in (TRACE.names or ()) if counts else ():
            trace[name] = np.concatenate(list(recorded[name])).reshape(trace[name].shape)
        trace["t"] -= self.clock.t_release
        trace.flags.writeable = False
        return trace

    @cached_property
    def statuses(self) -> tuple[CaptureStatus, ...]:
        """The detector's statuses, in order."""
        recorded = self.columns(CAPTURE_STATUS)
        if not recorded:
            return ()
        self._check_numbers(CAPTURE_STATUS, "state", recorded["state"], CaptureState)
        by_name: dict[str, list[Any]] = {
            name: recorded[name].tolist() for name in CaptureStatus._fields if name in recorded
        }
        by_name["t"] = self.clock.since(stamps_of(recorded)).tolist()
        by_name["state"] = [CaptureState(state) for state in by_name["state"]]
        rows = zip(*by_name.values(), strict=True)
        *earlier, last = (CaptureStatus(**dict(zip(by_name, row, strict=True))) for row in rows)
        return *earlier, last._replace(not_used=_rejected_in(recorded))

    @cached_property
    def criteria(self) -> Detector | None:
        """The detector's criteria; None if not recorded, SceneError if a value is invalid."""
        recorded = self.columns(CAPTURE_CRITERIA)
        if not recorded:
            return None
        return Detector(**{field: float(recorded[name][-1]) for name, field in CRITERIA.items()})

    @property
    def verdict(self) -> str | None:
        """The detector's last state; None if not recorded."""
        return self.statuses[-1].state.label if self.statuses else None

    def _check_numbers(
        self, topic: Topic, name: str, values: np.ndarray, kinds: type[IntEnum]
    ) -> None:
        highest = max(kinds)
        if (wrong := values[values > highest]).size:
            raise RecordingError(
                f"{self.path}: {topic.name}: {name} = {wrong[0]}: must be 0 to {highest}"
            )

    def store_for(self, type_name: str) -> Typestore:
        """Return a store that knows the type as this file defines it."""
        text = self._contents.schemas.get(type_name, "")
        try:
            return store_of(type_name, text)
        except NO_DEFINITION as error:
            reason = " ".join(str(error).split())
            raise RecordingError(
                f"{self.path}: definition of type {type_name!r} cannot be read: {reason}"
            ) from None

    def _resolved(self, topic: str | Topic) -> str:
        name = topic if isinstance(topic, str) else topic.name
        absolute = name if name.startswith("/") else f"/{name}"
        name = absolute if absolute in self._contents.messages else name
        if isinstance(topic, Topic):
            type_name = self._contents.types.get(name, topic.type_name)
            if type_name != topic.type_name:
                raise RecordingError(
                    f"{self.path}: type of {name} = {type_name or 'none'}: must be "
                    f"{topic.type_name}"
                )
        return name


def _rejected_in(recorded: Columns) -> str:
    """Return the numbers of measurements that were not used until the last status, as a text.

    Empty for an older recording, which has none.
    """
    counts = Counts()
    for source in Source:
        for numbers in recorded.get(f"{source.value}_rejected", ())[-1:]:
            for reason, number in zip(Reason, numbers.tolist(), strict=True):
                counts.reject(source, reason, number)
    return counts.text


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 0.0 <= seconds < math.inf:
        raise ValueError(text)
    return seconds


def _touch(recorded: Columns, i: int, t_release: float) -> np.void | None:
    """Return the touch that event i ended, times since the release; None if it ended none."""
    if recorded["kind"][i] not in _ENDED or recorded["wall"][i] == 0:
        return None
    touch: np.void = np.zeros(1, dtype=TOUCH)[0]
    touch["start"] = recorded["touch_start"][i]
    touch["end"] = recorded["t"][i]
    touch["rate_ratio"] = math.nan  # no message carries it
    for name in ("wall", "approach_speed", "peak_force", "peak_time", "impulse", "dissipated"):
        touch[name] = recorded[name][i]
    for name in ("start", "end", "peak_time"):
        touch[name] -= t_release
    return touch
