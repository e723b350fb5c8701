"""The node that records a run or a trial into one MCAP file."""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import serialize_message

from capture_sim.base.exit_status import RECORDING_IN
from capture_sim.base.files import writing_problem
from capture_sim.errors import CaptureSimError, MessageError, RecordingError, one_line
from capture_sim.messages.definitions import learn_type
from capture_sim.messages.measurements import TOPICS_OF_SOURCE
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    HOLD,
    LAUNCHER,
    LOAD_CELL,
    RECORDER,
    RUN_INFO,
    STREAM_COUNTS,
    TOPICS,
    Rate,
    RunSource,
    Stamp,
    Topic,
    topics_of,
)
from capture_sim.nodes.base.endpoints import TRANSIT_TIME, from_bytes, is_own
from capture_sim.nodes.base.node import LOOK_UP_PERIOD, BenchNode
from capture_sim.nodes.base.process import run
from capture_sim.nodes.base.sources import SOURCES_TIMEOUT, SourceDiagnostics
from capture_sim.nodes.protocol.ends import EndKind, RunEnd
from capture_sim.nodes.protocol.follower import AnnouncedRun, Follower, RunPart
from capture_sim.nodes.protocol.roll import RunReport
from capture_sim.recording.live import LiveRecorder, RecordingReport
from capture_sim.recording.results_table import ResultsTable, row_of
from capture_sim.recording.trial_check import checked_trial
from capture_sim.run.run import Run

#: What is recorded later too: the last messages of the participants.
AFTER_END = {STREAM_COUNTS, *topics_of(LAUNCHER), *topics_of(CAPTURE_DETECTOR)}


