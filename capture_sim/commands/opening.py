"""Runs that a command looks at: recordings, bags of a real bench, experiments run now."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capture_sim.errors import RecordingError, SceneError

if TYPE_CHECKING:
    from capture_sim.viewing.source import ViewableRun


@dataclass(frozen=True)
class Opened:
    """A run to be looked at.

    Attributes
    ----------
    run
        To be drawn.
    label
        Its name, no other's of those opened with it: the recording's, or the experiment's.
    source
        Where it comes from, in words.
    software
        ``"name version"`` each, of what made it.
    wall_time
        s, that it took; None where that is not known.
    problems
        What is wrong with its recording.
    measured
        Known from measurements alone: it cannot be run again.
    """

    run: ViewableRun
    label: str
    source: str
    software: Sequence[str]
    wall_time: float | None = None
    problems: Sequence[str] = ()
    measured: bool = False

    def summary(self) -> dict[str, Any]:
        """Return the run in a few numbers, as results.json has them."""
        from capture_sim.results import summarize
        from capture_sim.viewing.source import verdict

        run = self.run
        return summarize(
            run.scene, run.samples, run.touches, run.events, verdict(run), self.wall_time
        )


def open_runs(
    sources: Sequence[str], scene: str | None, release: float | None = None
) -> list[Opened]:
    """Open recordings, or run experiments given by name; say what is wrong with a recording.

    Parameters
    ----------
    sources
        MCAP files, bags' folders, or experiments.
    scene
        Whose geometry the bench of a recording has that holds no scene; None for none.
    release
        When a bench released the chaser, s after the first pose; None where the bag tells.

    Raises
    ------
    RecordingError
        A file cannot be read or holds nothing to draw.
    SceneError
        There is no such experiment.
    """
    from capture_sim.commands.recorded import is_recording

    opened = [
        _open_recording(source, scene, release) if is_recording(source) else _run_now(source)
        for source in sources
    ]
    opened = [
        dataclasses.replace(one, label=label)
        for one, label in zip(opened, _labels(opened, sources), strict=True)
    ]
    for one in opened:
        for problem in one.problems:
            print(f"capture-sim: {one.label}: {problem}", file=sys.stderr)
    return opened


def _labels(opened: Sequence[Opened], sources: Sequence[str]) -> list[str]:
    """Name runs, with the folder in front where recordings in several are called the same."""
    from capture_sim.commands.recorded import is_recording
    from capture_sim.viewing.source import distinct_names

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


def _open_recording(path: str, scene: str | None, release: float | None) -> Opened:
    from capture_sim.commands.recorded import open_run
    from capture_sim.launch.scenes import load_scene
    from capture_sim.viewing.bag import run_from_bag

    recorded = open_run(path, tell=False)
    place = Path(path).resolve()  # the path may be . or end in ..
    label = place.stem if path.endswith(".mcap") else place.name
    software = tuple(filter(None, recorded.metadata.get("software", "").split("\n")))
    problems = (*recorded.left_out, *recorded.problems)
    if recorded.samples.size:
        return Opened(
            recorded, label, f"recorded in {path}", software, recorded.wall_time, problems
        )
    if scene is None:
        raise RecordingError(
            f"{path}: holds no samples of the simulator; if it is of a real bench, name an "
            "experiment of the same geometry by --scene"
        )
    run = run_from_bag(recorded, load_scene(scene), release)
    return Opened(run, label, f"measured, in {path}", software, problems=problems, measured=True)


def _run_now(name: str) -> Opened:
    from capture_sim.commands.showing import compile_first
    from capture_sim.launch.scenes import load_scene
    from capture_sim.messages.convert import software_versions
    from capture_sim.simulation import simulate

    try:
        scene = load_scene(name)
    except SceneError as error:
        raise SceneError(f"{error}; a recording ends in .mcap, or is a bag's folder") from None
    compile_first()
    result = simulate(scene)
    return Opened(result, scene.name, "run now", software_versions(), result.wall_time)
