"""A recording of one run: its topics, its origin, its clock, and the parts that it lacks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import TypeVar

import numpy as np

from capture_sim.base.software import newer_line, newer_version
from capture_sim.detection.criteria import CaptureStatus
from capture_sim.dynamics.samples import (
    TOUCH,
    Event,
    Extremes,
)
from capture_sim.errors import RecordingError, one_line
from capture_sim.messages.convert import LaunchAction, RunDescription
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    CAPTURE_STATUS,
    CHASER_ODOMETRY,
    CHASER_POSE,
    HOLD,
    LAUNCH_COMMAND,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    TARGET_ODOMETRY,
    TARGET_POSE,
    Topic,
    topic_named,
)
from capture_sim.recording.bag_folder import stem_of
from capture_sim.recording.clock import Clock, Logged, find_clock, has_stamps, stamps_of
from capture_sim.recording.contents import Contents, read_contents, rename_topics
from capture_sim.recording.losses import is_cut, losses
from capture_sim.recording.recorded_bench import (
    criteria_in,
    events_in,
    samples_in,
    statuses_in,
    trace_in,
)
from capture_sim.recording.recorded_topics import Columns, RecordedTopics
from capture_sim.recording.records import MAX_UNPACKED_RATIO
from capture_sim.recording.write import (
    END_METADATA,
    REMAPS,
    RUN_METADATA,
    SCENE_ATTACHMENT,
    describing,
)
from capture_sim.run.loads import extremes_from_text, with_forces_of_touches
from capture_sim.run.series import Series, in_order
from capture_sim.scene.loading import load_scene_text
from capture_sim.scene.parts import Detector, Scene

_T = TypeVar("_T")


def read_bag(
    path: Path | str,
    ratio: float = MAX_UNPACKED_RATIO,
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
        The file cannot be read or is of another kind, or a topic of ``remaps`` is not in it.
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


class Bag(RecordedTopics):
    """A recording.  Topics are decoded at their first use; times are s since the release."""

    def __init__(self, path: Path, contents: Contents, release: float | None = None) -> None:
        super().__init__(path, contents)
        self._given_release = release

    # complete or not

    @property
    def complete(self) -> bool:
        """True if the file was closed properly and no message is missing from it."""
        return not self.problems

    @property
    def problems(self) -> tuple[str, ...]:
        """One line for everything that is wrong with the recording; empty when complete."""
        return tuple(map(one_line, (*self.damage, *self.missing)))

    @property
    def left_out(self) -> tuple[str, ...]:
        """One line for all that is left out or odd, and one for a recording by a newer version."""
        newer = [] if not self.newer_version else [newer_line(self.newer_version)]
        reasons = dict(self._contents.left_out)
        for name, messages in self._contents.messages.items():
            topic, type_name = topic_named(name), self._contents.types[name]
            if topic is not None and messages and topic.type_name != type_name:
                reasons[name] = f"type = {type_name or 'none'}: must be {topic.type_name}"
        left_out = (f"{topic}: left out: {reason}" for topic, reason in reasons.items())
        return *newer, *left_out, *self._contents.doubts

    @property
    def newer_version(self) -> str:
        """Version of this package that made the recording, if it is above ours; else empty."""
        return newer_version(self.metadata.get("software", "").split("\n"))

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """A line for each loss and early end, by sequence numbers and reported counts."""
        if len(self.run_ids) > 1:
            return (f"contains {len(self.run_ids)} runs: lost messages cannot be counted",)
        # when the recording was cut, their counts are missing too
        return losses(self, self._publishers if self._contents.has_verified_end else ())

    @property
    def cut(self) -> bool:
        """True if the end of the run is missing: ended early, or not all recorded."""
        if SIMULATOR in self._publishers:
            return is_cut(self)
        return bool(self.damage)

    @cached_property
    def has_end(self) -> bool:
        """True if the end of the run is recorded.

        That is the simulator's report, also of a run that it ended early; of a real bench, in an
        undamaged file, a final status of the detector, the counts that a node sends at the end, or
        a chaser that is held again.
        """
        if SIMULATOR in self._publishers:
            return SIMULATOR in self.columns_if_typed(STREAM_COUNTS).get("publisher", ())
        if self.damage:
            return False
        has_verdict = self.holds(CAPTURE_STATUS) and self.statuses[-1].final
        return has_verdict or self.holds(STREAM_COUNTS) or self._is_held

    @property
    def _is_held(self) -> bool:
        """True if the last message to the holding device holds the chaser."""
        if not self.has(HOLD) or self.types.get(f"/{HOLD}") != "std_msgs/msg/Bool":
            return False
        return bool(self.columns(HOLD)["data"][-1])

    # how it was made

    @property
    def _publishers(self) -> list[str]:
        return list(filter(None, self.metadata.get("publishers", "").split("\n")))

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata of the run: run_id, name, scene_sha256, software, rates."""
        stored = self._contents.metadata.get(RUN_METADATA, {})
        # unlike a metadata record, a message has a checksum in every file
        return {**stored, **({} if self.announced is None else describing(self.announced))}

    @property
    def name(self) -> str:
        """Name of the experiment; of the file if that has none."""
        return self.metadata.get("name") or stem_of(self.path)

    @property
    def run_id(self) -> str:
        """Unique id of the run; empty if the file has none."""
        return self.metadata.get("run_id", "")

    @property
    def run_ids(self) -> tuple[str, ...]:
        """Ids of the announced runs, in order."""
        return tuple(dict.fromkeys(self.columns_if_typed(RUN_INFO).get("run_id", ())))

    @cached_property
    def announced(self) -> RunDescription | None:
        """The announcement, which `ros2 bag record` keeps; None unless it is of one run."""
        if len(self.run_ids) != 1:
            return None
        fields = {name: column[0] for name, column in self.columns(RUN_INFO).items()}
        return RunDescription.of_message(SimpleNamespace(**fields))

    @property
    def has_scene(self) -> bool:
        """True if the file contains the scene that made the run."""
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
    def scene(self) -> Scene:
        """The scene that made the run.

        RecordingError if the file contains none, SceneError if it is not one of this version.
        """
        return load_scene_text(self.scene_text, only_known=bool(self.newer_version))

    @property
    def is_simulated(self) -> bool:
        """True if a simulator sent the run: one clock stamps all of it."""
        is_announced = self.announced is not None and SIMULATOR in self.announced.publishers
        return is_announced or self.holds(BENCH_STATE)

    # clock and series

    @cached_property
    def clock(self) -> Clock:
        """The release, and the clocks by which times count from it.

        The release is the first of these that exists: the given release; that of a simulated run;
        the launcher's command, by its stamp or by its arrival; the announcement of the trial; the
        first pose; the first message.  RecordingError if the given release is not between the first
        and the last pose.
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
            if fields := self.columns_if_typed(topic):
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

    def series(self, topic: Topic, values: Callable[[Columns], np.ndarray]) -> Series:
        """Return the series of a topic's stamped messages.

        ``values`` computes (n,) or (n, m) values from the columns of n messages.  Messages that
        cannot be decoded are left out; MessageError if none can be decoded.
        """
        columns, log_times = self.readable(topic)
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

    # what the suite's nodes recorded

    @cached_property
    def samples(self) -> np.ndarray:
        """The recorded BenchStates, (n,) of dtype SAMPLE; bit-identical if t = 0 at 1 s."""
        return samples_in(self, self.clock.t_release)

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """The recorded BenchEvents, in order."""
        return events_in(self, self.clock.t_release, only_known=bool(self.newer_version))

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
        return trace_in(self, self.clock.t_release)

    @cached_property
    def statuses(self) -> tuple[CaptureStatus, ...]:
        """The detector's statuses, in order."""
        return statuses_in(self, self.clock)

    @cached_property
    def criteria(self) -> Detector | None:
        """The detector's criteria; None if not recorded, SceneError if a value is invalid."""
        return criteria_in(self)

    @property
    def verdict(self) -> str | None:
        """The detector's last state; None if not recorded."""
        return self.statuses[-1].state.label if self.statuses else None

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


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 0.0 <= seconds < math.inf:
        raise ValueError(text)
    return seconds
