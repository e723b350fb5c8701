"""Recordings as commands read them: their options, problems and plausibility.

Modules for recordings are imported inside the functions that use them, because most commands do
not need them.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from capture_sim.commands.inputs import is_recording, recordings_in, refuse_several_runs
from capture_sim.commands.output import echo, warn
from capture_sim.errors import SceneError
from capture_sim.scene.loading import load_scene, load_scene_text
from capture_sim.viewing.source import distinct_names

if TYPE_CHECKING:
    from capture_sim.recording.bag import Bag
    from capture_sim.run.run import Run


@dataclass(frozen=True)
class RecordingReader:
    """How a command reads recordings; the defaults are those without an option.

    Each call prints the recording's problems, and raises RecordingError if it cannot be read or
    contains several runs.
    """

    remaps: Sequence[str] = ()  # from inputs.add_remaps
    release: float | None = None  # from inputs.add_release
    scene: str | None = None  # from inputs.add_geometry, in place of the recorded scene
    overrides: Sequence[str] = ()  # changes to the scene, as texts PART.FIELD=VALUE
    waived: Sequence[str] = ()  # names of the plausibility rules that are not checked

    @classmethod
    def of(cls, options: argparse.Namespace) -> RecordingReader:
        """Return the reader that a command's options describe; it may lack some of them."""
        given = {each.name for each in fields(cls)} & set(vars(options))
        return cls(**{name: getattr(options, name) for name in given})

    def bag(self, path: str, *, several: bool = False) -> Bag:
        """Read a recording, which may contain ``several`` runs."""
        from capture_sim.recording.bag import read_bag, remap_of

        bag = read_bag(path, remaps=dict(map(remap_of, self.remaps)), release=self.release)
        if not several:
            refuse_several_runs(bag)
        for problem in (*bag.left_out, *bag.problems):
            warn(f"{path}: {problem}")
        return bag

    def run(self, path: str) -> Run:
        """Read a recorded run to evaluate it, without the series that a broken rule excludes.

        RecordingError if it breaks a rule of grade *refused*; SceneError if the scene or a change
        to it is invalid, or a name in ``waived`` is not a rule.
        """
        from capture_sim.recording.read import run_of

        bag, scene = self.bag(path), None
        if self.scene is not None:
            scene = load_scene(self.scene, self.overrides)
        elif self.overrides and bag.has_scene:
            scene = load_scene_text(bag.scene_text, self.overrides)
        return self._checked(run_of(bag, scene), path, judges=True)

    def run_or_scene(self, source: str, *, judges: bool = True) -> Run:
        """Read a recorded run to show it, or simulate a scene.

        A recording of a simulated run keeps its scene.  Without ``judges``, a run that breaks a
        rule of grade *refused* is returned, too.
        """
        if not is_recording(source):
            return _simulated(source)
        from capture_sim.recording.read import run_of

        run = run_of(self.bag(source))
        if self.scene is not None and not (run.is_exact and run.given.scene):
            run = run.replaced(scene=load_scene(self.scene))
        return self._checked(run, source, judges=judges)

    def runs(self, sources: Sequence[str]) -> list[Run]:
        """Read recorded runs to draw them, or simulate scenes.

        All runs get different names; a recorded run is named after its file or folder.  If a run
        was recorded repeatedly with bit-identical samples (``tilt_0.mcap``, ``tilt_0_2.mcap``),
        only the newest recording is returned.  A folder with several recorded runs gives a run for
        each file.
        """
        from capture_sim.recording.bag_folder import stem_of

        if self.scene is not None:
            load_scene(self.scene)  # also where every recording contains its own
        sources = [file for source in sources for file in _one_run_each(source)]
        runs = [self.run_or_scene(source, judges=False) for source in sources]
        runs = [
            # the path may be . or end in ..
            run.replaced(name=stem_of(Path(source).resolve())) if is_recording(source) else run
            for run, source in zip(runs, sources, strict=True)
        ]
        kept = _without_repetitions(runs, sources)
        runs, sources = [runs[k] for k in kept], [sources[k] for k in kept]
        names = _distinct_names(runs, sources)
        return [run.replaced(name=name) for run, name in zip(runs, names, strict=True)]

    def _checked(self, run: Run, path: str, *, judges: bool) -> Run:
        """Return a run without the series that broken plausibility rules exclude.

        A line is printed for each broken rule and topic, and one for the rules that the trial has
        waived.  With ``judges``, RecordingError is raised if a rule of grade *refused* is broken.
        """
        from capture_sim.plausibility.rules import Grade
        from capture_sim.run.doubts import refuse, remaining

        if run.waived:
            names = ", ".join(run.waived)
            warn(f"{path}: rules not checked, as the trial has waived them: {names}")
        run = run.replaced(waived=(*run.waived, *self.waived))
        if judges:
            refuse(path, run.doubts)
        for doubt in run.doubts:
            warn(f"{path}: {doubt.line}")
        if any(doubt.grade is Grade.REFUSED for doubt in run.doubts):
            warn(f"{path}: no verdict, as a rule of grade refused is broken")
        return run.replaced(series=remaining(run.series, run.doubts))


def _one_run_each(source: str) -> list[str]:
    """Return the paths of the files of a folder with several recorded runs.

    For any other source, a recording or a scene, the list contains only this source.
    """
    from capture_sim.recording.bag import read_bag

    files = recordings_in(Path(source)) if is_recording(source) else []
    if len(files) > 1 and len(read_bag(source).run_ids) > 1:
        return list(map(str, files))
    return [source]


def _without_repetitions(runs: Sequence[Run], sources: Sequence[str]) -> list[int]:
    """Return the indices of the runs, without runs that a newer file repeats bit by bit.

    Only files in one folder whose names differ by a final number are compared.  A second
    ``make run`` records every run again, and ``view runs/*.mcap`` would draw each of them twice.
    """
    newest: dict[object, int] = {}
    for k, (run, source) in enumerate(zip(runs, sources, strict=True)):
        path = Path(source).resolve()
        key: object = k
        if run.is_exact and path.suffix == ".mcap" and path.is_file():
            key = path.parent, re.sub(r"_\d+$", "", path.stem), run.samples.tobytes()
        other = newest.setdefault(key, k)
        if other != k:
            old, new = sorted((other, k), key=lambda i: Path(sources[i]).stat().st_mtime_ns)
            echo(f"{sources[old]}: left out, as {sources[new]} is newer and bit-identical")
            newest[key] = new
    return sorted(newest.values())


def _distinct_names(runs: Sequence[Run], sources: Sequence[str]) -> list[str]:
    """Return a different name for each run.

    If recordings in two folders have the same name, the name of the folder is put in front.
    """
    folders: dict[str, set[Path]] = {}
    for run, source in zip(runs, sources, strict=True):
        if is_recording(source):
            folders.setdefault(run.name, set()).add(Path(source).resolve().parent)
    return distinct_names(
        [
            f"{Path(source).resolve().parent.name}-{run.name}"
            if is_recording(source) and len(folders[run.name]) > 1
            else run.name
            for run, source in zip(runs, sources, strict=True)
        ]
    )


def _simulated(name: str) -> Run:
    from capture_sim.commands.compiling import compile_first
    from capture_sim.run.simulation import simulate

    try:
        scene = load_scene(name)
    except SceneError as error:
        raise SceneError(f"{error}; a recording ends in .mcap or is the folder of a bag") from None
    compile_first()
    return simulate(scene)
