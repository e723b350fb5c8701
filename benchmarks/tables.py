"""What a benchmark has measured, and its tables: Markdown that reads well as plain text."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import work_precision
from benchmarks.costs import BatchCost, EvaluationCost, PartCost, RunCost
from benchmarks.machine import QUIET
from benchmarks.other_engines import Agreement, EngineResult
from benchmarks.trial import Trial, spread
from benchmarks.work_precision import WorkPrecision

_ERRORS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)  # m or rad
_NAMES = {"compiled": "compiled RHS", "numpy": "NumPy RHS", "python": "tuned Python RHS"}


@dataclass(frozen=True)
class Results:
    """Measurements, and what they were made on.

    Attributes
    ----------
    scene : str
        Name of the scene of works, engines and costs.
    quick : bool
        It was a reduced sweep.
    machine : dict
        From :func:`benchmarks.machine.describe`.
    clock : float
        Hz.
    others : float
        Cores that other processes kept busy meanwhile.
    seconds : float
        That the benchmark took.
    works : list of WorkPrecision
        One for each horizon.
    engines : list of EngineResult
        Other engines, skipped ones too.
    agreement : list of Agreement
        With Exudyn.
    uncertainty : dict
        Of each reference at its times, m or rad: {name: {t: u}}.
    evaluation : EvaluationCost
        Of the equations of motion.
    operations : dict
        Arithmetic in one evaluation, by phase.
    parts, rail, times, batches
        What things cost.
    """

    scene: str
    quick: bool
    machine: dict[str, str]
    clock: float
    others: float
    seconds: float
    works: list[WorkPrecision]
    engines: list[EngineResult]
    agreement: list[Agreement]
    uncertainty: dict[str, dict[float, float]]
    evaluation: EvaluationCost
    operations: dict[str, dict[str, int]]
    parts: list[PartCost]
    rail: RunCost
    times: list[RunCost]
    batches: list[BatchCost]

    @property
    def busy(self) -> bool:
        """Whether others were at work, or may have been: then no target counts as met."""
        return not self.others <= QUIET


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table that reads well as plain text, first column to the left."""
    lines = [list(head), *[list(row) for row in rows]]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    rule = ["-" * widths[0], *["-" * (width - 1) + ":" for width in widths[1:]]]

    def laid_out(line: Sequence[str]) -> str:
        cells = [
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        return "| " + " | ".join(cells) + " |"

    return "\n".join([laid_out(lines[0]), laid_out(rule), *map(laid_out, lines[1:])])


def seconds(value: float) -> str:
    """Return a time with its unit, three digits."""
    if not math.isfinite(value):
        return "-"
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if value * factor >= 0.9995 or unit == "ns":
            digits = max(0, 2 - math.floor(math.log10(max(value * factor, 1e-12))))
            return f"{value * factor:.{min(digits, 3)}f} {unit}"
    return "-"


def error(value: float) -> str:
    """Return an error, two digits."""
    return f"{value:.1e}" if math.isfinite(value) else "-"


def ratio(value: float) -> str:
    """Return a ratio, three digits at most."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.2f}" if value < 10.0 else f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"


def targets(results: Results) -> str:
    """Return the table of what was asked for."""
    rows = []
    for work in results.works:
        for c in work.comparisons:
            wanted = "" if math.isnan(c.target) else f"{c.target:g}"
            met = "" if not wanted else "busy" if results.busy else "yes" if c.met else "**no**"
            rows.append(
                [
                    f"{c.error:.0e} m at {c.t_end:g} s",
                    f"SciPy, {_NAMES[c.group]}",
                    f"{c.own}: {seconds(c.own_seconds)}",
                    f"{c.rival}: {seconds(c.rival_seconds)}",
                    f"{ratio(c.ratio)} ({ratio(c.low)} to {ratio(c.high)})",
                    wanted,
                    met,
                ]
            )
    head = ["position error", "against", "ours", "its best", "ratio (quartiles)", "wanted", "met"]
    return table(head, rows)


def at_errors(work: WorkPrecision) -> str:
    """Return wall times of all families at given position errors, with ratios to our best."""
    own = [trial for trial in work.trials if trial.group == "own"]
    best = [work_precision.time_at(own, e) for e in _ERRORS]
    names = list(dict.fromkeys(trial.family for trial in work.trials))
    rows = []
    for name in names:
        of_name = [trial for trial in work.trials if trial.family == name]
        row = [name]
        for e, ours in zip(_ERRORS, best, strict=True):
            t = work_precision.time_at(of_name, e)
            cell = seconds(t)
            if math.isfinite(t) and math.isfinite(ours):
                cell += f" ({ratio(t / ours)})"
            row.append(cell)
        rows.append(row)
    return table(["wall time (per our best) at", *[f"{e:.0e} m" for e in _ERRORS]], rows)


def quantities(work: WorkPrecision) -> str:
    """Return what our default tolerances and SciPy's nearest rival get right beside position."""
    rows = []
    for trial in work.trials:
        if trial.group not in ("own", "compiled") or not trial.seconds:
            continue
        if not any(rtol in trial.setting for rtol in ("e-04", "e-06", "e-08", "2e-05 s")):
            continue
        e = trial.errors
        rows.append(
            [
                f"{trial.family}, {trial.setting}",
                error(e.position),
                error(e.peak_force),
                error(e.event_time),
                error(e.impulse),
                str(e.touches),
                f"{trial.outcome.evaluations if trial.outcome else 0}",
                seconds(trial.median),
            ]
        )
    head = [
        "integrator",
        "position, m",
        "peak force, 1",
        "event times, s",
        "impulse, 1",
        "touches",
        "RHS",
        "median",
    ]
    return table(head, rows)


def failures(trials: Iterable[Trial]) -> str:
    """Return what did not get to the end, and why; empty if all did."""
    rows = [[trial.family, trial.setting, trial.failure] for trial in trials if trial.failure]
    return table(["integrator", "setting", "what happened"], rows) if rows else ""


def engines(results: Results) -> str:
    """Return the other engines' table."""
    rows = []
    for engine in results.engines:
        if engine.reason:
            rows.append([engine.name, "-", "-", "-", "-", engine.reason])
            continue
        for trial in engine.trials:
            name = trial.family.replace(engine.name, f"{engine.name} {engine.version}")
            peak = trial.errors.peak_force
            rows.append(
                [
                    name,
                    trial.setting,
                    error(trial.errors.position),
                    error(peak),
                    seconds(trial.median) if trial.seconds else "-",
                    trial.failure or "",
                ]
            )
    return table(["engine", "setting", "position, m", "peak force, 1", "median", "remark"], rows)


def engine_ratios(results: Results) -> str:
    """Return how the other engines compare with ours at the same error."""
    rows = []
    for engine in results.engines:
        for c in engine.comparisons:
            rows.append(
                [
                    c.rival,
                    error(c.error),
                    seconds(c.rival_seconds),
                    f"{c.own}: {seconds(c.own_seconds)}",
                    f"{ratio(c.ratio)} ({ratio(c.low)} to {ratio(c.high)})",
                ]
            )
    return table(["engine", "position error, m", "takes", "ours", "ratio (quartiles)"], rows)


def evaluation(results: Results) -> str:
    """Return the cost of an evaluation against its arithmetic."""
    cost = results.evaluation
    rows = []
    for name, phase, measured in (
        ("free flight", "free", cost.free),
        ("contact, sliding", "contact", cost.sliding),
        ("contact, slip about v_eps", "contact", cost.creeping),
    ):
        counts = results.operations[phase]
        plain = counts.get("add", 0) + counts.get("multiply", 0)
        slow = counts.get("divide", 0) + counts.get("sqrt", 0)
        tanh = " + tanh" if "v_eps" in name else ""
        rows.append(
            [
                name,
                seconds(measured.median),
                f"{seconds(measured.low)} to {seconds(measured.high)}",
                f"{plain} + {slow} slow{tanh}",
                seconds(plain / 2.0 / results.clock),
                f"{measured.median * results.clock:.0f}",
            ]
        )
    head = [
        "one evaluation (RHS)",
        "median",
        "quartiles",
        "operations",
        "two a cycle",
        "cycles taken",
    ]
    return table(head, rows)


def parts(results: Results) -> str:
    """Return what the parts of a scene cost."""
    rows = [
        [
            part.name,
            seconds(part.free),
            seconds(part.contact),
            str(part.touches),
            str(part.evaluations),
            seconds(part.seconds.median),
            seconds(part.seconds.median / part.evaluations),
            seconds(part.seconds.median / part.t_end),
        ]
        for part in results.parts
    ]
    rail = results.rail
    rows.append(
        [
            f"rail and string (closed form), {rail.t_end:.3g} s",
            "-",
            "-",
            str(rail.touches),
            str(rail.evaluations),
            seconds(rail.seconds.median),
            "-",
            seconds(rail.seconds.median / rail.t_end),
        ]
    )
    head = ["scene", "RHS free", "RHS contact", "touches", "RHS", "run", "per RHS", "per second"]
    return table(head, rows)


def times(results: Results) -> str:
    """Return what simulated time and touches cost."""
    rows = [
        [
            f"{row.t_end:g} s",
            str(row.touches),
            str(row.evaluations),
            seconds(row.seconds.median),
            f"{seconds(row.seconds.low)} to {seconds(row.seconds.high)}",
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
            str(row.runs),
            seconds(row.seconds.median),
            seconds(row.seconds.median / row.runs),
            f"{row.runs / row.seconds.median:.0f}",
            f"{100.0 * row.preparing:.0f} %",
        ]
        for row in results.batches
    ]
    return table(["runs", "all", "each", "runs/s", "of it before the integration"], rows)


#: Said of results that were measured while others were at work.
BUSY = "Measured on a busy machine: neither times nor ratios count; measure again on a quiet one."


def summary(results: Results) -> str:
    """Return what is shown on the terminal."""
    parts_ = [BUSY] if results.busy else []
    parts_ += [targets(results)]
    parts_ += [f"To {w.plan.t_end:g} s:\n\n{at_errors(w)}" for w in results.works]
    parts_ += [engines(results), engine_ratios(results), evaluation(results), parts(results)]
    parts_ += [times(results), batches(results)]
    return "\n\n".join(parts_)


def write_trials(results: Results, path: Path) -> None:
    """Write all trials as CSV, SI units."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(
            [
                "t_end_s",
                "family",
                "setting",
                "position_error_m_or_rad",
                "peak_force_error_1",
                "event_time_error_s",
                "impulse_error_1",
                "touches",
                "rhs",
                "median_s",
                "lower_quartile_s",
                "upper_quartile_s",
                "repetitions",
                "failure",
            ]
        )
        named = [(work.plan.t_end, work.trials) for work in results.works]
        named += [(results.works[0].plan.t_end, engine.trials) for engine in results.engines]
        for t_end, trials in named:
            for trial in trials:
                writer.writerow([t_end, *_row(trial)])


def _row(trial: Trial) -> list[str | int]:
    e = trial.errors
    errors = [e.position, e.peak_force, e.event_time, e.impulse]
    times_ = [trial.median, *spread(trial.seconds)] if trial.seconds else []
    return [
        trial.family,
        trial.setting,
        *[f"{value:.3e}" if math.isfinite(value) else "" for value in errors],
        e.touches if e.touches >= 0 else "",
        trial.outcome.evaluations if trial.outcome else "",
        *([f"{value:.4e}" for value in times_] or [""] * 3),
        len(trial.seconds),
        trial.failure,
    ]
