"""``capture-sim report``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands import OK
from capture_sim.commands.inputs import add_runs, open_runs, prepare_folder
from capture_sim.commands.output import say, summary_of
from capture_sim.viewing.report import (
    ReportedRun,
    error_statement,
    not_simulated,
    save_report,
)

DESCRIPTION = (
    "Make one self-contained HTML page of runs: results, figures, energy, errors, parameters. "
    "Experiments given by name are run first."
)
EXAMPLE = "  capture-sim report runs/tilt_0.mcap runs/tilt_p10.mcap --out report.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_runs(parser)
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("report.html"),
        metavar="FILE.html",
        help="the page (default: report.html)",
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    prepare_folder(options.out.parent)
    reported = [
        ReportedRun(
            run=one.run,
            label=one.label,
            source=one.source,
            summary=summary_of(one.run, one.wall_time),
            software=one.software,
            error=not_simulated() if one.measured else error_statement(one.run),
            problems=one.problems,
        )
        for one in open_runs(options.runs, options.scene, options.release)
    ]
    say(f"report in {save_report(reported, options.out)}")
    return OK
