"""What a step of a controller's loop costs: the table on docs/thrusters.md.

python -m benchmarks.steps
"""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pages import table, write_parts

SCENE = Path(__file__).resolve().parent.parent / "examples" / "free_flyer.yaml"
STILL = (0.0, 0.0, 0.0)
STEP = 1e-3  # s


def by_step(bench: Any, count: int, vary: float) -> None:
    """Take steps by Bench.step; ``vary`` (N) is the change of the wrench from step to step."""
    for k in range(count):
        bench.step((0.1 + vary * k, 0.0, 0.0), STILL, STEP)


def by_thrust(bench: Any, count: int, vary: float) -> None:
    """Take the same steps by Bench.thrust and Bench.advance."""
    for k in range(count):
        until = round(bench.t + STEP, 12)
        bench.thrust((0.1 + vary * k, 0.0, 0.0), STILL, until)
        bench.advance(np.array([until]))


def seconds(ways: dict[str, Callable[[], None]], turns: int) -> dict[str, float]:
    """Return the least processor time of each way, s; the ways take turns."""
    best = dict.fromkeys(ways, np.inf)
    for _ in range(turns):
        for name, work in ways.items():
            began = time.process_time()
            work()
            best[name] = min(best[name], time.process_time() - began)
    return best


def steps(asked: Namespace, _: Path) -> list[str]:
    """Steps of 1 ms in free flight, by both ways, and the kernels alone."""
    from capture_sim import Bench, load_scene

    scene, n = load_scene(SCENE), asked.steps

    def kernels() -> None:
        Bench(scene).advance(np.arange(1, n + 1) * STEP)

    found = seconds(
        {
            "`Bench.step`, another wrench each": lambda: by_step(Bench(scene), n, 1e-6),
            "`Bench.step`, the same wrench": lambda: by_step(Bench(scene), n, 0.0),
            "`Bench.thrust` and `Bench.advance`": lambda: by_thrust(Bench(scene), n, 1e-6),
            "one `Bench.advance` over all, without thrust": kernels,
        },
        asked.turns,
    )
    first = min(found, key=lambda name: name != "`Bench.step`, another wrench each")
    rows = [
        [name, f"{1e6 * t / n:.1f}", f"{n / t:,.0f}".replace(",", " "), f"{t / found[first]:.2f}"]
        for name, t in found.items()
    ]
    return [table(["way", "us a step", "steps a second", "of the first"], rows)]


if __name__ == "__main__":
    write_parts(
        "thrusters",
        __doc__,
        {"steps": steps},
        steps=(3000, "steps of 1 ms"),
        turns=(5, "turns, of which the least time counts"),
    )
