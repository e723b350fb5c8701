"""One way of doing the job, tried several times, and how far what it gives is from a reference."""

from __future__ import annotations

import gc
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.pages import Spread
from capture_sim.errors import SimulationError
from capture_sim.run.first_contact import first_cluster

#: A touch as any engine can give it; ``end`` is NaN for one that was still on.
TOUCHED = np.dtype(
    [
        ("start", "f8"),  # s
        ("end", "f8"),  # s
        ("wall", "i8"),  # +1 or -1
        ("peak_force", "f8"),  # N; NaN where an engine does not tell
    ]
)


@dataclass(frozen=True)
class Outcome:
    """A run's result; NaN and None where an engine does not tell."""

    q: np.ndarray  # (8,), coordinates at the end, m and rad; NaN if it did not get there
    evaluations: int  # of the equations of motion
    touches: np.ndarray | None = None  # (n,) of dtype TOUCHED, in order of their starts
    impulse: float = math.nan  # N s, normal, of both walls
    peak_force: float = math.nan  # N
    failure: str = ""  # why there is no result

    @classmethod
    def failed(cls, why: str, evaluations: int = 0) -> Outcome:
        """Return the outcome of a run that did not get to its end."""
        return cls(np.full(8, np.nan), evaluations, failure=why)


@dataclass(frozen=True)
class Errors:
    """How far an outcome is from a reference; NaN where it cannot be told."""

    position: float = math.nan  # largest difference in any coordinate, m or rad
    peak_force: float = math.nan  # ... of a touch of the first contact, per largest force there
    event_time: float = math.nan  # ... of a touch or lift-off, s
    impulse: float = math.nan  # normal, of both walls, per impulse
    touches: int = -1  # begun; -1 where an engine does not tell


def errors(outcome: Outcome, truth: Outcome) -> Errors:
    """Compare an outcome with the reference's at the same time."""
    if outcome.failure:
        return Errors()
    position = float(np.abs(outcome.q - truth.q).max())
    impulse = abs(outcome.impulse - truth.impulse) / truth.impulse
    if outcome.touches is None or truth.touches is None:
        peak = abs(outcome.peak_force - truth.peak_force) / truth.peak_force
        return Errors(position=position, impulse=impulse, peak_force=peak)
    ours, theirs = outcome.touches, truth.touches
    if not np.array_equal(ours["wall"], theirs["wall"]):
        return Errors(position=position, impulse=impulse, touches=ours.size)
    times = [np.abs(ours["start"] - theirs["start"]), _both(ours["end"], theirs["end"])]
    ended = theirs[np.isfinite(theirs["end"])]
    first = np.isin(theirs["start"], first_cluster(ended)["start"])
    largest = theirs["peak_force"][first].max(initial=0.0)
    off = np.abs(ours["peak_force"] - theirs["peak_force"])[first].max(initial=0.0)
    return Errors(
        position=position,
        peak_force=float(off / largest) if largest > 0.0 else math.nan,
        event_time=float(max(difference.max(initial=0.0) for difference in times)),
        impulse=impulse,
        touches=ours.size,
    )


def _both(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return differences, 0 where both touches are still on, inf where only one is."""
    difference: np.ndarray = np.abs(ours - theirs)
    on, also_on = np.isnan(ours), np.isnan(theirs)
    difference[on & also_on] = 0.0
    difference[on != also_on] = np.inf
    return difference


#: Makes a run ready: returns what is timed, and what reads the outcome of what that returns.
Prepare = Callable[[], tuple[Callable[[], Any], Callable[[Any], Outcome]]]
#: What engines raise that cannot go on.
STOPPED = (SimulationError, RuntimeError)

#: CPU time below which a run, ours or another engine's, is done once before it is timed, s.
MAX_WARMED_TIME = 0.1
#: CPU time after which a setting is not run again, s.
MAX_SETTING_TIME = 1.5


def timed(job: Callable[[], Any], warm: Callable[[], Any] | None = None) -> tuple[float, Any]:
    """Return the CPU time of a job in this thread, s, and what it returns.

    ``warm``, the like of it, goes before: what others have left in the processor's caches is not
    to be timed.
    """
    gc.collect()
    gc.disable()
    try:
        if warm is not None:
            warm()
        began = time.thread_time()
        result = job()
        return time.thread_time() - began, result
    finally:
        gc.enable()


@dataclass
class Trial:
    """An engine at one setting; the settings of a family, loose to tight, make a curve."""

    family: str
    setting: str  # such as "rtol 1e-06"
    prepare: Prepare  # makes a run ready, untimed
    group: str  # "own", "floor", "library", "python", "numpy" or "engine"
    truth: Outcome
    seconds: list[float] = field(default_factory=list)  # one a round; empty if it failed
    outcome: Outcome | None = None  # of the first run
    errors: Errors = field(default_factory=Errors)
    skipped: str = ""  # why it was not tried at all

    @property
    def failure(self) -> str:
        """Why there is no result; empty if there is one."""
        if self.skipped:
            return self.skipped
        return "" if self.outcome is None else self.outcome.failure

    @property
    def spread(self) -> Spread:
        """Median and quartiles of the CPU time, s."""
        return Spread.of(self.seconds)

    @property
    def least(self) -> float:
        """Least CPU time, s; NaN if there is none."""
        return min(self.seconds, default=math.nan)

    def run(self) -> None:
        """Run once more."""
        warm = self.prepare()[0] if self.seconds and self.seconds[-1] < MAX_WARMED_TIME else None
        job, read = self.prepare()
        try:
            seconds, result = timed(job, warm)
        except STOPPED as error:
            self.outcome = Outcome.failed(str(error).splitlines()[0])
            return
        if self.outcome is None:
            self.outcome = read(result)
            self.errors = errors(self.outcome, self.truth)
        if not self.outcome.failure:
            self.seconds.append(seconds)


def run_rounds(trials: Sequence[Trial], rounds: int, progress: Progress, stage: str) -> None:
    """Run all trials some times, in turn: what disturbs one round disturbs all alike.

    A setting that has taken :data:`MAX_SETTING_TIME` is not repeated any more; where two of a kind
    took too long, the tighter ones are not tried.
    """
    late: dict[tuple[str, str], list[str]] = {}
    for k in range(rounds):
        for number, trial in enumerate(trials):
            if k and (trial.failure or sum(trial.seconds) > MAX_SETTING_TIME):
                continue
            done, total = k * len(trials) + number, rounds * len(trials)
            progress.at(stage, done, total, f"{trial.family}, {trial.setting}")
            kind = late.setdefault((trial.family, trial.setting.rpartition(" ")[2]), [])
            if k == 0 and len(kind) >= 2:
                trial.skipped = f"not tried: {' and '.join(kind)} were not done in time"
                continue
            trial.run()
            if trial.failure.startswith("not done"):
                kind.append(trial.setting)


class Progress:
    """Shows on standard error what is being done, every few seconds."""

    def __init__(self) -> None:
        self._began = self._last = time.monotonic()
        self._stage = ""

    def at(self, stage: str, done: int, total: int, detail: str = "") -> None:
        """Show how far a stage is."""
        now = time.monotonic()
        if stage != self._stage or now - self._last > 5.0:
            self._stage, self._last = stage, now
            text = f"[{now - self._began:5.0f} s] {stage}: {done + 1} of {total}, {detail}"
            print(text, file=sys.stderr, flush=True)
