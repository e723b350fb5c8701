"""``capture-sim paper``: design a buffer as in the paper, for the strokes of the first contact."""

from __future__ import annotations

import argparse
import dataclasses
import math
from pathlib import Path
from typing import Any, Self

from rich.console import Console

from capture_sim.base.exit_status import FAILED, OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.design_report import outcome_of, print_whole_run, write_design
from capture_sim.commands.inputs import add_out, add_scene, in_unit, load, prepare_folder
from capture_sim.commands.output import drawing, echo
from capture_sim.errors import SceneError
from capture_sim.studies.evaluate.outcome import run_first_contact
from capture_sim.studies.search.paper_flow import (
    FirstContactDesign,
    FirstContactTarget,
    FlowRun,
    design_first_contact,
    with_buffer,
)

DESCRIPTION = (
    "Design a buffer by the flow of the paper: springs that meet a stroke and a torsion in the "
    "first contact without the damper, then the damper that captures. Later contacts may exceed "
    "them. Without a target, the strokes are those of the scene's own buffer."
)
FAILS = "no buffer meets the target"
GIVES = "what is in design.json"
EXAMPLE = "  capture-sim paper paper_designed --stroke 7.5 --torsion 2"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_scene(parser, "paper_designed")
    parser.add_argument(
        "--stroke", type=in_unit("mm"), metavar="MM", help="axial stroke, mm or with a unit"
    )
    parser.add_argument(
        "--torsion", type=in_unit("mrad"), metavar="MRAD", help="torsion, mrad or with a unit"
    )
    parser.add_argument(
        "--peak-force",
        type=in_unit("N"),
        metavar="N",
        help="limit the peak force of every touch, N (default: no limit)",
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="list every candidate buffer")
    add_out(parser, "runs/paper")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    if (options.stroke is None) != (options.torsion is None):
        raise SceneError("--stroke (mm), --torsion (mrad): must be given both or neither")
    scene = load(options.scene, options.overrides)
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
    with _Candidates(verbose=options.verbose) as candidates:
        design = design_first_contact(scene, target, candidates.show)
    _report(design)
    _keep(design, options.out)
    with drawing():
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.studies import draw_first_contact_design

        path = options.out / "design.png"
        echo(f"plot in {save(draw_first_contact_design(design), path)}")
    return OK if design.met else FAILED


class _Candidates:
    """Output of the candidate buffers during the search.

    With ``--verbose``, each candidate is printed.  Otherwise a terminal shows the latest candidate.
    """

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

    def show(self, candidate: FlowRun) -> None:
        """Show a candidate buffer and its loads."""
        self._count += 1
        line = f"{self._count:5d}  {_line(candidate)}"
        if self._verbose:
            echo(line)
        elif self._status is not None:
            self._status.update(f"candidate {line.strip()}")


def _line(trial: FlowRun) -> str:
    return (
        f"k_A {trial.k_A:9.5g}  k_T {trial.k_T:9.5g}  c_A {trial.c_A:8.4g}  "
        f"{trial.axial_stroke * 1e3:8.4f} mm  {trial.torsion * 1e3:8.4f} mrad"
        f"{'' if trial.verdict is None else f'  {trial.verdict}'}"
    )


def _report(design: FirstContactDesign) -> None:
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
    print_whole_run(design.scene, design.outcome, design.target.limits)
    for limit in design.exceeded:
        echo(
            f"later contacts exceed the target: {limit.meaning} "
            f"{limit.shown(design.outcome.loads[limit.key])} {limit.load.shown_in}, must be at "
            f"most {limit.shown(limit.value)}; capture-sim design includes them"
        )


def _keep(design: FirstContactDesign, folder: Path) -> None:
    """Write the designed buffer as a scene, if one was found, and all runs of the design flow."""

    def plain(trial: FlowRun) -> dict[str, Any]:
        nearest = None if math.isnan(trial.nearest) else trial.nearest
        return {**dataclasses.asdict(trial), "nearest": nearest}

    kept: dict[str, Any] = {"refusal": design.refusal}
    kept["target"] = dataclasses.asdict(design.target)
    kept |= outcome_of(design.outcome)
    kept["history"] = [plain(trial) for trial in design.history]
    write_design(kept, design.scene if design.met else None, folder)
