"""Arguments that several commands take, and what they check before anything runs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from capture_sim.control.pacing import FACTORS
from capture_sim.errors import RecordingError, SceneError
from capture_sim.folders import why_not_writable

if TYPE_CHECKING:
    from capture_sim.scene.parts import Scene

#: Exit statuses
OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def add_experiments(parser: argparse.ArgumentParser) -> None:
    """Add experiments, the folder of the results, and changes to the scenes."""
    parser.add_argument(
        "experiments",
        nargs="+",
        metavar="EXPERIMENT",
        help="names of scenes, paths of YAML files, or recordings (.mcap, or a bag's folder)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs"),
        help="folder of the results (default: runs). A recording of the nodes or of a bench is "
        "never overwritten: the new one and its picture get a number behind their name. "
        "results.txt, results.json, overview.png and runs.rrd are of the last command that made "
        "a run",
    )
    add_overrides(parser)


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Add ``--set PART.FIELD=VALUE``."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="PART.FIELD=VALUE",
        help="change a value of the scene, in SI units; may be repeated",
    )


def add_release(parser: argparse.ArgumentParser) -> None:
    """Add ``--release S``: when the chaser of a real bench was released."""
    parser.add_argument(
        "--release",
        type=not_negative,
        metavar="S",
        help="when a bench released the chaser, s after the recording's first pose (default: as "
        "launcher/command tells, else the first pose)",
    )


def not_negative(text: str) -> float:
    """Read a finite number >= 0 off the command line."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r}: allowed is a number >= 0")
    return value


def factor(text: str) -> float:
    """Read simulated (or recorded) seconds per second off the command line."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if value not in FACTORS:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed is a number {FACTORS}")
    return value


def whole(text: str) -> int:
    """Read a whole number >= 0 off the command line."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r}: allowed is a whole number >= 0")
    return int(text)


def load(source: str, overrides: Sequence[str]) -> Scene:
    """Load a scene by name, from a YAML file, or out of a recording."""
    from capture_sim.commands.recorded import is_recording
    from capture_sim.launch.scenes import load_scene, load_scene_text

    if not is_recording(source):
        return load_scene(source, overrides)
    from capture_sim.recording import read_run

    return load_scene_text(read_run(source).scene_text, overrides)


def load_all(sources: Sequence[str], overrides: Sequence[str]) -> list[Scene]:
    """Load several scenes; their names must differ."""
    scenes = [load(source, overrides) for source in sources]
    names = [scene.name for scene in scenes]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise SceneError(
            f"experiments: {', '.join(sorted(twice))} given twice: each needs a name of its own, "
            "for its files"
        )
    return scenes


def prepare_folder(folder: Path) -> None:
    """Make sure, before anything runs, that results can be written."""
    if reason := why_not_writable(folder):
        raise RecordingError(f"--out {folder}: cannot be written: {reason}; allowed is a folder")
