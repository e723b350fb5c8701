"""``capture-sim resimulate``."""

from __future__ import annotations

import argparse

from capture_sim.commands import FAILED, OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import add_remaps, not_negative, open_run, scene_of
from capture_sim.commands.output import echo
from capture_sim.errors import RecordingError
from capture_sim.messages.convert import software_versions
from capture_sim.simulation import simulate
from capture_sim.studies.resimulate import agreement

DESCRIPTION = (
    "Simulate a recorded run again from the scene inside it and compare it state by state. "
    "Exit status 1 when a coordinate differs by more than the tolerance, when the recording holds "
    "samples of another run, and without tolerance when the events differ."
)
EXAMPLE = "  capture-sim resimulate runs/tilt_0.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap")
    add_remaps(parser)
    parser.add_argument(
        "--tolerance",
        type=not_negative,
        default=0.0,
        help="difference of coordinates that is allowed, m and rad (default: 0, not a bit)",
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    recorded = open_run(options.recording, options.remaps)
    scene = scene_of(recorded, None, ())
    if not recorded.samples.size:
        raise RecordingError(f"{options.recording}: holds no bench/state to compare with")
    compile_first()
    again = simulate(scene)
    traces = None if again.trace is None else (recorded.trace, again.trace)
    found = agreement(recorded.samples, again.samples, recorded.events, again.events, traces)
    echo(f"{found.compared} of {recorded.samples.size} samples compared")
    if found.foreign:
        echo(f"  {found.foreign} samples are none of this run's: another publisher, or another run")
    if found.missing:
        echo(f"  {found.missing} samples of the run were not recorded")
    if found.identical:
        echo("identical, bit for bit, events included")
    for difference in found.differences:
        echo(
            f"  {difference.name:20} differs by up to {difference.largest:.3g}, "
            f"first at {difference.first:.4f} s"
        )
    if not found.same_events:
        echo("  the events differ")
    if not found.same_trace:
        echo("  the traces of the contact differ")
    before = recorded.metadata.get("software", "").split("\n")
    for line in sorted(set(before) ^ set(software_versions())):
        if line:
            echo(f"  {'then' if line in before else 'now'}: {line}")
    worst = max((d.largest for d in found.differences if d.name == "q"), default=0.0)
    close = worst <= options.tolerance and (found.same_events or options.tolerance > 0.0)
    return OK if close and found.compared and not found.foreign else FAILED
