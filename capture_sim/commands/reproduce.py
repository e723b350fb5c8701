"""``capture-sim reproduce``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands.arguments import OK, prepare_folder

HELP = "set the paper's results beside ours"
DESCRIPTION = (
    "Run all of the paper's numerical section and its experiments, in less than a minute; write "
    "a page with a table 'paper says, we get, difference, why' and the figures. Figures 10 and "
    "11 need Exudyn (requirements/benchmark.txt); without it the page says so."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs"),
        help="folder of reproduction.md and reproduction/ (default: runs)",
    )
    parser.add_argument(
        "--only", metavar="FIGURE", help="draw one figure, as figure_6, into the folder"
    )
    parser.add_argument(
        "--workers", type=int, default=0, metavar="N", help="processes (default: one per core)"
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.commands.showing import compile_first, say
    from capture_sim.errors import MissingPackageError, RecordingError, SceneError
    from capture_sim.reproduction.everything import FIGURES, reproduce, reproduce_figure
    from capture_sim.reproduction.page import NAME, page, terminal_table
    from capture_sim.studies.executors import default_workers, open_executor

    if options.only is not None and options.only not in FIGURES:
        raise SceneError(f"--only {options.only}: allowed are {', '.join(FIGURES)}")
    if not 0 <= options.workers <= 1024:
        raise SceneError(f"--workers {options.workers}: allowed is >= 1 and <= 1024")
    try:
        import capture_sim.viewing.canvas  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(f"the figures cannot be drawn: {error}") from None
    prepare_folder(options.out / NAME)
    compile_first()
    with open_executor(options.workers or default_workers()) as executor:
        if options.only is not None:
            say(f"picture in {reproduce_figure(options.only, executor, options.out / NAME)}")
            return OK
        found = reproduce(executor, options.out / NAME, lambda what: say(f"{what} ..."))
    say("")
    say(terminal_table(found.claims))
    say("")
    target = options.out / f"{NAME}.md"
    try:
        target.write_text(page(found), encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{target}: cannot be written: {error.strerror}") from None
    say(f"page in {target}, figures in {options.out / NAME}")
    return OK
