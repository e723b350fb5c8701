"""Scenes that are requested over the network: names and texts, no paths."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

from capture_sim.errors import SceneError
from capture_sim.launch.scenes import load_scene, load_scene_text
from capture_sim.resources import config_dir
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import shown


def load_requested(text: str, overrides: Sequence[str] = (), folder: Path | None = None) -> Scene:
    """Return the scene of a request: a packaged scene's name, a file in ``folder``, or YAML text.

    SceneError for anything else: a request must not read files of this machine.
    """
    if "\n" in text:
        return load_scene_text(text, list(overrides))
    for directory in (config_dir() / "scenes", folder):
        path = None if directory is None else directory / f"{text.removesuffix('.yaml')}.yaml"
        if path is not None and "/" not in text and path.is_file():
            return load_scene(path, list(overrides))
    names = [path.stem for path in (config_dir() / "scenes").glob("[!_]*.yaml")]
    where = "" if folder is None else f", a file in {folder}"
    near = difflib.get_close_matches(text, names, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise SceneError(
        f"scene = {shown(text)}: must be a packaged scene's name{where}, or YAML text{hint}"
    )
