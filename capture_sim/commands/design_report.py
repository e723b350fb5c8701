"""Output of a design: the printed report, and the files with its front, scenes and candidates.

The front is the set of buffers that no other buffer beats in all objectives; each is a row.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from capture_sim.base.files import write_text
from capture_sim.base.software import own_version
from capture_sim.base.tables import Section, print_table
from capture_sim.commands.output import echo, give, write_json
from capture_sim.recording.sweep_file import head_of
from capture_sim.run.loads import LOADS, implausible_stroke
from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.limits import CAPTURE_RANGE, LOAD_KEYS, Limit, Measure
from capture_sim.studies.evaluate.outcome import CAPTURED, Outcome, run_to_end
from capture_sim.studies.search.design import Design, beaten_by
from capture_sim.studies.search.evaluator import CHECK_DRAWS, Candidate
from capture_sim.studies.search.limit_costs import STEPS, CostChange, LimitCost
from capture_sim.studies.search.refinement import Goal
from capture_sim.studies.search.rows import LONGEST, SHARP, DesignRow
from capture_sim.studies.search.variables import DAMPING_RATIO


def report_front(sections: Sequence[Section]) -> None:
    """Print the sections of a report, see :func:`sections_of`."""
    for section in sections:
        for line in section.before:
            echo(line)
        if section.head:
            print_table(section.head, section.rows)
        for line in section.after:
            echo(line)


def sections_of(design: Design, picked: int | None, costs: Sequence[LimitCost]) -> list[Section]:
    """Return the sections of the report of a design.

    They are the front, the picked buffer with a new run of it, the check by draws and the costs of
    limits.  ``picked`` is the index of a row; None, if no buffer was found, gives one section with
    the reason.
    """
    n_feasible = sum(each.feasible for each in design.history)
    tried = f"{len(design.history)} buffers tried, {n_feasible} feasible"
    if picked is None:
        return [Section("Front", [tried, f"no buffer found: {design.refusal}"])]
    before = [tried]
    if len(design.rows) > 1:
        before.append(f"front of {len(design.rows)} buffers; {_picked_text(design, picked)}\n")
    head, rows = _front_table(design)
    found = [Section("Front", before, head, rows, [*_notes(design), *_against_own(design)])]
    row, requirements = design.rows[picked], design.requirements
    scene = design.scene_of(row.candidate)
    run = _whole_run(scene, run_to_end(scene), requirements.limits)
    found.append(dataclasses.replace(run, before=[_buffer_text(design, row), *run.before]))
    check = row.check
    if check is not None:
        least = math.ceil(requirements.confidence * check.computed)
        text = (
            f"{requirements.confidence:.4g} required, shown if {least} of {check.computed} new "
            f"draws are captured within the limits: {check.met} are, probability "
            f"{check.estimate:.4f}, 95 % interval {check.low:.4f} to {check.high:.4f}"
        )
        found.append(Section("Check by draws", [text]))
    if costs:
        found.append(_costs_section(costs, requirements.objectives))
    return found


def _picked_text(design: Design, picked: int) -> str:
    at_knee = "the knee, " if design.rows[picked].is_knee else ""
    return f"{at_knee}row {picked + 1}, is picked"


def _shown_measures(design: Design) -> list[Measure]:
    """Return the quantities of the table: objectives, limited loads and capture range, each once.

    The capture range is included if the design has an area of approach.
    """
    requirements = design.requirements
    keys = [each.key for each in (*requirements.objectives, *requirements.limits)]
    if requirements.area:
        keys.append(CAPTURE_RANGE)
    return [Measure(key) for key in dict.fromkeys(keys)]


def _front_table(design: Design) -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of the table of the front; the last row is the own buffer.

    The own buffer is the buffer of the given scene.
    """
    measures, variables = _shown_measures(design), design.variables
    head = ["row"]
    head += [f"{each.meaning}\n{each.load.shown_in}" for each in measures]
    head += [f"{each.name.removeprefix('buffer.')}\n{each.unit}" for each in variables]

    details = _details(design)
    head += details

    def cells(name: str, candidate: Candidate, row: DesignRow | None) -> list[str]:
        loads = [_text_of(each, candidate) for each in measures]
        values = [f"{candidate.values[each.name]:.4g}" for each in variables]
        return [name, *loads, *values, *(show(candidate, row) for show in details.values())]

    rows = [
        cells(
            f"{number}{' knee' if row.is_knee and len(design.rows) > 1 else ''}", row.candidate, row
        )
        for number, row in enumerate(design.rows, 1)
    ]
    return head, [*rows, cells("own", design.own, None)]


