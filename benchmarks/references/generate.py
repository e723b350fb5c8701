"""Makes the reference solutions of this folder; see README.md.

    python benchmarks/references/generate.py [NAME ...]

Takes some five minutes for each.  Needs extended precision: x86, and not Windows.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
from extrapolation import COLUMNS, Real, Reference, table

from benchmarks.engines.python_model import PythonModel
from benchmarks.reference import physics_of
from capture_sim import load_scene
from capture_sim.scene.parts import FRICTION_LAWS, Scene

FOLDER = Path(__file__).resolve().parent
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


def solve(scene: Scene, friction: str, tolerance: float) -> tuple[list[np.ndarray], Reference]:
    """Run a scene; return the states at TIMES, and the run."""
    q, v = scene.initial_coordinates()
    model = PythonModel(scene, Real, friction)
    run = Reference(model, np.concatenate([q, v, [0.0, 0.0]]), tolerance, scales(scene))
    states = []
    for t in TIMES:
        states.append(run.advance(t))
        print(
            f"  tolerance {tolerance:g}: at {t} s after {run.evaluations} evaluations", flush=True
        )
    return states, run


def generate(name: str) -> None:
    """Make one reference."""
    source, friction = REFERENCES[name]
    # "clamp" is not among the scene's own laws
    law = [f"friction.law={friction}"] if friction in FRICTION_LAWS else []
    scene = load_scene(source, law)
    began = time.monotonic()
    coarse, _ = solve(scene, friction, TOLERANCES[0])
    states, run = solve(scene, friction, TOLERANCES[1])
    rows = table(run.touches + [touch for touch in run.open if touch is not None])
    data = {
        "scene": source,
        "friction": friction,
        "method": "extrapolated midpoint rule of order 16, extended precision, located touches",
        "tolerance": TOLERANCES[1],
        "evaluations": run.evaluations,
        "times": TIMES,
        "uncertainty": [
            float(np.abs(a[:8] - b[:8]).max()) for a, b in zip(coarse, states, strict=True)
        ],
        "q": [[float(x) for x in y[:8]] for y in states],
        "v": [[float(x) for x in y[8:16]] for y in states],
        "impulse": [[float(x) for x in y[16:]] for y in states],
        "touches": {"columns": COLUMNS, "rows": rows},
        "physics": physics_of(scene),
    }
    text = json.dumps(data, indent=1, allow_nan=False)
    (FOLDER / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    print(
        f"{name}: {len(rows)} touches, uncertainty {data['uncertainty']}, "
        f"{time.monotonic() - began:.0f} s",
        flush=True,
    )


if __name__ == "__main__":
    for wanted in sys.argv[1:] or REFERENCES:
        generate(wanted)
