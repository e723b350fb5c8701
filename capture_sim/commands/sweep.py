"""``capture-sim sweep``: run a scene over values, distributions or the rows of a table."""

from __future__ import annotations

import argparse
import hashlib
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from capture_sim.base.exit_status import FAILED as FAILED_STATUS
from capture_sim.base.exit_status import INTERRUPTED, OK
from capture_sim.base.journal import Journal
from capture_sim.base.software import software_versions
from capture_sim.base.tables import print_table, transcript
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import (
    add_control,
    add_limits,
    add_resume,
    add_scene,
    add_seed,
    add_under,
    add_workers,
    dispersions,
    load,
    prepare_folder,
    whole,
)
from capture_sim.commands.output import Progress, command_line, drawing, echo, give, warn
from capture_sim.errors import SceneError
from capture_sim.recording.sweep_file import check_format, is_complete, read_cases, write_sweep
from capture_sim.run.loads import LOADS, implausible_stroke, plausible_stroke
from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.capture_range import CaptureRange, area_of_map, ranges_of_sweep
from capture_sim.studies.evaluate.dispersion import (
    MAIN_LOADS,
    QUANTILES,
    Indices,
    Probability,
    Quantile,
    capture_probability,
    complete_samples,
    computed_rows,
    hold_probability,
    limit_probability,
    main_effects,
    margin_at,
    outcome_labels,
    plain_rows,
    quantiles,
    rank_correlations,
    sobol_indices,
    success_probability,
    wilks_runs,
)
from capture_sim.studies.evaluate.executors import open_executor
from capture_sim.studies.evaluate.limits import Limit, read_limits
from capture_sim.studies.evaluate.sweep import (
    FAILED,
    RTOL,
    Recipe,
    at_tolerance,
    notes_text,
    run_samples,
    samples_of,
)
from capture_sim.studies.vary.inputs import FAMILIAR, typed_unit
from capture_sim.studies.vary.sampling import EDGES, SAMPLES, Samples

if TYPE_CHECKING:
    import pandas

DESCRIPTION = (
    "Run a scene over values, distributions or the rows of a table. Print the probability of "
    "capture and of keeping the limits, the percentiles of the loads, the worst runs and the most "
    "influential inputs. The tolerance is 1e-6 unless --set run.rtol gives another. Verdicts "
    "evaluate the exact motion, without the noise of the scene's sensors."
)
FAILS = "no run could be computed"
GIVES = "the table"
EXAMPLE = """\
  capture-sim sweep tilt_p10 --vary buffer.c_A=5:30:26 --out runs/damper.csv
  capture-sim sweep tilt_0 --vary initial.chaser.y='normal(5 mm, 2 mm)' \\
    --vary buffer.k_A='normal(500, 5%)' --runs 200
  capture-sim sweep paper_designed --vary approach.angle='-30 deg:30 deg:13' \\
    --vary approach.offset='-50 mm:50 mm:11' --out runs/map.parquet"""
