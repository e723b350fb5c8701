"""``capture-sim scenes``."""

from __future__ import annotations

import argparse

from capture_sim.commands.arguments import OK

HELP = "list the scenes that come with the package"
DESCRIPTION = "List the scenes that come with the package."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    del parser  # none


def run(_: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.launch.scenes import load_scene
    from capture_sim.scene.files import scene_names

    for name in scene_names():
        print(f"{name:16} {load_scene(name).title}")
    return OK
