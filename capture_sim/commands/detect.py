"""``capture-sim detect``."""

from __future__ import annotations

import argparse

from capture_sim.commands.arguments import FAILED, OK, add_overrides
from capture_sim.commands.showing import say

HELP = "judge a recorded run anew, with other limits if wanted"
DESCRIPTION = (
    "Judge a recorded run anew from its poses and the buffer's state alone, with the capture "
    "detector's limits as recorded or changed (--set detector.radius=0.004). Unchanged it must "
    "come to the recorded verdict, else the exit status is 1."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap")
    parser.add_argument(
        "--scene", help="scene of a bag that holds none: a name or a YAML file", default=None
    )
    add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.commands.recorded import open_run, scene_of
    from capture_sim.recording.judging import judge_recording

    recorded = open_run(options.recording)
    scene = scene_of(recorded, options.scene, options.overrides)
    statuses = judge_recording(recorded, scene)
    state = None
    for status in statuses:
        if status.state is not state:
            say(f"{status.t:10.3f} s  {status.state.label:9} {status.reason}")
            state = status.state
    verdict = statuses[-1]
    say(
        f"verdict: {verdict.state.label}; nearest {verdict.nearest_distance * 1e3:.3f} mm, "
        f"{len(statuses) - 1} measurements"
    )
    if recorded.statuses:
        before = recorded.statuses[-1]
        since = before.t - before.time_in_state
        same = before.state is verdict.state and since == verdict.t - verdict.time_in_state
        say(
            f"recorded: {before.state.label} since {since:.3f} s ({before.reason})"
            + ("; the same" if same else "; DIFFERENT")
        )
        if not same and not options.overrides and options.scene is None:
            return FAILED
    return OK
