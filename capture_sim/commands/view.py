"""``capture-sim view``."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from capture_sim.commands import OK
from capture_sim.commands.inputs import add_out, add_runs, number, open_runs, prepare_folder
from capture_sim.commands.output import (
    IMAGES_MISSING,
    Progress,
    draw,
    echo,
    reported_if_interrupted,
)
from capture_sim.errors import RecordingError
from capture_sim.viewing.canvas import save
from capture_sim.viewing.figures import FIGURES, OVER_TIME, snapshots
from capture_sim.viewing.source import Opened, resolved, resolved_or_not

DESCRIPTION = (
    "Draw runs: one image of each, one of all side by side, and a file for the rerun viewer. "
    "Scenes given by name are run first."
)
EXAMPLE = "  capture-sim view runs/tilt_0.mcap --figures --out pictures"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_runs(parser)
    add_out(parser, ".", "write the images to this folder")
    parser.add_argument(
        "--save",
        type=Path,
        metavar="FILE.rrd",
        help="write this file for rerun (default: OUT/runs.rrd)",
    )
    parser.add_argument(
        "--figures",
        action="store_true",
        help="also draw the paper's figures, with the runs overlaid, as SVG and PNG in OUT/figures",
    )
    parser.add_argument(
        "--window",
        nargs=2,
        type=number(),
        metavar=("FROM", "TO"),
        help="show only this time window, s since the release, at the integrator's own steps",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    window = None if options.window is None else (options.window[0], options.window[1])
    if window is not None and not window[0] < window[1]:
        raise RecordingError(f"--window = {window[0]:g} {window[1]:g} s: must be FROM < TO")
    prepare_folder(options.out)
    if options.save is not None:
        if options.save.suffix != ".rrd":
            raise RecordingError(f"--save {options.save}: must end in .rrd")
        prepare_folder(options.save.parent)
    with reported_if_interrupted("nothing is written"):
        opened = open_runs(options.runs, options.scene, options.release, options.remaps)
        if window is not None:
            opened = [_within(run, window) for run in opened]
    runs = [item.run for item in opened]
    labels = [item.label for item in opened]
    with reported_if_interrupted(IMAGES_MISSING):
        draw(runs, labels, options.out, options.save, pictures=window is None)
        if options.figures:
            _draw_figures(runs, labels, options.out / "figures", window)
    return OK


def _within(one: Opened, window: tuple[float, float]) -> Opened:
    if not one.measured:
        return dataclasses.replace(one, run=resolved(one.run, window))
    run: Any = one.run  # cannot be run again: select from its samples
    t = run.samples["t"]
    inside = run.samples[(t >= window[0]) & (t <= window[1])]
    if not inside.size:
        raise RecordingError(
            f"{run.scene.name}: no sample from {window[0]:g} to {window[1]:g} s; it has samples "
            f"from {t[0]:g} to {t[-1]:g} s"
        )
    return dataclasses.replace(one, run=dataclasses.replace(run, samples=inside))


def _draw_figures(
    runs: list, labels: list[str], folder: Path, window: tuple[float, float] | None
) -> None:
    drawn = dict(FIGURES)
    if window is None:
        drawn["snapshots"] = snapshots
        runs = [resolved_or_not(run) for run in runs]  # with a window they are already
    with Progress("figures") as progress:
        for done, (name, figure) in enumerate(drawn.items()):
            progress.at("figures", done, len(drawn))
            aligned = {"aligned": True} if name in OVER_TIME and len(runs) > 1 else {}
            paths = (folder / f"{name}{ending}" for ending in (".svg", ".png"))
            save(figure(runs, labels=labels, **aligned), *paths)
    echo(f"figures of the paper in {folder}")
