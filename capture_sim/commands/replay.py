"""``capture-sim replay``: publish the messages of a recording with ROS 2."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from capture_sim.commands.inputs import add_remaps, folder_beside, number, prepare_folder
from capture_sim.commands.suite import replay
from capture_sim.errors import RecordingError
from capture_sim.recording.bag import remap_of
from capture_sim.recording.playback import Playback
from capture_sim.scene.quantities import REAL_TIME_FACTORS, Range

DESCRIPTION = (
    "Publish the recorded messages with ROS 2, unchanged and with their timing, in the "
    "ROS_DOMAIN_ID of the environment. The services /player/pause and /player/resume "
    "(std_srvs/Trigger) control the replay."
)
FAILS = "a node has failed"
EXAMPLE = "  capture-sim replay runs/tilt_0.mcap --rtf 0.1 --start 2.2"
#: Nodes that can be started together with the replay, to process the played messages.
FOLLOWERS = ("capture_detector", "recorder")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap", help="file, or folder of a bag")
    parser.add_argument(
        "--rtf",
        type=number(REAL_TIME_FACTORS),
        default=1.0,
        metavar="FACTOR",
        help="set the real-time factor, up to 1000; 0 plays without pacing (default: 1)",
    )
    parser.add_argument(
        "--start",
        type=number(Range(0.0, 1e9)),
        default=0.0,
        metavar="S",
        help="skip the first S seconds of the recording (default: 0)",
    )
    parser.add_argument("--paused", action="store_true", help="start paused")
    parser.add_argument(
        "--topics", nargs="+", default=[], metavar="TOPIC", help="play only these topics"
    )
    parser.add_argument(
        "--with",
        nargs="+",
        default=[],
        dest="followers",
        choices=FOLLOWERS,
        help="also start these nodes; their topics are then not played",
    )
    add_remaps(parser)
    parser.add_argument(
        "--out",
        type=Path,
        help="write the recording of --with recorder to this folder (default: replayed, next to "
        "the recording)",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    if not Path(options.recording).exists():
        raise RecordingError(f"{options.recording}: no such file or folder")
    # rejects a recording that cannot be played before a node starts
    Playback(Path(options.recording), dict(map(remap_of, options.remaps)))
    parameters: dict[str, Any] = {
        "bag": str(options.recording),
        "rtf": options.rtf,
        "start": options.start,
        "paused": options.paused,
    }
    # an empty list has no type in ROS
    if options.topics:
        parameters["topics"] = options.topics
    if options.remaps:
        parameters["remaps"] = options.remaps
    if options.followers:
        parameters["wait_for"] = list(dict.fromkeys(options.followers))  # one of each is started
    folder = options.out or folder_beside(options.recording) / "replayed"
    if "recorder" in options.followers:
        prepare_folder(folder)
    return replay(parameters, folder)
