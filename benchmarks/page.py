"""docs/benchmark.md: tables of one run of the benchmark, Markdown that reads well as plain text."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import work_precision
from benchmarks.costs import BatchCost, EvaluationCost, RunCost, Spread
from benchmarks.machine import BUSY, QUIET
from benchmarks.other_engines import Agreement, EngineResult
from benchmarks.trial import Trial, spread
from benchmarks.work_precision import ATOL, GROUP_NAMES, Comparison, WorkPrecision

FOLDER = "benchmark"  # of the pictures, beside the page
_ERRORS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)  # m or rad


@dataclass(frozen=True)
class Results:
    """Measurements, and what they were made on."""

    scene: str  # of works, engines and costs
    quick: bool  # it was a reduced sweep
    machine: dict[str, str]
    clock: float  # Hz
    others: float  # cores that other processes kept busy meanwhile
    seconds: float  # that the benchmark took
    works: list[WorkPrecision]  # one for each horizon
    engines: list[EngineResult]  # skipped ones too
    agreement: list[Agreement]  # with Exudyn
    uncertainty: dict[str, dict[float, float]]  # of each reference at its times, m or rad
    evaluation: EvaluationCost
    operations: dict[str, dict[str, int]]  # in one evaluation, by phase
    parts: list[RunCost]
    times: list[RunCost]
    batches: list[BatchCost]

    @property
    def busy(self) -> bool:
        """Whether others were at work, or may have been: then no target counts as met."""
        return not self.others <= QUIET


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table, first column to the left."""
    lines = [list(head), *map(list, rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    lines.insert(1, ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])

    def laid_out(line: Sequence[str]) -> str:
        first, *rest = (cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        return f"| {' | '.join([first.strip().ljust(widths[0]), *rest])} |"

    return "\n".join(map(laid_out, lines))


def seconds(value: float) -> str:
    """Return a time with its unit, three digits."""
    if not math.isfinite(value):
        return "-"
    units = (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))
    unit, factor = next(((u, f) for u, f in units if value * f >= 0.9995), units[-1])
    digits = max(0, 2 - math.floor(math.log10(max(value * factor, 1e-12))))
    return f"{value * factor:.{min(digits, 3)}f} {unit}"


def error(value: float) -> str:
    """Return an error, two digits."""
    return f"{value:.1e}" if math.isfinite(value) else "-"


def ratio(value: float) -> str:
    """Return a ratio, three digits at most."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.2f}" if value < 10.0 else f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"


def _range(found: Spread) -> str:
    return f"{seconds(found.low)} to {seconds(found.high)}"


def _ratios(c: Comparison) -> str:
    return f"{ratio(c.ratio)} ({ratio(c.low)} to {ratio(c.high)})"


def targets(results: Results) -> str:
    """Return the table of what was asked for."""
    rows = []
    for c in (c for work in results.works for c in work.comparisons):
        wanted = "" if math.isnan(c.target) else f"{c.target:g}"
        met = "" if not wanted else "busy" if results.busy else "yes" if c.met else "**no**"
        ours, best = f"{c.own}: {seconds(c.own_seconds)}", f"{c.rival}: {seconds(c.rival_seconds)}"
        at, against = f"{c.error:.0e} m at {c.t_end:g} s", f"SciPy, {GROUP_NAMES[c.group]}"
        rows.append([at, against, ours, best, _ratios(c), wanted, met])
    head = ["position error", "against", "ours", "its best", "ratio (quartiles)", "wanted", "met"]
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
            str(e.touches),
            str(trial.outcome.evaluations if trial.outcome else 0),
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
    return table(["integrator", "setting", "what happened"], rows) if rows else "Nothing."


def engines(results: Results) -> str:
    """Return the other engines' table."""
    rows = []
    for engine in results.engines:
        if engine.reason:
            rows.append([engine.name, "-", "-", "-", "-", engine.reason])
        for trial in engine.trials:
            name = trial.family.replace(engine.name, f"{engine.name} {engine.version}")
            errors = [error(trial.errors.position), error(trial.errors.peak_force)]
            took = seconds(trial.median) if trial.seconds else "-"
            rows.append([name, trial.setting, *errors, took, trial.failure])
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


def evaluation(results: Results) -> str:
    """Return the cost of an evaluation against its arithmetic."""
    cost, rows = results.evaluation, []
    for name, phase, measured, more in (
        ("free flight", "free", cost.free, ""),
        ("contact, sliding", "contact", cost.sliding, ""),
        ("contact, slip about v_eps", "contact", cost.creeping, " + tanh"),
    ):
        counts = results.operations[phase]
        plain = counts.get("add", 0) + counts.get("multiply", 0)
        slow = counts.get("divide", 0) + counts.get("sqrt", 0)
        ideal, cycles = plain / 2.0 / results.clock, f"{measured.median * results.clock:.0f}"
        times_ = [seconds(measured.median), _range(measured)]
        rows.append([name, *times_, f"{plain} + {slow} slow{more}", seconds(ideal), cycles])
    head = ["one evaluation (RHS)", "median", "quartiles", "operations", "two a cycle"]
    return table([*head, "cycles taken"], rows)


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
            seconds(part.seconds.median / part.evaluations) if part.free == part.free else "-",
            seconds(part.seconds.median / part.t_end),
        ]
        for part in results.parts
    ]
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
            _range(row.seconds),
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


