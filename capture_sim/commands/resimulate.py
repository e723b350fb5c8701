"""``capture-sim resimulate``."""

from __future__ import annotations

import argparse

from capture_sim.commands import FAILED, OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import add_remaps, not_negative, open_run
from capture_sim.commands.output import echo
from capture_sim.errors import RecordingError
from capture_sim.messages.convert import software_versions
from capture_sim.simulation import simulate
from capture_sim.studies.resimulate import agreement

DESCRIPTION = (
    "Simulate a recorded run again from the scene in the recording and compare the states sample "
    "by sample. The exit status is 1 if a coordinate differs by more than the tolerance, or if the "
    "recording contains samples of another run. With --tolerance 0 it is also 1 if the events "
    "differ."
)
EXAMPLE = "  capture-sim resimulate runs/tilt_0.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap", help="file, or folder of a bag")
    add_remaps(parser)
    parser.add_argument(
        "--tolerance",
        type=not_negative,
        default=0.0,
        help="accept coordinate differences up to this value, m and rad (default: 0, "
        "bit-identical)",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    recorded = open_run(options.recording, options.remaps)
    scene = recorded.scene
    if not recorded.samples.size:
        raise RecordingError(f"{options.recording}: contains no bench/state to compare with")
    compile_first()
    again = simulate(scene)
    traces = None if again.trace is None else (recorded.trace, again.trace)
    found = agreement(recorded.samples, again.samples, recorded.events, again.events, traces)
    echo(f"{found.compared} of {recorded.samples.size} samples compared")
    if found.foreign:
        echo(f"  {found.foreign} samples do not match this run: another publisher or another run")
    if found.missing:
        echo(f"  {found.missing} samples of the run were not recorded")
    if found.identical:
        echo("bit-identical, including the events")
    for difference in found.differences:
        echo(
            f"  {difference.name:20} differs by at most {difference.largest:.3g}, "
            f"first at {difference.first:.4f} s"
        )
    if not found.same_events:
        echo("  the events differ")
    if not found.same_trace:
        echo("  the contact traces differ")
    before = recorded.metadata.get("software", "").split("\n")
    for line in sorted(set(before) ^ set(software_versions())):
        if line:
            echo(f"  {'then' if line in before else 'now'}: {line}")
    worst = max((d.largest for d in found.differences if d.name == "q"), default=0.0)
    close = worst <= options.tolerance and (found.same_events or options.tolerance > 0.0)
    return OK if close and found.compared and not found.foreign else FAILED
