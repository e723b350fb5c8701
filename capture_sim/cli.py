"""The command line, ``capture-sim``: runs a command and reports an error in one line."""

from __future__ import annotations

import argparse
import gc
import os
import shutil
import sys
import textwrap
import warnings
from collections.abc import Iterable, Sequence
from contextlib import redirect_stdout, suppress
from contextvars import copy_context
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

import capture_sim
from capture_sim.base.exit_status import BAD_INPUT, FAILED, INTERRUPTED, OK
from capture_sim.base.outputs import check_replaceable, guarded_outputs
from capture_sim.base.threads import limit_linear_algebra
from capture_sim.base.version import __version__
from capture_sim.commands import COMMANDS, FORMER, GROUPS, OPTIONS
from capture_sim.errors import explain_import_error, one_line

#: Errors of Python that a wrong file, value or device may cause; reported as bad input.
_FROM_OUTSIDE = (OSError, ValueError, ArithmeticError, RecursionError)
#: New objects after which Python looks for garbage.  With its default, 700, it spends 8 % of a
#: short command on the modules that were just loaded.
_GARBAGE_THRESHOLD = 100_000
#: Number of options from which on a command's help has titles.
_MANY = 10


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status, see :data:`base.exit_status.OF_COMMANDS`."""
    _open_closed_streams()
    limit_linear_algebra()  # no command has loaded NumPy yet
    gc.set_threshold(_GARBAGE_THRESHOLD)
    try:
        if "_ARGCOMPLETE" in os.environ:  # a shell asks
            from capture_sim.commands.completion import complete

            complete(command_parser)
        # settings of this command end with it
        status = copy_context().run(_run, sys.argv[1:] if arguments is None else arguments)
        sys.stdout.flush()
        return status
    except SystemExit as leaving:  # argparse, after --help or a bad argument
        return _flushed(leaving.code if isinstance(leaving.code, int) else BAD_INPUT)
    except KeyboardInterrupt as interrupt:
        return _interrupted(str(interrupt))
    except BrokenPipeError:
        _give_up_stdout()  # its reader has gone
        return FAILED
    except Exception as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            return _interrupted()  # while a compiled module was loaded
        if os.environ.get("CAPTURE_SIM_TRACEBACK"):
            raise
        return _failed(error)


def command_parser(name: str) -> argparse.ArgumentParser:
    """Load the module of a command and return the parser of its arguments.

    The parsed options have the function of the command as ``run``.  The module is imported in a
    thread, so that Ctrl-C also works while a compiled module is imported.
    """
    from capture_sim.base.interrupts import in_worker  # not for --help

    command = in_worker(lambda: import_module(f"capture_sim.commands.{name}"))
    parser = _Parser(
        prog=f"capture-sim {name}",
        description=textwrap.fill(command.DESCRIPTION, shutil.get_terminal_size().columns - 2),
        epilog=f"example:\n{command.EXAMPLE}{_failure(getattr(command, 'FAILS', ''))}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # an option of a later version would change what "--ou" means
    )
    command.add_arguments(parser)
    if gives := getattr(command, "GIVES", ""):
        text = f"print {gives} as JSON, in place of the text"
        parser.add_argument("--json", action="store_true", help=text)
    known = {option for action in parser._actions for option in action.option_strings}
    if "--out" in known and "--overwrite" not in known:
        text = "replace files that capture-sim has not written, except the inputs"
        parser.add_argument("--overwrite", action="store_true", help=text)
    _sort_options(parser)
    parser.set_defaults(run=command.run, fails=getattr(command, "FAILS", ""))
    return parser


def _sort_options(parser: argparse.ArgumentParser) -> None:
    """Put the options below the titles of :data:`OPTIONS`, if there are many."""
    options = parser._optionals._group_actions
    if len(options) < _MANY:
        return
    for title, names in OPTIONS.items():
        found = [each for each in options if set(each.option_strings) & set(names)]
        parser.add_argument_group(title)._group_actions.extend(found)
    for each in [each for group in parser._action_groups[2:] for each in group._group_actions]:
        options.remove(each)


def _failure(reason: str) -> str:
    """Return the text for a command's help that explains its exit status 1.

    ``reason`` is the ``FAILS`` of the command; without a reason, '' is returned.
    """
    width = shutil.get_terminal_size().columns - 2
    return "\n\n" + textwrap.fill(f"exit status 1: {reason}", width) if reason else ""


def _open_closed_streams() -> None:
    """Send the standard streams that the caller has closed (``>&-``) to the null device.

    Otherwise the next file to be opened would get the file descriptor of the stream, and messages
    would be written into that file.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: this one
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115


