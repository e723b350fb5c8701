"""``capture-sim design``."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from rich.console import Console

from capture_sim.base.exit_status import FAILED, OK
from capture_sim.base.tables import print_table
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import (
    add_limits,
    add_out,
    add_scene,
    add_seed,
    add_under,
    add_workers,
    dispersions,
    in_unit,
    load,
    number,
    prepare_folder,
    reader,
    whole,
)
from capture_sim.commands.output import (
    Progress,
    drawing,
    echo,
    warn,
    write_json,
    write_text,
)
from capture_sim.errors import SceneError
from capture_sim.run.loads import LOADS, implausible_stroke
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Range
from capture_sim.studies.design import (
    CHECK_DRAWS,
    DRAWS,
    FREE,
    Candidate,
    Design,
    Dispersions,
    Requirements,
    design_buffer,
    make_variables,
)
from capture_sim.studies.executors import open_executor
from capture_sim.studies.limits import Limit, make_limits, read_limits
from capture_sim.studies.outcome import Outcome, run_first_contact, run_to_end
from capture_sim.studies.paper_flow import (
    FirstContactDesign,
    FirstContactTarget,
    Trial,
    design_first_contact,
    with_buffer,
)

DESCRIPTION = (
    "Find the buffer that captures within limits with the least peak force. If none does, print "
    "the buffer that comes closest among the ones tried (exit status 1). Limits apply to the "
    "whole run, including the latched phase. Without limits, the strokes of the scene's own "
    "buffer are the limits. With --first-contact, design as in the paper: for strokes of the "
    "first contact."
)
EXAMPLE = """\
  capture-sim design paper_designed --stroke-limit 7.5 --torsion-limit 2
  capture-sim design tilt_0 --stroke-limit 10 --limit max_buffer_force=8 \\
    --free buffer.k_A,buffer.c_A,buffer.preload --under dispersions.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_scene(parser, "paper_designed")
    parser.add_argument(
        "--stroke-limit",
        type=in_unit("mm"),
        metavar="MM",
        help="limit the axial stroke, inwards and outwards, mm or with a unit",
    )
    parser.add_argument(
        "--torsion-limit",
        type=in_unit("mrad"),
        metavar="MRAD",
        help="limit the torsion, mrad or with a unit, e.g. '0.2 deg'",
    )
    parser.add_argument(
        "--peak-force",
        type=in_unit("N"),
        metavar="N",
        help="limit the peak force of every touch, N (default: no limit)",
    )
    add_limits(parser)
    parser.add_argument(
        "--free",
        action="append",
        default=[],
        metavar="NAME[=LOW:HIGH],..",
        help="search these values, e.g. buffer.k_A,buffer.c_A=5:50,buffer.preload; may be repeated "
        f"(default: {','.join(FREE)}). buffer.c_A_rebound keeps its ratio to buffer.c_A unless it "
        "is free",
    )
    add_seed(parser, "the search and of the draws")
    add_under(parser, "require the limits under the distributions of this YAML file")
    parser.add_argument(
        "--confidence",
        type=number(Range(0.5, 1.0, high_open=True)),
        metavar="SHARE",
        help="set the share of the draws that must be captured within the limits (default: 0.95)",
    )
    parser.add_argument(
        "--draws",
        type=whole(Range(1, 10_000)),
        metavar="N",
        help=f"with --under, run each candidate with N draws (default: {DRAWS}); the design is "
        f"checked with {CHECK_DRAWS} new ones",
    )
    parser.add_argument(
        "--first-contact",
        action="store_true",
        help="design as in the paper: meet --stroke and --torsion in the first contact without the "
        "damper; later contacts may exceed them",
    )
    parser.add_argument(
        "--stroke",
        type=in_unit("mm"),
        metavar="MM",
        help="set the target axial stroke of --first-contact, mm or with a unit",
    )
    parser.add_argument(
        "--torsion",
        type=in_unit("mrad"),
        metavar="MRAD",
        help="set the target torsion of --first-contact, mrad or with a unit",
    )
    parser.add_argument(
        "--trade-off",
        type=reader(_factors, "LOW:HIGH:N with 0 < LOW < HIGH and N from 2 to 100"),
        default=(),
        metavar="LOW:HIGH:N",
        help="with --first-contact, also design for N axial strokes from LOW to HIGH times the "
        "target, e.g. 0.3:3:9",
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="list every candidate buffer")
    add_workers(parser)
    add_out(parser, "runs/design")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    _check(options)
    scene = load(options.scene, options.overrides)
    if options.first_contact:
        return _design_first_contact(scene, options)
    free = [name for text in options.free for name in text.split(",")] or list(FREE)
    under = None
    if options.under is not None:
        under = Dispersions(*dispersions(options))
    given = _limits(options)
    make_variables(scene, given, free)  # before anything runs
    prepare_folder(options.out)
    compile_first()
    limits = given or _own_limits(scene)
    requirements = Requirements(limits, under, options.confidence or 0.95, options.draws or DRAWS)
    echo(f"limits: {', '.join(limit.text for limit in limits)}")
    with (
        open_executor(options.workers, options.scheduler) as executor,
        _Candidates(_candidate_line, verbose=options.verbose) as candidates,
    ):
        design = design_buffer(
            scene,
            requirements,
            free,
            seed=options.seed,
            executor=executor,
            report=candidates.show,
        )
    _report(design)
    _keep(design, options)
    with drawing():
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.studies import draw_design

        echo(f"plot in {save(draw_design(design), options.out / 'design.png')}")
    return OK if design.met else FAILED


