"""``capture-sim show``: print a scene with all its values as YAML."""

from __future__ import annotations

import argparse

from capture_sim.base.exit_status import OK
from capture_sim.commands.inputs import add_overrides, load

DESCRIPTION = "Print a scene with all its values as YAML."
EXAMPLE = "  capture-sim show tilt_0 --set buffer.c_A=20 > mine.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene", metavar="SCENE", help="name, YAML file or recording")
    add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    print(load(options.scene, options.overrides).to_yaml(), end="")
    return OK
