"""The node that records every stream of a run into one MCAP file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from capture_sim.nodes.following import FOLLOWED, RECORDER, RunFollower
from capture_sim.nodes.running import ParameterError, run
from capture_sim.recording.live import LiveRecorder
from capture_sim.topics import BENCH_STATE, Topic


class RecorderNode(RunFollower):
    """Writes the messages' bytes as they come, and checks at the end that none is missing.

    What it does with them stands in :class:`capture_sim.recording.live.LiveRecorder`.
    """

    def __init__(self) -> None:
        super().__init__(RECORDER)
        self._out = Path(self.declare("out", "runs", "folder of the recordings"))
        if self._out.exists() and not self._out.is_dir():
            raise ParameterError(f"parameter out = '{self._out}': allowed is a folder")
        self._recorder = LiveRecorder(self._out)
        self._states = 0
        for topic in FOLLOWED[RECORDER]:
            self.listen(topic, partial(self._take, topic), raw=True)

    def begin(self, info: Any) -> None:
        """Say where the run goes; the recorder itself opens the file."""
        self._states = 0
        self.get_logger().info(f"{info.name}: recording to {self._out / info.name}.mcap")

    def complete(self) -> bool:
        """Whether all publishers have ended the run and all their messages have come."""
        return self._recorder.done

    def end(self, reason: str) -> list[str]:
        """Close the file and say what is missing."""
        report = self._recorder.close()
        self._recorder = LiveRecorder(self._out)
        count = sum(entry.seen for entry in report.topics.values())
        state = "complete" if report.complete else "INCOMPLETE"
        self.get_logger().info(f"{report.path}: {count} messages, {state}")
        return [*super().end(reason), *report.problems]

    def _take(self, topic: Topic, data: bytes) -> None:
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