#: Function that returns the cell of a column for a candidate; the row is None for the own buffer.
_Show = Callable[[Candidate, DesignRow | None], str]


def _details(design: Design) -> dict[str, _Show]:
    """Return the table columns on the quality of a row: for each head, the function of its cells.

    They are convergence, how long the tip stays captured, and sensitivity to changed values.
    """
    details: dict[str, _Show] = {"found": lambda _, row: row.convergence if row else ""}
    if any(row.stays is not None for row in design.rows):
        details["stays\nuntil s"] = _stays_text
    elif any(each.left_again for each in (design.own, *design.front)):
        details["left\nagain"] = lambda candidate, _: "yes" if candidate.left_again else "no"
    if any(row.sharpness for row in design.rows):
        details[f"{SHARP:.0%} off:\nworse by"] = lambda _, row: _sharpness_text(row)
        if design.requirements.limits:
            details[f"{SHARP:.0%} off:\nexcess"] = lambda _, row: (
                f"{row.sharpness.excess:.2%}"
                if row and row.sharpness and not math.isnan(row.sharpness.excess)
                else ""
            )
    return details


def _stays_text(candidate: Candidate, row: DesignRow | None) -> str:
    if row is None or row.stays is None:
        return "left" if candidate.left_again else ""
    if not row.stays and row.behind:
        return "behind BE"
    return f"{row.stays:g}" if row.stays else "left"


def _sharpness_text(row: DesignRow | None) -> str:
    if row is None or row.sharpness is None:
        return ""
    lost = " lost" if row.sharpness.not_held else ""
    return f"{row.sharpness.change:.2%}{lost}" if not math.isnan(row.sharpness.change) else "lost"


def _notes(design: Design) -> list[str]:
    """Return the notes below the table of the front.

    They report values at an end of their range, large loads without a limit, a tip that leaves or
    passes BE, and from which runs the loads come if there are dispersions.
    """
    notes = []
    if design.requirements.under is not None and design.interrupted:
        notes.append("loads: of the scene without dispersions, as the search was interrupted")
    elif design.requirements.under is not None:
        share = f"{design.requirements.confidence:.4g}"
        notes.append(f"loads: at {share} of {CHECK_DRAWS} new draws")
    for number, row in enumerate(design.rows, 1):
        where = f"row {number}: " if len(design.rows) > 1 else ""
        if row.at_ends:
            notes.append(
                f"{where}{'; '.join(row.at_ends)}: another range would give another buffer"
            )
        if row.grown:
            loads = ", ".join(
                f"{each.meaning} {each.shown(row.candidate.loads[each.key])} {each.load.shown_in} "
                f"({factor:.2g} times the own buffer's)"
                for each, factor in row.grown
            )
            notes.append(f"{where}no limit on {loads}")
        if row.behind:
            notes.append(
                f"{where}at {row.behind_at:g} s the tip is {row.behind * 1e3:.0f} mm behind BE, "
                "inside of the target: no scene describes what is there"
            )
    if len(design.rows) > 1 and any(row.at_ends for row in (design.rows[0], design.rows[-1])):
        notes.append("an end of the front is an end of a range, so the knee depends on the ranges")
    if any(row.sharpness and row.sharpness.not_held for row in design.rows):
        notes.append(f"lost: with one value {SHARP:.0%} off, a run does not stay captured")
    if (ends := [row.stays for row in design.rows if row.stays is not None]) and min(ends) < (
        LONGEST * design.scene.run.t_end
    ):
        notes.append(
            f"no latch: each row was also run to {3.0 * design.scene.run.t_end:g} and "
            f"{LONGEST * design.scene.run.t_end:g} s; a row that does not stay until then leaves "
            "between"
        )
    return notes


