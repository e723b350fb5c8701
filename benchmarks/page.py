"""docs/evidence/benchmark.md: the measured parts of it, from one run of the benchmark."""

from __future__ import annotations

import csv
import importlib.metadata
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.costs import BatchCost, Difference, PartCost, RunCost
from benchmarks.machine import stamp
from benchmarks.pages import Spread, error, ratio, seconds, table
from benchmarks.programs import LEVELS, OURS, Contest, Level, at_level, miscounted
from benchmarks.reference import load_reference
from benchmarks.trial import Trial

FOLDER = "benchmark"  # of the pictures, next to the page
TRIALS = "trials.csv"  # in this folder
_COLUMNS = (
    *("t_end_s", "program", "setting", "position_error_m_or_rad", "peak_force_error_1"),
    *("event_time_error_s", "impulse_error_1", "touches", "evaluations", "least_s"),
    *("lower_quartile_s", "median_s", "upper_quartile_s", "repetitions", "failure"),
)
_PACKAGES = ("numpy", "scipy", "numba", "llvmlite")


@dataclass(frozen=True)
class Results:
    """Measurements of one run, and the load meanwhile."""

    scene: str
    quick: bool  # a reduced run
    others: float  # cores that other processes kept busy
    seconds: float  # duration of the benchmark
    contests: list[Contest]  # one for each end time
    parts: list[PartCost]
    rail: RunCost
    times: list[RunCost]
    batches: list[BatchCost]


def measured(results: Results) -> dict[str, str]:
    """Return the measured parts of the page, by name."""
    packages = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES)
    kind = " (`--quick`)" if results.quick else ""
    reference = load_reference(results.scene)
    pairs = zip(reference.times, reference.uncertainty, strict=True)
    uncertain = ", ".join(f"{error(u)} at {t:g} s" for t, u in pairs)
    return {
        "machine": f"{stamp(results.others)}\n\n*{packages}; one run of "
        f"{results.seconds:.0f} s{kind}.*",
        "answer": answer(results.contests[0]),
        "levels": "\n\n".join(map(levels, results.contests)),
        "miscounts": "\n\n".join(map(miscounts, results.contests)),
        "parts": parts(results),
        "batches": batches(results),
        "references": f"Two tolerances of the reference differ by {uncertain} (m or rad).",
    }


def _by_program(contest: Contest, level: Level) -> dict[str, Trial]:
    return {name: trial for name, trial in at_level(contest.trials, level) if trial is not None}


def _least(trials: Iterable[Trial]) -> float:
    return min((trial.least for trial in trials), default=math.nan)


def answer(contest: Contest) -> str:
    """Return how the groups of programs compare at two levels, in a sentence."""
    chosen = [level for level in LEVELS if level.position in (1e-6, 1e-9)]
    found = [_by_program(contest, level) for level in chosen]
    ours = [_least(t for t in each.values() if t.group == "own") for each in found]

    def compared(group: str) -> str:
        theirs = [_least(t for t in each.values() if t.group == group) for each in found]
        first, second = (ratio(b / a) for a, b in zip(ours, theirs, strict=True))
        return f"{first} ({second})"

    least, most = chosen
    library = (
        f"The best library integrator in C, CVODE, needs {compared('library')} times as long. "
        if any(trial.group == "library" for trial in contest.trials)
        else ""
    )
    return (
        f"To {contest.plan.t_end:g} s, {OURS} needs {seconds(ours[0])} at errors of "
        f"{least.position:.0e} m and {least.event_time:.0e} s, and {seconds(ours[1])} at "
        f"{most.position:.0e} m and {most.event_time:.0e} s. The floor, a bare "
        "loop in C++ for this scene alone, without energy ledger, peak loads and limits of steps, "
        f"needs {compared('floor')} times as long. {library}SciPy with the same compiled equations "
        f"needs {compared('python')} times as long, nearly all of it Python calls."
    )


