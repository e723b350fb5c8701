"""``capture-sim export``: write a recording as CSV, NumPy or Parquet tables."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.base.exit_status import OK
from capture_sim.commands.inputs import add_remaps, prepare_folder
from capture_sim.commands.output import echo, warn
from capture_sim.commands.recordings import RecordingReader
from capture_sim.errors import RecordingError
from capture_sim.recording.export import KINDS, readable, save_tables, tables_of

DESCRIPTION = (
    "Write a recording as tables with one column for each number, in the SI units of msg/: one CSV "
    "or Parquet file for each topic, or one .npz file for all."
)
EXAMPLE = "  capture-sim export runs/tilt_0.mcap --to npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap", help="file, or folder of a bag")
    add_remaps(parser)
    parser.add_argument(
        "--to", choices=KINDS, default="csv", help="write this format (default: csv)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="write the files to this folder (default: RUN next to the recording, RUN_tables next "
        "to a bag)",
    )
    parser.add_argument(
        "--topics", nargs="+", default=(), metavar="TOPIC", help="write only these topics"
    )
    parser.add_argument(
        "--columns",
        nargs="+",
        default=(),
        metavar="NAME",
        help="write only these columns, e.g. q or q.x_S",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    bag = RecordingReader.of(options).bag(options.recording, several=True)
    tables, problems = readable(tables_of(bag))
    for problem in problems:
        warn(problem)
    if not tables:
        raise RecordingError(
            f"{options.recording}: contains no message that can be written as a table"
        )
    folder = options.out or _folder_beside(Path(options.recording).resolve(), options.to)
    prepare_folder(folder)
    files = save_tables(
        tables,
        folder,
        options.to,
        name=bag.path.stem,
        topics=options.topics,
        columns=options.columns,
        scene=bag.scene_text if bag.has_scene else "",
    )
    # named one by one: if the next one fails, these are complete
    for path in files:
        echo(f"written: {path}")
    return OK


def _folder_beside(recording: Path, to: str) -> Path:
    """Return the default folder for the tables of a recording in the format ``to``.

    For npz it is the folder of the recording.  Otherwise it is a folder with the name of the
    recording; if that is a bag, ``_tables`` is added, so that nothing is written into the bag.
    """
    if to == "npz":
        return recording.parent
    from capture_sim.recording.bag_folder import is_bag

    folder = recording if recording.is_dir() else recording.with_suffix("")
    return folder.with_name(f"{folder.name}_tables") if is_bag(folder) else folder
