"""Replays of a run as a real bench would have measured it: scatter, loss, delay."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from capture_sim.detection.criteria import CaptureStatus
from capture_sim.detection.detector import CaptureDetector
from capture_sim.detection.measurements import Source
from capture_sim.run.run import Run
from capture_sim.scene.parts import Scene

Measurement = tuple[Source, float, tuple[float, ...]]


@dataclass(frozen=True)
class Disturbance:
    """What happens to measurements on their way; the defaults are those of docs/detection.md.

    Attributes
    ----------
    position, angle
        Standard deviation of each coordinate (m) and heading (rad) of both vehicles.
    stroke, torsion
        ... and of the buffer's measurements, m and rad.
    loss
        Share of the messages that never arrive, of each source by itself.
    jitter
        s.  A message is stamped later than it was measured by up to this, and arrives later
        than its stamp by up to this again, so that messages overtake each other.
    """

    position: float = 1e-3
    angle: float = math.radians(0.2)
    stroke: float = 1e-4
    torsion: float = math.radians(0.02)
    loss: float = 0.05
    jitter: float = 0.02


def disturbed(
    result: Run, how: Disturbance, rng: np.random.Generator, rate: float = 100.0
) -> Iterator[Measurement]:
    """Yield a run's poses and buffer states as they would arrive.

    Parameters
    ----------
    result
        The run, without noise.
    how
        What is done to it.
    rng
        Makes the noise.
    rate
        Hz, of each source.
    """
    every = round(result.scene.run.state_rate / rate)
    samples = result.samples[::every]
    t, q = samples["t"], samples["q"]
    n = t.size
    buffer = np.column_stack([samples["axial_stroke"], samples["torsion"]])
    pose = [how.position, how.position, how.angle]
    arriving: list[tuple[float, Measurement]] = []
    for source, values, scatter in (
        (Source.CHASER, q[:, 0:3], pose),
        (Source.TARGET, q[:, 5:8], pose),
        (Source.BUFFER, buffer, [how.stroke, how.torsion]),
    ):
        measured = values + rng.standard_normal(values.shape) * np.array(scatter)
        stamps = t + rng.uniform(0.0, 1.0, n) * how.jitter
        arrival = stamps + rng.uniform(0.0, 1.0, n) * how.jitter
        kept = rng.uniform(size=n) >= how.loss
        for i in np.nonzero(kept)[0]:
            row = tuple(measured[i].tolist())
            arriving.append((float(arrival[i]), (source, float(stamps[i]), row)))
    arriving.sort(key=lambda item: item[0])
    for _, measurement in arriving:
        yield measurement


def judge(scene: Scene, measurements: Iterator[Measurement]) -> tuple[CaptureStatus, float]:
    """Return the verdict on measurements in the order of their arrival, and its time, s."""
    detector = CaptureDetector(scene)
    verdict: CaptureStatus | None = None
    for source, t, values in measurements:
        for status in detector.measure(source, round(t * 1e9), values):
            if status.final and verdict is None:
                verdict = status
    last = detector.finish()[-1]
    return last, (last if verdict is None else verdict).t
