"""``capture-sim export``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands import OK
from capture_sim.commands.inputs import open_run, prepare_folder
from capture_sim.commands.output import say, warn
from capture_sim.errors import RecordingError
from capture_sim.recording.export import exported, flat_columns, save_csv, save_npz, table_name

DESCRIPTION = (
    "Write a recording as tables: a column for every number, SI units as in msg/, a CSV or "
    "Parquet file for every topic in a folder, or all in one .npz."
)
EXAMPLE = "  capture-sim export runs/tilt_0.mcap --to npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap")
    parser.add_argument(
        "--to", choices=("csv", "npz", "parquet"), default="csv", help="default: csv"
    )
    parser.add_argument(
        "--out", type=Path, help="folder of the files (default: RUN, beside the recording)"
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    recorded = open_run(options.recording, several=True)
    topics, problems = exported(recorded)
    for problem in problems:
        warn(problem)
    if not topics:
        raise RecordingError(f"{options.recording}: holds no messages that make a table")
    folder = options.out or Path(options.recording).with_suffix("")
    if options.to == "npz":
        folder = options.out or Path(options.recording).parent
    prepare_folder(folder)
    if options.to == "npz":
        say(f"written: {save_npz(recorded, folder / f'{Path(options.recording).stem}.npz')}")
        return OK
    if options.to == "csv":
        paths = save_csv(recorded, folder)
    else:
        try:
            from capture_sim.recording.tables import save_parquet
        except ImportError as error:
            raise RecordingError(f"--to parquet: needs pyarrow: {error}") from None
        paths = [
            save_parquet(flat_columns(recorded, topic), folder / f"{table_name(topic)}.parquet")
            for topic in topics
        ]
    for path in paths:
        say(f"written: {path}")
    return OK
