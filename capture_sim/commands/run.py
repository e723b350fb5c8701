"""``capture-sim run``."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from capture_sim.commands.arguments import FAILED, OK, add_experiments, load_all, prepare_folder
from capture_sim.commands.showing import compile_first, draw, report, say
from capture_sim.errors import SimulationError

if TYPE_CHECKING:
    from capture_sim.simulation import Result

HELP = "run experiments without ROS"
DESCRIPTION = "Run experiments without ROS; record, tabulate and draw them."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_experiments(parser)
    parser.add_argument(
        "--no-record", action="store_true", help="write no MCAP files and no pictures"
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.simulation import simulate

    scenes = load_all(options.experiments, options.overrides)
    prepare_folder(options.out)
    compile_first()
    results: list[Result] = []
    recordings: list[str] = []
    status = OK
    for scene in scenes:
        try:
            result = simulate(scene)
        except SimulationError as error:
            print(f"capture-sim: {error}", file=sys.stderr)
            status = FAILED
            if error.result is None or error.result.samples.size == 0:
                continue
            result = error.result
        results.append(result)
        if not options.no_record:
            from capture_sim.recording import write_run

            path = write_run(result, options.out / f"{scene.name}.mcap")
            recordings.append(path.stem)
            say(f"{scene.name}: recorded in {path}")
    report([result.summary for result in results], options.out)
    if not options.no_record:
        draw(results, recordings, options.out)
    return status
