"""The node that judges, from poses and buffer state alone, whether the tip is captured."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from capture_sim.detection.align import Source, Values
from capture_sim.detection.exact import CaptureStatus
from capture_sim.detection.noisy import NoisyDetector
from capture_sim.launch.scenes import load_scene, load_scene_text
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.measurements import detector_sources
from capture_sim.messages.telemetry import DetectorTelemetry
from capture_sim.messages.topics import BUFFER_STATE, CAPTURE_DETECTOR, Topic, topics_of
from capture_sim.nodes.decoding import decoder
from capture_sim.nodes.detector_parameters import Criteria
from capture_sim.nodes.following import FOLLOWED, RunFollower
from capture_sim.nodes.running import run
from capture_sim.scene.parts import Scene

#: A source that has fallen behind the others by this much is warned of, s of their stamps;
#: topics of an unpaced run may be apart by the simulator's window.
STALE = 2.0


class CaptureDetectorNode(RunFollower):
    """Sends its judgement of every instant that the poses were measured at.

    What it decides stands in :class:`capture_sim.detection.noisy.NoisyDetector`.
    """

    # of the run that is on
    _detector: NoisyDetector
    _decoders: dict[Topic, tuple[Source, Callable[[bytes], tuple[float, Values]]]]
    _telemetry: DetectorTelemetry
    _sets: int

    def __init__(self) -> None:
        super().__init__(CAPTURE_DETECTOR)
        self._criteria = Criteria(self)
        self.open(topics_of(CAPTURE_DETECTOR))
        for topic in FOLLOWED[CAPTURE_DETECTOR]:
            self.follow(topic, partial(self._take, topic), raw=True)
        name = self.declare(
            "scene",
            "",
            "judge by this scene from the start, for a bench where nobody announces runs: "
            "name in config/scenes, or file; empty to wait for a run",
        )
        overrides = self.declare("overrides", list, "changes of that scene (SI)")
        if name:
            self._begin_alone(load_scene(name, overrides))

    def _begin_alone(self, scene: Scene) -> None:
        """Begin a run that nobody has announced; it lasts until Ctrl-C."""
        description = RunDescription.of(scene, uuid.uuid4().hex, [CAPTURE_DETECTOR])
        info = self.messages.run_info(description)
        self.begin(info)
        self.run = info
        self.get_logger().info(f"judging by {scene.name} until Ctrl-C")

    def begin(self, info: Any) -> None:
        """Start anew for the scene of this run."""
        scene = self._criteria.of(load_scene_text(info.scene))
        self._detector, sources = NoisyDetector(scene), detector_sources(scene)
        self._decoders = {
            topic: (source, decoder(topic, source))
            for topic in FOLLOWED[CAPTURE_DETECTOR]
            if (source := sources.get(topic)) is not None
        }
        self._telemetry = DetectorTelemetry(self.messages, info.run_id)
        self._sets = 0
        self.publish(self._telemetry.begin(scene.detector))
        if given := self._criteria.given():
            self.get_logger().info(f"{info.name}: judged by {given}; else by the scene")

    def end(self, reason: str) -> list[str]:
        """Send the final verdict, and tell how much was sent."""
        statuses = self._detector.finish(cut=self.cut)
        self._send_all(statuses)
        verdict = statuses[-1]
        undecided = "" if verdict.final else "no verdict, "
        self.get_logger().info(
            f"{self.run.name}: {undecided}{verdict.state.label}, {verdict.reason}"
        )
        if skipped := self._detector.aligner.skipped:
            self.get_logger().warning(
                f"{self.run.name}: {skipped} instants not judged: a source had a hole there"
            )
        self.publish(self._telemetry.end(complete=not reason, reason=reason))
        return super().end(reason)

    def _take(self, topic: Topic, data: bytes) -> None:
        if topic in self._decoders:
            source, decode = self._decoders[topic]
            self._send_all(self._detector.measure(source, *decode(data)))
        if silent := self._detector.aligner.silent(STALE):
            names = " and ".join(source.value for source in silent)
            self.get_logger().warning(
                f"nothing is judged: no measurement of the {names} for {STALE:g} s",
                throttle_duration_sec=5.0,
            )
        if topic is BUFFER_STATE:
            # one in every set of periodic messages
            self.advance_past(self._sets)
            self._sets += 1

    def _send_all(self, statuses: Sequence[CaptureStatus]) -> None:
        for status in statuses:
            self.publish(self._telemetry.status(status.t, status))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; return the exit status."""
    return run(CaptureDetectorNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
