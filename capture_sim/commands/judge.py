"""``capture-sim judge``."""

from __future__ import annotations

import argparse
import sys

from capture_sim.commands.arguments import FAILED, OK, add_overrides

HELP = "judge recorded runs again"
DESCRIPTION = (
    "Let the capture detector judge recorded runs again, from the recorded poses and buffer "
    "states alone. Without --set it must come to the recorded verdict (else exit status 1)."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("runs", nargs="+", metavar="RUN.mcap")
    add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.recording import read_run
    from capture_sim.recording.judging import judge_recording
    from capture_sim.scene_files import load_scene_text

    status = OK
    for path in options.runs:
        recorded = read_run(path)
        scene = load_scene_text(recorded.scene_text, options.overrides)
        statuses = judge_recording(recorded, scene)
        verdict = statuses[-1]
        decided = verdict.t - verdict.time_in_state
        was = recorded.verdict
        print(f"{recorded.name}: {verdict.state.label} at {decided:.3f} s, {verdict.reason}")
        if was is not None and was is not verdict.state:
            print(f"capture-sim: {recorded.name}: recorded was {was.label}", file=sys.stderr)
            status = status if options.overrides else FAILED
    return status
