"""``capture-sim envelope``."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from capture_sim.commands import OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import (
    add_scene,
    add_workers,
    load,
    positive,
    prepare_folder,
    quantity,
    reader,
    whole,
)
from capture_sim.commands.output import Progress, drawing, echo
from capture_sim.errors import SceneError
from capture_sim.recording.envelope_file import check_parquet, write_envelope
from capture_sim.scene.parts import Scene
from capture_sim.studies.approach import other_parts
from capture_sim.studies.envelope import AXES, Envelope, Plan, Slices, Span, explore
from capture_sim.studies.envelope_runs import KeptRuns
from capture_sim.studies.executors import open_executor

DESCRIPTION = (
    "Map the verdict over relative angle, lateral offset and speed, with the boundary refined. "
    "Killed and started again with the same arguments, it goes on where it was."
)
EXAMPLE = '  capture-sim envelope tilt_0 --angle="-20 deg:20 deg:10" --offset=-40:40:10 --speed 0.1'
_AXIS = "LOW:HIGH:CELLS (a range that is refined) or A,B,C (slices)"
_EXPERIMENTS = ("tilt_0", "tilt_p10", "tilt_m10")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_scene(parser, "tilt_0")
    for name, unit, default, what in (
        ("angle", "deg", "-30:30:12", f"target's angle, deg; {_AXIS}"),
        ("offset", "mm", "-50:50:10", "lateral offset, mm; likewise"),
        ("speed", "m/s", "0.05,0.1,0.2", "at the touch, m/s; likewise"),
    ):
        parser.add_argument(
            f"--{name}", type=axis(unit), default=default, metavar=unit.upper(), help=what
        )
    parser.add_argument(
        "--levels", type=whole(), default=4, help="how often a cell is cut in four (default: 4)"
    )
    parser.add_argument(
        "--runs", type=whole(), default=10_000, help="most points of the map (default: 10000)"
    )
    parser.add_argument("--rtol", type=positive, default=1e-5, help="of the runs (default: 1e-5)")
    add_workers(parser)
    parser.add_argument(
        "--mark",
        nargs="*",
        metavar="SCENE",
        help="experiments on the same bench, to run and mark in the picture (default: the scene, "
        f"and those of {' '.join(_EXPERIMENTS)} that are)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/envelope.parquet"),
        metavar="FILE.parquet",
        help="the table; the picture lies beside it (default: runs/envelope.parquet)",
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    if options.out.suffix != ".parquet":
        raise SceneError(f"--out {options.out}: must be a name that ends in .parquet")
    scene = load(options.scene, options.overrides)
    plan = Plan(
        scene,
        angle=options.angle,
        offset=options.offset,
        speed=options.speed,
        levels=options.levels,
        runs=options.runs,
        rtol=options.rtol,
    )
    marks = experiments(scene, options.mark, options.overrides)
    check_parquet()
    prepare_folder(options.out.parent)
    compile_first()
    with (
        open_executor(options.workers, options.scheduler) as executor,
        Progress() as progress,
    ):
        runs = KeptRuns(plan, executor, options.out.with_suffix(".runs"), progress.at)
        envelope = explore(plan, runs)
    if runs.resumed:
        echo(f"{runs.resumed} runs were there already")
    echo(f"table in {write_envelope(envelope, options.out)}")
    runs.remove()
    report(envelope)
    with drawing():
        from capture_sim.simulation import simulate
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.studies import draw_envelope

        results = [simulate(scene) for scene in marks]
        path = options.out.with_suffix(".png")
        echo(f"picture in {save(draw_envelope(envelope, results), path)}")
    return OK


def experiments(scene: Scene, names: Sequence[str] | None, overrides: Sequence[str]) -> list[Scene]:
    """Return the experiments to mark on the map of a scene, with the same overrides.

    Parameters
    ----------
    scene
        That is mapped.
    names
        Of the experiments; None takes the scene and the stock ones that are on its bench.
    overrides
        Of the scene.

    Raises
    ------
    SceneError
        One that is named is on another bench: its verdict has no place on the map.
    """
    if names is None:
        stock = (load(name, overrides) for name in _EXPERIMENTS)
        found = {scene.name: scene, **{each.name: each for each in stock}}
        return [each for each in found.values() if not other_parts(scene, each)]
    marks = [load(name, overrides) for name in names]
    for mark in marks:
        if parts := other_parts(scene, mark):
            raise SceneError(
                f"--mark {mark.name}: another bench than {scene.name}: its {', '.join(parts)} "
                "differ"
            )
    return marks


def axis(unit: str) -> Callable[[str], Span | Slices]:
    """Return a reader of ``LOW:HIGH:CELLS`` or ``A,B,C``; numbers may bear units."""

    def read(text: str) -> Span | Slices:
        if ":" in text:
            low, high, cells = text.split(":")
            return Span(quantity(low, unit), quantity(high, unit), int(cells))
        return Slices(tuple(quantity(value, unit) for value in text.split(",")))

    return reader(read, f"{_AXIS}, in {unit}")


def report(envelope: Envelope) -> None:
    """Print what share of each slice is captured, and how sure that is."""
    plan, rows = envelope.plan, envelope.rows
    name, unit, _ = AXES[plan.sliced]
    echo(f"{len(rows)} points, {int(rows['checked'].sum())} of them twice")
    for number, value in enumerate(plan.slices):
        share = envelope.shares[number]
        echo(
            f"{name} {value:.4g} {unit}: captured {share['surely']:.1%} to {share['perhaps']:.1%} "
            f"of the plane, {share['ill_conditioned']:.2%} ill-conditioned"
        )
    failed = int(rows["failed"].sum())
    if failed:
        echo(f"{failed} runs had to stop: their verdict is that of the run until then")
