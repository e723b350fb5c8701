"""The quality of a recording: a row for each topic, and what each command lacks in it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from capture_sim.errors import CaptureSimError
from capture_sim.messages import topics
from capture_sim.messages.topics import Topic
from capture_sim.plausibility.rules import Doubt, Grade
from capture_sim.plausibility.signals import noise
from capture_sim.recording.bag import Bag
from capture_sim.recording.clock import has_stamps, stamps_of
from capture_sim.run.run import Run
from capture_sim.run.series import Series

#: What a topic of the bench measures: quantities of Run.series, and their parts.
_MEASURED: dict[Topic, tuple[tuple[str, tuple[str, ...], str, float], ...]] = {
    topics.CHASER_POSE: (("chaser", ("x", "y"), "mm", 1e3),),
    topics.TARGET_POSE: (("target", ("x", "y"), "mm", 1e3),),
    topics.CHASER_ODOMETRY: (("chaser", ("x", "y"), "mm", 1e3),),
    topics.TARGET_ODOMETRY: (("target", ("x", "y"), "mm", 1e3),),
    topics.JOINT_STATES: (
        ("stroke", ("stroke",), "mm", 1e3),
        ("torsion", ("torsion",), "mrad", 1e3),
    ),
    topics.BUFFER_STATE: (
        ("stroke", ("stroke",), "mm", 1e3),
        ("torsion", ("torsion",), "mrad", 1e3),
    ),
    topics.LOAD_CELL: (("cone_force", ("x", "y"), "N", 1.0),),
    topics.CONTACT_WRENCH: (("tip_force", ("x", "y"), "N", 1.0),),
}
#: What those topics are used for.
_USES = {
    **dict.fromkeys((topics.CHASER_POSE, topics.CHASER_ODOMETRY), "chaser's pose"),
    **dict.fromkeys((topics.TARGET_POSE, topics.TARGET_ODOMETRY), "target's pose"),
    **dict.fromkeys((topics.JOINT_STATES, topics.BUFFER_STATE), "buffer"),
    **dict.fromkeys((topics.LOAD_CELL, topics.CONTACT_WRENCH), "force, first contact, touches"),
    topics.LAUNCH_COMMAND: "release, launch",
    topics.RUN_INFO: "scene, release",
    topics.CAPTURE_STATUS: "recorded verdict",
    topics.CAPTURE_CRITERIA: "criteria",
    topics.BENCH_STATE: "exact samples",
    topics.BENCH_EVENT: "touches, events",
}


@dataclass(frozen=True)
class SeriesRow:
    """What a recording contains of one topic; a value that is not known is None.

    Times are s since the release: of the stamps for a topic that measures poses, buffer or force,
    else of logging.  Rate and gap are of the same times.
    """

    topic: str
    type: str
    serialization_format: str
    messages: int
    rate: float | None  # Hz, by the median interval
    gap: float | None  # s, longest interval
    first: float | None
    last: float | None
    clock: float | None  # s, median of stamp less arrival
    noise: str  # standard deviations, with units
    range: str  # smallest and largest values, with units
    use: str  # what it is used for, or why it is left out


def series_rows(bag: Bag, run: Run) -> list[SeriesRow]:
    """Return a row for each topic of a recording, sorted by name; ``run`` is its run."""
    left_out = {d.topic: d.rule.name for d in run.doubts if d.leaves_out_topic}
    return [_row(bag, run, name, left_out) for name in sorted(bag.topics)]


def _row(bag: Bag, run: Run, name: str, left_out: dict[str, str]) -> SeriesRow:
    logged = bag.log_times(name)
    topic = topics.topic_named(name)
    topic = topic if topic is not None and bag.holds(topic) else None
    times, clock = bag.clock.since_by_log(logged), None
    if topic in _MEASURED and logged.size:
        with suppress(CaptureSimError):
            columns, log_times = bag.readable(topic)
            if has_stamps(columns):
                stamps = stamps_of(columns)
                times = bag.clock.since(stamps)
                clock = float(np.median(stamps - log_times)) / 1e9
    steps = np.diff(np.sort(times)) if times.size > 1 else np.zeros(0)
    middle = float(np.median(steps)) if steps.size else 0.0
    by_noise, by_range = [], []
    for quantity, parts, unit, factor in _MEASURED.get(topic, ()) if topic is not None else ():
        series = run.series.get(quantity, {}).get(topic.name if topic else "")
        if series is not None and series.t.size:
            for part, values in zip(parts, _columns(series), strict=False):
                by_noise.append(f"{part} {factor * noise(values):.2g} {unit}")
                low, high = factor * float(values.min()), factor * float(values.max())
                by_range.append(f"{part} {low:.4g} to {high:.4g} {unit}")
    use = _USES.get(topic, "") if topic is not None else ""
    for doubted, rule in left_out.items():
        if name in doubted.split(" and "):
            use = f"left out ({rule})"
    return SeriesRow(
        topic=name,
        type=bag.types.get(name, ""),
        serialization_format="cdr",
        messages=bag.topics[name],
        rate=1.0 / middle if middle > 0.0 else None,
        gap=float(steps.max()) if steps.size else None,
        first=float(times.min()) if times.size else None,
        last=float(times.max()) if times.size else None,
        clock=clock,
        noise=", ".join(by_noise),
        range=", ".join(by_range),
        use=use or "-",
    )


def _columns(series: Series) -> np.ndarray:
    """Return the values of a series as one row for each component, (m, n); m is 1 for scalars."""
    return series.values[None] if series.values.ndim == 1 else series.values.T


def missing_for(run: Run) -> dict[str, list[str]]:
    """Return what a run lacks for each of the commands ``detect``, ``compare`` and ``calibrate``.

    The result is by command; a list is empty if the command can use the run.
    """
    refused = [d.rule.name for d in run.doubts if d.grade is Grade.REFUSED]
    common = [f"rule {name} kept" for name in dict.fromkeys(refused)]
    vehicles = [v for v in ("chaser", "target") if not run.measured(v).t.size]
    poses = [f"poses of the {vehicle}" for vehicle in vehicles]
    scene = [] if run.given.scene is not None else ["a scene (--scene)"]
    has_buffer = all(run.measured(name).t.size for name in ("stroke", "torsion"))
    buffer = [] if has_buffer else ["the buffer's state"]
    contact: list[str] = []
    with suppress(CaptureSimError):
        contact = [] if run.first_contact is not None else ["a contact in a force or the buffer"]
    return {
        "detect": common + scene + poses + buffer,
        "compare": common + contact,
        "calibrate": common + scene + poses,
    }


def as_data(bag: Bag, run: Run) -> dict[str, object]:
    """Return what ``inspect`` shows as data of plain types, for JSON."""
    return {
        "recording": str(bag.path),
        "scene": None if run.given.scene is None else run.given.scene.name,
        "problems": [*bag.left_out, *bag.problems],
        "series": [vars(row) for row in series_rows(bag, run)],
        "doubts": [_doubt(doubt) for doubt in run.doubts],
        "not_applied": {rule.name: reason for rule, reason in run.unapplied},
        "missing": missing_for(run),
    }


def _doubt(doubt: Doubt) -> dict[str, object]:
    return {
        "rule": doubt.rule.name,
        "grade": str(doubt.grade),
        "topic": doubt.topic,
        "text": doubt.text,
        "messages": doubt.messages,
    }
