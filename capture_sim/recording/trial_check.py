"""What the file of a trial lacks, as it lies on the disk when the trial is over.

A count of messages says nothing of a file that was removed, or of a recorder that stood still while
the sensors went on.  Therefore the file itself is read again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from capture_sim.errors import CaptureSimError
from capture_sim.messages.measurements import OF_A_BENCH
from capture_sim.messages.topics import CAPTURE_STATUS, HOLD, LAUNCH_COMMAND, LOAD_CELL, Topic
from capture_sim.plausibility.rules import Grade
from capture_sim.recording.bag import Bag, read_bag
from capture_sim.recording.clock import stamps_of
from capture_sim.recording.read import run_of
from capture_sim.run.run import Run, detect
from capture_sim.run.verdict import with_criteria

#: A source has a gap if two of its measurements are further apart than this, s, and than this
#: number of its periods (median).
MIN_GAP, GAP_PERIODS = 0.1, 5.0
#: Without a verdict, what is missing in the last part of a file is no gap, s: topics end one after
#: another.
LAST_PART = 0.5
#: Accepted difference in the time of a verdict, s: recorder and detector may have received the
#: messages of different topics in different orders.
VERDICT_TOLERANCE = 0.1


def checked_trial(path: Path) -> tuple[list[str], Run | None]:
    """Return a line for each thing that the file of a finished trial lacks, and the run in it.

    The list is empty if the file is whole; without a run that can be read, it says why.

    - the file exists, and can be read to its end;
    - no source has a gap between the release and the verdict, or, without a verdict, the end of the
      file, see :data:`MIN_GAP` and :data:`LAST_PART`; if all sources had stopped before the chaser
      was held again, the gap ends there;
    - no rule of plausibility excludes a topic, but those that the trial waives;
    - the detector's verdict, made again from the file, is the recorded one, within 0.1 s.
    """
    try:
        bag = read_bag(path)
        run = run_of(bag)
    except CaptureSimError as error:
        return [f"read again: {error}"], None
    try:
        grave = [d for d in run.doubts if d.grade is Grade.REFUSED or d.leaves_out_topic]
        lines = [*bag.damage, *_gaps(bag), *(doubt.line for doubt in grave)]
        is_refused = any(doubt.grade is Grade.REFUSED for doubt in grave)
        return lines if is_refused else [*lines, *_other_verdict(run)], run
    except CaptureSimError as error:
        return [f"read again: {error}"], run


def _gaps(bag: Bag) -> Iterator[str]:
    """Yield a line for each gap in a source between the release and the verdict."""
    measured = {t: _measured(bag, t) for t in (*OF_A_BENCH, LOAD_CELL) if bag.holds(t)}
    times = {topic: np.unique(bag.clock.since(stamps)) for topic, (stamps, _) in measured.items()}
    last = bag.statuses[-1] if bag.holds(CAPTURE_STATUS) else None
    if last is not None and last.state.is_verdict:
        end = last.t - last.time_in_state
    else:  # the detector's time stops with a source that stops
        end = max((t[-1] for t in times.values() if t.size), default=0.0)
        silent = _silent_before_hold(bag, [logged for _, logged in measured.values()])
        end += silent if silent > MIN_GAP else -LAST_PART
    for topic, t in times.items():
        if len(t) < 2:
            yield f"{topic.name}: {len(t)} measurements"
            continue
        limit = max(MIN_GAP, GAP_PERIODS * float(np.median(np.diff(t))))
        for begin, until in itertools.pairwise([*t.tolist(), max(end, t[-1])]):
            if until - begin > limit and until > 0.0 and begin < end:
                yield (
                    f"{topic.name}: no measurement from {begin:.3f} to {until:.3f} s after the "
                    "release"
                )


def _measured(bag: Bag, topic: Topic) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and log times, each (n,), ns, of the measurements of a topic."""
    if topic is LOAD_CELL:
        columns, logged = bag.readable(topic)
        return stamps_of(columns), logged
    stamps, values, logged = bag.measured(topic)
    is_finite = np.isfinite(values[:, : OF_A_BENCH[topic].size]).all(axis=1)
    return stamps[is_finite], logged[is_finite]


def _silent_before_hold(bag: Bag, logged: Iterable[np.ndarray]) -> float:
    """Return the time from the last measurement to the message that held the chaser again, s.

    ``logged`` are the log times, ns, of each source.  The time is 0 if a measurement came later, or
    if no recorded message held the chaser after its release.
    """

    def last(log_times: Iterable[np.ndarray]) -> int:
        return max((int(each.max()) for each in log_times if each.size), default=0)

    # the launcher's silence counts as a hold too, but may be the end of the file
    told = last(bag.log_times(name) for name in (HOLD, LAUNCH_COMMAND.absolute_name))
    return max(min(bag.held_again or 0, told) - last(logged), 0) * 1e-9


def _other_verdict(run: Run) -> Iterator[str]:
    """Yield a line if the verdict made again from the file is not the recorded one."""
    if not run.given.statuses:
        return
    given = run.given.statuses[-1]
    found = detect(run, with_criteria(run.scene, run.given.criteria, ()))[-1]
    times = [status.t - status.time_in_state for status in (given, found)]
    is_timed = given.state.is_verdict
    if given.state is found.state and (
        not is_timed or abs(times[0] - times[1]) <= VERDICT_TOLERANCE
    ):
        return
    yield (
        f"verdict: {given.label} at {times[0]:.3f} s, but made again from the file {found.label} "
        f"at {times[1]:.3f} s"
    )
