"""``capture-sim bench``: run scenes with the ROS 2 nodes, and tabulate and draw the results."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from capture_sim.base.exit_status import FAILED
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import add_experiments, load_all, number, prepare_folder, reader
from capture_sim.commands.output import IMAGES_MISSING, give, reported_if_interrupted, warn
from capture_sim.commands.results_folder import ResultsFolder
from capture_sim.commands.suite import check_ros, run_suite
from capture_sim.recording.read import read_run
from capture_sim.recording.results_table import Recorded
from capture_sim.scene.quantities import REAL_TIME_FACTORS

DESCRIPTION = (
    "Run scenes with the ROS 2 nodes, one process each; record, tabulate and draw the results."
)
FAILS = "a node or a run has failed, or a scene has no result"
GIVES = "the rows of results.json"
EXAMPLE = "  capture-sim bench tilt_0 tilt_p10 --rtf 1 --out runs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_experiments(parser)
    parser.add_argument(
        "--rtf",
        type=number(REAL_TIME_FACTORS),
        default=0.0,
        metavar="FACTOR",
        help="set the real-time factor, up to 1000; 0 runs without pacing (default: 0)",
    )
    parser.add_argument(
        "--namespace",
        type=reader(_namespace, "a ROS name, e.g. lab (letters, digits, _ and /)"),
        metavar="NAME",
        help="put all nodes and topics in this namespace, e.g. to run two suites in one "
        "ROS_DOMAIN_ID (default: none)",
    )


def _namespace(text: str) -> str:
    if not re.fullmatch(r"/?[A-Za-z]\w*(/[A-Za-z]\w*)*", text, re.ASCII):
        raise ValueError(text)
    return text


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    check_ros()
    scenes = load_all(options.experiments, options.overrides)
    prepare_folder(options.out)
    folder = ResultsFolder(options.out)
    compile_first()
    with reported_if_interrupted(f"only recordings are written to {options.out}"):
        status, recordings = run_suite(
            scenes, options.out, rtf=options.rtf, namespace=options.namespace or ""
        )
    read = (Recorded(read_run(path), Path(path)) for path in recordings)
    runs = [one for one in read if one.run.is_exact]
    rows = folder.add(runs)
    give(lambda: rows)
    with reported_if_interrupted(IMAGES_MISSING):
        folder.draw(runs)
    missing = {scene.name for scene in scenes} - {one.run.name for one in runs}
    if missing:
        warn(f"no result for {', '.join(sorted(missing))}")
        return int(status) or FAILED
    return int(status)