def _check(options: argparse.Namespace) -> None:
    """Raise SceneError for options that do not belong together."""
    targets = {"--stroke": options.stroke, "--torsion": options.torsion}
    if options.first_contact:
        if (options.stroke is None) != (options.torsion is None):
            raise SceneError("--stroke (mm), --torsion (mrad): must be given both or neither")
        others = {"--stroke-limit": options.stroke_limit, "--torsion-limit": options.torsion_limit}
        others |= {"--limit": options.limits, "--free": options.free, "--under": options.under}
        others |= {"--confidence": options.confidence, "--correlate": options.correlate}
        others |= {"--draws": options.draws}
        for name, value in others.items():
            if value:
                raise SceneError(f"{name}: must be given without --first-contact")
        return
    for name, value in (*targets.items(), ("--trade-off", options.trade_off)):
        if value:
            limit = f"; use {name}-limit" if name in targets else ""
            raise SceneError(f"{name}: must be given with --first-contact{limit}")
    of_draws = {"--confidence": options.confidence, "--draws": options.draws}
    of_draws["--correlate"] = options.correlate
    for name, value in of_draws.items():
        if value and options.under is None:
            raise SceneError(f"{name}: must be given with --under")


def _limits(options: argparse.Namespace) -> tuple[Limit, ...]:
    """Return the limits that are given."""
    limits: dict[str, float] = {}
    if options.stroke_limit is not None:
        limits |= dict.fromkeys(
            ("max_axial_stroke_in", "max_axial_stroke_out"), options.stroke_limit
        )
    if options.torsion_limit is not None:
        limits["max_torsion"] = options.torsion_limit
    if options.peak_force is not None:
        limits["max_normal_force"] = options.peak_force
    others = read_limits(options.limits)
    for limit in others:
        if limit.key in limits:
            raise SceneError(f"--limit {limit.key}: must be given once")
    return (*make_limits(limits), *others)


def _own_limits(scene: Scene) -> tuple[Limit, ...]:
    """Return the strokes and the torsion of the scene's own buffer as limits."""
    loads = run_to_end(scene).loads
    stroke = max(loads["max_axial_stroke_in"], loads["max_axial_stroke_out"])
    if not stroke or not loads["max_torsion"]:
        raise SceneError(f"{scene.name}: its buffer has no stroke: --stroke-limit must be given")
    return (
        Limit("max_axial_stroke_in", stroke),
        Limit("max_axial_stroke_out", stroke),
        Limit("max_torsion", loads["max_torsion"]),
    )


class _Candidates:
    """Output of the candidate buffers: the latest on a terminal, all with ``--verbose``."""

    def __init__(self, line: Callable[[Any], str], *, verbose: bool) -> None:
        self._line, self._verbose = line, verbose
        self._count = 0
        console = Console(stderr=True)
        self._status = console.status("") if console.is_terminal and not verbose else None

    def __enter__(self) -> Self:
        if self._status is not None:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status is not None:
            self._status.stop()

    def show(self, candidate: Any) -> None:
        """Show a candidate buffer and its loads."""
        self._count += 1
        line = f"{self._count:5d}  {self._line(candidate)}"
        if self._verbose:
            echo(line)
        elif self._status is not None:
            self._status.update(f"candidate {line.strip()}")


def _candidate_line(candidate: Candidate) -> str:
    values = "  ".join(
        f"{name.rpartition('.')[2]} {value:9.5g}" for name, value in candidate.values.items()
    )
    return (
        f"{values}  {candidate.peak_force:8.1f} N  {candidate.verdict}"
        f"{'' if candidate.feasible else f', violates the limits by {candidate.violation:.3g}'}"
    )


