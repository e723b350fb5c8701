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

from capture_sim.errors import MessageError
from capture_sim.files import why_not_writable
from capture_sim.messages.definitions import learn_type
from capture_sim.messages.topics import RUN_INFO, STREAM_COUNTS, TOPICS, Rate, Stamp, Topic
from capture_sim.nodes.node import from_bytes
from capture_sim.nodes.parameters import ParameterError
from capture_sim.nodes.participant import READ, RECORDER, Participant
from capture_sim.nodes.process import run
from capture_sim.nodes.start import RECORDING_IN
from capture_sim.recording.live import LiveRecorder
from capture_sim.scene.parts import Scene

#: Messages that came so shortly before the announcement of a run belong to it, ns (wall): those of
#: other publishers may overtake it.
OVERTAKING = 500_000_000


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
        self._early: deque[tuple[int, Topic, bytes]] = deque()  # the first: arrival, ns (wall)
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
        self._recorder = LiveRecorder(self._out, topics=self._topics, remaps=self._remaps)
        self._recorder.paused = self._paused
        self._recorder.take(RUN_INFO, serialize_message(info))
        self._forget_early()
        for arrival, topic, data in self._early:
            try:
                self._recorder.take(topic, data, arrival)
            except MessageError as error:
                self.refuse(topic, error)
        self._early.clear()
        self.get_logger().info(f"{info.name}: {RECORDING_IN}{self._recorder.path}")

    def complete(self) -> bool:
        """Whether all publishers have ended the run and all their messages have come."""
        return self._recorder is not None and self._recorder.done

    def end(self, reason: str) -> list[str]:
        """Close the file and say what is missing."""
        assert self._recorder is not None
        report = self._recorder.close()
        self._recorder = None
        self._early.clear()
        received = sum(entry.received for entry in report.topics.values())
        written = sum(entry.written for entry in report.topics.values())
        count = (
            f"{received} messages" if written == received else f"{written} of {received} messages"
        )
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
            self._early.append((time.time_ns(), topic, data))
            self._forget_early()
            return
        self._recorder.take(topic, data)
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
            self._take(STREAM_COUNTS, data)
        super()._counted(data)


main = partial(run, RecorderNode)

if __name__ == "__main__":
    raise SystemExit(main())