def _text_of(measure: Measure, candidate: Candidate) -> str:
    value = candidate.loads[measure.key]
    if math.isnan(value):
        return "-"
    if measure.key == CAPTURE_RANGE:
        return f"{value * 100.0:.1f} +- {candidate.range_error * 100.0:.1f}"
    return measure.shown(value)


def _against_own(design: Design) -> list[str]:
    """Return lines that compare the front with the scene's own buffer.

    They give the verdict of the own buffer if it does not capture.  Otherwise they give the limits
    that it exceeds, and by how much the front improves each objective.
    """
    own = design.own
    if own.verdict != CAPTURED:
        return [f"the scene's own buffer ends {own.verdict}"]
    lines = []
    excess = [each for each in design.requirements.limits if each.is_exceeded(own.loads[each.key])]
    if excess:
        lines.append(f"the scene's own buffer exceeds {', '.join(limit.text for limit in excess)}")
    parts = []
    for objective, best in beaten_by(design):
        value = own.loads[objective.key]
        change = best / value - 1.0 if value else 0.0
        parts.append(
            f"{objective.meaning} {objective.shown(best)} {objective.load.shown_in} in place of "
            f"{objective.shown(value)} ({change:+.1%})"
        )
    if parts:
        others = ", the other objectives no worse" if len(design.rows) > 1 else ""
        lines.append(f"against the scene's own buffer{others}: {'; '.join(parts)}")
    return lines


def _costs_section(costs: Sequence[LimitCost], objectives: Sequence[Measure]) -> Section:
    """Return the section on active limits: the change of each objective if a limit is increased."""
    steps = " and ".join(f"{step:.0%}" for step in STEPS)
    title = f"\nactive limits, and the change of each objective with {steps} more of them"
    head = ["limit", "used"]
    head += [f"{each.meaning}\nwith {step:+.0%}" for step in STEPS for each in objectives]
    rows = [
        [
            cost.limit.text,
            f"{cost.use:.2%}",
            *(_change_text(change) for changes in cost.changes for change in changes),
        ]
        for cost in costs
    ]
    return Section("Limits", [title], head, rows)


def _change_text(change: CostChange) -> str:
    """Return the change of an objective and its error, in percent, as text.

    The number of decimals is such that the error is not printed as 0.  NaN gives "not found".
    """
    if math.isnan(change.value):
        return "not found"
    digits = min(max(1 - math.floor(math.log10(change.error * 100.0)), 2), 5)
    if abs(change.value) < change.error:
        return f"less than {change.error:.{digits}%}"
    return f"{change.value:+.{digits}%} +- {change.error:.{digits}%}"


def _buffer_text(design: Design, row: DesignRow) -> str:
    values = dict(row.candidate.values)
    buffer = design.scene_of(row.candidate).buffer
    rebound = buffer.c_A_rebound
    if DAMPING_RATIO in values:
        values["buffer.c_A"] = buffer.c_A
    if rebound is not None:
        values["buffer.c_A_rebound"] = rebound
    units = {variable.name: variable.unit for variable in design.variables}
    units["buffer.c_A_rebound"] = units["buffer.c_A"] = "N s/m"
    return ", ".join(
        f"{name.removeprefix('buffer.')} = {value:.5g} {units[name]}".rstrip()
        for name, value in values.items()
    )


def print_whole_run(scene: Scene, outcome: Outcome, limits: Sequence[Limit]) -> None:
    """Print the verdict and the loads of the run of a designed buffer, with the limits."""
    report_front([_whole_run(scene, outcome, limits)])