def _trial_line(trial: Trial) -> str:
    return (
        f"k_A {trial.k_A:9.5g}  k_T {trial.k_T:9.5g}  c_A {trial.c_A:8.4g}  "
        f"{trial.axial_stroke * 1e3:8.4f} mm  {trial.torsion * 1e3:8.4f} mrad"
        f"{'' if trial.verdict is None else f'  {trial.verdict}'}"
    )


def _report(design: Design) -> None:
    echo(f"{len(design.history)} buffers tried")
    if not design.met:
        echo(f"no buffer found: {design.refusal}")
    if design.best.feasible:
        _print_buffer(design)
        _print_whole_run(design.scene, design.outcome, design.requirements.limits)
    check, requirements = design.check, design.requirements
    if check is not None and design.best.share is not None:
        echo(
            f"captured within the limits in {design.best.share:.1%} of the draws of the search, "
            f"and in {check.met} of {check.computed} new draws: probability "
            f"{check.estimate:.4f}, 95 % interval {check.low:.4f} to {check.high:.4f}; "
            f"{requirements.confidence:.4g} required"
        )


def _print_buffer(design: Design) -> None:
    values = dict(design.best.values)
    rebound = design.scene.buffer.c_A_rebound
    if rebound is not None:
        values["buffer.c_A_rebound"] = rebound
    units = {variable.name: variable.unit for variable in design.variables}
    units["buffer.c_A_rebound"] = "N s/m"
    echo(
        ", ".join(
            f"{name.removeprefix('buffer.')} = {value:.5g} {units[name]}"
            for name, value in values.items()
        )
    )


def _print_whole_run(scene: Scene, outcome: Outcome, limits: Sequence[Limit]) -> None:
    echo(f"\nsimulation of the design: {_verdict(outcome)}, {outcome.reason}")
    print_table(["whole run", "", "at s", "limit", "margin"], _load_rows(outcome, limits))
    if text := implausible_stroke(scene, outcome.loads["max_axial_stroke_in"]):
        warn(text)
    if outcome.failure:
        echo("the run stopped early: loads until then do not show that limits are kept")
    if outcome.left_again:
        echo("the tip leaves the capture zone again; a latch would hold it")


def _verdict(outcome: Outcome) -> str:
    return f"{outcome.verdict}, left again" if outcome.left_again else outcome.verdict


def _load_rows(outcome: Outcome, limits: Sequence[Limit]) -> list[list[str]]:
    """Return one row for each load of the design's whole run, with its limit."""
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


def _keep(design: Design, options: argparse.Namespace) -> None:
    """Write the scene with the designed buffer, and every candidate of the search."""
    requirements = design.requirements
    kept: dict[str, Any] = {"refusal": design.refusal, "seed": options.seed}
    kept["limits"] = {limit.key: limit.value for limit in requirements.limits}
    kept["free"] = {each.name: [each.low, each.high] for each in design.variables}
    if requirements.under is not None:
        kept["under"] = {name: str(given) for name, given in requirements.under.vary.items()}
        kept["confidence"] = requirements.confidence
    if design.check is not None:
        kept["check"] = design.check._asdict()
    kept |= _outcome_of(design.outcome)
    kept["history"] = [
        {**dataclasses.asdict(candidate), "values": dict(candidate.values)}
        for candidate in design.history
    ]
    _write(kept, design.scene if design.best.feasible else None, options.out)


def _outcome_of(outcome: Outcome | None) -> dict[str, Any]:
    return {name: getattr(outcome, name, None) for name in ("verdict", "left_again", "loads")}


def _write(kept: Mapping[str, Any], scene: Scene | None, folder: Path) -> None:
    echo(f"every candidate in {write_json(folder / 'design.json', kept)}")
    if scene is not None:
        # a name of its own: both can be run into one folder and compared
        name, title = f"{scene.name}_design", f"{scene.title}; designed"
        scene = dataclasses.replace(scene, name=name, title=title)
        echo(f"scene in {write_text(folder / 'design.yaml', scene.to_yaml())}")


def _factors(text: str) -> list[float]:
    first, last, number = text.split(":")
    low, high, count = float(first), float(last), int(number)
    if not (0.0 < low < high < math.inf and 2 <= count <= 100):
        raise ValueError(text)
    return [low * (high / low) ** (n / (count - 1)) for n in range(count)]


