"""Completion of the command line by the shell, with argcomplete.

eval "$(register-python-argcomplete capture-sim)"
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable

import argcomplete
from argcomplete.completers import FilesCompleter

from capture_sim.commands import COMMANDS
from capture_sim.scene.files import scene_names


def complete(command_parser: Callable[[str], argparse.ArgumentParser]) -> None:
    """Give the shell what may follow on the command line that it asks about, and end the process.

    Only the module of the command that has been typed is loaded.
    """
    parser = argparse.ArgumentParser(prog="capture-sim", allow_abbrev=False)
    commands = parser.add_subparsers()
    typed = os.environ["COMP_LINE"].split()[1:2]
    for name in COMMANDS:
        parents = [_completed(command_parser(name))] if typed == [name] else []
        commands.add_parser(name, parents=parents, add_help=not parents)
    argcomplete.autocomplete(parser)


def _completed(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Return a parser whose arguments know what the shell may complete them to."""
    for action in parser._actions:
        metavar = str(action.metavar or "")
        if "SCENE" in metavar or metavar in ("A", "B"):
            action.completer = _scenes  # type: ignore[attr-defined]
        elif metavar.startswith(("NAME", "PART.FIELD")):
            action.completer = _fields  # type: ignore[attr-defined]
    return parser


def _scenes(prefix: str, **_: object) -> list[str]:
    return [*scene_names(), *FilesCompleter()(prefix)]


def _fields(prefix: str, **_: object) -> list[str]:
    """Return the names of all numbers of a scene; the part before ``=`` is completed."""
    from capture_sim.scene.loading import load_scene
    from capture_sim.scene.paths import ALIASES, field_names

    return [name for name in (*ALIASES, *field_names(load_scene("tilt_0"))) if prefix in name]
