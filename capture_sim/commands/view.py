"""``capture-sim view``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from capture_sim.commands.arguments import OK, prepare_folder
from capture_sim.commands.showing import draw
from capture_sim.errors import RecordingError

HELP = "draw recorded runs"
DESCRIPTION = "Draw recorded runs: a picture of each, and all side by side for rerun."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("runs", nargs="+", metavar="RUN.mcap")
    parser.add_argument(
        "--out", type=Path, default=Path(), help="folder of the pictures (default: .)"
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.recording import read_run

    prepare_folder(options.out)
    runs = [read_run(path) for path in options.runs]
    for run in runs:
        for problem in run.problems:
            print(f"capture-sim: {run.name}: {problem}", file=sys.stderr)
    drawable = [run for run in runs if run.samples.size]
    if not drawable:
        raise RecordingError("nothing to draw: no recording holds a sample")
    draw(drawable, options.out)
    return OK