#: Number of runs below which the percentiles are printed with their intervals.
_INTERVALS_BELOW = 500
#: Captions of the plots, by name.
_CAPTIONS = {
    "curve": "Loads over the input",
    "map": "Verdicts over two inputs",
    "loads": "Distribution of the loads",
    "indices": "What matters: Sobol indices",
    "tornado": "What matters: rank correlations",
}
_WORST = 3  # number of runs whose commands are printed; the table has the commands of all runs
_FAILURES = 3  # maximum number of kinds of failures that are printed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_scene(parser, "tilt_0")
    parser.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME=VALUES",
        help="vary a field of the scene, or approach.angle, .offset, .mouth_offset or .speed (free "
        "flight just before the first touch), over LOW:HIGH:COUNT, A,B,C, VALUE +- ERROR or a "
        "distribution: "
        f"{', '.join(FAMILIAR.values())} or any other of scipy.stats. Numbers are in SI units, "
        "with a unit, or in %% of the mean. May be repeated",
    )
    add_under(parser, "also vary the distributions of this YAML file")
    parser.add_argument(
        "--from",
        type=Path,
        dest="cases",
        metavar="TABLE",
        help="run the rows of a .csv or .parquet table; columns that are no fields stay as notes",
    )
    parser.add_argument(
        "--runs",
        type=whole(),
        metavar="N",
        help="draw N samples from the distributions, or N base samples with saltelli (default: "
        "100, or 128 with sobol and saltelli)",
    )
    parser.add_argument(
        "--sample",
        choices=SAMPLES,
        default="random",
        help="draw independently, or by a Latin hypercube, a Sobol sequence, or Saltelli's design "
        "for Sobol indices (default: random)",
    )
    add_seed(parser, "the draws")
    parser.add_argument(
        "--edges",
        type=whole(),
        default=0,
        metavar="N",
        help="draw N more runs near the edges of the distributions (default: 0)",
    )
    add_limits(parser)
    parser.add_argument(
        "--check",
        action="store_true",
        help="repeat every run at half the tolerance and report the verdicts that change",
    )
    parser.add_argument(
        "--worst",
        choices=[load.key for load in LOADS],
        default=MAIN_LOADS[0],
        metavar="LOAD",
        help=f"list the runs with the largest LOAD (default: {MAIN_LOADS[0]})",
    )
    add_control(parser)
    add_workers(parser)
    add_resume(parser, "sweep")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/sweep.csv"),
        metavar="FILE",
        help="write the table to FILE.csv or FILE.parquet, and plots next to it (default: "
        "runs/sweep.csv)",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    check_format(options.out)
    scene = at_tolerance(load(options.scene, options.overrides), options.overrides, RTOL)
    samples = _samples(scene, options)
    limits = read_limits(options.limits)
    if samples.notes:
        warn(notes_text(scene, list(samples.notes)))
    prepare_folder(options.out.parent)
    is_noisy = scene.sensors is not None and scene.sensors.motion_capture is not None
    if is_noisy and not options.control:
        warn("verdicts are of the exact motion: sensors.motion_capture is not simulated")
    is_left = _journal_path(options).exists()
    if options.resume and not is_left and is_complete(options.out, _about(scene, samples, options)):
        echo(f"complete: {len(samples.rows)} runs, table in {options.out}")
        return OK
    with _journal(scene, samples, options) as journal:
        return _sweep(scene, samples, limits, options, journal)


def _about(scene: Scene, samples: Samples, options: argparse.Namespace) -> dict[str, Any]:
    """Return what made the table, see :func:`write_sweep`."""
    about = {"scene": scene.to_yaml(), "vary": options.vary, "seed": options.seed}
    about |= {"sample": options.sample, "runs": len(samples.rows), "limits": options.limits}
    about |= {"correlate": options.correlate, "check": options.check}
    about |= {"control": options.control} if options.control else {}
    return about | {"rows": _hash(samples)}


def _hash(samples: Samples) -> str:
    """Return a hash of the varied values of all runs."""
    names = [axis.name for axis in samples.axes]
    return hashlib.sha256(repr([names, samples.rows, samples.designs]).encode()).hexdigest()


def _journal_path(options: argparse.Namespace) -> Path:
    return Path(options.out.with_name(f"{options.out.name}.journal"))


def _journal(scene: Scene, samples: Samples, options: argparse.Namespace) -> Journal:
    """Open the journal, the file to which finished runs are written, and return it.

    With ``--resume``, the journal also has the runs of the interrupted sweep.
    """
    head = {"study": "sweep", "software": list(software_versions()), "scene": scene.to_yaml()}
    head |= {"vary": _hash(samples), "limits": sorted(options.limits), "check": options.check}
    head |= {"control": options.control} if options.control else {}
    journal = Journal(_journal_path(options), head, resume=options.resume)
    if journal.replaced is not None:
        warn(f"the unfinished sweep of before is now {journal.replaced}; --resume continues one")
    if options.resume:
        done = sum(len(rows) for _, rows in journal.entries)
        echo(f"{done} of {len(samples.rows)} runs were done before")
    return journal


