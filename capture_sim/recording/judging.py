"""The capture detector on a recording, as if it had listened then."""

from __future__ import annotations

from capture_sim.detection.decisions import CaptureStatus
from capture_sim.detection.watching import Watch, watched
from capture_sim.errors import RecordingError
from capture_sim.recording.definitions import typestore
from capture_sim.recording.reader import Run
from capture_sim.scene import Scene


def judge_recording(run: Run, scene: Scene | None = None) -> list[CaptureStatus]:
    """Judge a recorded run again, from its poses and buffer states alone.

    Parameters
    ----------
    run
        From :func:`capture_sim.recording.read_run`.
    scene
        With the criteria to judge by; None takes the recorded scene.

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
    scene = run.scene if scene is None else scene
    for topic in watched(scene):
        if not run.raw(topic):
            raise RecordingError(f"{run.path}: holds no {topic.name}, which the detector needs")
    store = typestore()
    watch = Watch(scene)
    stored = [
        (int(time), place, topic, data)
        for topic in watched(scene)
        for place, (time, data) in enumerate(zip(run.log_times(topic), run.raw(topic), strict=True))
    ]
    # in the order of recording; within a topic that is the order of arrival
    stored.sort(key=lambda item: item[:2])
    statuses = [
        status
        for _, _, topic, data in stored
        for status in watch.take(topic.name, store.deserialize_cdr(data, topic.type_name))
    ]
    return [*statuses, *watch.finish(cut=run.cut)]
