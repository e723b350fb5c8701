"""``capture-sim show``."""

from __future__ import annotations

import argparse

from capture_sim.commands.arguments import OK, add_overrides, load

HELP = "print a scene with all its values, as YAML"
DESCRIPTION = "Print a scene with all its values, as YAML."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene")
    add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    print(load(options.scene, options.overrides).to_yaml(), end="")
    return OK
