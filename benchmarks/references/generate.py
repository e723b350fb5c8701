"""Makes the reference solutions of this folder; see README.md.

    python -m benchmarks.references.generate [NAME ...]

Takes some ten minutes for each.  Needs extended precision: x86, and not Windows.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from benchmarks.engines.model import Model
from benchmarks.reference import FOLDER, physics_of
from benchmarks.references.extrapolation import COLUMNS, Extrapolation, Real
from capture_sim import load_scene
from capture_sim.scene.parts import Scene

TIMES = (0.1, 0.35, 1.5)  # s since the release
TOLERANCES = (1e-14, 1e-15)
#: Scene and law of friction, by the reference's name.
REFERENCES = {
    "paper_designed": ("paper_designed", "tanh"),
    "paper_designed_clamp": ("paper_designed", "clamp"),
    "paper_designed_frictionless": ("paper_designed", "none"),
    "paper_undamped": ("paper_undamped", "tanh"),
}


def scales(scene: Scene) -> np.ndarray:
    """Scale of each state (18,): the tip's radius, the approach's speed, and 0.01 N s."""
    length, speed = scene.probe.tip_radius, 0.1
    arm, at_target = scene.buffer.hinge_offset + scene.rest_length, scene.cone.L_T + scene.cone.R_c
    shape = np.array([1, 1, 1 / arm, 1 / arm, 1, 1, 1, 1 / at_target])
    return np.concatenate([length * shape, speed * shape, [0.01, 0.01]])


def solve(scene: Scene, tolerance: float, times: tuple[float, ...] = TIMES):
    """Run a scene; return the states at some times, (n, 18), and the run."""
    q, v = scene.initial_coordinates()
    y_0 = np.concatenate([q, v, [0.0, 0.0]])
    run = Extrapolation(Model(scene, Real), y_0, tolerance, scales(scene))
    states = np.array([run.advance(t) for t in times])
    return states, run


def generate(name: str) -> None:
    """Make one reference."""
    source, friction = REFERENCES[name]
    scene = load_scene(source, [f"friction.law={friction}"])
    (coarse, _), (states, run) = (solve(scene, tolerance) for tolerance in TOLERANCES)
    final = states.astype(float)
    data = {
        "scene": source,
        "friction": friction,
        "method": "extrapolated midpoint rule of order 16, extended precision, located touches",
        "tolerance": TOLERANCES[1],
        "evaluations": run.model.evaluations,
        "times": TIMES,
        "uncertainty": np.abs(coarse - states)[:, :8].max(axis=1).astype(float).tolist(),
        "q": final[:, :8].tolist(),
        "v": final[:, 8:16].tolist(),
        "impulse": final[:, 16:].tolist(),
        "touches": {"columns": COLUMNS, "rows": run.table()},
        "physics": physics_of(scene),
    }
    text = json.dumps(data, indent=1, allow_nan=False)
    Path(FOLDER, f"{name}.json").write_text(text + "\n", encoding="utf-8")
    print(f"{name}: {len(run.table())} touches, uncertainty {data['uncertainty']}", flush=True)


if __name__ == "__main__":
    for wanted in sys.argv[1:] or REFERENCES:
        generate(wanted)
