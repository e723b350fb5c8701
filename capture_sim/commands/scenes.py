"""``capture-sim scenes``: list the scenes of the package, or print a template of a scene."""

from __future__ import annotations

import argparse
import dataclasses

from capture_sim.base.exit_status import OK
from capture_sim.commands.output import echo
from capture_sim.scene.files import scene_names
from capture_sim.scene.loading import load_scene
from capture_sim.scene.template import template

DESCRIPTION = "List the scenes of the package, or print a template for a scene of your own."
EXAMPLE = "  capture-sim scenes --template > mine.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "--template",
        nargs="?",
        const="tilt_0",
        metavar="SCENE",
        help="print this scene with the unit, range and meaning of each field (default: tilt_0)",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    if options.template is not None:
        scene = load_scene(options.template)
        own = dataclasses.replace(scene, name="mine", title=f"Made from {scene.name}")
        echo(template(own).rstrip())
        return OK
    for name in scene_names():
        echo(f"{name:16} {load_scene(name).title}")
    return OK
