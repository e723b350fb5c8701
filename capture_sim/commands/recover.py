"""``capture-sim recover``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands.arguments import OK
from capture_sim.commands.showing import say

HELP = "save what is whole in a damaged recording"
DESCRIPTION = (
    "Save all whole chunks of a recording that was cut or damaged into a new file, "
    "and say what was lost. The damaged file is left as it is."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap", help="file, or a split one's folder")
    parser.add_argument(
        "--out", type=Path, help="file to write (default: RUN_recovered.mcap beside it)"
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.recording import recover

    saved = recover(options.recording, options.out)
    say(f"saved {sum(saved.messages.values())} messages in {saved.chunks} chunks: {saved.path}")
    for topic, count in saved.messages.items():
        say(f"  {topic}: {count}")
    for line in saved.losses:
        say(f"lost: {line}")
    for line in saved.unconfirmed:
        say(f"unconfirmed: {line}")
    if not saved.losses and not saved.unconfirmed:
        say("nothing was lost")
    return OK