def _run(arguments: Sequence[str]) -> int:
    if arguments and arguments[0] in COMMANDS:
        from capture_sim.base.interrupts import terminated_as_interrupted  # not for --help

        parser = command_parser(arguments[0])
        for argument in takewhile(lambda text: text != "--", arguments):
            option, equals, value = argument.partition("=")
            # argparse of Python 3.11 would hand on an empty list
            if option.startswith("-") and equals and value == "--":
                parser.error(f"argument {option}: expected one argument, not '--'")
        # an optional positional argument may follow options
        is_intermixed = parser.get_default("intermixed")
        parse = parser.parse_intermixed_args if is_intermixed else parser.parse_args
        options = parse(arguments[1:])
        overwrites = getattr(options, "overwrite", False)
        with terminated_as_interrupted(), guarded_outputs(_inputs(options), overwrites=overwrites):
            if isinstance(out := getattr(options, "out", None), (str, Path)):
                check_replaceable(Path(out))  # before it is worked for
            return _printed_as_json(options) if vars(options).get("json") else _status(options)
    parser = _Parser(
        prog="capture-sim",
        usage="capture-sim [-h] [--version] COMMAND ...",
        description=str(capture_sim.__doc__).partition("\n")[0],
        epilog=_overview(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"capture_sim {__version__}")
    parser.add_argument("command", metavar="COMMAND", choices=COMMANDS, help=argparse.SUPPRESS)
    first = arguments[0] if arguments else ""
    known = (*COMMANDS, "-h", "--help", "--version")
    if first == "help" and arguments[1:2] != ["help"]:
        return _run([*arguments[1:2], "--help"])
    if first and first not in known:
        now = f"; run capture-sim {FORMER[first]}" if first in FORMER else _hint(first, known)
        parser.error(f"{first!r}: not a command or option{now}")
    parser.parse_args(arguments)
    return OK


def _status(options: argparse.Namespace) -> int:
    return int(options.run(options))


def _printed_as_json(options: argparse.Namespace) -> int:
    from capture_sim.commands.output import GIVEN, json_text

    given: list[Any] = []
    GIVEN.set(given)
    with open(os.devnull, "w") as nothing, redirect_stdout(nothing):  # noqa: PTH123
        status = _status(options)
    for data in given:
        print(json_text(data), end="")
    return status


def _inputs(options: argparse.Namespace) -> list[Path]:
    """Return the files that the arguments name, except the output."""
    texts: list[object] = []
    for name, value in vars(options).items():
        if name not in ("out", "c"):
            texts += value if isinstance(value, list) else [value]
    paths = []
    for text in texts:
        with suppress(OSError, ValueError):  # a text that is no path
            if isinstance(text, (str, Path)) and str(text) and Path(text).is_file():
                paths.append(Path(text))
    return paths


def _hint(word: str, known: Iterable[str]) -> str:
    """Return the end of an error message that suggests the most similar known word.

    If no known word is similar, '' is returned.
    """
    nearest = get_close_matches(word, known, 1)
    return f"; did you mean {nearest[0]}?" if nearest else ""


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = []
    for group, commands in GROUPS.items():
        lines.append(f"{group}:")
        lines += [f"  {name:{width}}  {line}" for name, line in commands.items()]
        lines.append("")
    lines.append("Run capture-sim COMMAND --help for the options of a command and an example.")
    return "\n".join(lines)


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports an error in one line.

    If a message cannot be written, e.g. to a full device, it raises OSError; argparse ignores this.
    """

    def _print_message(self, message: str, file: Any = None) -> None:
        (file or sys.stderr).write(message)

    def error(self, message: str) -> NoReturn:
        _, _, unknown = message.partition("unrecognized arguments: ")
        if unknown:
            option = unknown.split()[0].partition("=")[0]
            message += _hint(option, [o for action in self._actions for o in action.option_strings])
        self.exit(BAD_INPUT, f"{self.prog}: {one_line(message)}; see {self.prog} --help\n")


def _failed(error: Exception) -> int:
    """Print an error in one line and return the exit status of the command for this error."""
    from capture_sim.errors import (
        CaptureSimError,
        MemoryLimitError,
        MissingPackageError,
        SimulationError,
    )

    status, text = BAD_INPUT, str(error)
    if isinstance(error, ImportError):
        status, text = FAILED, explain_import_error(error)
    elif isinstance(error, (SimulationError, MissingPackageError, MemoryLimitError)):
        status = FAILED
    elif isinstance(error, MemoryError):
        status, text = FAILED, "too little memory for this command"
    elif isinstance(error, OSError):
        prefix = f"{error.filename}: " if error.filename else ""
        text = f"{prefix}{error.strerror or error}"
    elif not isinstance(error, CaptureSimError):
        text = f"{type(error).__name__}: {error}"
        if not isinstance(error, _FROM_OUTSIDE):
            status, text = FAILED, f"{text} (set CAPTURE_SIM_TRACEBACK=1 for the traceback)"
    _complain(text)
    return _flushed(status)


def _complain(text: str) -> None:
    try:
        print(f"capture-sim: {one_line(text)}", file=sys.stderr, flush=True)
    except OSError:
        sys.stderr = open(os.devnull, "w")  # noqa: PTH123, SIM115


def _interrupted(state: str = "") -> int:
    from capture_sim.base.interrupts import leave_if_busy

    _complain(f"interrupted: {state}" if state else "interrupted")
    leave_if_busy(INTERRUPTED)
    return INTERRUPTED


def _flushed(status: int) -> int:
    """Flush standard output and return the exit status of the command.

    A status OK becomes BAD_INPUT if the flush fails, unless the reader of a pipe has closed it.
    """
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _give_up_stdout()
    except OSError as error:
        _give_up_stdout()
        if status == OK:
            _complain(f"standard output: {error.strerror}")
            return BAD_INPUT
    return status


def _give_up_stdout() -> None:
    """Redirect standard output to the null device, so that Python's flush at exit cannot fail."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        null = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, sys.stdout.fileno())
        except (OSError, ValueError):
            sys.stdout = open(null, "w")  # noqa: PTH123, SIM115


if __name__ == "__main__":
    raise SystemExit(main())
