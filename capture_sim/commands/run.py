"""``capture-sim run``: run scenes without ROS; record, tabulate and draw the results."""

from __future__ import annotations

import argparse
import dataclasses

from capture_sim.base.exit_status import FAILED, OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import add_control, add_experiments, load_all, prepare_folder
from capture_sim.commands.output import (
    IMAGES_MISSING,
    echo,
    give,
    reported_if_interrupted,
    warn,
)
from capture_sim.commands.results_folder import ResultsFolder
from capture_sim.recording.results_table import Recorded
from capture_sim.run.controllers import control_of
from capture_sim.run.loads import implausible_stroke
from capture_sim.run.simulation import RunError, simulate
from capture_sim.scene.loading import overridden_name

DESCRIPTION = "Run scenes without ROS; record, tabulate and draw the results."
FAILS = "a run has stopped before its end; its results until then are written"
GIVES = "the rows of results.json"
EXAMPLE = "  capture-sim run tilt_0 tilt_p10 --set buffer.c_A=20 --out runs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_experiments(parser)
    add_control(parser)
    parser.add_argument("--no-record", action="store_true", help="write no recordings and no plots")
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace earlier simulated runs of the same name (default: a run of another scene or "
        "version is kept, and the new one gets a number after its name)",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    scenes = load_all(options.experiments, options.overrides)
    if options.overrides:
        scenes = [dataclasses.replace(scene, name=overridden_name(scene)) for scene in scenes]
    if not options.no_record:
        # imported here: the import needs more time than a run without recording
        from capture_sim.recording.offline import write_run
    prepare_folder(options.out)
    folder = ResultsFolder(options.out)
    compile_first()
    runs: list[Recorded] = []
    status = OK
    with reported_if_interrupted("only the recordings named above are written"):
        for scene in scenes:
            try:
                control = control_of(scene, options.control) if options.control else None
                result = simulate(scene, control=control)
            except RunError as error:
                warn(str(error))
                status = FAILED
                if error.result.samples.size == 0:
                    continue
                result = error.result
            if text := implausible_stroke(scene, result.summary["max_axial_stroke_in"]):
                warn(f"{scene.name}: {text}")
            path = None
            if not options.no_record:
                file = options.out / f"{scene.name}.mcap"
                path = write_run(result, file, overwrite=options.overwrite)
                echo(f"{scene.name}: recorded in {path}")
            runs.append(Recorded(result, path))
    rows = folder.add(runs)
    give(lambda: rows)
    if not options.no_record:
        with reported_if_interrupted(IMAGES_MISSING):
            folder.draw(runs)
    return status