def _sweep(
    scene: Scene,
    samples: Samples,
    limits: Sequence[Limit],
    options: argparse.Namespace,
    journal: Journal,
) -> int:
    """Run the samples, write the table of results and plots, and print statistics.

    The exit status is returned.
    """
    compile_first()
    with (
        open_executor(options.workers, options.scheduler) as executor,
        Progress() as progress,
    ):
        table = run_samples(
            scene,
            samples,
            limits=limits,
            check=options.check,
            executor=executor,
            report=partial(progress.at, "sweep"),
            journal=journal,
            control=options.control,
        )
        ranges: dict[tuple[Any, ...], CaptureRange] = {}
        if options.cases is None and not options.control:
            with suppress(KeyboardInterrupt):  # the table is complete without
                ranges = ranges_of_sweep(scene, samples, table, limits, executor)
    if table.empty:
        warn(f"interrupted: 0 of {len(samples.rows)} runs are done; nothing is written")
        return INTERRUPTED
    about = _about(scene, samples, options)
    table["command"] = _commands(scene, samples, options)[: len(table)]
    table.attrs["units"]["command"] = ""
    echo(
        f"{len(table)} runs, seed {options.seed}: table in {write_sweep(table, options.out, about)}"
    )
    give(lambda: table.astype(object).where(table.notna(), None).to_dict("records"))
    indices = _indices(samples, table, options)
    with transcript() as shown:
        _report(scene, samples, table, indices, limits, options)
        _print_ranges(samples, ranges, limits)
    if len(table) < len(samples.rows):
        warn(
            f"interrupted: {len(table)} of {len(samples.rows)} runs written to {options.out}; "
            "--resume continues"
        )
        return INTERRUPTED
    with drawing():
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.study_page import drawn, save_page
        from capture_sim.viewing.sweep import draw_sweep

        figures = draw_sweep(table, samples.axes, scene.name, indices, limits, ranges)
        for name, figure in figures.items():
            path = options.out.with_name(f"{options.out.stem}_{name}.png")
            echo(f"plot in {save(figure, path)}")
        asked = {
            "command": command_line(),
            "scene": f"{scene.name}: {scene.title}",
            "varied": "; ".join(options.vary) or ", ".join(axis.name for axis in samples.axes),
            "limits": ", ".join(limit.text for limit in limits) or "none",
            "runs": f"{len(table)}, seed {options.seed}",
        }
        page = options.out.with_suffix(".html")
        files = {"table of all runs": options.out.name}
        title = f"Sweep: {scene.name}"
        pictures = drawn({_CAPTIONS[name]: figure for name, figure in figures.items()})
        save_page(page, title, asked, pictures, shown, files=files, scene=scene)
        echo(f"page in {page}")
    journal.remove()  # last: until then, --resume makes all of this again
    if computed_rows(table).empty:
        warn("no run could be computed")
        return FAILED_STATUS
    return OK


def _samples(scene: Scene, options: argparse.Namespace) -> Samples:
    if options.cases is not None:
        others = options.vary, options.under, options.correlate, options.runs, options.edges
        if any(others) or options.calibrated is not None:
            raise SceneError(
                "--from: must be given without --vary, --under, --calibrated, --correlate, --runs "
                "and --edges"
            )
        return samples_of(scene, read_cases(options.cases), is_flown=bool(options.control))
    vary, correlations = dispersions(options)
    for item in options.vary:
        name, sign, given = item.partition("=")
        if not sign or not name.strip() or name.strip() in vary:
            raise SceneError(f"--vary {item}: must be NAME=VALUES, each name once")
        vary[name.strip()] = given
    if not vary:
        raise SceneError(
            "--vary: must be given at least once, or --under, or --calibrated, or --from"
        )
    runs = options.runs
    if runs is None:
        runs = 100 if any("(" in given for given in vary.values()) else 0
        if runs and options.sample in ("sobol", "saltelli"):
            runs = 128
    draws = options.sample, options.seed, options.edges, correlations
    return samples_of(scene, vary, runs, *draws, is_flown=bool(options.control))


def _commands(scene: Scene, samples: Samples, options: argparse.Namespace) -> list[str]:
    """Return, for each sample, the command line that repeats its run.

    It is '' for a sample whose values make no valid scene.
    """
    recipe = Recipe(scene, tuple(axis.name for axis in samples.axes))
    given = {item.partition("=")[0].strip() for item in options.overrides}
    always = [*options.overrides]
    if "run.rtol" not in given:
        always.append(f"run.rtol={scene.run.rtol!r}")
    commands = []
    for number, row in enumerate(samples.rows):
        if number in samples.failures:
            commands.append("")
            continue
        words = ["capture-sim", "run", options.scene]
        for change in (*always, *recipe.overrides_of(row)):
            words += ["--set", change]
        words += ["--control", options.control] if options.control else []
        commands.append(shlex.join(words))
    return commands


def _indices(
    samples: Samples, table: pandas.DataFrame, options: argparse.Namespace
) -> list[Indices]:
    """Return the Sobol indices of each main load; empty unless ``--sample`` is saltelli.

    Loads whose indices cannot be computed, because they do not vary, are left out.
    """
    if options.sample != "saltelli":
        return []
    drawn = sorted(axis.name for axis in samples.axes if axis.distribution)
    indices = (sobol_indices(table, drawn, key, options.seed) for key in MAIN_LOADS)
    return [found for found in indices if found is not None]


