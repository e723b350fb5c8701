"""What the suite's nodes recorded: samples, events, contact trace, statuses and criteria.

In all functions, ``t_release`` is the value of the recorded field ``t`` at the release, s; it is 0
in a simulated run.  Returned times count from the release, s.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any

import numpy as np

from capture_sim.detection.criteria import CaptureState, CaptureStatus
from capture_sim.detection.measurements import Counts, Reason, Source
from capture_sim.dynamics.samples import (
    SAMPLE,
    TOUCH,
    TRACE,
    Event,
    EventKind,
    Phase,
)
from capture_sim.errors import RecordingError
from capture_sim.messages.convert import CRITERIA
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    CAPTURE_CRITERIA,
    CAPTURE_STATUS,
    CONTACT_TRACE,
    Topic,
)
from capture_sim.recording.clock import Clock, stamps_of
from capture_sim.recording.recorded_topics import Columns, RecordedTopics
from capture_sim.scene.parts import Detector

# events that end a touch
_ENDED = (EventKind.LIFT_OFF.label, EventKind.END.label)


def samples_in(topics: RecordedTopics, t_release: float) -> np.ndarray:
    """Return the recorded BenchStates, (n,) of dtype SAMPLE, read-only; (0,) if there are none.

    The values are bit-identical to those of the simulation; so are the times if ``t_release`` is 0.
    RecordingError if a state has a number of a phase that this version does not know.
    """
    recorded = topics.columns(BENCH_STATE)
    samples = np.zeros(len(recorded.get("t", ())), dtype=SAMPLE)
    if len(samples):
        for name in SAMPLE.names or ():
            samples[name] = recorded[name]
        _check_numbers(topics, BENCH_STATE, "phase", samples["phase"], Phase)
        samples["t"] -= t_release
    samples.flags.writeable = False
    return samples


def events_in(topics: RecordedTopics, t_release: float, *, only_known: bool) -> tuple[Event, ...]:
    """Return the recorded BenchEvents, in order of recording; empty if there are none.

    If an event is of a kind that this version does not know, it is left out with ``only_known``;
    otherwise RecordingError is raised.
    """
    recorded = topics.columns(BENCH_EVENT)
    kinds = {kind.label: kind for kind in EventKind}
    labels = recorded.get("kind", ())
    unknown = [label for label in labels if label not in kinds]
    if unknown and not only_known:
        raise RecordingError(f"{topics.path}: event of unknown kind {unknown[0]!r}")
    return tuple(
        Event(
            kind=kinds[label],
            t=float(recorded["t"][i]) - t_release,
            q=recorded["q"][i],
            v=recorded["v"][i],
            wall=int(recorded["wall"][i]),
            detail=recorded["detail"][i],
            touch=_touch(recorded, i, t_release),
        )
        for i, label in enumerate(labels)
        if label in kinds
    )


def trace_in(topics: RecordedTopics, t_release: float) -> np.ndarray:
    """Return the state of the contact at the integrator's steps, (n,) of dtype TRACE, read-only.

    (0,) if no trace is recorded: the scene of the run must request it (``run.trace``).
    RecordingError if the recorded type lacks a field.
    """
    recorded = topics.columns(CONTACT_TRACE)
    counts = [len(t) for t in recorded.get("t", ())]
    trace = np.zeros(sum(counts), dtype=TRACE)
    for name in (TRACE.names or ()) if counts else ():
        trace[name] = np.concatenate(list(recorded[name])).reshape(trace[name].shape)
    trace["t"] -= t_release
    trace.flags.writeable = False
    return trace


def statuses_in(topics: RecordedTopics, clock: Clock) -> tuple[CaptureStatus, ...]:
    """Return the recorded statuses of the live detector, in order; empty if there are none.

    Only the last one has the text ``not_used``, on the measurements that were not used in the run.
    RecordingError if a status has a number of a state that this version does not know.
    """
    recorded = topics.columns(CAPTURE_STATUS)
    if not recorded:
        return ()
    _check_numbers(topics, CAPTURE_STATUS, "state", recorded["state"], CaptureState)
    by_name: dict[str, list[Any]] = {
        name: recorded[name].tolist() for name in CaptureStatus._fields if name in recorded
    }
    by_name["t"] = clock.since(stamps_of(recorded)).tolist()
    by_name["state"] = [CaptureState(state) for state in by_name["state"]]
    rows = zip(*by_name.values(), strict=True)
    *earlier, last = (CaptureStatus(**dict(zip(by_name, row, strict=True))) for row in rows)
    return *earlier, last._replace(not_used=_rejected_in(recorded))


def criteria_in(topics: RecordedTopics) -> Detector | None:
    """Return the live detector's criteria, those of the last message; None if there is none.

    SceneError if a value is invalid.
    """
    recorded = topics.columns(CAPTURE_CRITERIA)
    if not recorded:
        return None
    return Detector(**{field: float(recorded[name][-1]) for name, field in CRITERIA.items()})


def _check_numbers(
    topics: RecordedTopics, topic: Topic, name: str, values: np.ndarray, kinds: type[IntEnum]
) -> None:
    highest = max(kinds)
    if (wrong := values[values > highest]).size:
        raise RecordingError(
            f"{topics.path}: {topic.name}: {name} = {wrong[0]}: must be 0 to {highest}"
        )


def _rejected_in(recorded: Columns) -> str:
    """Return how many measurements were not used until the last status, and why, as a text.

    Empty if all were used, or if an older version recorded the statuses without these numbers.
    """
    counts = Counts()
    for source in Source:
        for numbers in recorded.get(f"{source.value}_rejected", ())[-1:]:
            for reason, number in zip(Reason, numbers.tolist(), strict=True):
                counts.reject(source, reason, number)
    return counts.text


def _touch(recorded: Columns, i: int, t_release: float) -> np.void | None:
    """Return the touch that event number i ended, dtype TOUCH; None if the event ended none."""
    if recorded["kind"][i] not in _ENDED or recorded["wall"][i] == 0:
        return None
    touch: np.void = np.zeros(1, dtype=TOUCH)[0]
    touch["start"] = recorded["touch_start"][i]
    touch["end"] = recorded["t"][i]
    touch["rate_ratio"] = math.nan  # no message carries it
    for name in ("wall", "approach_speed", "peak_force", "peak_time", "impulse", "dissipated"):
        touch[name] = recorded[name][i]
    for name in ("start", "end", "peak_time"):
        touch[name] -= t_release
    return touch
