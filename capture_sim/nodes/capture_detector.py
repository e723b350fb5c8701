"""The node that detects, from poses and buffer state alone, whether the tip is captured."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

from rclpy.parameter import Parameter

from capture_sim.detection.align import MAX_LEAD, Source
from capture_sim.detection.clocks import MAX_OFFSET
from capture_sim.detection.exact import CaptureState, CaptureStatus
from capture_sim.detection.noisy import NoisyDetector
from capture_sim.errors import SceneError
from capture_sim.messages.convert import EPOCH_NS, stamp_seconds
from capture_sim.messages.measurements import OF_A_BENCH, MeasurementReader, detector_sources
from capture_sim.messages.telemetry import DetectorTelemetry
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    Topic,
    topics_of,
)
from capture_sim.nodes.parameters import ParameterError
from capture_sim.nodes.participant import READ, Participant
from capture_sim.nodes.process import run
from capture_sim.scene.parts import Detector, Scene

#: The node warns of a source whose last stamp is this much older than the others', s.
STALE = 2.0
CRITERION = {field.name: field for field in fields(Detector)}
#: The parameter that names the criteria whose parameters show the scene's values.
SCENE_CRITERIA = "scene_criteria"


class CaptureDetectorNode(Participant):
    """Publishes a status for every instant at which the poses were measured.

    The decisions are those of :mod:`capture_sim.detection`.
    """

    # of the run that is on
    _detector: NoisyDetector
    _sources: dict[Topic, Source]
    _telemetry: DetectorTelemetry
    _state: CaptureState
    _zero: int | None  # ns, stamp of t = 0: the release, or a bench's first measurement

    def __init__(self) -> None:
        super().__init__(CAPTURE_DETECTOR)
        self._declare_criteria()
        self.open(topics_of(CAPTURE_DETECTOR))
        self._readers = {topic: MeasurementReader(topic) for topic in READ[CAPTURE_DETECTOR]}
        for topic in self._readers:
            self.follow(topic, partial(self._receive_measurement, topic), raw=True)
        self._scene = self.declare_scene(
            "evaluate by this scene from the start, for a bench where no node announces runs; "
            "empty to wait for a run"
        )

    def work(self) -> int:
        """Take part until the process is to end; return the exit status."""
        if self._scene is not None:
            self.announce(self._scene.name, self._scene)
            self.get_logger().info(f"evaluated by {self._scene.name} until Ctrl-C")
        return super().work()

    def begin(self, info: Any, scene: Scene) -> None:
        """Start anew for the scene of this run."""
        criteria = self._criteria()
        scene = replace(scene, detector=replace(scene.detector, **criteria))
        self._detector = NoisyDetector(scene, is_released=self.simulated)
        self._sources = detector_sources(scene) if self.simulated else dict(OF_A_BENCH)
        self._zero = EPOCH_NS if self.simulated else None
        self._state = CaptureState.APPROACH
        self._telemetry = DetectorTelemetry(self.messages, info.run_id)
        self.publish(self._telemetry.begin(scene.detector))
        self._show_criteria(scene.detector, criteria)
        if criteria:
            given = ", ".join(
                f"{n} = {v:g} {CRITERION[n].metadata['unit']}" for n, v in criteria.items()
            )
            self.get_logger().info(f"{info.name}: evaluated by {given}; else by the scene")

    def end(self, reason: str) -> list[str]:
        """Send the final verdict, and say how much was sent."""
        statuses = self._detector.finish(cut=self.cut)
        self._send_all(statuses)
        verdict = statuses[-1]
        self.get_logger().info(f"{self.run.name}: {verdict.label}, {verdict.reason}")
        if skipped := self._detector.aligner.skipped:
            self.get_logger().warning(
                f"{self.run.name}: {skipped} instants skipped: gap in a measurement source"
            )
        self.drain(1.0)
        self.publish(self._telemetry.end(complete=not reason, reason=reason))
        return super().end(reason)

    def trial_result(self) -> str:
        """Return the verdict."""
        return f"verdict {self._state.label}" if self._state.is_verdict else "no verdict"

    def _declare_criteria(self) -> None:
        """Declare the scene's criteria as parameters, with their units and ranges.

        One that is set applies from the next run on, as a run is evaluated by one set of criteria
        from its start to its end.  The others have the values of the scene, once a run has begun.
        """
        for name, field in CRITERION.items():
            unit, allowed = field.metadata["unit"], field.metadata["allowed"]
            self.declare(
                name,
                float,
                f"{unit}, {field.metadata['doc']}; .nan: the scene's, shown once a run has begun",
                allowed=f"a number with a decimal point, {allowed} {unit}",
                read_only=False,
                check=partial(_check_criterion, name),
            )
        of_scene = self.declare(
            SCENE_CRITERIA,
            list,
            "criteria that are taken from the scene, whatever their parameters show; those that "
            "are not set, unless given",
            choices=tuple(CRITERION),
            read_only=False,
            check=_check_names,
        )
        self._scene_criteria = set(of_scene)
        self.add_post_set_parameters_callback(self._criteria_set)

    def _criteria_set(self, parameters: list[Parameter]) -> None:
        """Take note which criteria are set from now on."""
        values = {parameter.name: parameter.value for parameter in parameters}
        self._scene_criteria.difference_update(values)
        self._scene_criteria.update(values.get(SCENE_CRITERIA, ()))

    def _criteria(self) -> dict[str, float]:
        """Return the criteria that are set; the others are the scene's."""
        values = {name: float(self.get_parameter(name).value) for name in CRITERION}
        return {
            name: value
            for name, value in values.items()
            if name not in self._scene_criteria and not math.isnan(value)
        }

    def _show_criteria(self, in_force: Detector, given: Collection[str]) -> None:
        """Let the parameters show the criteria in force."""
        of_scene = [name for name in CRITERION if name not in given] or [""]
        self.set_parameters_atomically(
            [
                *(Parameter(name, value=getattr(in_force, name)) for name in CRITERION),
                Parameter(SCENE_CRITERIA, value=of_scene),
            ]
        )

    def _receive_measurement(self, topic: Topic, data: bytes) -> None:
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
        arrival = None if self.simulated else time.monotonic()
        self._send_all(self._detector.measure(source, t, values, arrival))
        self._warn_of_sources()

    def _warn_of_sources(self) -> None:
        """Name a source that is silent, far ahead, or of another clock."""
        detector, warnings = self._detector, []
        if offset := detector.clock_offset:
            source, lead = offset
            warnings.append(
                f"{source.value}: clock {abs(lead):.3f} s {'ahead of' if lead > 0.0 else 'behind'} "
                f"the other sources' (stamp less arrival): must be at most {MAX_OFFSET:g} s"
                + ("; nothing is evaluated" if detector.clocks_differ else "")
            )
        elif silent := detector.aligner.silent(STALE):
            names = " and ".join(source.value for source in silent)
            warnings.append(f"nothing is evaluated: no measurement of the {names} for {STALE:g} s")
        for source, (count, lead) in detector.aligner.rejected_leads.items():
            warnings.append(
                f"{source.value}: {count} stamps rejected, up to {lead:.4g} s ahead of the other "
                f"sources: must be at most {MAX_LEAD:g} s"
            )
        if warnings:
            self.get_logger().warning("; ".join(warnings), throttle_duration_sec=5.0)

    def _send_all(self, statuses: Sequence[CaptureStatus]) -> None:
        for status in statuses:
            self._state = status.state
            self.publish(*self._telemetry.status(self._own_time(status.t), status))

    def _own_time(self, t: float) -> float:
        """Return the time that is stamped: a bench's own clock goes back into the message."""
        return t if self._zero in (None, EPOCH_NS) else t + (self._zero - EPOCH_NS) / 1e9


def _check_criterion(name: str, value: float) -> None:
    try:
        Detector(**{name: value})
    except SceneError as error:
        raise ParameterError(f"parameter {str(error).removeprefix('Detector.')}") from None


def _check_names(names: Sequence[str]) -> None:
    if unknown := {*names} - CRITERION.keys():
        raise ParameterError(
            f"parameter {SCENE_CRITERIA} = {sorted(unknown)}: must be of {', '.join(CRITERION)}"
        )


main = partial(run, CaptureDetectorNode)

if __name__ == "__main__":
    raise SystemExit(main())
