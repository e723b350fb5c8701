"""The node that records every stream of a run into one MCAP file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger

from capture_sim.folders import why_not_writable
from capture_sim.messages.topics import BENCH_STATE, RECORDED, RUN_INFO, Topic
from capture_sim.nodes.early import EarlyMessages
from capture_sim.nodes.following import FOLLOWED, RECORDER, RunFollower
from capture_sim.nodes.running import ParameterError, run
from capture_sim.recording.cdr import sequence_of
from capture_sim.recording.live import LiveRecorder, Split


class RecorderNode(RunFollower):
    """Writes the messages' bytes as they come, and checks at the end that none is missing.

    What it does with them stands in :class:`capture_sim.recording.live.LiveRecorder`.
    The services ``~/pause`` and ``~/resume`` (std_srvs/Trigger) stop and go on writing.
    """

    def __init__(self) -> None:
        super().__init__(RECORDER)
        self._out = Path(self.declare("out", "runs", "folder of the recordings"))
        if reason := why_not_writable(self._out):
            raise ParameterError(
                f"parameter out = '{self._out}': allowed is a folder that can be written: {reason}"
            )
        wanted = self.declare("topics", list, "those that are recorded; all unless given")
        self._topics = self._chosen(wanted) if wanted else RECORDED
        self._split = Split(
            size=self.declare(
                "split_size",
                0,
                "bytes, then a new file is begun; 0 never",
                low=0,
                high=10**15,
            ),
            time=self.declare(
                "split_time",
                0.0,
                "s, simulated, after which a new file is begun; 0 never",
                low=0.0,
                high=1e9,
            ),
        )
        self._split = replace(
            self._split,
            folder=self.declare(
                "folder", False, "a bag's folder with metadata.yaml, even if it is not split"
            ),
        )
        self._paused = self.declare("paused", False, "begin each run paused")
        self._recorder = self._fresh()
        self._early = EarlyMessages()
        self._states = 0
        self.create_service(Trigger, "~/pause", partial(self._pause, True))
        self.create_service(Trigger, "~/resume", partial(self._pause, False))
        for topic in FOLLOWED[RECORDER]:
            if topic is not RUN_INFO:
                # what is kept for latecomers may be of a run before
                self.listen(topic, partial(self._take, topic), latecomer=False, raw=True)

    def begin(self, info: Any) -> None:
        """Open the file: the run's description, then what came before it."""
        self._states = 0
        self._recorder.take(RUN_INFO, serialize_message(info))
        for topic, data in self._early.take(info.run_id):
            self._recorder.take(topic, data)
        self.get_logger().info(f"{info.name}: recording in {self._out}")

    def complete(self) -> bool:
        """Whether all publishers have ended the run and all their messages have come."""
        return self._recorder.done

    def end(self, reason: str) -> list[str]:
        """Close the file and say what is missing."""
        report = self._recorder.close()
        self._recorder = self._fresh()
        seen = sum(entry.seen for entry in report.topics.values())
        written = sum(entry.written for entry in report.topics.values())
        count = f"{seen} messages" if written == seen else f"{written} of {seen} messages"
        state = "complete" if report.complete else "INCOMPLETE"
        self.get_logger().info(f"{report.path}: {count}, {state}")
        return [*super().end(reason), *report.problems]

    def _fresh(self) -> LiveRecorder:
        recorder = LiveRecorder(self._out, topics=self._topics, split=self._split)
        recorder.paused = self._paused
        return recorder

    def _chosen(self, names: Sequence[str]) -> tuple[Topic, ...]:
        known = {topic.absolute_name: topic for topic in RECORDED}
        wanted = [name if name.startswith("/") else f"/{name}" for name in names]
        if unknown := [name for name in wanted if name not in known]:
            raise ParameterError(
                f"parameter topics = {list(names)!r}: unknown is {', '.join(unknown)}; "
                f"allowed are {', '.join(known)}"
            )
        return tuple(known[name] for name in wanted)

    def _pause(self, paused: bool, _: Any, response: Any) -> Any:
        response.success = self._recorder.paused != paused
        response.message = "" if response.success else f"already {'paused' * paused or 'recording'}"
        self._recorder.paused = self._paused = paused
        return response

    def _take(self, topic: Topic, data: bytes) -> None:
        if self.run is None:
            self._early.add(topic, data, sequence_of(topic, data))
            return
        self._recorder.take(topic, data)
        if topic is BENCH_STATE:
            self._states += 1
            self.advance_to(self._states)
        self.end_if_complete()


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; return the exit status."""
    return run(RecorderNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
