"""The capture detector on a run's series, as if it had read the messages then."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from capture_sim.detection.criteria import CaptureStatus
from capture_sim.detection.detector import CaptureDetector
from capture_sim.detection.exact import ExactDetector
from capture_sim.detection.measurements import REORDER, Source
from capture_sim.errors import RecordingError
from capture_sim.scene.parts import Detector, Scene
from capture_sim.series import STATE, Series, SeriesBySource, at_rate

#: Resolution of stamps that count from 1970, as floats, s.
TICK = 1e-6

#: Prefix of the sources that measure poses with noise.
_MOTION_CAPTURE = "motion_capture/"
#: Quantities of each source, with those of their rates.
_QUANTITIES = {
    Source.CHASER: (("chaser",), ("chaser_rate",)),
    Source.TARGET: (("target",), ("target_rate",)),
    Source.BUFFER: (("stroke", "torsion"), ("stroke_rate", "torsion_rate")),
}
#: The topic of each source that the detector reads if the scene has no motion capture.
_USUAL_TOPIC = {
    Source.CHASER: "chaser/odom",
    Source.TARGET: "target/odom",
    Source.BUFFER: "bench/buffer",
}


class Trial(NamedTuple):
    """The part of a recording that the live detector has used."""

    is_simulated: bool  # one clock stamps everything, and the run begins with the release
    begin: float = -math.inf  # first and last arrival, s since the release
    end: float = math.inf
    last: float = math.inf  # last instant that is evaluated, s since the release
    is_cut: bool = False  # the run ended early


def with_criteria(scene: Scene, recorded: Detector | None, changed: Collection[str]) -> Scene:
    """Return the scene with the recorded criteria, but the scene's own where they were changed.

    Without recorded criteria, all are the scene's.
    """
    if recorded is None:
        return scene
    changes = {name: getattr(scene.detector, name) for name in changed}
    return replace(scene, detector=replace(recorded, **changes))


def detect_state(state: np.ndarray, scene: Scene, *, is_cut: bool) -> list[CaptureStatus]:
    """Evaluate exact samples, (n,) of dtype SAMPLE, at the scene's ``run.rate``.

    Return the statuses; the last one has the verdict.
    """
    detector = ExactDetector(scene)
    due = state[at_rate(state["t"], scene.run.rate)]
    return [*detector.update(due), detector.finish(cut=is_cut)]


def detect_series(
    series: SeriesBySource, scene: Scene, trial: Trial, name: str
) -> list[CaptureStatus]:
    """Evaluate a run from its poses and buffer states alone; ``name`` is that of the run.

    Return the statuses as the detector's node would have sent them, the final verdict last.
    RecordingError if the run lacks a series that the detector needs.
    """
    # messages before the announcement of a bench's trial, or after its end, the live detector has
    # not used; each node has its own moment of both
    reorder = 0 if trial.is_simulated else REORDER
    detector = CaptureDetector(
        scene, is_released=trial.is_simulated, reorder=reorder, last=trial.last
    )
    statuses: list[CaptureStatus] = []
    for measurement in _in_order_of_arrival(_measured(series, scene, name)):
        if trial.begin <= measurement.arrival <= trial.end:
            arrival = None if trial.is_simulated else round(measurement.arrival * 1e9)
            stamp = round(measurement.t * 1e9)
            statuses += detector.measure(measurement.source, stamp, measurement.values, arrival)
    return [*statuses, *detector.finish(cut=trial.is_cut)]


class _Measurement(NamedTuple):
    """One message of a source."""

    arrival: float
    source: Source
    t: float
    values: tuple[float, ...]


def _in_order_of_arrival(measured: dict[Source, Series]) -> Iterator[_Measurement]:
    messages = [
        _Measurement(arrival, source, t, tuple(values))
        for source, of_source in measured.items()
        for t, values, arrival in zip(
            of_source.t.tolist(),
            of_source.values.tolist(),
            (of_source.arrival if of_source.arrival.size else of_source.t).tolist(),
            strict=True,
        )
    ]
    return iter(sorted(messages, key=lambda message: message.arrival))


def _measured(series: SeriesBySource, scene: Scene, run_name: str) -> dict[Source, Series]:
    """Return the values of each source, with their rates if it gives these."""
    is_noisy = scene.sensors is not None and scene.sensors.motion_capture is not None
    measured = {}
    for source, (quantities, rates) in _QUANTITIES.items():
        names = [name for name in series.get(quantities[0], ()) if name != STATE]
        # the scene's source of poses first
        names.sort(key=lambda name: name.startswith(_MOTION_CAPTURE) is not is_noisy)
        if not names:
            topic = _USUAL_TOPIC[source]
            if is_noisy and source is not Source.BUFFER:
                topic = f"{_MOTION_CAPTURE}{source.value}"
            raise RecordingError(
                f"{run_name}: contains no {topic}, which the detector needs; --remap reads it from "
                "another topic"
            )
        name = names[0]
        columns = [series[quantity][name] for quantity in quantities]
        columns += [
            rate
            for rate in (series.get(quantity, {}).get(name) for quantity in rates)
            if rate is not None and rate.t.size == columns[0].t.size
        ]
        measured[source] = columns[0]._replace(
            values=np.column_stack([column.values for column in columns])
        )
    return measured