def _whole_run(scene: Scene, outcome: Outcome, limits: Sequence[Limit]) -> Section:
    """Return the section with the verdict and the loads of the run of a designed buffer."""
    after = []
    if text := implausible_stroke(scene, outcome.loads["max_axial_stroke_in"]):
        after.append(text)
    if outcome.failure:
        after.append("the run stopped early: loads until then do not show that limits are kept")
    if outcome.left_again:
        after.append("the tip leaves the capture zone again; a latch would hold it")
    title = f"\nsimulation of the design: {_verdict(outcome)}, {outcome.reason}"
    head = ["whole run", "", "at s", "limit", "margin"]
    rows = [row + [""] * (len(head) - len(row)) for row in _load_rows(outcome, limits)]
    return Section("Chosen buffer", [title], head, rows, after)


def _verdict(outcome: Outcome) -> str:
    return f"{outcome.verdict}, left" if outcome.left_again else outcome.verdict


def _load_rows(outcome: Outcome, limits: Sequence[Limit]) -> list[list[str]]:
    """Return table rows with the verdict and the loads of a run, with time, limit and margin.

    Loads that are 0 or unknown are left out, as are loads before the latch without a limit.
    """
    by_key, loads = {limit.key: limit for limit in limits}, outcome.loads
    rows = [["verdict", _verdict(outcome), f"{outcome.t:.3f}", "captured"]]
    for row_load in LOADS:
        for key in (row_load.key, f"{row_load.key}_before_latch"):
            value, limit = loads.get(key), by_key.get(key)
            if not value or (limit is None and key != row_load.key):
                continue
            meaning = row_load.meaning if limit is None else limit.meaning
            shown = f"{value * row_load.factor:.4g}"
            cells = [f"{meaning}, {row_load.shown_in}", shown, f"{loads[f'{key}_time']:.3f}"]
            if limit is not None:
                cells += [limit.shown(limit.value), f"{1.0 - limit.use(value):+z.1%}"]
            rows.append(cells)
    return rows


def write_front(
    design: Design,
    picked: int | None,
    costs: Sequence[LimitCost],
    folder: Path,
    seed: int,
) -> None:
    """Write the result of a design to a folder.

    ``design.json`` has all results and candidates, ``design.yaml`` is the scene with the picked
    buffer.  A front of several rows is also written as ``front.csv`` and as a scene for each row.
    """
    requirements = design.requirements
    keys = [each.key for each in _shown_measures(design)]

    def plain(candidate: Candidate) -> dict[str, Any]:
        loads = {key: candidate.loads[key] for key in keys if key in candidate.loads}
        return {
            "values": dict(candidate.values),
            "loads": {key: None if math.isnan(x) else x for key, x in loads.items()},
            "verdict": candidate.verdict,
            "violation": candidate.violation,
            "share": candidate.share,
            "left_again": candidate.left_again,
        }

    def plain_row(row: DesignRow) -> dict[str, Any]:
        return {
            **plain(row.candidate),
            "convergence": row.convergence,
            "stays_until": row.stays,
            "behind": row.behind,
            "behind_at": row.behind_at,
            "at_ends": row.at_ends,
            "sharpness": row.sharpness and _without_nan(dataclasses.asdict(row.sharpness)),
            "grown": {each.key: factor for each, factor in row.grown},
        }

    kept: dict[str, Any] = {"refusal": design.refusal, "seed": seed}
    kept["objectives"] = [each.key for each in requirements.objectives]
    kept["limits"] = {limit.key: limit.value for limit in requirements.limits}
    kept["free"] = {
        each.name: list(each.values) if each.values else [each.low, each.high]
        for each in design.variables
    }
    if requirements.under is not None:
        kept["under"] = {name: str(given) for name, given in requirements.under.vary.items()}
        kept["confidence"] = requirements.confidence
    if requirements.area:
        kept["area"] = {axis.name: axis.values for axis in requirements.area}
        kept["least_capture_range"] = requirements.least_range
    outcome = None
    if picked is not None:
        row = design.rows[picked]
        kept["picked"] = picked + 1
        if row.check is not None:
            kept["check"] = row.check._asdict()
        outcome = run_to_end(design.scene_of(row.candidate))
    kept |= outcome_of(outcome)
    kept["costs"] = [
        {
            "limit": cost.limit.key,
            "use": cost.use,
            "changes": {
                f"{step:g}": [_without_nan(change._asdict()) for change in changes]
                for step, changes in zip(STEPS, cost.changes, strict=True)
            },
        }
        for cost in costs
    ]
    kept["own"] = plain(design.own)
    kept["rows"] = [plain_row(row) for row in design.rows]
    kept["history"] = [plain(candidate) for candidate in design.history]
    for old in folder.glob("design_[0-9][0-9].yaml"):
        old.unlink()  # of an earlier design with more rows
    if len(design.rows) > 1:
        echo(f"front in {write_text(folder / 'front.csv', _front_csv(design))}")
        for number, row in enumerate(design.rows, 1):
            named = _named(design.scene_of(row.candidate), f"_{number:02d}")
            write_text(folder / f"design_{number:02d}.yaml", named.to_yaml())
        echo(f"rows in {folder / 'design_01.yaml'} to design_{len(design.rows):02d}.yaml")
    picked_scene = None if picked is None else design.scene_of(design.rows[picked].candidate)
    write_design(kept, picked_scene, folder)


