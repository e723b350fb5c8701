"""What a run to its verdict costs over the kernel's own time; prints JSON, ms of a processor.

    .venv/bin/python -m benchmarks.verdict

Also runs on an earlier checkout: as a file, by its interpreter and with ``PYTHONPATH`` set to it.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from capture_sim import load_scene
from capture_sim.bench import Bench
from capture_sim.studies.approach import placed
from capture_sim.studies.verdict import run_to_verdict

ROUNDS = 15
RUNS = 80


def fastest(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Return the least time of the processor, ms."""
    spent = []
    for _ in range(rounds):
        began = time.process_time()
        work()
        spent.append(time.process_time() - began)
    return min(spent) * 1e3


def advanced(scene, t: float) -> Callable[[], object]:
    """Return what runs a bench to ``t`` (s) in one call, and nothing else."""
    benches = [Bench(scene) for _ in range(ROUNDS)]
    times = np.arange(math.floor(t * scene.run.rate + 1e-6) + 1) / scene.run.rate
    return lambda: benches.pop().advance(times)


def main() -> None:
    scene = load_scene("tilt_p10")
    t = run_to_verdict(scene).t
    base = load_scene("tilt_0")
    run = replace(base.run, rtol=1e-5, t_end=5.0, after_latch=None)
    base = replace(base, run=run, rail=None, string=None)
    rng = np.random.default_rng(1)
    approaches = [
        (rng.uniform(-0.5, 0.5), rng.uniform(-0.05, 0.05), rng.choice([0.05, 0.1, 0.2]))
        for _ in range(RUNS)
    ]

    def map_points() -> None:
        for approach in approaches:
            start = placed(base, *approach)
            if start is not None:
                run_to_verdict(start)

    found = {
        "kernel": fastest(advanced(scene, t)),
        "run": fastest(lambda: run_to_verdict(scene)),
        "point": fastest(map_points, 5) / RUNS,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
