"""What the rules of plausibility cost beside reading a recording of a rig, in CPU time.

python -m benchmarks.rules_cost RECORDING SCENE

The recording is read and evaluated, as `capture-sim detect` does, with the rules and without them,
in turns in one process; the smallest time of each counts.
"""

from __future__ import annotations

import sys
import time

from capture_sim.recording.read import read_run
from capture_sim.run.run import detect
from capture_sim.scene.loading import load_scene


def cost(path: str, scene_name: str, turns: int = 5) -> tuple[float, float]:
    """Return the CPU times of reading and evaluating without and with the rules, s."""
    scene, times = load_scene(scene_name), {False: [], True: []}
    for _ in range(turns):
        for has_rules in times:
            begin = time.process_time()
            run = read_run(path, scene=scene)
            if not has_rules:
                run = run.replaced(evidence=())
            detect(run)
            times[has_rules].append(time.process_time() - begin)
    return min(times[False]), min(times[True])


if __name__ == "__main__":
    without, with_rules = cost(sys.argv[1], sys.argv[2])
    print(f"{without:.3f} s without the rules, {with_rules:.3f} s with: {with_rules / without:.3f}")