def _without_nan(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: None if x != x else x for key, x in values.items()}


def _front_csv(design: Design) -> str:
    """Return the front as CSV text, in SI units, which the head names.

    It has a line for each buffer that was run and that no other one beats.  Those that are rows
    have a number, and details such as the convergence of the row.  The columns are the free values,
    all loads, and these details.
    """
    keys = [*LOAD_KEYS, *([CAPTURE_RANGE] if design.requirements.area else [])]
    head = ["row", "knee", *(head_of(each.name, each.unit) for each in design.variables)]
    head += [head_of(key, Measure(key).load.unit.replace("1", "")) for key in keys]
    head += ["left_again", "found", "stays_until [s]", "change_if_1_percent_off"]
    head += ["excess_if_1_percent_off", "at_ends"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for candidate, number in design.whole_front:
        row = DesignRow(candidate, Goal((), ()), convergence="")
        if number is not None:
            row = design.rows[number - 1]
        sharp = row.sharpness
        values = [candidate.values[each.name] for each in design.variables]
        loads = ["" if math.isnan(x := candidate.loads[key]) else x for key in keys]
        found = [candidate.left_again, row.convergence, "" if row.stays is None else row.stays]
        found += [sharp.change, sharp.excess] if sharp else ["", ""]
        found.append("; ".join(row.at_ends))
        shown = "" if number is None else number
        writer.writerow([shown, "knee" if row.is_knee else "", *values, *loads, *found])
    return text.getvalue()


def outcome_of(outcome: Outcome | None) -> dict[str, Any]:
    """Return the verdict and the loads of a run for ``design.json``; all None without a run."""
    return {name: getattr(outcome, name, None) for name in ("verdict", "left_again", "loads")}


def write_design(kept: Mapping[str, Any], scene: Scene | None, folder: Path) -> None:
    """Write ``kept`` as ``design.json`` and the scene, unless it is None, as ``design.yaml``."""
    made = {"made_by": f"capture_sim {own_version()}", **kept}
    give(lambda: made)
    echo(f"every candidate in {write_json(folder / 'design.json', made)}")
    if scene is not None:
        echo(f"scene in {write_text(folder / 'design.yaml', _named(scene).to_yaml())}")


def _named(scene: Scene, number: str = "") -> Scene:
    """Return the scene under a new name, ``<name>_design<number>``.

    The designed and the original scene can thus be run into the same folder.
    """
    name, title = f"{scene.name}_design{number}", f"{scene.title}; designed"
    return dataclasses.replace(scene, name=name, title=title)
