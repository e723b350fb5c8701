"""The node that judges, from poses and buffer state alone, whether the tip is captured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field, fields, replace
from functools import partial
from typing import Any

from capture_sim.detection.align import Source
from capture_sim.detection.exact import CaptureStatus
from capture_sim.detection.noisy import NoisyDetector
from capture_sim.errors import SceneError
from capture_sim.messages.convert import CRITERIA, EPOCH_NS, stamp_seconds
from capture_sim.messages.measurements import OF_A_BENCH, MeasurementReader, detector_sources
from capture_sim.messages.telemetry import DetectorTelemetry
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    Topic,
    topics_of,
)
from capture_sim.nodes.node import BenchNode, ParameterError, run
from capture_sim.nodes.participant import READ, Participant
from capture_sim.scene.parts import Detector, Scene

#: A source that has fallen behind the others by this much is warned of, s of their stamps.
STALE = 2.0


class CaptureDetectorNode(Participant):
    """Sends its judgement of every instant that the poses were measured at.

    What it decides stands in :mod:`capture_sim.detection`.
    """

    # of the run that is on
    _detector: NoisyDetector
    _sources: dict[Topic, Source]
    _telemetry: DetectorTelemetry
    _zero: int | None  # ns, stamp of t = 0: the release, or a bench's first measurement
    _state: Any

    def __init__(self) -> None:
        super().__init__(CAPTURE_DETECTOR)
        self._criteria = Criteria(self)
        self.open(topics_of(CAPTURE_DETECTOR))
        self._readers = {topic: MeasurementReader(topic) for topic in READ[CAPTURE_DETECTOR]}
        for topic in self._readers:
            self.follow(topic, partial(self._take, topic), raw=True)
        self._scene = self.declare_scene(
            "judge by this scene from the start, for a bench where nobody announces runs; "
            "empty to wait for a run"
        )

    def work(self) -> int:
        """Take part until the process is to end; return the exit status."""
        if self._scene is not None:
            self.announce(self._scene.name, self._scene)
            self.get_logger().info(f"judged by {self._scene.name} until Ctrl-C")
        return super().work()

    def begin(self, info: Any, scene: Scene) -> None:
        """Start anew for the scene of this run."""
        scene = self._criteria.of(scene)
        self._detector = NoisyDetector(scene)
        self._sources = detector_sources(scene) if self.simulated else dict(OF_A_BENCH)
        self._zero = EPOCH_NS if self.simulated else None
        self._telemetry = DetectorTelemetry(self.messages, info.run_id)
        self._state = None
        self.publish(self._telemetry.begin(scene.detector))
        if given := self._criteria.given():
            self.get_logger().info(f"{info.name}: judged by {given}; else by the scene")

    def end(self, reason: str) -> list[str]:
        """Send the final verdict, and say how much was sent."""
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
        self.drain(1.0)
        self.publish(self._telemetry.end(complete=not reason, reason=reason))
        return super().end(reason)

    def _take(self, topic: Topic, data: bytes) -> None:
        source = self._sources.get(topic)
        if source is None:
            return
        stamp, values = self._readers[topic](data)
        if self._zero is None:
            self._zero = stamp
        if not self.simulated:
            rivals = [other for other, kind in self._sources.items() if kind is source]
            for other in rivals:
                if other is not topic:
                    del self._sources[other]
        t = stamp_seconds(stamp - self._zero + EPOCH_NS)
        self._send_all(self._detector.measure(source, t, values))
        if silent := self._detector.aligner.silent(STALE):
            names = " and ".join(source.value for source in silent)
            self.get_logger().warning(
                f"nothing is judged: no measurement of the {names} for {STALE:g} s",
                throttle_duration_sec=5.0,
            )

    def _send_all(self, statuses: Sequence[CaptureStatus]) -> None:
        for status in statuses:
            changed = (status.state, status.final) != self._state
            self._state = status.state, status.final
            self.publish(self._telemetry.status(self._own_time(status.t), status), latch=changed)

    def _own_time(self, t: float) -> float:
        """Return the time that is stamped: a bench's own clock goes back into the message."""
        return t if self._zero in (None, EPOCH_NS) else t + (self._zero - EPOCH_NS) / 1e9


#: Earlier names of the criteria, by which they are still taken.
_FORMERLY = {field: name for name, field in CRITERIA.items()}


class Criteria:
    """The scene's criteria as parameters of the node, with their units and ranges.

    One that is not set follows the scene; one that is set holds from the next run on, as a run is
    judged by one set of criteria from its start to its end.

    Raises
    ------
    ParameterError
        A value given at the start is wrong; one line that says what is allowed.
    """

    def __init__(self, node: BenchNode) -> None:
        self._node = node
        self._fields: dict[str, Field[Any]] = {field.name: field for field in fields(Detector)}
        for field in self._fields.values():
            self._declare(field)

    def of(self, scene: Scene) -> Scene:
        """Return the scene with the criteria that are set; the others are its own."""
        values = {name: self._node.get_parameter_or(name).value for name in self._fields}
        given = {name: float(value) for name, value in values.items() if value is not None}
        return replace(scene, detector=replace(scene.detector, **given)) if given else scene

    def given(self) -> str:
        """Return the criteria that are set, as text; empty when all are the scene's."""
        return ", ".join(
            f"{name} = {value:g} {field.metadata['unit']}"
            for name, field in self._fields.items()
            if (value := self._node.get_parameter_or(name).value) is not None
        )

    def _declare(self, field: Field[Any]) -> None:
        def check(value: float) -> None:
            try:
                Detector(**{field.name: value})
            except SceneError as error:
                raise ParameterError(f"parameter {str(error).removeprefix('Detector.')}") from None

        self._node.declare(
            field.name,
            float,
            f"{field.metadata['unit']}, {field.metadata['doc']}; not set: the scene's",
            allowed="a number with a decimal point, "
            f"{field.metadata['allowed']} {field.metadata['unit']}",
            read_only=False,
            check=check,
            formerly=_FORMERLY[field.name],
        )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; return the exit status."""
    return run(CaptureDetectorNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
