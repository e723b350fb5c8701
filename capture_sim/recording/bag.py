"""A recording: its topics, the run that it contains, its clock, and what is missing from it."""

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
from capture_sim.messages.definitions import NO_DEFINITION, store_of
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
from capture_sim.recording.trials import TRIAL, keep_trial
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
from capture_sim.trial.hold import HOLD_TIMEOUT

_T = TypeVar("_T")


def read_bag(
    path: Path | str,
    *,
    remaps: Mapping[str, str] | None = None,
    release: float | None = None,
    trial: int | None = None,
) -> Bag:
    """Read a recording from a file or from a bag's folder, and check its checksums.

    The recording may come from this package or from a real bench with the same topics.  It may
    lack a scene, and it may contain several runs.  A topic without messages gives empty results.
    A truncated or damaged file is read up to the damage; :attr:`Bag.damage` then has a line for
    it and :attr:`Bag.complete` is False.  The messages of each topic are sorted by log time.

    Parameters
    ----------
    path
        The file or folder.  A file may unpack to 100 times its size, and to 64 MiB in any case.
    remaps
        The topics that were recorded under a name other than the bench's: maps the bench's name to
        the recorded name, e.g. ``{"chaser/odom": "/mocap/rb1/odom"}``.  Names that the recorder
        itself has noted in the file need not be given.
    release
        Release time, s after the first pose; None to find it, see :attr:`Bag.clock`, which raises
        RecordingError if this time is outside of the recording.
    trial
        Number of the trial to read, counted from 1, if several are in one recording; None for that
        of the command line, or the whole recording.

    Raises
    ------
    RecordingError
        The file cannot be read or is not a recording, or a topic of ``remaps`` is in it under
        neither name or under both names, or there is no such trial.
    """
    path = Path(path)
    contents = read_contents(path)
    remap(path, contents, remaps or {})
    if number := TRIAL.get() if trial is None else trial:
        keep_trial(path, contents, number)
    _leave_out_undefined(contents)
    return Bag(path, contents, release)


def _leave_out_undefined(contents: Contents) -> None:
    """Leave out the topics of the suite whose definition in the file cannot be read."""
    for name, type_name in list(contents.types.items()):
        if topic_named(name) is None or not contents.messages.get(name):
            continue
        text, encoding = contents.schemas.get(type_name, ""), contents.encodings.get(type_name, "")
        try:
            store_of(type_name, text, encoding)
        except NO_DEFINITION as error:
            reason = one_line(f"definition of type {type_name!r} cannot be read: {error}")
            contents.left_out[name] = reason
            contents.messages[name], contents.log_times[name] = [], []


def remap(path: Path, contents: Contents, remaps: Mapping[str, str]) -> None:
    """Rename topics in ``contents``, in place, from their recorded names to the bench's names.

    ``path`` is that of the recording, for errors.

    The names come from the recorder's notes in the file and from ``remaps``, which maps the bench's
    names to the recorded names.  RecordingError if a topic of ``remaps`` is in the file under
    neither name, or if a topic is in it under both names.
    """
    noted = contents.metadata.get(RUN_METADATA, {}).get(REMAPS, "").splitlines()
    pairs = [line.partition(":=")[::2] for line in noted]
    names = {f"/{n.lstrip('/')}": f"/{topic.lstrip('/')}" for n, topic in remaps.items()}
    try:
        rename_topics(contents, {name: topic for name, topic in pairs if topic in contents.types})
        rename_topics(contents, names)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None


def remap_of(text: str) -> tuple[str, str]:
    """Return the bench's name and the recorded name from a text ``TOPIC:=RECORDED_TOPIC``.

    RecordingError if the text has another form, or if TOPIC is no topic of the bench.
    """
    name, separator, recorded_name = text.partition(":=")
    if not separator or not recorded_name.strip("/") or topic_named(name) is None:
        raise RecordingError(
            f"remap {text!r}: must be TOPIC:=RECORDED_TOPIC, e.g. chaser/odom:=/mocap/rb1/odom"
        )
    return name, recorded_name


