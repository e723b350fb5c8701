"""``capture-sim export``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands import OK
from capture_sim.commands.inputs import add_remaps, is_bag, open_run, prepare_folder
from capture_sim.commands.output import echo, warn
from capture_sim.errors import RecordingError
from capture_sim.recording.export import KINDS, exported, save_tables

DESCRIPTION = (
    "Write a recording as tables: a column for every number, SI units as in msg/, a CSV or "
    "Parquet file for every topic in a folder, or all in one .npz."
)
EXAMPLE = "  capture-sim export runs/tilt_0.mcap --to npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap")
    add_remaps(parser)
    parser.add_argument("--to", choices=KINDS, default="csv", help="default: csv")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder of the files (default: RUN beside the recording, RUN_tables beside a bag)",
    )
    parser.add_argument("--topics", nargs="+", default=(), metavar="TOPIC", help="only these")
    parser.add_argument(
        "--columns", nargs="+", default=(), metavar="NAME", help="only these, as q, q.x_S"
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    recorded = open_run(options.recording, options.remaps, several=True)
    topics, problems = exported(recorded)
    for problem in problems:
        warn(problem)
    if not topics:
        raise RecordingError(f"{options.recording}: holds no messages that make a table")
    folder = options.out or _folder_beside(Path(options.recording).resolve(), options.to)
    prepare_folder(folder)
    for path in save_tables(recorded, folder, options.to, options.topics, options.columns):
        echo(f"written: {path}")
    return OK


def _folder_beside(recording: Path, to: str) -> Path:
    """Return where tables go unless told: beside the recording, never into a bag."""
    if to == "npz":
        return recording.parent
    folder = recording if recording.is_dir() else recording.with_suffix("")
    return folder.with_name(f"{folder.name}_tables") if is_bag(folder) else folder
