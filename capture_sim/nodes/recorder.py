"""The node that records a run or a trial into one MCAP file."""

from __future__ import annotations

import os
import time
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger

from capture_sim.errors import MessageError, RecordingError, one_line
from capture_sim.files import why_not_writable
from capture_sim.messages.definitions import learn_type
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    LAUNCHER,
    RUN_INFO,
    STREAM_COUNTS,
    TOPICS,
    Rate,
    Stamp,
    Topic,
    topics_of,
)
from capture_sim.nodes.node import from_bytes
from capture_sim.nodes.parameters import ParameterError
from capture_sim.nodes.participant import READ, RECORDER, Participant
from capture_sim.nodes.process import run
from capture_sim.nodes.run_state import Stage
from capture_sim.nodes.start import FAILED, RECORDING_IN
from capture_sim.recording.live import LiveRecorder, RecordingReport
from capture_sim.scene.parts import Scene

#: Messages that came so shortly before the announcement of a run belong to it, ns (wall): those of
#: other publishers may overtake it.  Those that come so shortly after the end of a bench's trial
#: may have reached the detector before it.
OVERTAKING = 500_000_000
#: What is recorded later too: the last messages of the participants.
AFTER_END = {STREAM_COUNTS, *topics_of(LAUNCHER), *topics_of(CAPTURE_DETECTOR)}


