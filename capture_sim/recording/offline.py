"""Recording of a run that was simulated without ROS, as if the nodes had sent it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

import numpy as np

from capture_sim.base.files import free_path, is_device, whole_file
from capture_sim.errors import RecordingError
from capture_sim.launcher.state_machine import Launcher, LauncherStatus, LaunchObservation
from capture_sim.messages.convert import (
    LaunchAction,
    Messages,
    RunDescription,
    StringPhase,
    speeds_along_rail,
    stamp_ns,
    stamp_seconds,
    stamps_ns,
    string_phases,
)
from capture_sim.messages.telemetry import (
    BenchTelemetry,
    DetectorTelemetry,
    LauncherTelemetry,
    Sent,
    samples_per_message,
)
from capture_sim.messages.topics import CAPTURE_DETECTOR, LAUNCHER, SIMULATOR, TOPICS, Topic
from capture_sim.recording.scan import head_metadata
from capture_sim.recording.write import RUN_METADATA, RunWriter, describing
from capture_sim.run.loads import extremes_to_text

if TYPE_CHECKING:
    from capture_sim.run.run import Run
    from capture_sim.scene.parts import Scene

#: The nodes whose streams a run is made of.
PUBLISHERS = (SIMULATOR, LAUNCHER, CAPTURE_DETECTOR)
#: Origin of such a file, in the metadata record.
SIMULATED = "simulated"
#: Samples whose messages are made at a time.
BLOCK = 4096


def write_run(
    result: Run,
    path: Path | str,
    run_id: str | None = None,
    *,
    overwrite: bool = False,
    others: Mapping[Topic, Sequence[tuple[float, bytes]]] | None = None,
) -> Path:
    """Write a simulated run to one MCAP file, as the nodes would have recorded it.

    Parameters
    ----------
    result
        The run, sampled at ``scene.run.state_rate``.
    path
        The file.  It gets this name when it is complete, but a device is written directly.  If
        there is a file of this name, it is replaced if it is a run that was simulated without ROS,
        of the same scene and software; with ``overwrite`` of any scene and software.  Any other
        file is kept, and the new one gets a number after its name.
    run_id
        Id of the run; None for a new one.
    overwrite
        See ``path``.
    others
        Messages of further topics, each with its time, s since the release.

    Returns
    -------
    pathlib.Path
        The path of the file.

    Raises
    ------
    RecordingError
        The file cannot be written, or the run has other samples.
    """
    _check_grid(result)
    path = Path(path)
    run = RunDescription.of(result.scene, uuid4().hex if run_id is None else run_id, PUBLISHERS)
    while True:
        replaced = is_device(path) or _is_repeatable(path, None if overwrite else run)
        target = path if replaced else free_path(path)
        try:
            with whole_file(target, replace=replaced) as part:
                _write(result, run, part, target.name, others or {})
        except FileExistsError:
            continue  # another command was faster
        return target


def _write(
    result: Run,
    run: RunDescription,
    part: Path,
    name: str,
    others: Mapping[Topic, Sequence[tuple[float, bytes]]],
) -> None:
    topics = (*TOPICS, *others)
    with RunWriter(part, run, {"origin": SIMULATED}, topics=topics, name=name) as writer:
        for topic, messages in others.items():
            for t, data in messages:
                writer.write(topic, data, stamp_ns(t))
        for topic, stamp, data in run_stream(result, run):
            writer.write(topic, data, stamp)
        if result.wall_time is not None:
            writer.closing["wall_time"] = repr(result.wall_time)
        writer.closing["extremes"] = extremes_to_text(result.extremes)


def _is_repeatable(path: Path, run: RunDescription | None) -> bool:
    """Return True if a file may be replaced, because its run can be simulated again.

    The file must be a run that was simulated without ROS, and, with ``run``, one of the same scene
    and software.
    """
    earlier = head_metadata(path).get(RUN_METADATA, {})
    if earlier.get("origin") != SIMULATED:
        return False
    made_by = ("scene_sha256", "software")
    return run is None or all(earlier.get(key) == describing(run)[key] for key in made_by)


def run_stream(result: Run, run: RunDescription) -> Iterator[Sent]:
    """Yield the messages of simulator, launcher and detector in a simulated run.

    They come in the order in which the nodes would send them, each with topic, stamp (ns) and
    bytes.  RecordingError, at the first ``next``, if the run is not sampled at
    ``scene.run.state_rate``.
    """
    _check_grid(result)
    scene, samples = result.scene, result.samples
    messages = Messages()
    bench = BenchTelemetry(messages, scene, run)
    follower = LauncherTelemetry(messages, run.run_id)
    detector = DetectorTelemetry(messages, run.run_id)
    launcher = Launcher(scene)

    yield bench.begin()
    yield follower.command(0.0, LaunchAction.ARM, launcher.plan)
    yield from follower.status(0.0, launcher.status)
    yield follower.command(0.0, LaunchAction.RELEASE, launcher.plan)
    yield from follower.status(0.0, launcher.release())
    yield detector.begin(scene.detector)
    periodic = samples[:: samples_per_message(run.state_rate, run.rate)]
    launched = follower.statuses(_launched(launcher, scene, periodic))
    times = deque(periodic["t"].tolist())
    *decided, verdict = result.statuses
    statuses = detector.statuses((status.t, status) for status in decided)
    waiting = deque(status.t for status in decided)
    events, trace = iter([result.events]), iter([result.trace])
    for first in range(0, len(samples), BLOCK):
        block = samples[first : first + BLOCK]
        made = bench.block(block, next(events, ()), next(trace, None))
        for sent in chain.from_iterable(made):
            yield sent
            if sent.topic is bench.LAST_PERIODIC:
                yield from next(launched)
                t = times.popleft()
                while waiting and waiting[0] <= t:
                    waiting.popleft()
                    yield from next(statuses)
    yield from bench.rest()
    yield bench.end(result.failure)
    yield follower.end(result.failure)
    for undelivered in statuses:
        yield from undelivered
    yield from detector.status(verdict.t, verdict)
    yield detector.end(result.failure)


def _launched(
    launcher: Launcher, scene: Scene, samples: np.ndarray
) -> Iterator[tuple[float, LauncherStatus]]:
    """Yield the time of each sample, s, and the launcher's status after it."""
    speeds = speeds_along_rail(samples, scene).tolist()
    travels = [launcher.travelled(x, y) for x, y in samples["q"][:, :2].tolist()]
    slack = (string_phases(samples, scene) == StringPhase.SLACK).tolist()
    touched = (samples["touches"] > 0).tolist()
    # as in the node, which has the times of stamps
    times = [stamp_seconds(stamp) for stamp in stamps_ns(samples["t"]).tolist()]
    for t, values in zip(times, zip(speeds, travels, slack, touched, strict=True), strict=True):
        yield t, launcher.observe(LaunchObservation(t, *values))


def _check_grid(result: Run) -> None:
    scene, samples = result.scene, result.samples
    if not np.array_equal(samples["t"], np.arange(len(samples)) / scene.run.state_rate):
        raise RecordingError(
            f"{scene.name}: only a run sampled at run.state_rate = {scene.run.state_rate:g} Hz "
            "can be recorded"
        )
