"""Inputs that several commands share: arguments, scenes and recordings, checked before any run.

Modules for recordings are imported inside the functions that use them, because most commands do
not need them.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from capture_sim.base.files import writing_problem
from capture_sim.commands.output import warn
from capture_sim.errors import RecordingError, SceneError
from capture_sim.scene.files import MAX_TEXT, parse, scene_names
from capture_sim.scene.loading import load_scene, load_scene_text
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import NOT_NEGATIVE, POSITIVE, Range
from capture_sim.scene.units import comma_hint, in_si, split

if TYPE_CHECKING:
    from capture_sim.recording.bag import Bag

Read = TypeVar("Read")
Number = TypeVar("Number", int, float)

#: Allowed numbers of processes of a study.
WORKERS = Range(1, 1024)
#: Seeds that every generator accepts.
SEEDS = Range(0, 2**32 - 1)

#: Units of an argument's plain number, with the SI unit and the factor to it.
_UNITS = {
    "mm": ("m", 1e-3),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", math.pi / 180.0),
    "%": ("1", 1e-2),
    "N": ("N", 1.0),
}


def reader(read: Callable[[str], Read], allowed: str) -> Callable[[str], Read]:
    """Return a function for ``type=`` of an argument, with an error that states what is allowed.

    Parameters
    ----------
    read
        Function that converts the text of the user; raises ValueError if it is not allowed.
    allowed
        Allowed values in words, which follow "must be" in the error message.
    """

    def read_allowed(text: str) -> Read:
        try:
            return read(text)
        except ValueError:
            hint = comma_hint(text)
            raise argparse.ArgumentTypeError(f"{text!r}: must be {allowed}{hint}") from None

    return read_allowed


def _within(value: Number, allowed: Range) -> Number:
    if value not in allowed:
        raise ValueError(value)
    return value


def number(allowed: Range = Range(), unit: str = "") -> Callable[[str], float]:  # noqa: B008
    """Return a function for ``type=`` of an argument: a finite number within a range.

    ``unit`` follows the range in the error message.
    """
    return reader(lambda text: _within(float(text), allowed), f"a number {allowed}{unit}")


def whole(allowed: Range = NOT_NEGATIVE) -> Callable[[str], int]:
    """Return a function for ``type=`` of an argument: an integer, not negative, within a range."""

    def read(text: str) -> int:
        # the length: Python refuses to convert thousands of digits
        if not text.isascii() or not text.isdecimal() or len(text) > 18:
            raise ValueError(text)
        return _within(int(text), allowed)

    return reader(read, f"a whole number {allowed}")


not_negative = number(NOT_NEGATIVE)
positive = number(POSITIVE)


def quantity(text: str, unit: str) -> float:
    """Convert a number with or without a unit, e.g. ``5 deg``, to SI.

    Parameters
    ----------
    text
        The user's text.
    unit
        Unit of a number without a unit: mm, mrad, deg, % or N.

    Raises
    ------
    ValueError
        The text is not a finite number, or its unit is unknown or has another dimension.
    """
    si_unit, factor = _UNITS[unit]
    value_text, given = split(text)
    value = in_si(text, si_unit) if given else float(value_text) * factor
    if not math.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def in_unit(unit: str) -> Callable[[str], float]:
    """Return a function for ``type=`` of an argument: a number that is converted to SI.

    The user may write a unit (``5 mm``); a number without a unit is in ``unit``.
    """
    return reader(
        lambda text: _within(quantity(text, unit), POSITIVE), f"a number {POSITIVE}, in {unit}"
    )


def add_experiments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for the scenes to run, ``--out`` for the results, and ``--set``."""
    parser.add_argument(
        "experiments",
        nargs="+",
        metavar="SCENE",
        help="names of scenes, paths of YAML files, or recordings (.mcap, or a bag's folder)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs"),
        help="write the results to this folder (default: runs). A recording of the nodes or of a "
        "bench is never overwritten: the new one and its plot get a number after their name. "
        "results.txt and results.json have a row for every recording in the folder; overview.png "
        "and runs.rrd show the latest",
    )
    add_overrides(parser)


