"""``capture-sim recover``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands import FAILED, OK
from capture_sim.commands.output import echo, warn
from capture_sim.recording.recover import NothingToRecoverError, recover

DESCRIPTION = (
    "Copy a truncated or damaged recording, up to the damage, to a new complete file and report "
    "the losses. The damaged file is not changed. The exit status is 1 if no message precedes the "
    "damage."
)
EXAMPLE = "  capture-sim recover runs/tilt_0.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap", help="file, or folder of a bag")
    parser.add_argument(
        "--out", type=Path, help="write this file (default: RUN_recovered.mcap next to it)"
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    try:
        recovery = recover(options.recording, options.out)
    except NothingToRecoverError as error:
        warn(str(error))
        return FAILED
    echo(f"copied {sum(recovery.messages.values())} messages: {recovery.path}")
    for topic, number in recovery.messages.items():
        echo(f"  {topic}: {number}")
    for line in recovery.losses or ("nothing",):
        echo(f"lost: {line}")
    return OK
