"""The capture detector on a recording, as if it had run then."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

from capture_sim.detection.align import Source
from capture_sim.detection.exact import CaptureStatus
from capture_sim.detection.noisy import NoisyDetector
from capture_sim.errors import MessageError, RecordingError
from capture_sim.messages.convert import stamp_seconds
from capture_sim.messages.measurements import OF_A_BENCH, MeasurementReader, detector_sources
from capture_sim.messages.topics import CAPTURE_STATUS, RUN_INFO, Topic
from capture_sim.recording.read import Run
from capture_sim.scene.parts import Detector, Scene

#: As fine as a float is for stamps that count from 1970, s.
TICK = 1e-6


def with_criteria(scene: Scene, recorded: Detector | None, changed: Collection[str]) -> Scene:
    """Return the scene with the recorded criteria, but the scene's own where they were changed.

    Without recorded criteria, all are the scene's.
    """
    if recorded is None:
        return scene
    changes = {name: getattr(scene.detector, name) for name in changed}
    return replace(scene, detector=replace(recorded, **changes))


def detect_again(run: Run, scene: Scene | None = None) -> list[CaptureStatus]:
    """Evaluate a recorded run again, from its poses and buffer states alone.

    Return the statuses as the detector's node would have sent them, the final verdict last.  The
    criteria are those of the scene; without one, the recorded scene with the recorded criteria.
    RecordingError if the file contains no scene or lacks a topic that the detector needs.
    """
    scene = with_criteria(run.scene, run.criteria, ()) if scene is None else scene
    sources = _sources_in(run, scene)
    readers = {topic: MeasurementReader(topic) for topic in sources}
    is_simulated = run.is_simulated
    # what arrived before the announcement of a bench's trial, or after its end, the live detector
    # has not used; each node has its own moment of both
    begin, end, last = 0.0, math.inf, math.inf  # ns (wall), twice; s, the last instant
    if not is_simulated:
        begin = float(run.log_times(RUN_INFO)[:1].sum())
        if run.statuses and run.statuses[-1].final:
            end = float(run.log_times(CAPTURE_STATUS)[-1])
            last = run.statuses[-1].t + TICK
    detector = NoisyDetector(scene, is_released=is_simulated, last=last)
    stored = [
        (int(time), i, topic, data)
        for topic in sources
        for i, (time, data) in enumerate(zip(run.log_times(topic), run.raw(topic), strict=True))
        if begin <= time <= end
    ]
    # in the order of recording; within a topic that is the order of arrival
    stored.sort(key=lambda item: item[:2])
    statuses: list[CaptureStatus] = []
    read: set[Topic] = set()
    rejected: dict[Topic, MessageError] = {}
    for log_time, _, topic, data in stored:
        try:
            stamp, values = readers[topic](data)
        except MessageError as error:  # the node rejects it too
            rejected[topic] = error
            continue
        read.add(topic)
        arrival = None if is_simulated else log_time / 1e9
        statuses += detector.measure(sources[topic], stamp_seconds(stamp), values, arrival)
    for topic, reason in rejected.items():
        if topic not in read:
            raise RecordingError(f"{run.path}: {topic.name}: {reason}")
    return [*statuses, *detector.finish(cut=run.cut)]


def _sources_in(run: Run, scene: Scene) -> dict[Topic, Source]:
    """Return the recorded topics that the detector reads: the scene's, else those of a bench."""
    scene_sources = detector_sources(scene)
    recorded: dict[Source, Topic] = {}
    for topic, source in (*scene_sources.items(), *OF_A_BENCH.items()):
        if source not in recorded and run.raw(topic):
            recorded[source] = topic
    for topic, source in scene_sources.items():
        if source not in recorded:
            raise RecordingError(
                f"{run.path}: contains no {topic.name}, which the detector needs; --remap reads it "
                "from another topic"
            )
    return {topic: source for source, topic in recorded.items()}
