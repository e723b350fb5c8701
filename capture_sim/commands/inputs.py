"""What commands take: arguments, scenes, recordings; checked before anything runs.

Recordings and pictures load libraries that most commands do without: they are imported where
they are used.
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
from capture_sim.scene.units import in_si, split
from capture_sim.viewing.source import Opened, distinct_names

if TYPE_CHECKING:
    from capture_sim.recording.read import Run

Read = TypeVar("Read")
Number = TypeVar("Number", int, float)

#: Of processes that a study starts.
WORKERS = Range(1, 1024)
#: Of seeds: what every generator takes.
SEEDS = Range(0, 2**32 - 1)

#: Units that a plain number of an argument may be in: the SI unit, and its factor to that.
_UNITS = {
    "mm": ("m", 1e-3),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", math.pi / 180.0),
    "%": ("1", 1e-2),
    "N": ("N", 1.0),
}


def reader(read: Callable[[str], Read], allowed: str) -> Callable[[str], Read]:
    """Return a reader of an argument, for its ``type=``, that says what is allowed.

    Parameters
    ----------
    read
        Raises ValueError where a text is not allowed.
    allowed
        Behind "must be".
    """

    def read_allowed(text: str) -> Read:
        try:
            return read(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r}: must be {allowed}") from None

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
    """Return a number with or without a unit, as ``5 deg``, in SI.

    Parameters
    ----------
    text
        As the user wrote it.
    unit
        That a number has without one, as "mm".

    Raises
    ------
    ValueError
        It is no finite number, or its unit is of another dimension.
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


def add_scene(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the scene of a study, and changes to it."""
    parser.add_argument(
        "scene", nargs="?", default=default, metavar="SCENE", help=f"default: {default}"
    )
    add_overrides(parser)


def add_out(parser: argparse.ArgumentParser, default: str, what: str = "folder") -> None:
    """Add where the results go."""
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
        help="change a value of the scene, as buffer.k_A=500 (SI) or buffer.k_A='0.5 N/mm'; may be "
        "repeated",
    )


def add_runs(parser: argparse.ArgumentParser) -> None:
    """Add recordings or experiments to be looked at, and what a bench's recording leaves open."""
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="recorded .mcap files, bags' folders, or names"
    )
    add_geometry(parser)
    add_release(parser)
    add_remaps(parser)


def add_geometry(parser: argparse.ArgumentParser) -> None:
    """Add ``--scene EXPERIMENT``: of a recording that holds none."""
    parser.add_argument(
        "--scene",
        metavar="EXPERIMENT",
        help="name or YAML file whose geometry a bench has whose recording holds no scene",
    )


def add_release(parser: argparse.ArgumentParser) -> None:
    """Add ``--release S``: when the chaser of a real bench was released."""
    parser.add_argument(
        "--release",
        type=not_negative,
        metavar="S",
        help="when a bench released the chaser, s after the recording's first pose (default: by "
        "launcher/command, else the first pose)",
    )


def add_remaps(parser: argparse.ArgumentParser) -> None:
    """Add ``--remap TOPIC:=RECORDED_TOPIC``."""
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        dest="remaps",
        metavar="TOPIC:=RECORDED_TOPIC",
        help="read a topic of the bench under the name that it was recorded by, e.g. "
        "chaser/odom:=/mocap/rb1/odom; may be repeated (default: as the recorder noted)",
    )


def add_workers(parser: argparse.ArgumentParser, *, scheduler: bool = True) -> None:
    """Add where a study's runs are done."""
    parser.add_argument(
        "--workers", type=whole(WORKERS), metavar="N", help="processes (default: one per core)"
    )
    if scheduler:
        parser.add_argument(
            "--scheduler", metavar="ADDRESS", help="of a Dask cluster, as tcp://127.0.0.1:8786"
        )