class RecorderNode(Participant):
    """Writes the messages' bytes as they come, and checks at the end that none is missing.

    What it does with them stands in :class:`capture_sim.recording.live.LiveRecorder`.
    The services ``~/pause`` and ``~/resume`` (std_srvs/Trigger) stop and go on writing.
    """

    def __init__(self) -> None:
        super().__init__(RECORDER)
        self._out = Path(self.declare("out", "runs", "folder of the recordings"))
        if reason := why_not_writable(self._out):
            raise ParameterError(
                f"parameter out = '{self._out}': must be a folder that can be written: {reason}"
            )
        wanted = self.declare(
            "topics",
            list,
            "those that are recorded, of the bench or others, whose types are found when they are "
            "published; the bench's unless given",
        )
        bench_names = {topic.absolute_name: topic for topic in TOPICS}
        self._remaps = self._remapped()
        known = bench_names | {name: topic for topic, name in self._remaps.items()}
        names = [name if name.startswith("/") else f"/{name}" for name in wanted]
        names = names or list(bench_names)
        self._topics = [known[name] for name in names if name in known]
        self._sought = {name for name in names if name not in known}
        self._paused = self.declare("paused", False, "begin each run paused")
        self._recorder: LiveRecorder | None = None  # of the run that is on
        self._failure = ""  # of the disk: why the recording ended before the run
        self._early: deque[tuple[int, Topic, bytes]] = deque()  # the first: arrival, ns (wall)
        self._first_after_end: int | None = None  # ns (wall), arrival of the first measurement
        self.open((STREAM_COUNTS,))
        self.create_service(Trigger, "~/pause", partial(self._pause, True))
        self.create_service(Trigger, "~/resume", partial(self._pause, False))
        for topic in READ[RECORDER]:
            if topic is not STREAM_COUNTS:  # which every participant listens to
                # what is kept for latecomers may be of a run before
                self.listen(topic, partial(self._record, topic), latched=False, raw=True)
        if self._sought:
            self._seek()
            self.create_timer(0.5, self._seek, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def begin(self, info: Any, scene: Scene) -> None:
        """Open the file: the run's description, then what others sent before it came here."""
        del scene
        for name in sorted(self._sought):
            self.get_logger().warning(f"{info.name}: {name} is not recorded: it has no publisher")
        recorder = LiveRecorder(self._out, topics=self._topics, remaps=self._remaps)
        recorder.paused = self._paused
        self._recorder, self._failure, self._first_after_end = recorder, "", None
        self._write(RUN_INFO, serialize_message(info))
        self._forget_early()
        for arrival, topic, data in self._early:
            try:
                self._write(topic, data, arrival)
            except MessageError as error:
                self.refuse(topic, error)
        self._early.clear()
        if not self._failure:
            self.get_logger().info(f"{info.name}: {RECORDING_IN}{recorder.path}")

    def trial_result(self) -> str:
        """Return the file, or why there is none."""
        return self._failure or (f"file {self._recorder.path}" if self._recorder else "no file")

    def complete(self) -> bool:
        """Whether all publishers have ended the run and all their messages have come."""
        if self._failure:
            return super().complete()
        return self._recorder is not None and self._recorder.done

    def end(self, reason: str) -> list[str]:
        """Close the file and say what is missing."""
        problems, counts = super().end(reason), {}
        try:
            report = self._close()
        except RecordingError as error:
            self._fail_recording(error)
            self._status = FAILED
            ended = f"{reason}; {self._failure}" if reason else self._failure
        else:
            received = sum(entry.received for entry in report.topics.values())
            written = sum(entry.written for entry in report.topics.values())
            count = f"{received}" if written == received else f"{written} of {received}"
            state = "complete" if report.complete else "INCOMPLETE"
            self.get_logger().info(f"{report.path}: {count} messages, {state}")
            problems += report.problems
            counts = {topic: entry.written for topic, entry in report.topics.items()}
            ended = "; ".join(problems)
        message = self.messages.stream_counts(
            RECORDER, self.run.run_id, counts, complete=not ended, reason=ended
        )
        self.send(STREAM_COUNTS, self.messages.serialise(message))
        return problems

    def _close(self) -> RecordingReport:
        """Close the file; RecordingError if the disk has failed, now or before."""
        assert self._recorder is not None
        recorder, self._recorder = self._recorder, None
        self._early.clear()
        return recorder.close()

    def _write(self, topic: Topic, data: bytes, arrival: int | None = None) -> None:
        """Record a message; a disk that fails ends the recording of this run, not the node."""
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
        """Log once in a run why its recording has ended."""
        if not self._failure:
            self._failure = one_line(str(error))
            self.get_logger().error(f"{self.run.name}: {self._failure}")

    def _seek(self) -> None:
        """Subscribe to those of the other topics that are published by now."""
        for name, (type_name, *_) in self.get_topic_names_and_types():
            if name in self._sought:
                self._sought.remove(name)
                try:
                    share = Path(get_package_share_directory(type_name.split("/")[0]))
                except (LookupError, OSError):
                    share = Path(os.devnull)
                if not learn_type(type_name, share):
                    self.get_logger().warning(f"{name}: {type_name} is not installed: not recorded")
                    continue
                topic = Topic(name, type_name, (), Rate.EVENT, stamp=Stamp.NONE)
                self.listen(topic, partial(self._record, topic), raw=True)
                self._topics.append(topic)

    def _pause(self, paused: bool, _: Any, response: Any) -> Any:
        response.success = self._paused != paused
        response.message = "" if response.success else f"already {'paused' * paused or 'recording'}"
        self._paused = paused
        if self._recorder is not None:
            self._recorder.paused = paused
        return response

    def _record(self, topic: Topic, data: bytes) -> None:
        if self._recorder is None or self.run is None:
            self._early.append((time.time_ns(), topic, data))
            self._forget_early()
            return
        is_after_end = self.state.stage is Stage.ENDED and not self.simulated
        if is_after_end and topic not in AFTER_END:
            now = time.time_ns()
            self._first_after_end = self._first_after_end or now
            if now - self._first_after_end > OVERTAKING:
                return
        self._write(topic, data)
        self.end_if_complete()

    def _forget_early(self) -> None:
        """Drop messages that came too long ago to have overtaken an announcement."""
        oldest = time.time_ns() - OVERTAKING
        while self._early and self._early[0][0] < oldest:
            self._early.popleft()

    def _remapped(self) -> dict[Topic, str]:
        """Return the names of the bench's topics that this node was remapped to."""
        namespace = self.get_namespace().rstrip("/")
        names = {topic: self.resolve_topic_name(topic.name) for topic in TOPICS}
        return {
            topic: name
            for topic, name in names.items()
            if name not in (f"{namespace}/{topic.name}", topic.absolute_name)
        }

    def _counted(self, data: bytes) -> None:
        publisher = from_bytes(STREAM_COUNTS, data).publisher
        if self.run is None or publisher in self.run.publishers:  # not another recorder's
            self._record(STREAM_COUNTS, data)
        super()._counted(data)


main = partial(run, RecorderNode)

if __name__ == "__main__":
    raise SystemExit(main())
