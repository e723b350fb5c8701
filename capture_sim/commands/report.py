"""``capture-sim report``: write an HTML page about runs."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from capture_sim.base.exit_status import OK
from capture_sim.commands.inputs import add_runs, folder_beside, prepare_folder
from capture_sim.commands.output import Progress, echo, reported_if_interrupted
from capture_sim.commands.recordings import RecordingReader

DESCRIPTION = (
    "Write one self-contained HTML page about runs: results, plots, energy, errors, parameters. "
    "Scenes given by name are run first."
)
EXAMPLE = "  capture-sim report runs/tilt_0.mcap runs/tilt_p10.mcap --out report.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_runs(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE.html",
        help="write the page to this file, or to report.html in this folder (default: next to "
        "the first recording; for scenes, in the current folder)",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    from capture_sim.viewing.report import save_report

    out = options.out or folder_beside(options.runs[0])
    page = out / "report.html" if out.is_dir() or not out.suffix else out
    prepare_folder(page.parent)
    with reported_if_interrupted(f"{page} is not written"):
        runs = RecordingReader.of(options).runs(options.runs)
        with Progress("steps") as progress:
            saved = save_report(runs, page, partial(progress.at, "report"))
    echo(f"report in {saved}")
    return OK
