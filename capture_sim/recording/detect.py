"""The capture detector on a recording, as if it had run then."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from capture_sim.detection.align import Source
from capture_sim.detection.exact import CaptureStatus
from capture_sim.detection.noisy import NoisyDetector
from capture_sim.errors import RecordingError
from capture_sim.messages.convert import stamp_seconds
from capture_sim.messages.measurements import OF_A_BENCH, MeasurementReader, detector_sources
from capture_sim.messages.topics import Topic
from capture_sim.recording.read import Run
from capture_sim.scene.parts import Detector, Scene


def with_limits(scene: Scene, recorded: Detector | None, changed: Collection[str]) -> Scene:
    """Return the scene with the detector's limits of then, but for those that are changed.

    Parameters
    ----------
    scene
        With the changes.
    recorded
        Recorded limits; None where there are none.
    changed
        Names of the limits that are taken from the scene.
    """
    if recorded is None:
        return scene
    kept = {name: getattr(scene.detector, name) for name in changed}
    return replace(scene, detector=replace(recorded, **kept))


def detect_again(run: Run, scene: Scene | None = None) -> list[CaptureStatus]:
    """Judge a recorded run again, from its poses and buffer states alone.

    Parameters
    ----------
    run
        From :func:`capture_sim.recording.read_run`.
    scene
        With the criteria; None takes the recorded scene and the criteria that the
        detector had then.

    Returns
    -------
    list of CaptureStatus
        As the detector's node would have sent them; the final verdict last.

    Raises
    ------
    RecordingError
        The file holds no scene, lacks a topic that the detector needs, or a message cannot be
        read.
    """
    scene = with_limits(run.scene, run.criteria, ()) if scene is None else scene
    sources = _sources_in(run, scene)
    readers = {topic: MeasurementReader(topic) for topic in sources}
    is_simulated = run.is_simulated
    detector = NoisyDetector(scene, is_released=is_simulated)
    stored = [
        (int(time), place, topic, data)
        for topic in sources
        for place, (time, data) in enumerate(zip(run.log_times(topic), run.raw(topic), strict=True))
    ]
    # in the order of recording; within a topic that is the order of arrival
    stored.sort(key=lambda item: item[:2])
    statuses: list[CaptureStatus] = []
    for log_time, _, topic, data in stored:
        stamp, values = readers[topic](data)
        arrival = None if is_simulated else log_time / 1e9
        statuses += detector.measure(sources[topic], stamp_seconds(stamp), values, arrival)
    return [*statuses, *detector.finish(cut=run.cut)]


def _sources_in(run: Run, scene: Scene) -> dict[Topic, Source]:
    """Return what the detector decides by: the scene's topics, else those of a bench."""
    wanted = detector_sources(scene)
    found: dict[Source, Topic] = {}
    for topic, source in (*wanted.items(), *OF_A_BENCH.items()):
        if source not in found and run.raw(topic):
            found[source] = topic
    for topic, source in wanted.items():
        if source not in found:
            raise RecordingError(
                f"{run.path}: contains no {topic.name}, which the detector needs; --remap reads it "
                "from another topic"
            )
    return {topic: source for source, topic in found.items()}
