"""docs/benchmark.md: the measured parts of it, from one run of the benchmark."""

from __future__ import annotations

import csv
import importlib.metadata
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from benchmarks import work_precision
from benchmarks.costs import BatchCost, Difference, PartCost, RunCost
from benchmarks.machine import stamp
from benchmarks.other_engines import Agreement, EngineResult
from benchmarks.pages import error, ratio, seconds, table
from benchmarks.reference import load_reference
from benchmarks.trial import Trial
from benchmarks.work_precision import GROUP_NAMES, Comparison, WorkPrecision

FOLDER = "benchmark"  # of the pictures, beside the page
_ERRORS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)  # m or rad
_COLUMNS = (
    *("t_end_s", "family", "setting", "position_error_m_or_rad", "peak_force_error_1"),
    *("event_time_error_s", "impulse_error_1", "touches", "rhs", "median_s"),
    *("lower_quartile_s", "upper_quartile_s", "repetitions", "failure"),
)
_PACKAGES = ("numpy", "scipy", "numba", "llvmlite")


@dataclass(frozen=True)
class Results:
    """Measurements, and what they were made on."""

    scene: str  # of works, engines and costs
    quick: bool  # it was a reduced sweep
    others: float  # cores that other processes kept busy meanwhile
    seconds: float  # that the benchmark took
    works: list[WorkPrecision]  # one for each horizon
    engines: list[EngineResult]  # skipped ones too
    agreement: list[Agreement]  # with Exudyn
    parts: list[PartCost]
    rail: RunCost
    times: list[RunCost]
    batches: list[BatchCost]


def measured(results: Results) -> dict[str, str]:
    """Return the measured parts of the page, by name."""
    packages = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES)
    kind = " (a reduced sweep, `--quick`)" if results.quick else ""
    laws = dict.fromkeys(f"{results.scene}_{row.law}" for row in results.agreement)
    references = {name: load_reference(name) for name in (results.scene, *laws)}
    uncertain = "; ".join(
        f"`{name}` "
        + ", ".join(f"{error(u)} at {t:g} s" for t, u in zip(r.times, r.uncertainty, strict=True))
        for name, r in references.items()
    )
    tried = [trial for work in results.works for trial in work.trials]
    notes = [f"- {engine.name}: {engine.note}." for engine in results.engines if engine.note]
    return {
        "machine": f"{stamp(results.others)}\n\n*{packages}; one run of "
        f"{results.seconds:.0f} s{kind}.*",
        "comparisons": comparisons(results),
        "works": "\n\n".join(f"To {w.plan.t_end:g} s:\n\n{at_errors(w)}" for w in results.works),
        "quantities": "\n\n".join(
            f"To {w.plan.t_end:g} s:\n\n{quantities(w)}" for w in results.works
        ),
        "failures": f"{sum(bool(t.failure) for t in tried)} of {len(tried)} settings failed, "
        f"or were not tried after two others of their kind had.\n\n{failures(tried)}",
        "engines": "\n\n".join(["\n".join(notes), engines(results), engine_ratios(results)]),
        "agreement": agreement(results),
        "parts": parts(results),
        "times": times(results),
        "batches": batches(results),
        "references": f"Two tolerances of the references differ by (m or rad): {uncertain}.",
    }


def _ratios(c: Comparison) -> str:
    return f"{ratio(c.ratio.median)} ({ratio(c.ratio.low)} to {ratio(c.ratio.high)})"


def comparisons(results: Results) -> str:
    """Return how our best compares with SciPy's at the same position error."""
    rows = []
    for c in (c for work in results.works for c in work.comparisons):
        ours, best = f"{c.own}: {seconds(c.own_seconds)}", f"{c.rival}: {seconds(c.rival_seconds)}"
        at, against = f"{c.error:.0e} m at {c.t_end:g} s", f"SciPy, {GROUP_NAMES[c.group]}"
        rows.append([at, against, ours, best, _ratios(c)])
    head = ["position error", "compared with", "capture_sim", "SciPy's best", "ratio (quartiles)"]
    return table(head, rows)


def at_errors(work: WorkPrecision) -> str:
    """Return wall times of all families at given position errors, with ratios to our best."""
    own = [trial for trial in work.trials if trial.group == "own"]
    best = [work_precision.time_at(own, e) for e in _ERRORS]
    rows = []
    for name in dict.fromkeys(trial.family for trial in work.trials):
        family = [trial for trial in work.trials if trial.family == name]
        row = [name]
        for e, ours in zip(_ERRORS, best, strict=True):
            t = work_precision.time_at(family, e)
            known = math.isfinite(t) and math.isfinite(ours)
            row.append(seconds(t) + (f" ({ratio(t / ours)})" if known else ""))
        rows.append(row)
    return table(["wall time (per our best) at", *[f"{e:.0e} m" for e in _ERRORS]], rows)