def summary(results: Results) -> str:
    """Return what is shown on the terminal."""
    shown = [targets(results)]
    shown += [f"To {w.plan.t_end:g} s:\n\n{at_errors(w)}" for w in results.works]
    shown += [f(results) for f in (engines, engine_ratios, evaluation, parts, times, batches)]
    return "\n\n".join([BUSY] * results.busy + shown)


def write_trials(results: Results, path: Path) -> None:
    """Write all trials as CSV, SI units."""
    head = "t_end_s family setting position_error_m_or_rad peak_force_error_1 event_time_error_s "
    head += "impulse_error_1 touches rhs median_s lower_quartile_s upper_quartile_s repetitions "
    head += "failure"
    named = [(work.plan.t_end, work.trials) for work in results.works]
    named += [(results.works[0].plan.t_end, engine.trials) for engine in results.engines]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(head.split())
        for t_end, trial in ((t_end, trial) for t_end, trials in named for trial in trials):
            e = trial.errors
            errors = (e.position, e.peak_force, e.event_time, e.impulse)
            took = [trial.median, *spread(trial.seconds)] if trial.seconds else []
            writer.writerow(
                [
                    *(t_end, trial.family, trial.setting),
                    *(f"{value:.3e}" if math.isfinite(value) else "" for value in errors),
                    e.touches if e.touches >= 0 else "",
                    trial.outcome.evaluations if trial.outcome else "",
                    *([f"{value:.4e}" for value in took] or [""] * 3),
                    *(len(trial.seconds), trial.failure),
                ]
            )


