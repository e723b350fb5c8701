"""Recording of a run that was simulated without ROS, as if the nodes had sent it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.launching import Launcher
from capture_sim.messages import (
    LaunchAction,
    RunDescription,
    StringPhase,
    speed_along,
    string_phase,
)
from capture_sim.recording.definitions import offline_messages
from capture_sim.recording.writer import RunWriter
from capture_sim.telemetry import (
    BenchTelemetry,
    DetectorTelemetry,
    LauncherTelemetry,
    Sent,
    samples_per_message,
)
from capture_sim.topics import CAPTURE_DETECTOR, LAUNCHER, SIMULATOR

if TYPE_CHECKING:
    from capture_sim.simulation import Result

#: The nodes whose streams a run is made of.
PUBLISHERS = (SIMULATOR, LAUNCHER, CAPTURE_DETECTOR)


def write_run(result: Result, path: Path | str, run_id: str | None = None) -> Path:
    """Write a simulated run as one MCAP file.

    It holds the streams that simulator, launcher and capture detector send.

    Parameters
    ----------
    result
        Sampled on the grid of ``scene.run.state_rate``.
    path
        File to write; one that exists is replaced.
    run_id
        None makes a new one.

    Returns
    -------
    Path
        Of the file.

    Raises
    ------
    RecordingError
        The file cannot be written, or the samples are not those of the grid.
    """
    run = RunDescription.of(result.scene, uuid4().hex if run_id is None else run_id, PUBLISHERS)
    with RunWriter(path, run) as writer:
        for topic, message in run_stream(result, run):
            writer.write(topic, message)
        writer.closing["wall_time"] = repr(result.wall_time)
    return writer.path


def run_stream(result: Result, run: RunDescription) -> Iterator[Sent]:
    """Yield all messages of a simulated run, in the order in which nodes send them.

    Raises
    ------
    RecordingError
        The samples are not those of the grid.
    """
    scene, samples = result.scene, result.samples
    if not np.array_equal(samples["t"], np.arange(len(samples)) / scene.run.state_rate):
        raise RecordingError(
            f"{scene.name}: only a run sampled at run.state_rate = {scene.run.state_rate:g} Hz "
            "can be recorded"
        )
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
    statuses = iter(result.statuses)
    periodic = iter(samples[:: samples_per_message(run.state_rate, run.rate)])
    for topic, message in bench.block(samples, result.events):
        yield topic, message
        if topic is bench.LAST_PERIODIC:
            sample = next(periodic)
            launched = launcher.observe(
                speed_along(scene.initial.chaser.theta, sample["v"]),
                string_phase(sample, has_string=scene.string is not None) is StringPhase.SLACK,
                touched=int(sample["touches"]) > 0,
            )
            yield follower.state(float(sample["t"]), launched)
            yield detector.status(float(sample["t"]), next(statuses))
    complete, reason = not result.failure, result.failure
    yield from bench.end(complete=complete, reason=reason)
    yield follower.end(complete=complete, reason=reason)
    for status in statuses:  # the verdict at the end
        yield detector.status(status.t, status)
    yield detector.end(complete=complete, reason=reason)
