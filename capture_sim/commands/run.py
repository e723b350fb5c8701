"""``capture-sim run``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands import FAILED, OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import add_experiments, load_all, prepare_folder
from capture_sim.commands.output import (
    IMAGES_MISSING,
    OVERVIEW,
    RRD,
    draw,
    echo,
    remove_earlier,
    report,
    reported_if_interrupted,
    warn,
)
from capture_sim.errors import SimulationError
from capture_sim.simulation import Result, simulate

DESCRIPTION = "Run scenes without ROS; record, tabulate and draw the results."
EXAMPLE = "  capture-sim run tilt_0 tilt_p10 --set buffer.c_A=20 --out runs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_experiments(parser)
    parser.add_argument(
        "--no-record",
        action="store_true",
        help="write no recordings and no images; remove the earlier ones of the same scenes in "
        "the folder, which would not match the new results",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    scenes = load_all(options.experiments, options.overrides)
    if not options.no_record:
        # imported here: the import needs more time than a run without recording
        from capture_sim.recording.offline import write_run
    prepare_folder(options.out)
    compile_first()
    results: list[Result] = []
    recordings: list[str] = []
    status = OK
    with reported_if_interrupted("only the recordings named above are written"):
        for scene in scenes:
            try:
                result = simulate(scene)
            except SimulationError as error:
                warn(str(error))
                status = FAILED
                if error.result is None or error.result.samples.size == 0:
                    continue
                result = error.result
            results.append(result)
            if not options.no_record:
                path = write_run(result, options.out / f"{scene.name}.mcap")
                recordings.append(path.stem)
                echo(f"{scene.name}: recorded in {path}")
    report([result.summary for result in results], options.out)
    if options.no_record:
        _remove_replaced([result.scene.name for result in results], options.out)
    else:
        with reported_if_interrupted(IMAGES_MISSING):
            draw(results, recordings, options.out)
    return status


def _remove_replaced(names: list[str], folder: Path) -> None:
    """Remove files that a recorded run would have replaced: they do not match the results."""
    recordings = [path for name in names if (path := folder / f"{name}.mcap").is_file()]
    if recordings:
        from capture_sim.recording.offline import is_repeatable

        recordings = [path for path in recordings if is_repeatable(path)]
    pictures = [path.with_suffix(".png") for path in recordings]
    remove_earlier([*recordings, *pictures, *([folder / OVERVIEW, folder / RRD] if names else [])])