def is_recording(source: str) -> bool:
    """Whether an argument names a recording, a file or a bag's folder, and not a scene.

    A folder that has the name of a known scene is meant when it is written as a path (./tilt_0).
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
    """Make a folder, and make sure before anything runs that results can be written to it."""
    if reason := why_not_writable(folder):
        raise RecordingError(f"--out {folder}: cannot be written: {reason}; must be a folder")


def open_run(
    path: str, remaps: Sequence[str], *, several: bool = False, quiet: bool = False
) -> Run:
    """Read a recording, and say what is wrong with it.

    Parameters
    ----------
    path
        A file, or a bag's folder.
    remaps
        From :func:`add_remaps`.
    several
        Whether it may hold several runs.
    quiet
        Whether its problems are left to the caller.

    Raises
    ------
    RecordingError
        It cannot be read, or holds several runs where that is not allowed.
    """
    from capture_sim.recording.read import read_run, remap_of

    run = read_run(path, remaps=dict(map(remap_of, remaps)))
    if len(run.run_ids) > 1 and not several:
        raise RecordingError(
            f"{path}: holds {len(run.run_ids)} runs, which mix, as their times begin anew: allowed "
            "is one"
        )
    for problem in () if quiet else (*run.left_out, *run.problems):
        warn(f"{path}: {problem}")
    return run


def scene_of(run: Run, given: str | None, overrides: Sequence[str]) -> Scene:
    """Return the recorded scene, or for a bag without one the given one, with changes."""
    if given is not None:
        return load_scene(given, overrides)
    try:
        text = run.scene_text
    except RecordingError as error:
        raise SceneError(f"{error}: name one by --scene") from None
    return load_scene_text(text, overrides)


def open_runs(
    sources: Sequence[str],
    scene: str | None,
    release: float | None = None,
    remaps: Sequence[str] = (),
) -> list[Opened]:
    """Open recordings, or run experiments given by name; say what is wrong with a recording.

    Parameters
    ----------
    sources
        MCAP files, bags' folders, or experiments.
    scene
        Whose geometry the bench of a recording has that holds no scene; None for none.
    release
        When a bench released the chaser, s after the first pose; None to take it from the bag.
    remaps
        From :func:`add_remaps`.

    Raises
    ------
    RecordingError
        A file cannot be read or holds nothing to draw.
    SceneError
        There is no such experiment.
    """
    if scene is not None:
        load_scene(scene)  # also where every recording contains its own
    opened = [
        _open_recording(source, scene, release, remaps)
        if is_recording(source)
        else _run_now(source)
        for source in sources
    ]
    opened = [
        dataclasses.replace(one, label=label)
        for one, label in zip(opened, _labels(opened, sources), strict=True)
    ]
    for one in opened:
        for problem in one.problems:
            warn(f"{one.label}: {problem}")
    return opened


def _labels(opened: Sequence[Opened], sources: Sequence[str]) -> list[str]:
    """Name runs, with the folder in front where recordings in several are called the same."""
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

    recorded = open_run(path, remaps, quiet=True)
    place = Path(path).resolve()  # the path may be . or end in ..
    label = place.stem if path.endswith(".mcap") else place.name
    software = tuple(filter(None, recorded.metadata.get("software", "").split("\n")))
    problems = (*recorded.left_out, *recorded.problems)
    if recorded.samples.size:
        return Opened(
            recorded, label, f"recorded in {path}", software, recorded.wall_time, problems
        )
    run = run_from_bag(recorded, scene_of(recorded, scene, ()), release)
    return Opened(run, label, f"measured, in {path}", software, problems=problems, measured=True)


def _run_now(name: str) -> Opened:
    from capture_sim.commands.compiling import compile_first
    from capture_sim.messages.convert import software_versions
    from capture_sim.simulation import simulate

    try:
        scene = load_scene(name)
    except SceneError as error:
        raise SceneError(f"{error}; a recording ends in .mcap, or is a bag's folder") from None
    compile_first()
    result = simulate(scene)
    return Opened(result, scene.name, "run now", software_versions(), result.wall_time)