class RecorderNode(BenchNode, RunPart):
    """Writes the messages of each run to an MCAP file; checks at its end that none is missing."""

    def __init__(self, **options: Any) -> None:
        super().__init__(RECORDER, **options)
        kind = "a folder that can be written"
        out = self.declare_path("out", "runs", "folder of the recordings", kind, writing_problem)
        self._out = out or Path()
        wanted = self.declare(
            "topics",
            list,
            "topics of the bench or the rig to record; their types are found when they are "
            "published; the bench's unless given",
        )
        bench_names = {topic.absolute_name: topic for topic in TOPICS}
        self._remaps = self._remapped()
        known = bench_names | {name: topic for topic, name in self._remaps.items()}
        names = [name if name.startswith("/") else f"/{name}" for name in wanted]
        names = names or list(bench_names)
        self._topics = [known[name] for name in names if name in known]
        self._required = list(self._topics) if wanted else []
        #: By the name in the list: the name under which a topic is looked for.
        self._sought = {
            name: self.resolve_topic_name(HOLD) if name == f"/{HOLD}" else name
            for name in names
            if name not in known
        }
        self._recorder: LiveRecorder | None = None  # of the run that is on
        self._failure = ""  # of the disk: why the recording ended before the run
        self._first_after_end: float | None = None  # s (wall), arrival of the first measurement
        self._follower = Follower(self, RECORDER, self, list(RunSource))
        self._sources = SourceDiagnostics(self)
        self._kept: dict[Topic, bytes] = {}  # last message of transient-local topics of others
        for topic in {*self._topics, STREAM_COUNTS} - {RUN_INFO}:
            # what is kept for latecomers may be of a run before
            self.listen(topic, partial(self._record, topic), transient_local=False, raw=True)
            if not is_own(topic) and wanted:
                self._sources.watch(topic)
        self._follower.join()
        if self._sought:
            self._seek()
            self.every(LOOK_UP_PERIOD, self._seek)

    @property
    def run(self) -> Any:
        """The run that this node takes part in at the moment (AnnouncedRun), or None."""
        return self._follower.run

    def work(self) -> int:
        """Take part in runs until the process is to end; return the exit status."""
        return self._follower.work()

    def prepare(self, run: AnnouncedRun) -> None:
        """Open the file of a run and write the run's description into it.

        In a trial, also wait for the sensors.  If the file cannot be opened, a trial gets the
        RecordingError, so that the launcher knows before the release; a simulated run goes on
        without a recording.
        """
        for name in sorted(self._sought):
            self.get_logger().warning(f"{run.name}: {name} is not recorded: it has no publisher")
        if run.info.source == RunSource.TRIAL:
            self._await_sensors()
        self._recorder, self._failure, self._first_after_end = None, "", None
        try:
            recorder = LiveRecorder(
                self._out,
                serialize_message(run.info),
                topics=self._topics,
                required=self._required,
                remaps=self._remaps,
            )
        except RecordingError as error:
            if run.info.source == RunSource.TRIAL:  # the launcher then knows before the release
                raise
            self._fail_recording(error)
            return
        self._recorder = recorder
        self.get_logger().info(f"{run.name}: {RECORDING_IN}{recorder.path}")
        for topic, data in self._kept.items():
            self._write(topic, data)

    def _await_sensors(self) -> None:
        """Wait until each sensor that is to be recorded has sent, or SOURCES_TIMEOUT has passed.

        The launcher does not let the chaser go before this node is ready.  A recorder that has just
        started may know the launcher before it has found the drivers.
        """
        listed = [
            [topic for topic in topics if topic in self._required]
            for topics in (*TOPICS_OF_SOURCE.values(), (LOAD_CELL,))
        ]

        def all_heard() -> bool:
            return all(any(map(self._sources.is_fresh, topics)) for topics in listed if topics)

        self.wait(lambda: self._follower.has_ended or all_heard(), SOURCES_TIMEOUT)

    def is_complete(self) -> bool:
        """Return True if the file needs nothing more: all messages have come, or the disk failed.

        All have come if each publisher of the run has sent its counts and as many messages.
        """
        return bool(self._failure) or (self._recorder is not None and self._recorder.done)

    def end(self, run: AnnouncedRun, end: RunEnd) -> RunReport:
        """Close the file of the run; return its path and what is missing in it."""
        problems = [f"{name}: no message" for name in sorted(self._sought)]
        path = None if self._recorder is None else self._recorder.path
        try:
            report = self._close()
        except RecordingError as error:
            self._fail_recording(error)
        else:
            received = sum(entry.received for entry in report.topics.values())
            if end.kind is EndKind.ABANDONED:
                problems.append(end.reason)
            problems += report.problems
            if run.info.source == RunSource.TRIAL and report.path.exists():
                lines, trial = checked_trial(report.path)
                problems += lines
                self._tabulate(report.path, trial)
            elif not report.path.exists():
                problems.append(f"{report.path}: is gone: it was removed while it was written")
            for problem in problems[:1]:
                if problem.endswith("no message"):  # first of all: a sensor is missing
                    self._follower.fail(problem)
            for line in report.summary:
                self.get_logger().info(f"{run.name}: {line}")
            state = "INCOMPLETE" if problems else "complete"
            self.get_logger().info(f"{report.path}: {received} messages, {state}")
        if self._failure:
            problems.append(self._failure)
        return RunReport(tuple(problems), str(path or ""))

    def _tabulate(self, path: Path, trial: Run | None) -> None:
        """Add the trial to results.json and results.txt beside its recording."""
        try:
            row = row_of(path, trial)
            if row is not None:
                log = self.get_logger()
                # others may be many, and the launcher waits
                ResultsTable(path.parent, log.warning).update([row], reads_others=False)
        except (CaptureSimError, OSError, ValueError) as error:  # the recording itself is whole
            self.get_logger().warning(f"{path.parent}: the table of trials: {one_line(str(error))}")

    def cancel(self, run: AnnouncedRun, end: RunEnd) -> RunReport:
        """Leave a run that has not begun or has failed; close the file, if one was opened."""
        return super().cancel(run, end) if self._recorder is None else self.end(run, end)

    def _close(self) -> RecordingReport:
        """Close the file and return what it contains; RecordingError if it cannot be written.

        Also if it could not be opened.
        """
        if self._recorder is None:
            raise RecordingError(self._failure)
        recorder, self._recorder = self._recorder, None
        return recorder.close()

    def _write(self, topic: Topic, data: bytes, arrival: int | None = None) -> None:
        """Write a serialised message to the file of the run; MessageError if it is invalid.

        A disk that fails ends the recording of this run, not the node.
        """
        if self._failure:
            return
        assert self._recorder is not None
        try:
            self._recorder.take(topic, data, arrival)
        except MessageError:
            raise
        except RecordingError as error:
            self._fail_recording(error)

    def _fail_recording(self, error: RecordingError) -> None:
        """Log why the recording of the run has failed; the first reason goes into its report.

        The process will end with status 1.
        """
        self._failure = self._failure or one_line(str(error))
        self._follower.fail(self._failure)

    def _seek(self) -> None:
        """Subscribe to those topics of the parameter ``topics`` that have a publisher by now.

        It concerns topics that are not the bench's own, whose types are known only from their
        publishers.  One whose type is not installed is not recorded, and a warning says so.
        """
        published = dict(self.get_topic_names_and_types())
        for listed, name in list(self._sought.items()):
            if name in published:
                type_name = published[name][0]
                del self._sought[listed]
                try:
                    share = Path(get_package_share_directory(type_name.split("/")[0]))
                except (LookupError, OSError):
                    share = Path(os.devnull)
                if not learn_type(type_name, share):
                    self.get_logger().warning(f"{name}: {type_name} is not installed: not recorded")
                    continue
                ends = self.get_publishers_info_by_topic(name)
                transient_local = any(
                    end.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL for end in ends
                )
                topic = Topic(
                    HOLD if listed == f"/{HOLD}" else name,
                    type_name,
                    (),
                    Rate.EVENT,
                    transient_local=transient_local,
                    stamp=Stamp.NONE,
                )
                self.listen(topic, partial(self._record, topic), raw=True)
                self._sources.watch(topic)
                self._topics.append(topic)
                self._required.append(topic)

    def _record(self, topic: Topic, data: bytes) -> None:
        self._sources.add(topic)
        if topic.transient_local and not topic.publishers:
            self._kept[topic] = data
        if self._recorder is None or self.run is None:
            return
        if topic is STREAM_COUNTS and (
            from_bytes(STREAM_COUNTS, data).publisher not in self.run.info.publishers
        ):
            return
        if self._follower.has_ended and not self.run.simulated and topic not in AFTER_END:
            # what reached the detector before the end may come later here
            now = time.monotonic()
            self._first_after_end = self._first_after_end or now
            if now > self._first_after_end + TRANSIT_TIME:
                return
        self._follower.note_message(topic)
        self._write(topic, data)

    def _remapped(self) -> dict[Topic, str]:
        """Return the names that ROS remapping gave to topics of the bench, by topic."""
        namespace = self.get_namespace().rstrip("/")
        names = {topic: self.resolve_topic_name(topic.name) for topic in TOPICS}
        return {
            topic: name
            for topic, name in names.items()
            if name not in (f"{namespace}/{topic.name}", topic.absolute_name)
        }


main = partial(run, RecorderNode)

if __name__ == "__main__":
    raise SystemExit(main())
