"""States, touches, events and verdicts of known scenes, kept to the last bit.

    PYTHONPATH=. python tests/references/runs.py --write   # the file, from this source
    PYTHONPATH=. python tests/references/runs.py           # this source against the file

``runs.npz`` was written before the engine was rebuilt.  Bits depend on processor and compiler, so
the tests compare within a tenth of what each run is wrong by; run here, this script says which
runs agree to the last bit.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from random_scenes import random_scenes

from capture_sim import load_scene, scene_names, simulate
from capture_sim.scene.parts import Scene

FILE = Path(__file__).with_name("runs.npz")
RANDOM = 30
#: Fields of a touch that are kept, in this order.
TOUCH_FIELDS = ("start", "end", "approach_speed", "peak_force", "peak_time", "impulse")


def scenes() -> Iterator[tuple[str, Scene]]:
    """All scenes that come with the package, and random benches for half a second."""
    for name in scene_names():
        yield name, load_scene(name)
    for i, scene in enumerate(random_scenes(RANDOM, seed=4)):
        yield f"random_{i}", replace(scene, run=replace(scene.run, t_end=0.5, after_latch=None))


def measure(scene: Scene) -> dict[str, np.ndarray]:
    """Run a scene; return its last state, touches, events and verdict as arrays."""
    result = simulate(scene)
    last = result.samples[-1]
    return {
        "state": np.concatenate([[last["t"]], last["q"], last["v"], last["impulse"]]),
        "touches": np.array([[touch[name] for name in TOUCH_FIELDS] for touch in result.touches]),
        "events": np.array([[int(e.kind), e.wall, e.t, *e.q, *e.v] for e in result.events]),
        "verdict": np.array(int(result.verdict)),
        "cost": np.array(result.statistics),
    }


def load() -> dict[str, np.ndarray]:
    """Return the file's arrays by ``scene/name``."""
    with np.load(FILE) as arrays:
        return dict(arrays)


def compare(name: str, found: dict[str, np.ndarray], kept: dict[str, np.ndarray]) -> str:
    """Return in a line how a run differs from the kept one."""
    notes = []
    for key, value in found.items():
        old = kept[f"{name}/{key}"]
        if value.shape != old.shape:
            notes.append(f"{key}: {value.shape} for {old.shape}")
        elif value.tobytes() != old.tobytes():
            if key == "cost":
                notes.append(f"cost {old.tolist()} -> {value.tolist()}")
            else:
                size = np.abs(value - old).max()
                notes.append(f"{key} by {size:.1e}")
    return ", ".join(notes) or "identical"


def main() -> None:
    if "--write" in sys.argv[1:]:
        arrays = {
            f"{name}/{key}": value
            for name, scene in scenes()
            for key, value in measure(scene).items()
        }
        np.savez_compressed(FILE, **arrays)
        print(f"{FILE.name}: {len(arrays)} arrays, {FILE.stat().st_size} bytes")
        return
    kept = load()
    for name, scene in scenes():
        print(f"{name:16s} {compare(name, measure(scene), kept)}")


if __name__ == "__main__":
    main()