def add_scene(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the argument for the scene of a study, and ``--set`` for changes to the scene."""
    parser.add_argument(
        "scene",
        nargs="?",
        default=default,
        metavar="SCENE",
        help=f"name of a scene, YAML file or recording (default: {default})",
    )
    add_overrides(parser)


def add_out(parser: argparse.ArgumentParser, default: str) -> None:
    """Add ``--out``, the folder of the results."""
    text = f"write the results to this folder (default: {default})"
    parser.add_argument("--out", type=Path, default=Path(default), help=text)


def folder_beside(source: str) -> Path:
    """Return the folder in which a recording lies; for a scene, the current folder."""
    return Path(source).parent if is_recording(source) else Path()


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Add ``--set PART.FIELD=VALUE``, which changes a value of the scene."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="PART.FIELD=VALUE",
        help="change a value of the scene, e.g. buffer.k_A=500 (SI) or buffer.k_A='0.5 N/mm'; may "
        "be repeated",
    )


def add_runs(parser: argparse.ArgumentParser) -> None:
    """Add the argument for recordings or scenes to draw, and options to complete recordings.

    These options are ``--scene``, ``--waive``, ``--release`` and ``--remap``.
    """
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="recorded .mcap files, folders of bags, or scenes"
    )
    add_geometry(parser)
    add_release(parser)
    add_remaps(parser)


def add_geometry(parser: argparse.ArgumentParser) -> None:
    """Add ``--scene``, for recordings of a real bench, and ``--waive``.

    ``--waive`` names a plausibility rule that is not checked.
    """
    parser.add_argument(
        "--scene",
        metavar="SCENE",
        help="take the geometry of a real bench from this scene (name or YAML file), e.g. if the "
        "recording contains none",
    )
    parser.add_argument(
        "--waive",
        action="append",
        default=[],
        dest="waived",
        metavar="RULE",
        help="do not check this rule of plausibility (capture-sim inspect names those that are "
        "broken); may be repeated",
    )


def add_release(parser: argparse.ArgumentParser) -> None:
    """Add ``--release S``, the release time on a real bench."""
    parser.add_argument(
        "--release",
        type=not_negative,
        metavar="S",
        help="set the time of the release on a real bench, s after the first recorded pose "
        "(default: from launcher/command, otherwise the first pose)",
    )


def add_remaps(parser: argparse.ArgumentParser) -> None:
    """Add ``--remap TOPIC:=RECORDED_TOPIC``, for a topic that was recorded under another name."""
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        dest="remaps",
        metavar="TOPIC:=RECORDED_TOPIC",
        help="read a topic of the bench from another recorded topic, e.g. "
        "chaser/odom:=/mocap/rb1/odom; may be repeated (default: the recorder's remaps)",
    )
    parser.add_argument(
        "--memory",
        action=_SetMemory,
        metavar="GIB",
        help="limit the memory for a recording's messages that are used, GiB (default: 1)",
    )
    parser.add_argument(
        "--trial",
        action=_SetTrial,
        metavar="N",
        help="read only the N-th trial of a recording with several, which pauses of 2 s in all "
        "measurements tell apart",
    )


class _SetTrial(argparse.Action):
    """Sets the trial that is read of recordings with several."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        if not re.fullmatch(r"[1-9]\d{0,5}", str(values)):
            raise argparse.ArgumentError(self, f"{values!r}: must be a whole number >= 1")
        from capture_sim.recording.trials import TRIAL

        TRIAL.set(int(values))


class _SetMemory(argparse.Action):
    """Sets the limit of memory for recordings."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        try:
            limit = float(values)
        except ValueError:
            limit = math.nan
        if not 0.001 <= limit <= 1e6:
            raise argparse.ArgumentError(self, f"{values!r}: must be 0.001 to 1e6 GiB")
        from capture_sim.recording.records import MEMORY_LIMIT

        MEMORY_LIMIT.set(int(limit * 2**30))


def add_limits(parser: argparse.ArgumentParser) -> None:
    """Add ``--limit LOAD=VALUE``, which limits a load in the runs of a study."""
    parser.add_argument(
        "--limit",
        action="append",
        default=[],
        dest="limits",
        metavar="LOAD=VALUE",
        help="limit a load of the whole run, or until the latch closes, e.g. max_normal_force=500 "
        "(SI) or max_axial_stroke_in_before_latch='15 mm'; may be repeated",
    )


def add_seed(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--seed``, a seed of random numbers; its help text is "set the seed of <what>"."""
    parser.add_argument(
        "--seed", type=whole(SEEDS), default=1, help=f"set the seed of {what} (default: 1)"
    )


def add_under(parser: argparse.ArgumentParser, help_text: str) -> None:
    """Add the options for the dispersions (random variations) of a study.

    They are ``--under`` for a file of distributions, ``--correlate`` for correlations, and
    ``--calibrated`` for the parameters of a calibration with their errors.
    """
    parser.add_argument(
        "--under",
        type=Path,
        metavar="FILE",
        help=f"{help_text}, one line each, e.g. 'approach.speed: normal(0.1, 10%%)'",
    )
    parser.add_argument(
        "--correlate",
        action="append",
        default=[],
        metavar="NAME,NAME=R",
        help="correlate two distributions by R, of a Gaussian copula, e.g. "
        "approach.speed,approach.angle=0.6; may be repeated",
    )
    parser.add_argument(
        "--calibrated",
        type=Path,
        metavar="DIR",
        help="also vary the parameters of capture-sim calibrate, with their errors and "
        "correlations: its folder, or its calibration.json",
    )


def dispersions(
    options: argparse.Namespace, without: Sequence[str] = ()
) -> tuple[dict[str, str], dict[tuple[str, str], float]]:
    """Return the distributions of ``--under`` and ``--calibrated``, and the correlations.

    The distributions are texts, e.g. ``normal(0.1, 10%)``, by name.  The correlations are numbers
    by pairs of names.  ``without`` are calibrated fields that are not varied, because a design
    chooses their values.  SceneError if an option is invalid or a name has two distributions.
    """
    vary: dict[str, str] = {}
    if options.under is not None:
        try:
            with options.under.open(encoding="utf-8") as file:
                text = file.read(MAX_TEXT + 1)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or "no UTF-8"
            raise SceneError(f"--under {options.under}: cannot be read: {reason}") from None
        given = parse(text, str(options.under))
        if not isinstance(given, dict) or not all(isinstance(x, str) for x in given.values()):
            raise SceneError(
                f"--under {options.under}: must be distributions by name, e.g. "
                "approach.speed: normal(0.1, 10%)"
            )
        vary = given
    correlations = {}
    for item in options.correlate:
        names, _, value = item.partition("=")
        first, comma, second = (name.strip() for name in names.partition(","))
        try:
            if not comma:
                raise ValueError(item)
            correlations[first, second] = float(value)
        except ValueError:
            raise SceneError(f"--correlate {item}: must be NAME,NAME=R") from None
    if options.calibrated is not None:
        from capture_sim.studies.fit.files import calibrated_dispersions, read_calibrated

        calibrated = read_calibrated(options.calibrated)
        for finding in calibrated.findings:
            warn(f"{calibrated.path}: {calibrated.verdict}: {finding}")
        varied, correlated = calibrated_dispersions(calibrated, without)
        if twice := [name for name in varied if name in vary]:
            raise SceneError(f"{twice[0]}: must be in --under or --calibrated, not in both")
        vary |= varied
        correlations |= correlated
    return vary, correlations


def add_resume(parser: argparse.ArgumentParser, study: str) -> None:
    """Add ``--resume``, which continues an interrupted or killed study.

    ``study`` is the name of the study in the help text, e.g. "sweep".
    """
    parser.add_argument(
        "--resume",
        action="store_true",
        help=f"continue an interrupted or killed {study} with the same arguments; its runs are "
        "kept as they are done",
    )


def add_control(parser: argparse.ArgumentParser) -> None:
    """Add ``--control``, the controller of the scene's thrusters."""
    parser.add_argument(
        "--control",
        metavar="MODULE:FUNCTION",
        default="",
        help="controller of the thrusters: FUNCTION(scene), called for each run, returns it",
    )


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add ``--workers`` and ``--scheduler``, the processes or the Dask cluster of a study."""
    parser.add_argument(
        "--workers",
        type=whole(WORKERS),
        metavar="N",
        help="run in N processes (default: one per core)",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="run on this Dask cluster, e.g. tcp://127.0.0.1:8786",
    )


def is_recording(source: str) -> bool:
    """Return True if an argument names a recording (file or folder of a bag), not a scene.

    The name of a packaged scene is never a recording.  A folder with such a name must therefore be
    given as a path (./tilt_0).
    """
    if source.endswith(".mcap"):
        return True
    from capture_sim.recording.bag_folder import is_bag, is_bag_file

    return source not in scene_names() and (is_bag_file(source) or is_bag(Path(source)))


def load(source: str, overrides: Sequence[str] = ()) -> Scene:
    """Load a scene by name, from a YAML file, or out of a recording."""
    if not is_recording(source):
        return load_scene(source, overrides)
    from capture_sim.recording.bag import read_bag

    bag = read_bag(source)
    refuse_several_runs(bag)
    return load_scene_text(bag.scene_text, overrides)


def load_all(sources: Sequence[str], overrides: Sequence[str]) -> list[Scene]:
    """Load several scenes; SceneError if two of them have the same name."""
    scenes = [load(source, overrides) for source in sources]
    names = [scene.name for scene in scenes]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise SceneError(
            f"scenes: {', '.join(sorted(twice))} given twice: each must have its own name, as "
            "its files are named after it"
        )
    return scenes


def prepare_folder(folder: Path) -> None:
    """Raise RecordingError if results cannot be written to a folder.

    Commands call this function before they run anything.  A missing folder is not created yet.
    """
    if reason := writing_problem(folder):
        raise RecordingError(f"--out {folder}: cannot be written: {reason}; must be a folder")


def refuse_several_runs(bag: Bag) -> None:
    """Raise RecordingError if a recording contains several runs; the error names its files."""
    if len(bag.run_ids) < 2:
        return
    files = recordings_in(bag.path)
    choice = "must be one run" + (
        f", one of {', '.join(map(str, files))}" if len(files) > 1 else ""
    )
    raise RecordingError(f"{bag.path}: contains {len(bag.run_ids)} runs: {choice}")


def recordings_in(folder: Path) -> list[Path]:
    """Return the recorded files in a folder without ``metadata.yaml``; otherwise, an empty list.

    Such a folder may contain several recordings; with ``metadata.yaml`` it is a single bag.
    """
    from capture_sim.recording.bag_folder import FILE_NAME, bag_files

    if not folder.is_dir() or (folder / FILE_NAME).is_file():
        return []
    return list(bag_files(folder).files)
