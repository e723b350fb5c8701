"""``capture-sim design``."""

from __future__ import annotations

import argparse
import dataclasses
import math
from pathlib import Path
from typing import Any

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
from capture_sim.commands.output import drawing, echo, write_json, write_text
from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.studies.approach import Spread
from capture_sim.studies.design import (
    Design,
    DesignTarget,
    Trial,
    design_buffer,
    with_buffer,
)
from capture_sim.studies.outcome import run_first_contact

DESCRIPTION = (
    "The paper's design flow: target strokes in, k_A, k_T and c_A out, or the reason why no "
    "buffer meets the target (exit status 1). Without strokes those of the scene's own springs are "
    "taken."
)
EXAMPLE = "  capture-sim design paper_designed --stroke 7.5 --torsion 2"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_scene(parser, "paper_designed")
    parser.add_argument(
        "--stroke", type=in_unit("mm"), metavar="MM", help="axial stroke, mm or with a unit"
    )
    parser.add_argument(
        "--torsion",
        type=in_unit("mrad"),
        metavar="MRAD",
        help="torsional stroke, mrad or with a unit, as '0.2 deg'",
    )
    parser.add_argument(
        "--damped",
        action="store_true",
        help="the strokes are those with the damper in (the paper's are without)",
    )
    parser.add_argument(
        "--peak-force", type=in_unit("N"), metavar="N", help="most that a touch may push with, N"
    )
    parser.add_argument(
        "--spread",
        type=reader(_spread, "%,mm,deg, as 10,2,1"),
        metavar="SPEED,OFFSET,ANGLE",
        help="choose the damper that keeps the capture longest under this spread of the approach: "
        "%%, mm, deg, as 10,2,1",
    )
    parser.add_argument(
        "--trade-off",
        type=reader(_factors, "LOW:HIGH:N with 0 < LOW < HIGH and N from 2 to 100"),
        default=(),
        metavar="LOW:HIGH:N",
        help="also design for N axial strokes from LOW to HIGH times the target, as 0.3:3:9",
    )
    add_out(parser, "runs/design")


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    scene = load(options.scene, options.overrides)
    prepare_folder(options.out)
    compile_first()
    target = _target(options, scene)
    echo(
        f"wanted: {target.axial_stroke * 1e3:.4g} mm and {target.torsion * 1e3:.4g} mrad "
        f"{'with' if target.damped else 'without'} the damper"
    )
    design = design_buffer(scene, target, _print_trial)
    _report(design)
    _keep(design, options.out)
    designs = []
    for factor in options.trade_off:
        stroke = factor * target.axial_stroke
        designs.append(design_buffer(scene, dataclasses.replace(target, axial_stroke=stroke)))
        echo(_line(designs[-1]))
    with drawing():
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.studies import draw_design, draw_trade_off

        echo(f"picture in {save(draw_design(design), options.out / 'design.png')}")
        if designs:
            echo(f"trade-off in {save(draw_trade_off(designs), options.out / 'trade_off.png')}")
    return OK if design.met else FAILED


def _target(options: argparse.Namespace, scene: Scene) -> DesignTarget:
    stroke, torsion = options.stroke, options.torsion
    if (stroke is None) != (torsion is None):
        raise SceneError("--stroke (mm), --torsion (mrad): must be both or none")
    if stroke is None:
        b = scene.buffer
        own = run_first_contact(scene if options.damped else with_buffer(scene, b.k_A, b.k_T, 0.0))
        stroke, torsion = own.axial_stroke, own.torsion
    return DesignTarget(stroke, torsion, options.damped, options.peak_force, options.spread)


def _spread(text: str) -> Spread:
    speed, offset, angle = text.split(",")
    return Spread(quantity(speed, "%"), quantity(offset, "mm"), quantity(angle, "deg"))


def _factors(text: str) -> list[float]:
    first, last, number = text.split(":")
    low, high, count = float(first), float(last), int(number)
    if not (0.0 < low < high < math.inf and 2 <= count <= 100):
        raise ValueError(text)
    return [low * (high / low) ** (n / (count - 1)) for n in range(count)]


def _print_trial(trial: Trial) -> None:
    buffer = f"k_A {trial.k_A:9.5g}  k_T {trial.k_T:9.5g}  c_A {trial.c_A:8.4g}"
    if trial.step == 5:
        strokes = f"{trial.axial_stroke * 1e3:.4f} mm  {trial.torsion * 1e3:.4f} mrad"
        echo(f"step 5  {buffer}  strokes {strokes} {trial.reason}")
    else:
        verdict = trial.verdict.label if trial.verdict is not None else ""
        echo(f"step 7  {buffer}  {verdict}: nearest {trial.nearest * 1e3:.2f} mm")


def _report(design: Design) -> None:
    echo("")
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
    echo(f"  captures from c_A = {low:.4g} to {high:.4g} N s/m; {design.outcome.reason}")
    for name, contact in (("without", design.undamped), ("with", design.damped)):
        echo(
            f"  first contact {name} the damper: {contact.axial_stroke * 1e3:.4g} mm, "
            f"{contact.torsion * 1e3:.4g} mrad, {contact.duration * 1e3:.1f} ms, "
            f"touch {contact.peak_force:.1f} N, buffer {contact.buffer_force:.1f} N"
        )
    echo(
        f"  of {energy.approach * 1e3:.2f} mJ the damper absorbed {energy.damper * 1e3:.2f} "
        f"(area of load over stroke), the touches {energy.contact * 1e3:.2f} (force over "
        "penetration)"
    )
    if design.margin is not None:
        echo(f"  every capture is kept up to {design.margin:g} times the spread")
    steps = [trial.step for trial in design.history]
    echo(f"  {steps.count(5)} runs for the springs, {steps.count(7)} for the damper")


def _line(design: Design) -> str:
    stroke = f"{design.target.axial_stroke * 1e3:8.4g} mm"
    if not design.met or design.scene is None or design.damped is None:
        return f"{stroke}  {design.refusal}"
    b = design.scene.buffer
    return (
        f"{stroke}  k_A {b.k_A:8.4g}  k_T {b.k_T:8.4g}  c_A {b.c_A:7.3g}  first contact: touch "
        f"{design.damped.peak_force:.1f} N, buffer {design.damped.buffer_force:.1f} N"
    )


def _keep(design: Design, folder: Path) -> None:
    """Write the scene with its buffer, and every run of the flow."""

    def plain(trial: Trial) -> dict[str, Any]:
        row = dataclasses.asdict(trial)
        row["verdict"] = trial.verdict.label if trial.verdict is not None else None
        row["nearest"] = None if math.isnan(trial.nearest) else trial.nearest
        return row

    kept: dict[str, Any] = {"refusal": design.refusal, "margin": design.margin}
    kept["target"] = dataclasses.asdict(design.target)
    kept["history"] = [plain(trial) for trial in design.history]
    echo(f"every run in {write_json(folder / 'design.json', kept)}")
    if design.met and design.scene is not None:
        scene = dataclasses.replace(design.scene, title=f"{design.scene.title}; designed")
        echo(f"scene in {write_text(folder / 'design.yaml', scene.to_yaml())}")
