"""``capture-sim report``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands.arguments import OK, add_release, prepare_folder
from capture_sim.commands.opening import open_runs
from capture_sim.commands.showing import say

HELP = "one page about runs, to keep or to print"
DESCRIPTION = (
    "Make one self-contained HTML page of runs: results, figures, energy, errors, parameters. "
    "Experiments given by name are run first."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="recorded .mcap files, bags' folders, or names"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("report.html"),
        metavar="FILE.html",
        help="the page (default: report.html)",
    )
    parser.add_argument(
        "--scene",
        metavar="EXPERIMENT",
        help="whose geometry a bench has whose recording does not say it",
    )
    add_release(parser)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    prepare_folder(options.out.parent)
    opened = open_runs(options.runs, options.scene, options.release)

    from capture_sim.viewing.report import ReportedRun, save_report
    from capture_sim.viewing.report_parts import error_statement, not_simulated

    reported = [
        ReportedRun(
            run=one.run,
            label=one.label,
            source=one.source,
            summary=one.summary(),
            software=one.software,
            error=not_simulated() if one.measured else error_statement(one.run),
            problems=one.problems,
        )
        for one in opened
    ]
    say(f"report in {save_report(reported, options.out)}")
    return OK
