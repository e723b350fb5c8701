"""One way of doing the job, tried several times, interleaved with its rivals."""

from __future__ import annotations

import gc
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from benchmarks.outcome import Errors, Outcome, errors

#: Returns what is to be timed, which returns what reads the outcome.
Prepare = Callable[[], Callable[[], Callable[[], Outcome]]]


#: Runs that take less are done once before they are timed, s.
WARMED = 0.1


@dataclass
class Trial:
    """An engine at one setting.

    Attributes
    ----------
    family : str
        The engine; its settings make a curve.
    setting : str
        Such as "rtol 1e-06".
    prepare : callable
        Makes a run ready, untimed.
    group : str
        "own", "compiled", "numpy", "python" or "engine"; rivals are compared by group.
    seconds : list of float
        Wall times so far, one a round; empty if it failed.
    outcome : Outcome or None
        Of the first run.
    errors : Errors
        Against the reference.
    skipped : str
        Why it was not tried at all; empty if it was.
    """

    family: str
    setting: str
    prepare: Prepare
    group: str
    seconds: list[float] = field(default_factory=list)
    outcome: Outcome | None = None
    errors: Errors = field(default_factory=Errors)
    skipped: str = ""

    @property
    def failure(self) -> str:
        """Why there is no result; empty if there is one."""
        if self.skipped:
            return self.skipped
        return "" if self.outcome is None else self.outcome.failure

    @property
    def median(self) -> float:
        """Median wall time, s."""
        return statistics.median(self.seconds)

    def run(self, truth: Outcome) -> float:
        """Run once more; return the wall time, s."""
        gc.collect()
        # what others have left in the processor's caches is not to be timed: a short run, of
        # whoever's, is done once before
        warm = self.prepare() if self.seconds and self.seconds[-1] < WARMED else None
        job = self.prepare()
        gc.disable()
        try:
            if warm is not None:
                warm()
            began = time.perf_counter()
            read = job()
            seconds = time.perf_counter() - began
        finally:
            gc.enable()
        if self.outcome is None:
            self.outcome = read()
            self.errors = errors(self.outcome, truth)
        if not self.outcome.failure:
            self.seconds.append(seconds)
        return seconds


def run_rounds(
    trials: Sequence[Trial], truth: Outcome, rounds: int, progress: Progress, what: str
) -> None:
    """Run all trials ``rounds`` times, in turn: what disturbs one round disturbs all alike."""
    for k in range(rounds):
        for number, trial in enumerate(trials):
            done = k * len(trials) + number
            progress.at(what, done, rounds * len(trials), f"{trial.family}, {trial.setting}")
            trial.run(truth)


def spread(values: Iterable[float]) -> tuple[float, float]:
    """Return the lower and upper quartile."""
    ordered = sorted(values)
    if len(ordered) < 2:
        return ordered[0], ordered[0]
    low, _, high = statistics.quantiles(ordered, n=4, method="inclusive")
    return low, high


class Progress:
    """Tells on standard error what is being done; on a terminal, in place."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._last = 0.0
        self._stage = ""
        self._in_place = sys.stderr.isatty()

    def at(self, stage: str, done: int, total: int, detail: str = "") -> None:
        """Show how far a stage is; not more than five times a second."""
        now = time.monotonic()
        pause = 0.2 if self._in_place else 5.0
        if stage == self._stage and now - self._last < pause:
            return
        self._stage, self._last = stage, now
        text = f"[{now - self._began:5.0f} s] {stage}: {done + 1} of {total}, {detail}"
        if self._in_place:
            print(f"\r\033[K{text[:100]}", end="", file=sys.stderr, flush=True)
        else:
            print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        """Clear the line."""
        if self._in_place:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
