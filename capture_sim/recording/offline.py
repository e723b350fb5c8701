"""Recording of a run that was simulated without ROS, as if the nodes had sent it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

import numpy as np
from mcap.records import Chunk, Metadata
from mcap.stream_reader import StreamReader

from capture_sim.errors import RecordingError
from capture_sim.files import free_path, is_device, whole_file
from capture_sim.launch.watch import Launcher
from capture_sim.messages.convert import (
    LaunchAction,
    RunDescription,
    StringPhase,
    row_of,
    speed_along_rail,
    stamp_ns,
    string_phase,
)
from capture_sim.messages.telemetry import (
    BenchTelemetry,
    DetectorTelemetry,
    LauncherTelemetry,
    Sent,
    samples_per_message,
)
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    LAUNCHER,
    SIMULATOR,
    STREAM_COUNTS,
)
from capture_sim.recording.definitions import offline_messages
from capture_sim.recording.write import RUN_METADATA, RunWriter
from capture_sim.results import extremes_to_text

if TYPE_CHECKING:
    from capture_sim.simulation import Result

#: The nodes whose streams a run is made of.
PUBLISHERS = (SIMULATOR, LAUNCHER, CAPTURE_DETECTOR)
#: What the metadata record of such a file says of its origin.
SIMULATED = "simulated"


def write_run(
    result: Result, path: Path | str, run_id: str | None = None, *, replace: bool = True
) -> Path:
    """Write a simulated run as one MCAP file: what simulator, launcher and detector send.

    Parameters
    ----------
    result
        Sampled on the grid of ``scene.run.state_rate``.
    path
        File to write; it has its name when it is whole.  An earlier simulated run there is
        replaced; beside any other recording, which could not be made again, the file gets a
        number behind its name.
    run_id
        None makes a new one.
    replace
        Whether even a simulated run may be replaced.

    Returns
    -------
    Path
        Of the file.

    Raises
    ------
    RecordingError
        The file cannot be written, or the samples are not those of the grid.
    """
    _check_grid(result)
    path = Path(path)
    run = RunDescription.of(result.scene, uuid4().hex if run_id is None else run_id, PUBLISHERS)
    try:
        while True:
            replaced = is_device(path) or (replace and is_simulated(path))
            target = path if replaced else free_path(path)
            try:
                with whole_file(target, replace=replaced) as part:
                    _write(result, run, part, target.name)
            except FileExistsError:
                continue  # another command was faster
            return target
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None


def _write(result: Result, run: RunDescription, part: Path, name: str) -> None:
    with RunWriter(part, run, {"origin": SIMULATED}, name=name) as writer:
        for topic, t, data in run_stream(result, run):
            # the counts carry no time: they come last
            writer.write(topic, data, None if topic is STREAM_COUNTS else stamp_ns(t))
        writer.closing["wall_time"] = repr(result.wall_time)
        writer.closing["extremes"] = extremes_to_text(result.extremes)


def is_simulated(path: Path) -> bool:
    """Whether a file is a run that was simulated without ROS, and could be made again."""
    try:
        with path.open("rb") as file:
            for record in StreamReader(file, emit_chunks=True, record_size_limit=1 << 24).records:
                if isinstance(record, Metadata) and record.name == RUN_METADATA:
                    return record.metadata.get("origin") == SIMULATED
                if isinstance(record, Chunk):
                    break
    except Exception:  # whatever it is, it is no such file
        return False
    return False


def run_stream(result: Result, run: RunDescription) -> Iterator[Sent]:
    """Yield all messages of a simulated run, in the order in which nodes send them.

    Raises
    ------
    RecordingError
        The samples are not those of the grid.
    """
    _check_grid(result)
    scene, samples = result.scene, result.samples
    messages = offline_messages()
    bench = BenchTelemetry(messages, scene, run)
    follower = LauncherTelemetry(messages, run.run_id)
    detector = DetectorTelemetry(messages, run.run_id)
    launcher = Launcher(scene)

    yield bench.begin()
    yield follower.command(0.0, LaunchAction.ARM, launcher.plan)
    yield follower.state(0.0, launcher.status)
    yield follower.command(0.0, LaunchAction.RELEASE, launcher.plan)
    yield follower.state(0.0, launcher.release())
    yield detector.begin(scene.detector)
    *decided, verdict = result.statuses
    waiting = deque(decided)
    periodic = iter(samples[:: samples_per_message(run.state_rate, run.rate)])
    for sent in bench.block(samples, result.events, result.trace):
        yield sent
        if sent.topic is bench.LAST_PERIODIC:
            row = row_of(next(periodic))
            launched = launcher.observe(
                speed_along_rail(row, scene),
                string_phase(row, scene) is StringPhase.SLACK,
                touched=row.touches > 0,
            )
            yield follower.state(row.t, launched)
            while waiting and waiting[0].t <= row.t:
                status = waiting.popleft()
                yield detector.status(status.t, status)
    complete, reason = not result.failure, result.failure
    yield from bench.rest()
    yield bench.end(complete=complete, reason=reason)
    yield follower.end(complete=complete, reason=reason)
    for status in (*waiting, verdict):
        yield detector.status(status.t, status)
    yield detector.end(complete=complete, reason=reason)


def _check_grid(result: Result) -> None:
    scene, samples = result.scene, result.samples
    if not np.array_equal(samples["t"], np.arange(len(samples)) / scene.run.state_rate):
        raise RecordingError(
            f"{scene.name}: only a run sampled at run.state_rate = {scene.run.state_rate:g} Hz "
            "can be recorded"
        )
