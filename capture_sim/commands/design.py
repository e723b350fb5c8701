"""``capture-sim design``."""

from __future__ import annotations

import argparse
import dataclasses
import math
from pathlib import Path
from typing import Any, Self

from rich.console import Console

from capture_sim.commands import FAILED, OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import (
    add_out,
    add_scene,
    in_unit,
    load,
    prepare_folder,
    quantity,
    reader,
)
from capture_sim.commands.output import Progress, drawing, echo, print_table, write_json, write_text
from capture_sim.errors import SceneError
from capture_sim.results import LOADS
from capture_sim.scene.parts import Scene
from capture_sim.studies.approach import Spread
from capture_sim.studies.design import (
    Candidate,
    Design,
    DesignTarget,
    design_buffer,
    exceeded,
    limits_of,
    respond,
    with_buffer,
)
from capture_sim.studies.outcome import Outcome

DESCRIPTION = (
    "Find k_A, k_T and c_A of a buffer for target strokes, or the reason why no buffer meets the "
    "target (exit status 1). Targets and limits apply to the whole run, including the latched "
    "phase. Without --stroke and --torsion, the strokes of the scene's own buffer are the target."
)
EXAMPLE = "  capture-sim design paper_designed --stroke 7.5 --torsion 2"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_scene(parser, "paper_designed")
    parser.add_argument(
        "--stroke",
        type=in_unit("mm"),
        metavar="MM",
        help="set the target axial stroke, inwards or outwards, mm or with a unit",
    )
    parser.add_argument(
        "--torsion",
        type=in_unit("mrad"),
        metavar="MRAD",
        help="set the target torsion, mrad or with a unit, e.g. '0.2 deg'",
    )
    parser.add_argument(
        "--first-contact",
        action="store_true",
        help="design as in the paper: targets apply to the first contact without the damper, and "
        "later contacts may exceed them (default: targets apply to the whole run)",
    )
    parser.add_argument(
        "--peak-force",
        type=in_unit("N"),
        metavar="N",
        help="limit the peak force of every touch, N (default: no limit)",
    )
    parser.add_argument(
        "--spread",
        type=reader(_spread, "%,mm,deg, e.g. 10,2,1"),
        metavar="SPEED,OFFSET,ANGLE",
        help="choose the damper that captures up to the largest multiple of this spread of the "
        "approach, in %%, mm, deg, e.g. 10,2,1",
    )
    parser.add_argument(
        "--trade-off",
        type=reader(_factors, "LOW:HIGH:N with 0 < LOW < HIGH and N from 2 to 100"),
        default=(),
        metavar="LOW:HIGH:N",
        help="also design for N axial strokes from LOW to HIGH times the target, e.g. 0.3:3:9",
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="list every candidate buffer")
    add_out(parser, "runs/design")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    scene = load(options.scene, options.overrides)
    prepare_folder(options.out)
    compile_first()
    target = _target(options, scene)
    period = "first contact, without the damper" if target.first_contact else "whole run"
    echo(
        f"target: {target.axial_stroke * 1e3:.4g} mm and {target.torsion * 1e3:.4g} mrad ({period})"
    )
    with _Candidates(verbose=options.verbose) as candidates:
        design = design_buffer(scene, target, candidates.show)
    _report(design)
    _keep(design, options.out)
    designs = _trade_off(scene, target, options.trade_off)
    with drawing():
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.studies import draw_design, draw_trade_off

        echo(f"image in {save(draw_design(design), options.out / 'design.png')}")
        if designs:
            echo(f"trade-off in {save(draw_trade_off(designs), options.out / 'trade_off.png')}")
    return OK if design.met else FAILED


def _trade_off(scene: Scene, target: DesignTarget, factors: list[float]) -> list[Design]:
    """Return a design for each multiple of the target's axial stroke."""
    designs = []
    with Progress("designs") as progress:
        for done, factor in enumerate(factors):
            progress.at("trade-off", done, len(factors))
            stroke = factor * target.axial_stroke
            designs.append(design_buffer(scene, dataclasses.replace(target, axial_stroke=stroke)))
    for design in designs:
        echo(_line(design))
    return designs


def _target(options: argparse.Namespace, scene: Scene) -> DesignTarget:
    stroke, torsion, first_contact = options.stroke, options.torsion, options.first_contact
    if (stroke is None) != (torsion is None):
        raise SceneError("--stroke (mm), --torsion (mrad): must be given both or neither")
    limits: dict[str, Any] = {"first_contact": first_contact, "spread": options.spread}
    limits["peak_force"] = options.peak_force
    if stroke is None:
        b = scene.buffer
        own = with_buffer(scene, b.k_A, b.k_T, 0.0) if first_contact else scene
        response = respond(own, DesignTarget(1.0, 1.0, first_contact))
        stroke, torsion = response.axial_stroke, response.torsion
    return DesignTarget(stroke, torsion, **limits)


def _spread(text: str) -> Spread:
    speed, offset, angle = text.split(",")
    return Spread(quantity(speed, "%"), quantity(offset, "mm"), quantity(angle, "deg"))