class Bag(RecordedTopics):
    """A recording: its messages, and what is known of its run.

    Each topic is decoded when it is first used.  All times are s since the release, unless stated
    otherwise.  RecordingError is raised where a topic or a value in the file cannot be read.
    """

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
        """A line for each damaged file and for each loss; empty for a complete recording."""
        return tuple(map(one_line, (*self.damage, *self.missing)))

    @property
    def left_out(self) -> tuple[str, ...]:
        """A line for each topic or file that is not used, in whole or in part, and why.

        Further lines report a recording that a newer version of this package has made, and what is
        irregular in data that is used, e.g. log times that jump.  Empty if there is nothing to
        report.
        """
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
        """Version of this package that made the recording, if it is newer than this; else empty."""
        return newer_version(self.metadata.get("software", "").split("\n"))

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """A line for each way in which the run is incomplete; empty if it is complete.

        There is one for each topic that lost messages or has repeated, disordered or too many ones,
        and for each node that ended the run early or did not report how many messages it sent.
        Losses are found by sequence numbers of messages and by these reports (StreamCounts).  A
        topic whose losses cannot be counted has a line too.  The losses of a recording with several
        runs cannot be counted; its only line states this.
        """
        if len(self.run_ids) > 1:
            return (f"contains {len(self.run_ids)} runs: lost messages cannot be counted",)
        # when the recording was cut, their counts are missing too
        return losses(self, self._publishers if self._contents.has_verified_end else ())

    @property
    def cut(self) -> bool:
        """True if the end of the run is missing.

        For a simulated run: the simulator's report that it completed the run is not recorded,
        because the run was ended early or the recording stopped before.  For a real bench: a file
        is damaged.
        """
        if SIMULATOR in self._publishers:
            return is_cut(self)
        return bool(self.damage)

    @cached_property
    def has_end(self) -> bool:
        """True if the end of the run is recorded.

        For a simulated run this is the simulator's report at the end (StreamCounts), also for a run
        that it ended early.  A real bench has no such report.  Its end is recorded if no file is
        damaged and one of these is true: the detector's last status is final, a node has reported
        at the end how many messages it sent, or the chaser is held at the end.
        """
        if SIMULATOR in self._publishers:
            return SIMULATOR in self.columns_if_typed(STREAM_COUNTS).get("publisher", ())
        if self.damage:
            return False
        has_verdict = self.holds(CAPTURE_STATUS) and self.statuses[-1].final
        return has_verdict or self.holds(STREAM_COUNTS) or self._is_held

    @property
    def _is_held(self) -> bool:
        """True if the last message on ``launcher/hold`` commands the release device to hold."""
        return self._has_hold and bool(self.columns(HOLD)["data"][-1])

    @property
    def _has_hold(self) -> bool:
        return self.has(HOLD) and self.types.get(f"/{HOLD}") == "std_msgs/msg/Bool"

    @cached_property
    def held_again(self) -> int | None:
        """Log time, ns, from which on a real chaser was held again after its release; None if not.

        It is held by the launcher's abort, by ``launcher/hold``, or :data:`HOLD_TIMEOUT` after the
        last message there.
        """
        if self.is_simulated:
            return None
        times: list[int] = []
        commands = self.columns_if_typed(LAUNCH_COMMAND).get("action", np.zeros(0))
        aborts = np.flatnonzero(commands == LaunchAction.ABORT)
        times += self.log_times(LAUNCH_COMMAND)[aborts].tolist() if aborts.size else []
        if self._has_hold:
            log_times, is_held = self.log_times(HOLD), self.columns(HOLD)["data"].astype(bool)
            let_go = np.flatnonzero(~is_held)
            if let_go.size:
                later = log_times[np.flatnonzero(is_held[let_go[0] :]) + let_go[0]]
                silent = int(log_times[let_go[-1]]) + round(HOLD_TIMEOUT * 1e9)
                times += [*later[:1].tolist(), *([] if later.size else [silent])]
        return min(times, default=None)

    # how it was made

    @property
    def _publishers(self) -> list[str]:
        return list(filter(None, self.metadata.get("publishers", "").split("\n")))

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata of the run, by name, as text.

        The names are run_id, name, scene_sha256, software, state_rate and rate (Hz), publishers,
        and others that the recorder wrote.  Software and publishers have one line for each.  A
        value from the RunInfo message replaces that of the file's metadata record.  Empty for a
        recording with neither.
        """
        stored = self._contents.metadata.get(RUN_METADATA, {})
        # unlike a metadata record, a message has a checksum in every file
        return {**stored, **({} if self.announced is None else describing(self.announced))}

    @property
    def name(self) -> str:
        """Name of the experiment; if none is recorded, the file's or folder's name.

        Of that, the endings of a recording are left out, e.g. ``.mcap`` or ``.mcap.zstd``.
        """
        return self.metadata.get("name") or stem_of(self.path)

    @property
    def run_id(self) -> str:
        """Unique id of the run; empty if none is recorded."""
        return self.metadata.get("run_id", "")

    @property
    def run_ids(self) -> tuple[str, ...]:
        """Ids of the runs that RunInfo messages announce, each once, in the order of recording."""
        return tuple(dict.fromkeys(self.columns_if_typed(RUN_INFO).get("run_id", ())))

    @cached_property
    def announced(self) -> RunDescription | None:
        """Description of the run in its RunInfo message; None unless exactly one run is announced.

        A bag of ``ros2 bag record`` has this message too, while it lacks the metadata record of
        this package's recorder.  MessageError if a value of the message is invalid.
        """
        if len(self.run_ids) != 1:
            return None
        fields = {name: column[0] for name, column in self.columns(RUN_INFO).items()}
        return RunDescription.of_message(SimpleNamespace(**fields))

    @property
    def has_scene(self) -> bool:
        """True if the recording contains the scene of its run."""
        return SCENE_ATTACHMENT in self._contents.attachments or self.announced is not None

    @property
    def scene_text(self) -> str:
        """Text of the run's scene, YAML with all values; RecordingError if none is recorded."""
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
        """The scene of the run.

        RecordingError if none is recorded, SceneError if it is invalid in this version.  In a
        recording by a newer version, fields that this version does not know are ignored.
        """
        return load_scene_text(self.scene_text, only_known=bool(self.newer_version))

    @property
    def is_simulated(self) -> bool:
        """True if the run was simulated; the same clock then stamps all of its messages.

        Evidence of it is that the RunInfo message names the simulator as a publisher, or that
        ``bench/state`` is recorded.
        """
        is_announced = self.announced is not None and SIMULATOR in self.announced.publishers
        return is_announced or self.holds(BENCH_STATE)

    # clock and series

    @cached_property
    def clock(self) -> Clock:
        """The time of the release on each clock of the recording.

        The release is the first of these that exists:

        1. the release time given to :func:`read_bag`;
        2. for a simulated run, the stamp of 1 s;
        3. the launcher's command to release;
        4. the announcement of the trial (RunInfo);
        5. the first pose;
        6. the first message.

        For 3 and 4 the stamp of the message counts if it is within 1 s of the message's arrival, or
        if there are no poses; else the arrival counts, because another clock made the stamp.
        RecordingError if the given release is not between the first and the last pose.
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
        """Return stamps and log times of a topic's messages; None if none can be read."""
        with suppress(RecordingError):  # reported where the messages themselves are used
            if fields := self.columns_if_typed(topic):
                return Logged(stamps_of(fields), self.log_times(topic))
        return None

    def times(self, topic: str | Topic) -> np.ndarray:
        """Return the times of a topic's messages, (n,), s since the release.

        These are the times of their stamps, or of logging if the message type has no stamp.
        """
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
        """Return values of a topic's messages as a series, sorted by the times of their stamps.

        ``values`` computes (n,) or (n, m) values from the columns of n messages.  The topic must
        have messages, of a type with a stamp.  Messages that cannot be decoded, and values that are
        not finite, are left out.  MessageError if no message can be decoded.
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
        """Return the values of n messages as a series, sorted by the times of their stamps.

        ``stamps`` (n,), by the clock of the poses, and ``log_times`` (n,) are in ns; ``values`` is
        (n,) or (n, m).  Values that are not finite are left out; of messages with one stamp only
        the first counts.  ``angle`` is the column of an angle, which is unwrapped; None for none.
        """
        times = self.clock.since(stamps), values, self.clock.since_by_log(log_times)
        return in_order(*times, angle)

    # what the suite's nodes recorded

    @cached_property
    def samples(self) -> np.ndarray:
        """The recorded BenchStates, (n,) of dtype SAMPLE; empty if there are none.

        The values are bit-identical to the simulated samples; so are the times if the release is at
        a stamp of 1 s, where the simulator puts it.
        """
        return samples_in(self, self.clock.t_release)

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """The recorded BenchEvents, in order of recording; empty if there are none.

        RecordingError for a kind of event that this version does not know.  In a recording by a
        newer version, such events are left out.
        """
        return events_in(self, self.clock.t_release, only_known=bool(self.newer_version))

    @cached_property
    def touches(self) -> np.ndarray:
        """The touches in the recorded events, (n,) of dtype TOUCH, in the order of their ends.

        ``rate_ratio`` is NaN, because no message contains it.
        """
        ended = [event.touch for event in self.events if event.touch is not None]
        return np.array(ended, dtype=TOUCH)

    @cached_property
    def trace(self) -> np.ndarray:
        """The recorded state of the contact at each step of the integrator, (n,) of dtype TRACE.

        Empty unless the scene of the run requested it (``run.trace``).
        """
        return trace_in(self, self.clock.t_release)

    @cached_property
    def statuses(self) -> tuple[CaptureStatus, ...]:
        """The recorded statuses of the live detector, in order; empty if there are none."""
        return statuses_in(self, self.clock)

    @cached_property
    def criteria(self) -> Detector | None:
        """Criteria of the live detector; None if not recorded, SceneError if a value is invalid."""
        return criteria_in(self)

    @property
    def verdict(self) -> str | None:
        """State in the last status of the live detector, e.g. captured; None if not recorded."""
        return self.statuses[-1].state.label if self.statuses else None

    @property
    def wall_time(self) -> float | None:
        """Duration of the run in wall time, s; None if it is not recorded.

        It is in metadata at the end of the file, so a recording that ended early lacks it, and
        damage before that end makes it unusable (None).
        """
        return self._known_at_end("wall_time", _seconds, "must be a number of seconds >= 0")

    @property
    def extremes(self) -> Extremes | None:
        """Extremes of strokes, torsion and forces, located between the samples too.

        None if not recorded: they are in the same metadata as :attr:`wall_time`.  Normal forces
        that an older recording lacks are taken from the touches in its events.
        """
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
