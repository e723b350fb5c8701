"""Inputs of commands: arguments, scenes, recordings; checked before anything runs.

Recordings and images need libraries that most commands do not: they are imported where they are
used.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from capture_sim.commands.output import warn
from capture_sim.errors import RecordingError, SceneError
from capture_sim.files import why_not_writable
from capture_sim.launch.scenes import load_scene, load_scene_text
from capture_sim.scene.files import scene_names
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import NOT_NEGATIVE, POSITIVE, Range
from capture_sim.scene.units import comma_hint, in_si, split
from capture_sim.viewing.source import Opened, distinct_names

if TYPE_CHECKING:
    from capture_sim.recording.read import Run

Read = TypeVar("Read")
Number = TypeVar("Number", int, float)

#: Number of processes of a study.
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
    """Return a reader of an argument, for its ``type=``, whose error states the allowed values.

    Parameters
    ----------
    read
        Function of a text; raises ValueError if the text is not allowed.
    allowed
        Text after "must be".
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
    """Return a reader of a finite number within a range."""
    return reader(lambda text: _within(float(text), allowed), f"a number {allowed}{unit}")


def whole(allowed: Range = NOT_NEGATIVE) -> Callable[[str], int]:
    """Return a reader of a whole number within a range."""

    def read(text: str) -> int:
        # the length: Python refuses to convert thousands of digits
        if not text.isascii() or not text.isdecimal() or len(text) > 18:
            raise ValueError(text)
        return _within(int(text), allowed)

    return reader(read, f"a whole number {allowed}")


not_negative = number(NOT_NEGATIVE)
positive = number(POSITIVE)


def quantity(text: str, unit: str) -> float:
    """Return a number with or without a unit, e.g. ``5 deg``, in SI.

    Parameters
    ----------
    text
        The user's text.
    unit
        Unit of a plain number, e.g. "mm".

    Raises
    ------
    ValueError
        The number is not finite, or its unit has another dimension.
    """
    si_unit, factor = _UNITS[unit]
    value_text, given = split(text)
    value = in_si(text, si_unit) if given else float(value_text) * factor
    if not math.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def in_unit(unit: str, allowed: Range = POSITIVE) -> Callable[[str], float]:
    """Return a reader of a quantity (``5``, ``5 mm``), in SI."""
    return reader(
        lambda text: _within(quantity(text, unit), allowed), f"a number {allowed}, in {unit}"
    )


def add_experiments(parser: argparse.ArgumentParser) -> None:
    """Add the scenes to run, the folder of the results, and changes to the scenes."""
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
        "bench is never overwritten: the new one and its image get a number after their name. "
        "results.txt, results.json, overview.png and runs.rrd are replaced by every command that "
        "completes a run",
    )
    add_overrides(parser)


def add_scene(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the scene of a study, and changes to it."""
    parser.add_argument(
        "scene",
        nargs="?",
        default=default,
        metavar="SCENE",
        help=f"name of a scene, YAML file or recording (default: {default})",
    )
    add_overrides(parser)


def add_out(
    parser: argparse.ArgumentParser, default: str, what: str = "write the results to this folder"
) -> None:
    """Add the folder of the results."""
    parser.add_argument(
        "--out", type=Path, default=Path(default), help=f"{what} (default: {default})"
    )


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Add ``--set PART.FIELD=VALUE``."""
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
    """Add recordings or scenes to look at, and what the recording of a bench may lack."""
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="recorded .mcap files, folders of bags, or scenes"
    )
    add_geometry(parser)
    add_release(parser)
    add_remaps(parser)


def add_geometry(parser: argparse.ArgumentParser) -> None:
    """Add ``--scene SCENE`` for a recording that contains no scene."""
    parser.add_argument(
        "--scene",
        metavar="SCENE",
        help="take the geometry from this scene (name or YAML file) if the recording contains none",
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
    """Add ``--remap TOPIC:=RECORDED_TOPIC``."""
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        dest="remaps",
        metavar="TOPIC:=RECORDED_TOPIC",
        help="read a topic of the bench from another recorded topic, e.g. "
        "chaser/odom:=/mocap/rb1/odom; may be repeated (default: the recorder's remaps)",
    )


def add_workers(parser: argparse.ArgumentParser, *, scheduler: bool = True) -> None:
    """Add the processes or the cluster for the runs of a study."""
    parser.add_argument(
        "--workers",
        type=whole(WORKERS),
        metavar="N",
        help="run in N processes (default: one per core)",
    )
    if scheduler:
        parser.add_argument(
            "--scheduler",
            metavar="ADDRESS",
            help="run on this Dask cluster, e.g. tcp://127.0.0.1:8786",
        )


def is_recording(source: str) -> bool:
    """Return True if an argument names a recording (file or folder of a bag), not a scene.

    To name a folder that has the name of a scene, write it as a path (./tilt_0).
    """
    if source.endswith(".mcap"):
        return True
    return source not in scene_names() and is_bag(Path(source))


def is_bag(folder: Path) -> bool:
    """Return True if a path is a folder with a recording in it."""
    if not folder.is_dir():
        return False
    return (folder / "metadata.yaml").is_file() or any(folder.glob("*.mcap"))


def load(source: str, overrides: Sequence[str] = ()) -> Scene:
    """Load a scene by name, from a YAML file, or out of a recording."""
    if not is_recording(source):
        return load_scene(source, overrides)
    from capture_sim.recording.read import read_run

    run = read_run(source)
    _refuse_several_runs(run)
    return load_scene_text(run.scene_text, overrides)


