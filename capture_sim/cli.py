"""The command line, ``capture-sim``: finds the command, and says in a line what went wrong."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

from capture_sim import __version__
from capture_sim.commands import COMMANDS
from capture_sim.commands.arguments import BAD_INPUT, FAILED, INTERRUPTED
from capture_sim.errors import CaptureSimError, SceneError
from capture_sim.interrupts import leave_if_busy


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return the exit status: 0 fine, 1 failed, 2 bad input, 130 interrupted."""
    try:
        options = _parser().parse_args(arguments)
        return int(options.command(options))
    except SceneError as error:
        print(f"capture-sim: {error}", file=sys.stderr)
        return BAD_INPUT
    except CaptureSimError as error:
        print(f"capture-sim: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        return _interrupted()
    except ImportError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            return _interrupted()  # while a compiled module was loaded
        raise
    except BrokenPipeError:
        # the reader of our output has gone; there is nobody left to tell
        sys.stderr.close()
        return FAILED


def _interrupted() -> int:
    print("capture-sim: interrupted", file=sys.stderr)
    leave_if_busy(INTERRUPTED)
    return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="capture-sim",
        description="Emulates a ground test bench for docking and capture.",
    )
    parser.add_argument("--version", action="version", version=f"capture_sim {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name in COMMANDS:
        command = import_module(f"capture_sim.commands.{name}")
        its = commands.add_parser(name, help=command.HELP, description=command.DESCRIPTION)
        command.add_arguments(its)
        its.set_defaults(command=command.run)
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
