"""What the commands that examine a recording share."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from capture_sim.errors import SceneError

if TYPE_CHECKING:
    from capture_sim.recording import Run
    from capture_sim.scene.parts import Scene


def is_recording(source: str) -> bool:
    """Whether an argument names a recording, a file or a bag's folder, and not a scene.

    A folder that has the name of a known scene is meant when it is written as a path (./tilt_0).
    """
    from capture_sim.scene.files import scene_names

    if source.endswith(".mcap"):
        return True
    folder = Path(source)
    if source in scene_names() or not folder.is_dir():
        return False
    return (folder / "metadata.yaml").is_file() or any(folder.glob("*.mcap"))


def open_run(path: str, *, several: bool = False, tell: bool = True) -> Run:
    """Read a recording, and say what is wrong with it.

    Parameters
    ----------
    path
        A file, or a bag's folder.
    several
        Whether it may hold several runs.
    tell
        Whether its problems are printed.

    Raises
    ------
    RecordingError
        It cannot be read, or holds several runs where that is not allowed.
    """
    from capture_sim.errors import RecordingError
    from capture_sim.recording import read_run

    run = read_run(path)
    if len(run.run_ids) > 1 and not several:
        raise RecordingError(
            f"{path}: holds {len(run.run_ids)} runs, which mix, as their times begin anew: allowed "
            "is one"
        )
    for problem in (*run.left_out, *run.problems) if tell else ():
        print(f"capture-sim: {path}: {problem}", file=sys.stderr)
    return run


def scene_of(run: Run, given: str | None, overrides: Sequence[str]) -> Scene:
    """Return the recorded scene, or for a bag without one the given one, with changes."""
    from capture_sim.errors import RecordingError
    from capture_sim.launch.scenes import load_scene, load_scene_text

    if given is not None:
        return load_scene(given, overrides)
    try:
        text = run.scene_text
    except RecordingError as error:
        raise SceneError(f"{error}: name one by --scene") from None
    return load_scene_text(text, overrides)
