"""Evaluation of a finished run with the capture detector, as the live detector would do it."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from capture_sim.detection.criteria import CaptureState, CaptureStatus, Cause, Criteria, reason
from capture_sim.detection.exact import ExactDetector, Statuses
from capture_sim.detection.measurements import REORDER, Source, Values
from capture_sim.run.series import STATE, SeriesBySource, at_rate
from capture_sim.scene.parts import Detector, Scene

#: Resolution of stamps that count from 1970, as floats, s.
TICK = 1e-6


class LiveConditions(NamedTuple):
    """Conditions under which the live detector evaluated a run, to repeat the evaluation."""

    is_simulated: bool  # True: one clock for all stamps, and the run begins with the release
    last: float = math.inf  # last instant to evaluate, s since the release
    is_cut: bool = False  # True: the run was ended early
    has_end: bool = True  # False: the recording lacks the end of its run


def with_criteria(scene: Scene, recorded: Detector | None, changed: Collection[str]) -> Scene:
    """Return the scene with the recorded criteria of a detector.

    Criteria named in ``changed``, fields of the ``detector`` part, keep the scene's values.  If
    ``recorded`` is None, the scene is returned unchanged.
    """
    if recorded is None:
        return scene
    changes = {name: getattr(scene.detector, name) for name in changed}
    return replace(scene, detector=replace(recorded, **changes))


def as_cut(status: CaptureStatus, scene: Scene) -> CaptureStatus:
    """Return the last status of a recording, made undecided if the detector had not finished.

    The status is unchanged if it is final, a verdict, or undecided already.
    """
    if status.final or status.state.is_verdict or status.state is CaptureState.UNDECIDED:
        return status
    why = reason(Criteria.of(scene), Cause.NO_END, status.distance)
    return status._replace(state=CaptureState.UNDECIDED, time_in_state=0.0, reason=why)


def detect_state(
    state: np.ndarray, scene: Scene, *, is_cut: bool, has_end: bool = True
) -> Statuses:
    """Evaluate exact samples, (n,) of dtype SAMPLE, with the criteria of a scene.

    Only samples on the grid of ``run.rate`` are used.  ``is_cut`` and ``has_end`` are as in
    :class:`LiveConditions`.  Return the statuses; the last one has the verdict.
    """
    due = state[at_rate(state["t"], scene.run.rate)]
    return ExactDetector(scene).statuses(due, cut=is_cut, has_end=has_end)


class Received(NamedTuple):
    """A measurement as the detector has received it; times in ns since the release."""

    source: Source
    stamp: int
    values: Values
    arrival: int | None = None  # None: not to be used for comparing clocks


def detect_received(
    received: Iterable[Received], scene: Scene, live: LiveConditions
) -> list[CaptureStatus]:
    """Evaluate measurements, in the order of their arrival, as the detector's node does.

    Return the statuses, the last of which has the verdict.
    """
    from capture_sim.detection.detector import CaptureDetector  # 15 ms, not for exact samples

    detector = CaptureDetector(
        scene,
        is_released=live.is_simulated,
        reorder=0 if live.is_simulated else REORDER,
        last=live.last,
    )
    statuses = [status for each in received for status in detector.measure(*each)]
    return [*statuses, *detector.finish(cut=live.is_cut, has_end=live.has_end)]


def received_in(series: SeriesBySource) -> list[Received]:
    """Return the measurements that the series of a simulated run contain, sorted by time.

    Each quantity is read from its sensor if there is one, else from the exact state.
    """
    received = []
    for source, quantities in _QUANTITIES.items():
        # a sensor's series is preferred to the exact one
        names = (min(series[name], key=lambda of: of == STATE) for name in quantities)
        chosen = [series[q][name] for q, name in zip(quantities, names, strict=True)]
        stamps = np.rint(chosen[0].t * 1e9).astype(np.int64).tolist()
        rows = np.column_stack([each.values for each in chosen]).tolist()
        received += [
            Received(source, stamp, tuple(row)) for stamp, row in zip(stamps, rows, strict=True)
        ]
    return sorted(received, key=lambda each: each.stamp)


_QUANTITIES = {
    Source.CHASER: ("chaser",),
    Source.TARGET: ("target",),
    Source.BUFFER: ("stroke", "torsion", "stroke_rate", "torsion_rate"),
}
