"""``capture-sim view``: draw runs as plots and as a file for the rerun viewer."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.base.exit_status import OK
from capture_sim.commands.inputs import (
    add_runs,
    folder_beside,
    number,
    prepare_folder,
)
from capture_sim.commands.output import (
    IMAGES_MISSING,
    Progress,
    draw,
    echo,
    reported_if_interrupted,
)
from capture_sim.commands.recordings import RecordingReader
from capture_sim.errors import RecordingError
from capture_sim.run.run import Run
from capture_sim.viewing.canvas import save
from capture_sim.viewing.curves import plotted_runs
from capture_sim.viewing.figures import pictures_of
from capture_sim.viewing.source import resolved, resolved_or_not

DESCRIPTION = (
    "Draw runs: one plot of each, one of all side by side, and a file for the rerun viewer. "
    "Scenes given by name are run first."
)
EXAMPLE = "  capture-sim view runs/tilt_0.mcap --figures --out plots"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_runs(parser)
    parser.add_argument(
        "--out",
        type=Path,
        help="write the plots to this folder (default: plots next to the first recording, where "
        "the plots of run and bench stay; for scenes, plots in the current folder)",
    )
    parser.add_argument(
        "--save",
        type=Path,
        metavar="FILE.rrd",
        help="write this file for rerun (default: OUT/runs.rrd)",
    )
    parser.add_argument(
        "--figures",
        action="store_true",
        help="also draw a plot of each quantity, with the runs overlaid, as SVG and PNG in "
        "OUT/figures",
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
    options.out = options.out or folder_beside(options.runs[0]) / "plots"
    prepare_folder(options.out)
    if options.save is not None:
        if options.save.suffix != ".rrd":
            raise RecordingError(f"--save {options.save}: must end in .rrd")
        prepare_folder(options.save.parent)
    with reported_if_interrupted("nothing is written"):
        runs = RecordingReader.of(options).runs(options.runs)
        if window is not None:
            # a run known from measurements alone cannot be simulated again
            runs = [resolved(run, window) if run.is_exact else run for run in runs]
        names = [run.name for run in runs]
        plotted_runs(runs, names, window=window)  # before anything is written: are there samples?
    with reported_if_interrupted(IMAGES_MISSING):
        draw(runs, names, options.out, options.save, pictures=window is None, window=window)
        if options.figures:
            _draw_figures(runs, names, options.out / "figures", window)
    return OK


def _draw_figures(
    runs: list[Run], labels: list[str], folder: Path, window: tuple[float, float] | None
) -> None:
    if window is None:
        runs = [resolved_or_not(run) for run in runs]  # with a window they are already
    pictures = pictures_of(runs, labels, window)
    with Progress("figures") as progress:
        for done, picture in enumerate(pictures):
            progress.at("figures", done, len(pictures))
            save(picture.draw(), *(folder / f"{picture.name}{end}" for end in (".svg", ".png")))
    echo(f"plots of each quantity in {folder}")
