"""``capture-sim scenes``."""

from __future__ import annotations

import argparse

from capture_sim.commands import OK
from capture_sim.commands.output import echo
from capture_sim.launch.scenes import load_scene
from capture_sim.scene.files import scene_names

DESCRIPTION = "List the scenes of the package."
EXAMPLE = "  capture-sim scenes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments: none."""


def run(_: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    for name in scene_names():
        echo(f"{name:16} {load_scene(name).title}")
    return OK
