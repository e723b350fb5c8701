"""``capture-sim envelope``."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from capture_sim.commands.arguments import OK, add_overrides, load, prepare_folder

if TYPE_CHECKING:
    from capture_sim.studies.envelope import Envelope, Slices, Span

HELP = "map which approaches end in a capture"
DESCRIPTION = (
    "Map the verdict over relative angle, lateral offset and speed, with the boundary refined. "
    "Killed and started again with the same arguments, it goes on where it was."
)
_AXIS = "LOW:HIGH:CELLS (a range that is refined) or A,B,C (slices)"
_EXPERIMENTS = ("tilt_0", "tilt_p10", "tilt_m10")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene", nargs="?", default="tilt_0", help="default: tilt_0")
    add_axis = parser.add_argument
    add_axis("--angle", default="-30:30:12", metavar="DEG", help=f"target's angle, deg; {_AXIS}")
    add_axis("--offset", default="-50:50:10", metavar="MM", help="lateral offset, mm; likewise")
    add_axis("--speed", default="0.05,0.1,0.2", metavar="M/S", help="at the touch, m/s; likewise")
    parser.add_argument(
        "--levels", type=int, default=4, help="how often a cell is cut in four (default: 4)"
    )
    parser.add_argument(
        "--runs", type=int, default=10_000, help="most points of the map (default: 10000)"
    )
    parser.add_argument("--rtol", type=float, default=1e-5, help="of the runs (default: 1e-5)")
    parser.add_argument(
        "--workers", type=int, default=0, metavar="N", help="processes (default: one per core)"
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster, as tcp://127.0.0.1:8786"
    )
    parser.add_argument(
        "--mark",
        nargs="*",
        default=list(_EXPERIMENTS),
        metavar="SCENE",
        help=f"experiments to run and mark in the picture (default: {' '.join(_EXPERIMENTS)})",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/envelope.parquet"),
        metavar="FILE.parquet",
        help="the table; the picture lies beside it (default: runs/envelope.parquet)",
    )
    add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.commands.progress import Progress
    from capture_sim.commands.showing import compile_first, say
    from capture_sim.errors import SceneError
    from capture_sim.recording.envelope_file import check_parquet, write_envelope
    from capture_sim.studies.envelope import Plan, explore
    from capture_sim.studies.envelope_runs import KeptRuns
    from capture_sim.studies.executors import default_workers, open_executor

    if options.out.suffix != ".parquet":
        raise SceneError(f"--out {options.out}: allowed is a name that ends in .parquet")
    if not 0 <= options.workers <= 1024:
        raise SceneError(f"--workers {options.workers}: allowed is >= 1 and <= 1024")
    plan = Plan(
        load(options.scene, options.overrides),
        angle=read_axis("--angle", options.angle, math.radians(1.0)),
        offset=read_axis("--offset", options.offset, 1e-3),
        speed=read_axis("--speed", options.speed, 1.0),
        levels=options.levels,
        runs=options.runs,
        rtol=options.rtol,
    )
    marks = [load(name, ()) for name in options.mark]
    check_parquet()
    prepare_folder(options.out.parent)
    compile_first()
    with (
        open_executor(options.workers or default_workers(), options.scheduler) as executor,
        Progress() as progress,
    ):
        runs = KeptRuns(plan, executor, options.out.with_suffix(".parts"), progress.at)
        envelope = explore(plan, runs)
    if runs.resumed:
        say(f"{runs.resumed} runs were there already")
    say(f"table in {write_envelope(envelope, options.out)}")
    runs.remove()
    report(envelope)
    try:
        from capture_sim.simulation import simulate
        from capture_sim.viewing.envelope_map import save_envelope

        results = [simulate(scene) for scene in marks]
        say(f"picture in {save_envelope(envelope, options.out.with_suffix('.png'), results)}")
    except ImportError as error:
        say(f"no picture: {error}")
    return OK


def read_axis(flag: str, text: str, unit: float) -> Span | Slices:
    """Read ``LOW:HIGH:CELLS`` or ``A,B,C`` off the command line, in units of ``unit`` (SI).

    Raises
    ------
    SceneError
        It is neither.
    """
    from capture_sim.errors import SceneError
    from capture_sim.studies.envelope import Slices, Span

    try:
        if ":" in text:
            low, high, cells = text.split(":")
            return Span(float(low) * unit, float(high) * unit, int(cells))
        return Slices(tuple(float(value) * unit for value in text.split(",")))
    except ValueError:
        raise SceneError(f"{flag} {text}: allowed is {_AXIS}") from None


def report(envelope: Envelope) -> None:
    """Print what share of each slice is captured, and how sure that is."""
    from capture_sim.commands.showing import say
    from capture_sim.studies.envelope import AXES

    plan, rows = envelope.plan, envelope.rows
    name, unit = AXES[plan.sliced]
    say(f"{len(rows)} points, {int(rows['checked'].sum())} of them twice")
    for number, value in enumerate(plan.slices):
        share = envelope.shares[number]
        say(
            f"{name} {value:.4g} {unit}: captured {share['surely']:.1%} to {share['perhaps']:.1%} "
            f"of the plane, {share['ill_conditioned']:.2%} ill-conditioned"
        )
    failed = int(rows["failed"].sum())
    if failed:
        say(f"{failed} runs had to stop: judged by what was run until then")