def page(results: Results) -> str:
    """Return the page."""
    t_end = results.works[0].plan.t_end
    kind = " with a reduced sweep (`--quick`)" if results.quick else ""
    machine = table(["measured on", ""], [[k, v] for k, v in results.machine.items()])
    busy = f"\n**{BUSY}**\n" if results.busy else ""
    counts = sorted(results.operations["contact"].items())
    notes = "\n".join(f"- {engine.name}: {engine.note}." for engine in results.engines)
    sections = [
        f"""# Speed against error
{busy}
Generated by `make benchmark`{kind}; not edited by hand. Everything was measured in one run, of
{results.seconds:.0f} s, on the machine below, while others kept {results.others:.2f} cores busy.
Milliseconds are that machine's; ratios carry over to others.

{machine}

The scene is `{results.scene}`, the paper's designed case from 1 ms before the first touch. Only the
integration is timed; setting up is not, neither ours nor that of others.

## What was asked for

{targets(results)}

The ratio is SciPy's wall time per ours at the same position error, each side with its
best integrator, interpolated between settings on logarithmic axes.""",
        *(
            f"## The paper's case to {work.plan.t_end:g} s\n\nWall time at a position error "
            "(largest difference in any coordinate, m or rad), and in brackets\nhow many times "
            f"that of our best:\n\n{at_errors(work)}"
            for work in results.works
        ),
        f"""![Error against wall time]({FOLDER}/work_precision.svg)

![Error against evaluations]({FOLDER}/evaluations.svg)

## Forces, events and impulse

Errors of the peak forces of the first contact, per largest; of the times of all touches and
lift-offs; of the normal impulse, per impulse. A dash: the touches are not the reference's.
SciPy's forces and impulses are read from its dense output in a run that is not timed.""",
        *(f"To {w.plan.t_end:g} s:\n\n{quantities(w)}" for w in results.works),
        f"![Forces, events and impulse]({FOLDER}/quantities.svg)",
        "## What failed",
        *(f"To {w.plan.t_end:g} s:\n\n{failures(w.trials)}" for w in results.works),
        f"""## Other engines

To {t_end:g} s, each as near to the model as it can come:

{notes}

{engines(results)}

At the same position error, or where the engine's own error ends, interleaved with ours:

{engine_ratios(results)}""",
        _agreement(results),
        f"""## What it costs

{evaluation(results)}

In contact, sliding: {", ".join(f"{n} {what}" for what, n in counts)}. "Two a cycle" is what
additions and multiplications alone would take if two were done in each cycle of
{results.clock * 1e-9:.2f} GHz, with no waiting for one another, for divisions, or for memory.

The paper's scene to {results.parts[0].t_end:g} s with and without its parts, at the scene's own
tolerance, and the ground bench on its rail:

{parts(results)}

Growing with simulated time and touches:

{times(results)}

Many runs, one after the other in one process, each with a speed of its own:

{batches(results)}

![Cost of simulated time and of batches]({FOLDER}/costs.svg)

## How it is measured

{_method(results)}""",
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def _agreement(results: Results) -> str:
    if not results.agreement:
        return ""
    rows = [[a.law, f"{a.t:g} s", error(a.error)] for a in results.agreement]
    return (
        "Agreement of Exudyn at rtol 1e-10 with references of the same law, an independent "
        "confirmation\nof the model:\n\n"
        + table(["friction", "at", "largest difference, m or rad"], rows)
    )


def _method(results: Results) -> str:
    plan = results.works[0].plan
    forms = "\n".join(f"  - {name}: {ATOL[name]}." for name in plan.atols)
    uncertain = "; ".join(
        f"`{name}` " + ", ".join(f"{error(u)} at {t:g} s" for t, u in by_time.items())
        for name, by_time in results.uncertainty.items()
    )
    tried = [trial for work in results.works for trial in work.trials]
    longest = results.works[-1].plan.allowed
    return f"""- References: `benchmarks/references`, an extrapolation method of order 16 in
  extended precision with equations of its own. Two tolerances of it differ by (m or rad):
  {uncertain}.
- Median wall time of {plan.rounds} rounds. In a round every setting runs once, in turn, so what
  disturbs disturbs all alike. What is slow and far from any target runs once. Ratios are taken
  within a round; their median and quartiles are shown. What takes less than 0.1 s, whoever's it
  is, runs once untimed just before, so that the processor's caches are its own; ours would take
  about 0.1 ms more right after other work.
- An error may pass through zero by luck: a setting counts with its own error or that of a
  tighter one of its kind, whichever is larger, for ours and for others.
- SciPy has gap events for either wall, latches the approach speed at each touch and restarts;
  `benchmarks/engines/scipy_ivp.py` says which traps that minds. Tolerances:
{forms}
- SciPy's right-hand sides: "compiled" is the engine's own, called from Python; "NumPy" is the
  textbook's, in vectors; "tuned Python" the same with plain numbers,
  {_saving(results)}.
- A run of more than {plan.allowed:g} s ({longest:g} s for the longest horizon; twice that with the
  NumPy right-hand side) counts as failed; {sum(bool(t.failure) for t in tried)} of {len(tried)} \
settings failed, or were not tried
  after two others of their kind had.
- All settings with all errors: [trials.csv]({FOLDER}/trials.csv)."""


def _saving(results: Results) -> str:
    """Return how much faster the tuned right-hand side is than the NumPy one."""
    cost = {
        group: min(
            (
                t.median / t.outcome.evaluations
                for t in results.works[0].trials
                if t.group == group and t.seconds and t.outcome and "DOP853" in t.family
            ),
            default=math.nan,
        )
        for group in ("numpy", "python")
    }
    gain = cost["numpy"] / cost["python"]
    return "which this run did not try" if gain != gain else f"{gain:.1f} times as fast"