def _report(
    scene: Scene,
    samples: Samples,
    table: pandas.DataFrame,
    indices: Sequence[Indices],
    limits: Sequence[Limit],
    options: argparse.Namespace,
) -> None:
    if indices:
        size = len(indices[0].first) + 2
        whole = complete_samples(table, [axis.name for axis in samples.axes if axis.distribution])
        echo(f"statistics: of {len(whole) // size} complete of {len(table) // size} base samples")
        _print_failures(table)
        table = whole
    labels = outcome_labels(table).value_counts()
    echo(f"verdicts: {', '.join(f'{count} {name}' for name, count in labels.items())}")
    _print_failures(table)
    strokes = computed_rows(table)["max_axial_stroke_in"].dropna()
    if text := implausible_stroke(scene, float(strokes.max()) if strokes.size else None):
        n_long = int((strokes > plausible_stroke(scene)).sum())
        runs_have = "1 run has" if n_long == 1 else f"{n_long} runs have"
        warn(f"{runs_have} too long a stroke; the longest: {text}")
    drawn = sorted(axis.name for axis in samples.axes if axis.distribution)
    is_grid = not drawn and options.cases is None
    if not is_grid:
        _print_probability(table, samples, limits, options)
    if limits:
        _print_limits(table, limits, is_grid=is_grid)
    if options.check:
        changed = table[table["verdict"] != table["verdict_at_half_tolerance"]]
        which = f"runs {', '.join(map(str, changed.index))}" if len(changed) else "none"
        echo(f"verdicts that change at half the tolerance: {which}")
    if computed_rows(table).empty:
        return
    _print_loads(plain_rows(computed_rows(table)), is_grid=is_grid)
    if indices:
        _print_indices(indices, drawn)
    else:
        grid = [a.name for a in samples.axes if len(set(a.values)) > 1] if not options.cases else []
        _print_effects(table, [name for name in grid if table[name].nunique() > 1])
        _print_correlations(table, [a.name for a in samples.axes if a.name not in grid])
    _print_worst(table, samples, options)


def _print_failures(table: pandas.DataFrame) -> None:
    """Print the reasons why runs could not be computed, the most frequent first.

    Reasons that differ only in numbers are one kind; a line has the count and an example of it.
    """
    reasons = table.loc[table["verdict"] == FAILED, "failure"]
    without_numbers = reasons.str.replace(r"[-+.\d]+(e[-+]?\d+)?", "", regex=True)
    kinds = sorted(reasons.groupby(without_numbers), key=lambda kind: -len(kind[1]))
    for _, alike in kinds[:_FAILURES]:
        echo(f"{len(alike)} could not be computed, e.g. run {alike.index[0]}: {alike.iloc[0]}")


def _print_probability(
    table: pandas.DataFrame,
    samples: Samples,
    limits: Sequence[Limit],
    options: argparse.Namespace,
) -> None:
    # the rows of a table are draws of the user's own
    fixed = () if options.cases is not None else samples.axes
    grid = [axis.name for axis in fixed if not axis.distribution]
    groups = plain_rows(table).groupby(grid, sort=False) if grid else [("", table)]
    for point, rows in groups:
        values = point if isinstance(point, tuple) else (point,)
        where = ", ".join(
            f"{name} = {_in_typed_unit(samples, name, value, 6)}"
            for name, value in zip(grid, values, strict=False)
        )
        start = f"{where}: " if where else ""
        captured = capture_probability(rows)
        echo(f"{start}{_probability_text('captured', captured)}")
        if rows["left_again"].any():
            held = hold_probability(rows)
            echo(f"{start}{_probability_text('captured and not left again', held)}")
        if limits:
            echo(f"{start}{_probability_text('all limits met', limit_probability(rows, limits))}")
            success = success_probability(rows, limits)
            echo(f"{start}{_probability_text('captured with all limits met', success)}")
    if options.sample in ("latin", "sobol", "saltelli"):
        echo(f"(the interval applies to independent draws; {options.sample} draws are not)")
    if options.cases is not None:
        echo("(the interval applies if the rows of the table are independent draws)")
    if "design" in table:
        edge = capture_probability(table[table["design"] == EDGES].drop(columns="design"))
        echo(f"near the edges: captured {edge.met} of {edge.computed}, not counted above")
    needed = ", ".join(f"{wilks_runs(share)} for {share:g}" for share in (0.9, 0.95, 0.99, 0.9973))
    echo(f"runs without a failure that prove a probability at 95 % confidence: {needed}")