def quantities(work: WorkPrecision) -> str:
    """Return what our default tolerances and SciPy's nearest rival get right beside position."""
    shown = ("e-04", "e-06", "e-08", "2e-05 s")
    rows = [
        [
            f"{trial.family}, {trial.setting}",
            *map(error, (e.position, e.peak_force, e.event_time, e.impulse)),
            e.touches,
            trial.outcome.evaluations if trial.outcome else 0,
            seconds(trial.median),
        ]
        for trial in work.trials
        for e in [trial.errors]
        if trial.group in ("own", "compiled") and trial.seconds
        if any(rtol in trial.setting for rtol in shown)
    ]
    head = ["integrator", "position, m", "peak force, 1", "event times, s", "impulse, 1"]
    return table([*head, "touches", "RHS", "median"], rows)


def failures(trials: Iterable[Trial]) -> str:
    """Return what did not get to the end, and why."""
    rows = [[trial.family, trial.setting, trial.failure] for trial in trials if trial.failure]
    return table(["integrator", "setting", "what happened"], rows) if rows else ""


def engines(results: Results) -> str:
    """Return the other engines' table."""
    rows = []
    for engine in results.engines:
        if engine.reason:
            rows.append([engine.name, "-", "-", "-", "-", engine.reason])
        for trial in engine.trials:
            name = trial.family.replace(engine.name, f"{engine.name} {engine.version}")
            errors = [error(trial.errors.position), error(trial.errors.peak_force)]
            rows.append([name, trial.setting, *errors, seconds(trial.median), trial.failure])
    return table(["engine", "setting", "position, m", "peak force, 1", "median", "remark"], rows)


def engine_ratios(results: Results) -> str:
    """Return how the other engines compare with ours at the same error."""
    rows = [
        [
            c.rival,
            error(c.error),
            seconds(c.rival_seconds),
            f"{c.own}: {seconds(c.own_seconds)}",
            _ratios(c),
        ]
        for engine in results.engines
        for c in engine.comparisons
    ]
    return table(["engine", "position error, m", "takes", "ours", "ratio (quartiles)"], rows)


def agreement(results: Results) -> str:
    """Return how far Exudyn is from references of the same law."""
    rows = [[a.law, f"{a.t:g} s", error(a.error)] for a in results.agreement]
    return table(["friction", "at", "largest difference, m or rad"], rows) if rows else "Not tried."


def parts(results: Results) -> str:
    """Return what the parts of a scene cost; "-" is a difference that is not told from zero."""

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
            shown(part.free),
            shown(part.contact),
            shown(part.run),
            "{} ({})".format(*part.evaluations),
            "{} ({})".format(*part.touches),
        ]
        for part in results.parts
    ]
    head = ["part", "RHS free", "RHS in contact", "run", "evaluations (without)"]
    text = table([*head, "touches (without)"], rows)
    rail = results.rail
    return (
        f"{text}\n\nOn the rail, {rail.t_end:.3g} s are solved in closed form: the run needs "
        f"{seconds(rail.seconds.median)} (quartiles {rail.seconds})."
    )


def times(results: Results) -> str:
    """Return what simulated time and touches cost."""
    rows = [
        [
            f"{row.t_end:g} s",
            row.touches,
            row.evaluations,
            seconds(row.seconds.median),
            row.seconds,
            ratio(row.t_end / row.seconds.median),
            seconds(row.seconds.median / max(row.touches, 1)),
        ]
        for row in results.times
    ]
    head = ["simulated", "touches", "RHS", "median", "quartiles", "x real time", "per touch"]
    return table(head, rows)


def batches(results: Results) -> str:
    """Return what many runs cost."""
    rows = [
        [
            row.runs,
            seconds(row.seconds.median),
            seconds(row.seconds.median / row.runs),
            f"{row.runs / row.seconds.median:.0f}",
            f"{row.preparing:.0%}",
        ]
        for row in results.batches
    ]
    return table(["runs", "all", "each", "runs/s", "of it before the integration"], rows)


def write_trials(results: Results, path: Path) -> None:
    """Write all trials as CSV, SI units."""
    named = [(work.plan.t_end, work.trials) for work in results.works]
    named += [(results.works[0].plan.t_end, engine.trials) for engine in results.engines]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_COLUMNS)
        for t_end, trial in ((t_end, trial) for t_end, trials in named for trial in trials):
            e = trial.errors
            values = (e.position, e.peak_force, e.event_time, e.impulse)
            writer.writerow(
                [
                    *(t_end, trial.family, trial.setting),
                    *(f"{value:.3e}" if math.isfinite(value) else "" for value in values),
                    e.touches if e.touches >= 0 else "",
                    trial.outcome.evaluations if trial.outcome else "",
                    *(f"{value:.4e}" if value == value else "" for value in trial.spread),
                    *(len(trial.seconds), trial.failure),
                ]
            )