def _design_first_contact(scene: Scene, options: argparse.Namespace) -> int:
    """Design as in the paper; return the exit status."""
    prepare_folder(options.out)
    compile_first()
    stroke, torsion = options.stroke, options.torsion
    if stroke is None:
        b = scene.buffer
        own = run_first_contact(with_buffer(scene, b.k_A, b.k_T, 0.0))
        stroke, torsion = own.axial_stroke, own.torsion
    target = FirstContactTarget(stroke, torsion, options.peak_force)
    echo(
        f"target: {stroke * 1e3:.4g} mm and {torsion * 1e3:.4g} mrad (first contact, without the "
        "damper)"
    )
    with _Candidates(_trial_line, verbose=options.verbose) as candidates:
        design = design_first_contact(scene, target, candidates.show)
    _report_first_contact(design)
    _keep_first_contact(design, options.out)
    designs = _trade_off(scene, target, options.trade_off)
    with drawing():
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.studies import draw_first_contact_design, draw_trade_off

        path = options.out / "design.png"
        echo(f"plot in {save(draw_first_contact_design(design), path)}")
        if designs:
            echo(f"trade-off in {save(draw_trade_off(designs), options.out / 'trade_off.png')}")
    return OK if design.met else FAILED


def _trade_off(
    scene: Scene, target: FirstContactTarget, factors: Sequence[float]
) -> list[FirstContactDesign]:
    """Return a design for each multiple of the target's axial stroke."""
    designs = []
    with Progress("designs") as progress:
        for done, factor in enumerate(factors):
            progress.at("trade-off", done, len(factors))
            stroke = factor * target.axial_stroke
            target_here = dataclasses.replace(target, axial_stroke=stroke)
            designs.append(design_first_contact(scene, target_here))
    for design in designs:
        echo(_trade_off_line(design))
    return designs


def _report_first_contact(design: FirstContactDesign) -> None:
    echo(f"{len(design.history)} runs")
    if not design.met:
        echo(f"no buffer meets the target: {design.refusal}")
        return
    assert design.scene is not None
    assert design.undamped is not None
    assert design.damped is not None
    assert design.outcome is not None
    assert design.energy is not None
    assert design.capturing is not None
    b, energy = design.scene.buffer, design.energy
    low, high = design.capturing
    echo(f"k_A = {b.k_A:.5g} N/m, k_T = {b.k_T:.5g} N m/rad, c_A = {b.c_A:.4g} N s/m")
    echo(f"  captures from c_A = {low:.4g} to {high:.4g} N s/m")
    for name, contact in (("without", design.undamped), ("with", design.damped)):
        echo(
            f"  first contact {name} the damper: {contact.axial_stroke * 1e3:.4g} mm, "
            f"{contact.torsion * 1e3:.4g} mrad, {contact.duration * 1e3:.1f} ms, "
            f"touch {contact.peak_force:.1f} N, buffer {contact.buffer_force:.1f} N"
        )
    echo(
        f"  of {energy.approach * 1e3:.2f} mJ at the first touch, the damper dissipated "
        f"{energy.damper * 1e3:.2f} mJ and the touches {energy.contact * 1e3:.2f} mJ until the "
        "verdict"
    )
    _print_whole_run(design.scene, design.outcome, design.target.limits)
    for limit in design.exceeded:
        echo(
            f"later contacts exceed the target: {limit.meaning} "
            f"{limit.shown(design.outcome.loads[limit.key])} {limit.load.shown_in}, must be at "
            f"most {limit.shown(limit.value)}; omit --first-contact to include them"
        )


def _trade_off_line(design: FirstContactDesign) -> str:
    stroke = f"{design.target.axial_stroke * 1e3:8.4g} mm"
    if not design.met or design.scene is None or design.outcome is None:
        return f"{stroke}  {design.refusal}"
    b, loads = design.scene.buffer, design.outcome.loads
    return (
        f"{stroke}  k_A {b.k_A:8.4g}  k_T {b.k_T:8.4g}  c_A {b.c_A:7.3g}  whole run: touch "
        f"{loads['max_normal_force']:.1f} N, buffer {loads['max_buffer_force']:.1f} N, "
        f"{_verdict(design.outcome)}"
    )


def _keep_first_contact(design: FirstContactDesign, folder: Path) -> None:
    """Write the scene with the designed buffer, and every run of the flow."""

    def plain(trial: Trial) -> dict[str, Any]:
        nearest = None if math.isnan(trial.nearest) else trial.nearest
        return {**dataclasses.asdict(trial), "nearest": nearest}

    kept: dict[str, Any] = {"refusal": design.refusal}
    kept["target"] = dataclasses.asdict(design.target)
    kept |= _outcome_of(design.outcome)
    kept["history"] = [plain(trial) for trial in design.history]
    _write(kept, design.scene if design.met else None, folder)