def load_all(sources: Sequence[str], overrides: Sequence[str]) -> list[Scene]:
    """Load several scenes; their names must differ."""
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
    """Create a folder and check, before anything runs, that results can be written to it."""
    if reason := why_not_writable(folder):
        raise RecordingError(f"--out {folder}: cannot be written: {reason}; must be a folder")


def open_run(
    path: str,
    remaps: Sequence[str],
    *,
    release: float | None = None,
    several: bool = False,
) -> Run:
    """Read a recording and print its problems.

    Parameters
    ----------
    path
        File, or folder of a bag.
    remaps
        From :func:`add_remaps`.
    release
        From :func:`add_release`.
    several
        True if the recording may contain several runs.

    Raises
    ------
    RecordingError
        It cannot be read, or contains several runs without ``several``.
    """
    from capture_sim.recording.read import read_run, remap_of

    run = read_run(path, remaps=dict(map(remap_of, remaps)), release=release)
    if not several:
        _refuse_several_runs(run)
    for problem in (*run.left_out, *run.problems):
        warn(f"{path}: {problem}")
    return run


def _refuse_several_runs(run: Run) -> None:
    """Raise RecordingError, with the files to choose from, if a recording contains several runs."""
    if len(run.run_ids) < 2:
        return
    files = _recordings_in(run.path)
    choice = "must be one run" + (
        f", one of {', '.join(map(str, files))}" if len(files) > 1 else ""
    )
    raise RecordingError(f"{run.path}: contains {len(run.run_ids)} runs: {choice}")


def _recordings_in(folder: Path) -> list[Path]:
    """Return the files of a folder that is no bag but holds recordings; empty for any other."""
    from capture_sim.recording.bag_file import FILE_NAME
    from capture_sim.recording.contents import bag_files

    if not folder.is_dir() or (folder / FILE_NAME).is_file():
        return []
    return bag_files(folder)


def _one_run_each(source: str) -> list[str]:
    """Return the files of a folder of several recorded runs; any other source as it is."""
    from capture_sim.recording.read import read_run

    files = _recordings_in(Path(source)) if is_recording(source) else []
    if len(files) > 1 and len(read_run(source).run_ids) > 1:
        return list(map(str, files))
    return [source]


def scene_of(run: Run, given: str | None, overrides: Sequence[str]) -> Scene:
    """Return the recorded scene, or for a bag without one the given one, with changes."""
    if given is not None:
        return load_scene(given, overrides)
    try:
        text = run.scene_text
    except RecordingError as error:
        raise SceneError(f"{error}: give it with --scene") from None
    return load_scene_text(text, overrides)


def open_runs(
    sources: Sequence[str],
    scene: str | None,
    release: float | None = None,
    remaps: Sequence[str] = (),
) -> list[Opened]:
    """Open recordings and print their problems, or run scenes given by name.

    Parameters
    ----------
    sources
        MCAP files, folders of bags, or scenes.
    scene
        Scene for the geometry of a recording that contains none; None for no scene.
    release
        Release time on a real bench, s after the first pose; None to take it from the bag.
    remaps
        From :func:`add_remaps`.

    Raises
    ------
    RecordingError
        A file cannot be read or contains nothing to draw.
    SceneError
        There is no such scene.
    """
    if scene is not None:
        load_scene(scene)  # also where every recording contains its own
    sources = [file for source in sources for file in _one_run_each(source)]
    opened = [
        _open_recording(source, scene, release, remaps)
        if is_recording(source)
        else _run_now(source)
        for source in sources
    ]
    return [
        dataclasses.replace(one, label=label)
        for one, label in zip(opened, _labels(opened, sources), strict=True)
    ]


def _labels(opened: Sequence[Opened], sources: Sequence[str]) -> list[str]:
    """Return labels of runs, with the folder in front if recordings of two folders share a name."""
    folders: dict[str, set[Path]] = {}
    for one, source in zip(opened, sources, strict=True):
        if is_recording(source):
            folders.setdefault(one.label, set()).add(Path(source).resolve().parent)
    return distinct_names(
        [
            f"{Path(source).resolve().parent.name}-{one.label}"
            if is_recording(source) and len(folders[one.label]) > 1
            else one.label
            for one, source in zip(opened, sources, strict=True)
        ]
    )


def _open_recording(
    path: str, scene: str | None, release: float | None, remaps: Sequence[str]
) -> Opened:
    from capture_sim.recording.measured_run import run_from_bag

    recorded = open_run(path, remaps, release=release)
    place = Path(path).resolve()  # the path may be . or end in ..
    label = place.stem if path.endswith(".mcap") else place.name
    software = tuple(filter(None, recorded.metadata.get("software", "").split("\n")))
    problems = (*recorded.left_out, *recorded.problems)
    if recorded.samples.size:
        return Opened(
            recorded, label, f"recorded in {path}", software, recorded.wall_time, problems
        )
    run = run_from_bag(recorded, scene_of(recorded, scene, ()))
    return Opened(run, label, f"measured, in {path}", software, problems=problems, measured=True)


def _run_now(name: str) -> Opened:
    from capture_sim.commands.compiling import compile_first
    from capture_sim.messages.convert import software_versions
    from capture_sim.simulation import simulate

    try:
        scene = load_scene(name)
    except SceneError as error:
        raise SceneError(f"{error}; a recording ends in .mcap or is the folder of a bag") from None
    compile_first()
    result = simulate(scene)
    return Opened(result, scene.name, "run now", software_versions(), result.wall_time)
