"""The node that judges, from poses and buffer state alone, whether the tip is captured."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from capture_sim.detection import CaptureDetector
from capture_sim.nodes.following import FOLLOWED, RunFollower
from capture_sim.nodes.receiving import StampMatcher, observation_of
from capture_sim.nodes.running import run
from capture_sim.scene_files import load_scene_text
from capture_sim.telemetry import DetectorTelemetry
from capture_sim.topics import (
    BUFFER_STATE,
    CAPTURE_DETECTOR,
    CHASER_ODOMETRY,
    TARGET_ODOMETRY,
    topics_of,
)


class CaptureDetectorNode(RunFollower):
    """Sends its judgement of every periodic sample.

    What it decides stands in :class:`capture_sim.detection.CaptureDetector`.
    """

    # of the run that is on
    _detector: CaptureDetector
    _telemetry: DetectorTelemetry
    _matcher: StampMatcher
    _observed: int

    def __init__(self) -> None:
        super().__init__(CAPTURE_DETECTOR)
        self.open(topics_of(CAPTURE_DETECTOR))
        for topic in FOLLOWED[CAPTURE_DETECTOR]:
            self.follow(topic, partial(self._take, topic.name))

    def begin(self, info: Any) -> None:
        """Start anew for the scene of this run."""
        self._detector = CaptureDetector(load_scene_text(info.scene))
        self._telemetry = DetectorTelemetry(self.messages, info.run_id)
        self._matcher = StampMatcher(topic.name for topic in FOLLOWED[CAPTURE_DETECTOR])
        self._observed = 0

    def end(self, reason: str) -> list[str]:
        """Send the final verdict, and tell how much was sent."""
        verdict = self._detector.finish()
        self.send(*self._telemetry.status(verdict.t, verdict))
        self.get_logger().info(f"{self.run.name}: {verdict.state.label}, {verdict.reason}")
        self.send(*self._telemetry.end(complete=not reason, reason=reason))
        return super().end(reason)

    def _take(self, name: str, message: Any) -> None:
        parts = self._matcher.add(name, message)
        if parts is None:
            return
        observation = observation_of(
            parts[CHASER_ODOMETRY.name], parts[TARGET_ODOMETRY.name], parts[BUFFER_STATE.name]
        )
        status = self._detector.update(observation)
        self.send(*self._telemetry.status(observation.t, status))
        self.advance_past(self._observed)
        self._observed += 1


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; return the exit status."""
    return run(CaptureDetectorNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
