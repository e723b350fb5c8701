"""``capture-sim recover``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands import FAILED, OK
from capture_sim.commands.output import echo, warn
from capture_sim.recording.recover import NothingWholeError, recover

DESCRIPTION = (
    "Save all whole chunks of a recording that was cut or damaged into a new file, "
    "and say what was lost. The damaged file is left as it is. Exit status 1 when nothing is saved."
)
EXAMPLE = "  capture-sim recover runs/tilt_0.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap", help="file, or a split one's folder")
    parser.add_argument(
        "--out", type=Path, help="file to write (default: RUN_recovered.mcap beside it)"
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    try:
        saved = recover(options.recording, options.out)
    except NothingWholeError as error:
        warn(str(error))
        return FAILED
    count = sum(saved.messages.values())
    echo(f"saved {count} messages in {saved.chunks} chunks: {saved.path}")
    for topic, number in saved.messages.items():
        echo(f"  {topic}: {number}")
    for line in saved.losses:
        echo(f"lost: {line}")
    for line in saved.unconfirmed:
        echo(f"unconfirmed: {line}")
    if not saved.losses and not saved.unconfirmed:
        echo("nothing was lost")
    return OK
