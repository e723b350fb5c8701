"""The node that records a run or a trial into one MCAP file."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger

from capture_sim.errors import MessageError
from capture_sim.files import why_not_writable
from capture_sim.messages.definitions import learn_type
from capture_sim.messages.topics import RUN_INFO, STREAM_COUNTS, TOPICS, Rate, Stamp, Topic
from capture_sim.nodes.node import from_bytes
from capture_sim.nodes.parameters import ParameterError
from capture_sim.nodes.participant import READ, RECORDER, Participant
from capture_sim.nodes.process import run
from capture_sim.recording.live import LiveRecorder
from capture_sim.scene.parts import Scene

#: Messages of others that come before a run is announced here are kept for it, at most so many.
_EARLY = 1000


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
        known = {topic.absolute_name: topic for topic in TOPICS}
        names = [name if name.startswith("/") else f"/{name}" for name in wanted] or list(known)
        self._topics = [known[name] for name in names if name in known]
        self._sought = {name for name in names if name not in known}
        self._paused = self.declare("paused", False, "begin each run paused")
        self._recorder: LiveRecorder | None = None  # of the run that is on
        self._early: list[tuple[Topic, bytes]] = []
        self.open((STREAM_COUNTS,))
        self.create_service(Trigger, "~/pause", partial(self._pause, True))
        self.create_service(Trigger, "~/resume", partial(self._pause, False))
        for topic in READ[RECORDER]:
            if topic is not STREAM_COUNTS:  # which every participant listens to
                # what is kept for latecomers may be of a run before
                self.listen(topic, partial(self._take, topic), latched=False, raw=True)
        if self._sought:
            self._seek()
            self.create_timer(0.5, self._seek, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def begin(self, info: Any, scene: Scene) -> None:
        """Open the file: the run's description, then what others sent before it came here."""
        del scene
        for name in sorted(self._sought):
            self.get_logger().warning(f"{info.name}: {name} is not recorded: nobody publishes it")
        self._recorder = LiveRecorder(self._out, topics=self._topics)
        self._recorder.paused = self._paused
        self._recorder.take(RUN_INFO, serialize_message(info))
        early, self._early = self._early, []
        for topic, data in early:
            try:
                self._recorder.take(topic, data)
            except MessageError as error:
                self.refuse(topic, error)
        self.get_logger().info(f"{info.name}: recording in {self._out}")

    def complete(self) -> bool:
        """Whether all publishers have ended the run and all their messages have come."""
        return self._recorder is not None and self._recorder.done

    def end(self, reason: str) -> list[str]:
        """Close the file and say what is missing."""
        assert self._recorder is not None
        report = self._recorder.close()
        self._recorder = None
        self._early.clear()
        seen = sum(entry.seen for entry in report.topics.values())
        written = sum(entry.written for entry in report.topics.values())
        count = f"{seen} messages" if written == seen else f"{written} of {seen} messages"
        state = "complete" if report.complete else "INCOMPLETE"
        self.get_logger().info(f"{report.path}: {count}, {state}")
        problems = [*super().end(reason), *report.problems]
        counts = {topic: entry.written for topic, entry in report.topics.items()}
        ended = self.messages.stream_counts(
            RECORDER, self.run.run_id, counts, complete=not problems, reason="; ".join(problems)
        )
        self.send(STREAM_COUNTS, self.messages.serialise(ended))
        return problems

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
                self.listen(topic, partial(self._take, topic), raw=True)
                self._topics.append(topic)

    def _pause(self, paused: bool, _: Any, response: Any) -> Any:
        response.success = self._paused != paused
        response.message = "" if response.success else f"already {'paused' * paused or 'recording'}"
        self._paused = paused
        if self._recorder is not None:
            self._recorder.paused = paused
        return response

    def _take(self, topic: Topic, data: bytes) -> None:
        if self._recorder is None or self.run is None:
            # of another publisher than the announcer, whose message has overtaken the RunInfo
            if len(self._early) < _EARLY:
                self._early.append((topic, data))
            return
        self._recorder.take(topic, data)
        self.end_if_complete()

    def _counted(self, data: bytes) -> None:
        publisher = from_bytes(STREAM_COUNTS, data).publisher
        if self.run is None or publisher in self.run.publishers:  # not another recorder's
            self._take(STREAM_COUNTS, data)
        super()._counted(data)


main = partial(run, RecorderNode)

if __name__ == "__main__":
    raise SystemExit(main())