def _probability_text(condition: str, found: Probability) -> str:
    text = f"{condition} {found.met} of {found.computed}"
    if found.computed > 1:
        text += (
            f": probability {found.estimate:.4f}, 95 % interval {found.low:.4f} to {found.high:.4f}"
        )
    if found.failed:
        text += f"; {found.failed} could not be computed, not counted"
    return text


def _print_ranges(
    samples: Samples, ranges: Mapping[tuple[Any, ...], CaptureRange], limits: Sequence[Limit]
) -> None:
    """Print the capture ranges: the shares of an area of approaches that end in a capture.

    There is one capture range for each combination of values of the axes that do not span the area.
    """
    if not ranges:
        return
    area = area_of_map([axis for axis in samples.axes if len(axis.values) != 1])
    others = [a.name for a in samples.axes if a.name not in {axis.name for axis in area}]
    units = {axis.name: typed_unit(axis) for axis in area}
    where = ", ".join(
        f"{axis.name} {axis.values[0] * factor:.4g} to {axis.values[-1] * factor:.4g} {unit}"
        for axis, (unit, factor) in zip(area, units.values(), strict=True)
    )
    runs = sum(found.runs for found in ranges.values())
    what = "captured and not left again" + (", within the limits" if limits else "")
    echo(f"\ncapture range: share of the area {where} that is {what}; {runs} runs locate its edge")
    for values, found in ranges.items():
        point = ", ".join(
            f"{n} = {_in_typed_unit(samples, n, v, 6)}" for n, v in zip(others, values, strict=True)
        )
        start = f"{point}: " if point else ""
        echo(f"{start}{found.share * 100.0:.2f} +- {found.error * 100.0:.2f} %")


def _print_limits(table: pandas.DataFrame, limits: Sequence[Limit], *, is_grid: bool) -> None:
    """Print a table of the limits: in how many runs each is met, and its margins.

    A margin is the share of the limit that is left.  It is printed for the worst run and, unless
    the sweep is a grid, at the load that 5 % and 1 % of the runs exceed.
    """
    cells = []
    for limit in limits:
        found = limit_probability(table, [limit])
        row = [limit.meaning, limit.shown(limit.value), limit.load.shown_in]
        row.append(f"{found.met} of {found.computed}")
        if not is_grid:
            row += [f"{found.estimate:.4f}", f"{found.low:.4f} to {found.high:.4f}"]
            row += [f"{margin_at(table, limit, share):+.1%}" for share in (0.05, 0.01)]
        row.append(f"{margin_at(table, limit, 0.0):+.1%}")
        cells.append(row)
    head = ["limit", "at most", "unit", "met"]
    if not is_grid:
        head += ["probability", "95 % interval", "margin at 5 %", "at 1 %"]
    echo("\nlimits; a margin is the share of the limit that is left")
    print_table([*head, "worst run"], cells)


def _print_loads(rows: pandas.DataFrame, *, is_grid: bool) -> None:
    """Print a table of the percentiles of each load.

    The runs of a grid are not random draws.  Therefore a grid has the smallest value, the median
    and the largest value instead.
    """
    echo(f"\nloads of {len(rows)} runs, whole run and before the latch")
    cells = []
    for row_load in LOADS:
        before = rows.get(f"{row_load.key}_before_latch")
        # loads before the latch only if the latch changes them
        is_same = before is None or before.equals(rows[row_load.key])
        for name in [row_load.key] if is_same else [row_load.key, before.name]:
            values = rows[name].dropna().to_numpy(float) * row_load.factor
            if not values.size:
                continue
            if is_grid:
                texts = [f"{np.quantile(values, share):.4g}" for share in (0.0, 0.5, 1.0)]
            else:
                texts = [_quantile_text(q, len(rows)) for q in quantiles(values)]
            cells.append([name, row_load.shown_in, *texts])
    shares = ("smallest", "median", "largest") if is_grid else (f"{q:.0%}" for q in QUANTILES)
    print_table(["load", "unit", *shares], cells, left=2)


def _quantile_text(found: Quantile, runs: int) -> str:
    if runs >= _INTERVALS_BELOW or found.low == found.high or runs == 1:
        return f"{found.value:.4g}"
    low, high = ("-" if np.isnan(end) else f"{end:.3g}" for end in (found.low, found.high))
    return f"{found.value:.4g} ({low}..{high})"