def _factors(text: str) -> list[float]:
    first, last, number = text.split(":")
    low, high, count = float(first), float(last), int(number)
    if not (0.0 < low < high < math.inf and 2 <= count <= 100):
        raise ValueError(text)
    return [low * (high / low) ** (n / (count - 1)) for n in range(count)]


class _Candidates:
    """Output of the candidate buffers: the latest on a terminal, all with ``--verbose``."""

    def __init__(self, *, verbose: bool) -> None:
        self._verbose = verbose
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

    def show(self, candidate: Candidate) -> None:
        """Show a candidate buffer and its strokes."""
        self._count += 1
        verdict = "" if candidate.verdict is None else f"  {candidate.verdict}"
        line = (
            f"{self._count:4d}  k_A {candidate.k_A:9.5g}  k_T {candidate.k_T:9.5g}  "
            f"c_A {candidate.c_A:8.4g}  {candidate.axial_stroke * 1e3:8.4f} mm  "
            f"{candidate.torsion * 1e3:8.4f} mrad{verdict}"
        )
        if self._verbose:
            echo(line)
        elif self._status is not None:
            self._status.update(f"candidate {line.strip()}")


def _report(design: Design) -> None:
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
    b, energy, outcome = design.scene.buffer, design.energy, design.outcome
    low, high = design.capturing
    echo(f"k_A = {b.k_A:.5g} N/m, k_T = {b.k_T:.5g} N m/rad, c_A = {b.c_A:.4g} N s/m")
    echo(f"  captures from c_A = {low:.4g} to {high:.4g} N s/m")
    contacts = {"without": design.undamped, "with": design.damped}
    if not design.target.first_contact:
        del contacts["without"]
    for name, contact in contacts.items():
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
    if design.margin is not None:
        echo(f"  captures up to {design.margin:g} times the spread")
    echo(f"\nsimulation of the design: {_verdict(outcome)}, {outcome.reason}")
    print_table(["whole run", "", "at s", "target", "margin"], _load_rows(design))
    if outcome.failure:
        echo("the loads are those until the run stopped: the design is not shown to hold")
    if outcome.left_again:
        echo("the tip leaves the capture zone again; a latch would hold it")
    for key, limit in exceeded(design).items():
        exceeding = next(load for load in LOADS if load.key == key)
        echo(
            f"later contacts exceed the target: {exceeding.meaning} "
            f"{outcome.loads[key] * exceeding.factor:.4g} {exceeding.shown_in}, "
            f"must be at most {limit * exceeding.factor:.4g}; omit --first-contact to include them"
        )


def _verdict(outcome: Outcome) -> str:
    return f"{outcome.verdict}, left" if outcome.left_again else outcome.verdict


def _load_rows(design: Design) -> list[list[str]]:
    """Return one row for each load of the design's whole run, with its target."""
    assert design.outcome is not None
    limits, loads = limits_of(design.target), design.outcome.loads
    rows = [["verdict", _verdict(design.outcome), f"{design.outcome.t:.3f}", "captured"]]
    for row_load in LOADS:
        value, t = loads[row_load.key], loads[f"{row_load.key}_time"]
        if not value:
            continue
        factor = row_load.factor
        cells = [f"{row_load.meaning}, {row_load.shown_in}", f"{value * factor:.4g}", f"{t:.3f}"]
        if (limit := limits.get(row_load.key)) is not None:
            cells += [f"{limit * factor:.4g}", f"{1.0 - value / limit:+z.1%}"]
        rows.append(cells)
    return rows


def _line(design: Design) -> str:
    stroke = f"{design.target.axial_stroke * 1e3:8.4g} mm"
    if not design.met or design.scene is None or design.outcome is None:
        return f"{stroke}  {design.refusal}"
    b, loads = design.scene.buffer, design.outcome.loads
    return (
        f"{stroke}  k_A {b.k_A:8.4g}  k_T {b.k_T:8.4g}  c_A {b.c_A:7.3g}  whole run: touch "
        f"{loads['max_normal_force']:.1f} N, buffer {loads['max_buffer_force']:.1f} N, "
        f"{_verdict(design.outcome)}"
    )


def _keep(design: Design, folder: Path) -> None:
    """Write the scene with the designed buffer, and every run of the search."""

    def plain(candidate: Candidate) -> dict[str, Any]:
        row = dataclasses.asdict(candidate)
        row["nearest"] = None if math.isnan(candidate.nearest) else candidate.nearest
        return row

    kept: dict[str, Any] = {"refusal": design.refusal, "margin": design.margin}
    kept["target"] = dataclasses.asdict(design.target)
    for name in ("verdict", "left_again", "loads"):
        kept[name] = getattr(design.outcome, name, None)
    kept["history"] = [plain(candidate) for candidate in design.history]
    echo(f"every run in {write_json(folder / 'design.json', kept)}")
    if design.met and design.scene is not None:
        # a name of its own: both can be run into one folder and compared
        name, title = f"{design.scene.name}_design", f"{design.scene.title}; designed"
        scene = dataclasses.replace(design.scene, name=name, title=title)
        echo(f"scene in {write_text(folder / 'design.yaml', scene.to_yaml())}")
