"""Reference solutions, kept in ``benchmarks/references`` beside what made them."""

from __future__ import annotations

import json
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trial import TOUCHED, Outcome
from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene, as_mapping

FOLDER = Path(__file__).resolve().parent / "references"

#: What of a scene does not change the motion.
_NO_PHYSICS = {"name", "title", "run", "detector", "sensors"}


def physics_of(scene: Scene) -> dict[str, Any]:
    """Return what of a scene changes the motion, as plain data."""
    return {name: part for name, part in as_mapping(scene).items() if name not in _NO_PHYSICS}


def _completed(recorded: Any, part: Any) -> Any:
    """Return a recorded part of a scene with the default of each field that did not exist then."""
    if not isinstance(recorded, dict) or not is_dataclass(part):
        return recorded
    defaults = {f.name: f.default for f in fields(part) if f.default is not MISSING}
    return defaults | {
        name: _completed(value, getattr(part, name, None)) for name, value in recorded.items()
    }


@dataclass(frozen=True)
class Reference:
    """A scene's solution at a few times.

    Attributes
    ----------
    times : list of float
        s since the release.
    q : ndarray (n, 8)
        Coordinates then, m and rad.
    impulse : ndarray (n, 2)
        Normal impulse of the walls on +y and -y, N s.
    touches : ndarray (m,) of dtype TOUCHED
        Up to the last time.
    uncertainty : list of float
        Largest difference in q between two tolerances of the generator, m or rad.
    """

    times: list[float]
    q: np.ndarray
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
    """Load a reference by its file's name, without ``.json``; it must be about the scene.

    Raises
    ------
    SceneError
        The scene has changed since the reference was made.
    """
    data = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    if scene is not None:
        wanted, there = json.loads(json.dumps(physics_of(scene))), data["physics"]
        new = {f.name: as_mapping(f.default) for f in fields(Scene) if f.default is not MISSING}
        recorded = {
            key: _completed(there.get(key, new.get(key)), getattr(scene, key)) for key in wanted
        }
        if changed := [key for key in wanted if wanted[key] != recorded[key]]:
            raise SceneError(
                f"{scene.name}: {', '.join(changed)} differ from the reference {name}; make it "
                f"again: python -m benchmarks.references.generate {name}"
            )
    columns = [data["touches"]["columns"].index(name) for name in TOUCHED.names or ()]
    rows = [
        tuple(np.nan if row[i] is None else row[i] for i in columns)
        for row in data["touches"]["rows"]
    ]
    return Reference(
        times=data["times"],
        q=np.array(data["q"]),
        impulse=np.array(data["impulse"]),
        touches=np.array(rows, TOUCHED),
        uncertainty=data["uncertainty"],
    )