def levels(contest: Contest) -> str:
    """Return the fastest setting of each program at each level."""
    rows = []
    for level in LEVELS:
        found = _by_program(contest, level)
        ours = _least(t for t in found.values() if t.group == "own")
        for name in dict.fromkeys(trial.family for trial in contest.trials):
            trial, head = found.get(name), f"{level.position:.0e} m, {level.event_time:.0e} s"
            if trial is None:
                rows.append([head, name, *"------"])
                continue
            count = trial.outcome.evaluations if trial.outcome else 0
            spread = f"{seconds(trial.least)} ({trial.spread})"
            rows.append(
                [head, name, trial.setting.removeprefix("rtol "), spread, ratio(trial.least / ours)]
            )
            rows[-1] += [count, error(trial.errors.position), error(trial.errors.event_time)]
    head = ["errors at most", "program", "rtol", "CPU time: least (quartiles)", "ratio"]
    head += ["evaluations", "position error, m", "event times, s"]
    return f"To {contest.plan.t_end:g} s, {contest.touches} touches:\n\n{table(head, rows)}"


def miscounts(contest: Contest) -> str:
    """Return the settings of each program with other touches than the reference."""
    rows = []
    for name, wrong in miscounted(contest.trials).items():
        tried = [t for t in contest.trials if t.family == name]
        texts = [f"{t.setting.removeprefix('rtol ')}: {t.errors.touches}" for t in wrong]
        failed = sum(bool(t.failure) for t in tried)
        rows.append([name, len(tried), len(wrong), ", ".join(texts) or "-", failed])
    head = ["program", "settings", "wrong touches", "rtol: touches", "failed"]
    return f"To {contest.plan.t_end:g} s, {contest.touches} touches:\n\n{table(head, rows)}"


def parts(results: Results) -> str:
    """Return what the parts of a scene cost; "-" is a difference that is not significant."""

    def shown(difference: Difference) -> str:
        if not difference.is_told_from_zero:
            return "-"
        return (
            f"{signed(difference.median)} ({signed(difference.low)} to {signed(difference.high)})"
        )

    def signed(value: float) -> str:
        return f"{'+' if value > 0.0 else '-'}{seconds(abs(value))}"

    rows = [
        [
            part.name,
            *map(shown, (part.free, part.contact, part.run)),
            "{} ({})".format(*part.evaluations),
        ]
        for part in results.parts
    ]
    head = ["part", "evaluation, free", "evaluation in contact", "run", "evaluations (without)"]
    rail = results.rail
    return (
        f"{table(head, rows)}\n\nOn the rail, {rail.t_end:.3g} s are solved in closed form: the "
        f"run needs {seconds(rail.seconds.median)} (quartiles {rail.seconds})."
    )


def batches(results: Results) -> str:
    """Return what many runs cost."""
    many = results.batches[-1]
    return (
        f"{many.runs} runs to {results.contests[0].plan.t_end:g} s in one process need "
        f"{seconds(many.seconds.median / many.runs)} each, {many.preparing:.0%} of it before the "
        "integration."
    )


def write_trials(results: Results, path: Path) -> None:
    """Write all trials as CSV, SI units."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_COLUMNS)
        for contest in results.contests:
            writer.writerows(_rows(contest))


def _rows(contest: Contest) -> Iterator[list[object]]:
    for trial in contest.trials:
        e, spread = trial.errors, trial.spread
        values = (e.position, e.peak_force, e.event_time, e.impulse)
        yield [
            *(contest.plan.t_end, trial.family, trial.setting),
            *(f"{value:.3e}" if math.isfinite(value) else "" for value in values),
            e.touches if e.touches >= 0 else "",
            trial.outcome.evaluations if trial.outcome else "",
            *(_csv_time(value) for value in _times(trial, spread)),
            *(len(trial.seconds), trial.failure),
        ]


def _times(trial: Trial, spread: Spread) -> tuple[float, ...]:
    return trial.least, spread.low, spread.median, spread.high


def _csv_time(value: float) -> str:
    return f"{value:.4e}" if math.isfinite(value) else ""
