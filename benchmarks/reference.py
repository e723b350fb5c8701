"""Reference solutions, kept in ``benchmarks/references`` beside what made them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trial import TOUCHED, Outcome
from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene, as_mapping

FOLDER = Path(__file__).resolve().parent / "references"

#: What of a scene changes the motion.
PHYSICS = (
    "chaser",
    "target",
    "cylinder",
    "probe",
    "buffer",
    "cone",
    "contact",
    "friction",
    "initial",
    "supports",
    "rail",
    "string",
    "latch",
    "stops",
    "gravity",
)


def physics_of(scene: Scene) -> dict[str, Any]:
    """Return what of a scene changes the motion, as plain data."""
    mapping = as_mapping(scene)
    return {name: mapping[name] for name in PHYSICS}


@dataclass(frozen=True)
class Reference:
    """A scene's solution at a few times.

    Attributes
    ----------
    times : list of float
        s since the release.
    q, v : ndarray (n, 8)
        Coordinates and rates then, m, rad and per second.
    impulse : ndarray (n, 2)
        Normal impulse of the walls on +y and -y, N s.
    touches : ndarray (m,) of dtype TOUCHED
        Up to the last time.
    uncertainty : list of float
        Largest difference in q between two tolerances of the generator, m or rad.
    """

    times: list[float]
    q: np.ndarray
    v: np.ndarray
    impulse: np.ndarray
    touches: np.ndarray
    uncertainty: list[float]

    def at(self, t: float) -> Outcome:
        """Return the solution at one of its times, s."""
        k = self.times.index(t)
        touches = self.touches[self.touches["start"] <= t].copy()
        touches["end"][touches["end"] > t] = np.nan
        return Outcome(
            q=self.q[k],
            evaluations=0,
            touches=touches,
            impulse=float(self.impulse[k].sum()),
            peak_force=float(touches["peak_force"].max(initial=0.0)),
        )


def load_reference(name: str, scene: Scene | None = None) -> Reference:
    """Load a reference by name.

    Parameters
    ----------
    name
        Of the file, without ``.json``.
    scene
        To make sure that the reference is about this scene.

    Raises
    ------
    SceneError
        There is no such reference, or the scene has changed since it was made.
    """
    path = FOLDER / f"{name}.json"
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise SceneError(
            f"no reference {name}: benchmarks/references holds none of that name"
        ) from None
    if scene is not None:
        wanted, there = json.loads(json.dumps(physics_of(scene))), data["physics"]
        changed = [key for key in wanted if wanted[key] != there.get(key)]
        if changed:
            raise SceneError(
                f"{scene.name}: {', '.join(changed)} differ from the reference {name}; make it "
                "again with benchmarks/references/generate.py"
            )
    columns = data["touches"]["columns"]
    touches = np.zeros(len(data["touches"]["rows"]), TOUCHED)
    for row, values in zip(touches, data["touches"]["rows"], strict=True):
        for column, value in zip(columns, values, strict=True):
            if column in TOUCHED.names:  # type: ignore[operator]
                row[column] = np.nan if value is None else value
    return Reference(
        times=data["times"],
        q=np.array(data["q"]),
        v=np.array(data["v"]),
        impulse=np.array(data["impulse"]),
        touches=touches,
        uncertainty=data["uncertainty"],
    )