def _print_effects(table: pandas.DataFrame, inputs: Sequence[str]) -> None:
    """Print the effect of each input of a grid: the range of the mean loads over its values."""
    if not inputs:
        return
    effects = main_effects(table, inputs)
    units = {load.key: (load.shown_in, load.factor) for load in LOADS}
    head = [f"{name}, {units[name][0]}" if name in units else str(name) for name in effects.columns]
    echo("\neffect of each input: range of the load's mean over its values")
    cells = []
    for name, row in zip(effects.index, effects.to_numpy(float), strict=True):
        factors = [units.get(column, ("", 1.0))[1] for column in effects.columns]
        texts = ["-" if np.isnan(v) else f"{v * f:.4g}" for v, f in zip(row, factors, strict=True)]
        cells.append([str(name), *texts])
    print_table(["input", *head], cells)


def _print_correlations(table: pandas.DataFrame, names: Sequence[str]) -> None:
    """Print the rank correlations of the inputs ``names`` with the main loads and with capture."""
    inputs = [name for name in names if table[name].nunique() > 1]
    numbers = [name for name in inputs if table[name].dtype.kind in "if"]
    if not numbers or len(plain_rows(computed_rows(table))) < 3:
        return
    found = rank_correlations(table, numbers)
    if found.isna().to_numpy().all():
        return
    echo("\nrank correlation (Spearman) of each input with")
    cells = (
        [str(name), *("-" if np.isnan(v) else f"{v:+.2f}" for v in row)]
        for name, row in zip(found.index, found.to_numpy(), strict=True)
    )
    print_table(["input", *found.columns], cells)


def _print_indices(indices: Sequence[Indices], inputs: Sequence[str]) -> None:
    for found in indices:
        echo(f"\nSobol indices of {found.load}, {found.used} base samples (95 % interval)")
        columns: tuple[Any, ...] = found.first, found.first_interval, found.total
        cells = (
            [name, f"{s1:.3f} +- {d1:.3f}", f"{st:.3f} +- {dt:.3f}"]
            for name, s1, d1, st, dt in zip(inputs, *columns, found.total_interval, strict=True)
        )
        print_table(["input", "first", "total"], cells)


def _in_typed_unit(samples: Samples, name: str, value: Any, digits: int) -> str:
    """Return the value of an input as text, in the unit in which the input was given."""
    axis = next((each for each in samples.axes if each.name == name), None)
    if axis is None or isinstance(value, (str, bool)):
        return str(value)
    unit, factor = typed_unit(axis)
    unit = "" if unit in ("1", axis.unit) else unit
    return f"{value * factor:.{digits}g} {unit}".rstrip()


def _print_worst(table: pandas.DataFrame, samples: Samples, options: argparse.Namespace) -> None:
    """Print the runs with the largest load ``--worst``, with commands that repeat them.

    Values are rounded to nine digits; those of the column ``command`` are exact.

    If no run touches the cone, the runs with the closest approach are printed instead.
    """
    load = next(each for each in LOADS if each.key == options.worst)
    computed = computed_rows(table)
    if not computed["touches"].any():
        load = next(each for each in LOADS if each.least)
        echo(f"\nno run touches the cone; smallest {load.key}, with the command that repeats it")
        worst = computed.nsmallest(_WORST, load.key)
    else:
        echo(f"\nlargest {load.key}, with a command that repeats it (exact: column command)")
        worst = computed.nlargest(_WORST, load.key)
    labels = outcome_labels(worst)
    for number, row in worst.iterrows():
        if np.isnan(row[load.key]):
            continue
        shown = f"{row[load.key] * load.factor:.4g} {load.shown_in}, {labels[number]}"
        if row.get("exceeded"):
            shown += f", exceeds {row['exceeded']}"
        words = [_rounded(word, samples) for word in shlex.split(row["command"])]
        echo(f"{number}: {shown}: {shlex.join(words)}")


def _rounded(word: str, samples: Samples) -> str:
    """Return NAME=VALUE with nine digits in the unit of the user if it is a varied number."""
    name, _, value = word.partition("=")
    is_whole = value.lstrip("-").isdigit()  # a seed has more digits
    with suppress(ValueError):
        if not is_whole and name in {axis.name for axis in samples.axes}:
            return f"{name}={_in_typed_unit(samples, name, float(value), 9)}"
    return word
