"""Recording of a run that was simulated without ROS, as if the nodes had sent it."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.launch.plan import Launcher
from capture_sim.messages.convert import (
    LaunchAction,
    RunDescription,
    StringPhase,
    speed_along,
    string_phase,
)
from capture_sim.messages.telemetry import (
    BenchTelemetry,
    DetectorTelemetry,
    LauncherTelemetry,
    Sent,
    samples_per_message,
)
from capture_sim.messages.topics import CAPTURE_DETECTOR, LAUNCHER, SIMULATOR
from capture_sim.recording.column_stream import ColumnStream
from capture_sim.recording.definitions import offline_messages
from capture_sim.recording.writer import RunWriter, free_path

if TYPE_CHECKING:
    from capture_sim.simulation import Result

#: The nodes whose streams a run is made of.
PUBLISHERS = (SIMULATOR, LAUNCHER, CAPTURE_DETECTOR)
#: What the metadata record of such a file says of its origin.
SIMULATED = "simulated"


def write_run(
    result: Result, path: Path | str, run_id: str | None = None, *, replace: bool = True
) -> Path:
    """Write a simulated run as one MCAP file.

    It holds the streams that simulator, launcher and capture detector send, byte for byte
    those of :func:`run_stream`, but serialised by columns.

    Parameters
    ----------
    result
        Sampled on the grid of ``scene.run.state_rate``.
    path
        File to write.  An earlier simulated run there is replaced; beside any other
        recording, which could not be made again, the file gets a number behind its name.
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
    if path.is_file() and not (replace and is_simulated(path)):
        path = free_path(path)
    run = RunDescription.of(result.scene, uuid4().hex if run_id is None else run_id, PUBLISHERS)
    stream = ColumnStream(result, run)
    with RunWriter(path, run, {"origin": SIMULATED}, replace=replace) as writer:
        if not stream.covers_all:
            for topic, message in run_stream(result, run):
                writer.write(topic, message)
            writer.closing["wall_time"] = repr(result.wall_time)
            return writer.path
        for topic, message in stream.head():
            writer.write(topic, message)
        for blocks, order in stream.blocks():
            writer.write_rows(blocks, order)
        for topic, message in stream.tail():
            writer.write(topic, message)
        writer.closing["wall_time"] = repr(result.wall_time)
    return writer.path


def is_simulated(path: Path) -> bool:
    """Whether a file says of itself that it holds a run simulated without nodes."""
    try:
        with path.open("rb") as file:
            head = file.read(65536)
    except OSError:
        return False
    entry = [struct.pack("<I", len(text)) + text.encode() for text in ("origin", SIMULATED)]
    return b"".join(entry) in head


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

    yield from bench.begin()
    yield follower.command(0.0, LaunchAction.ARM, launcher.plan)
    yield follower.state(0.0, launcher.status)
    yield follower.command(0.0, LaunchAction.RELEASE, launcher.plan)
    yield follower.state(0.0, launcher.release())
    yield detector.begin(scene.detector)
    *judged, verdict = result.statuses
    waiting = deque(judged)
    periodic = iter(samples[:: samples_per_message(run.state_rate, run.rate)])
    for topic, message in bench.block(samples, result.events, result.trace):
        yield topic, message
        if topic is bench.LAST_PERIODIC:
            sample = next(periodic)
            launched = launcher.observe(
                speed_along(scene.initial.chaser.theta, sample["v"]),
                string_phase(sample, has_string=scene.string is not None) is StringPhase.SLACK,
                touched=int(sample["touches"]) > 0,
            )
            yield follower.state(float(sample["t"]), launched)
            while waiting and waiting[0].t <= float(sample["t"]):
                status = waiting.popleft()
                yield detector.status(status.t, status)
    complete, reason = not result.failure, result.failure
    yield from bench.end(complete=complete, reason=reason)
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
