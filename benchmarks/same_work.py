"""Work that any state of the package can do, timed; prints JSON: ms of a processor, the least.

Run as a file, by each state's own interpreter, with PYTHONPATH set to it: see before.py.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from capture_sim import load_scene, simulate
from capture_sim.dynamics.bench import Bench
from capture_sim.scene.approach import Approach, placed
from capture_sim.scene.launch_plan import travel_to_touch
from capture_sim.viewing.rerun_view import save_rrd

try:
    from capture_sim.recording.bag import read_bag
    from capture_sim.recording.offline import write_run
    from capture_sim.studies.outcome import run_to_verdict
except ImportError:  # before the rebuild
    from capture_sim.studies.verdict import run_to_verdict

    from capture_sim.recording import read_bag, write_run

TIMES = int(sys.argv[1])


def least(work: Callable[..., object], *given: Callable[[], object]) -> float:
    """Return the least processor time of some calls (ms); what they are given is made before."""
    spent = []
    for _ in range(TIMES):
        made = [make() for make in given]
        began = time.process_time()
        work(*made)
        spent.append(time.process_time() - began)
    return min(spent) * 1e3


def approaches() -> list[tuple[float, float, float]]:
    """Angle (rad), offset (m) and speed (m/s) of 80 points of a map."""
    rng = np.random.default_rng(1)
    return [
        (rng.uniform(-0.5, 0.5), rng.uniform(-0.05, 0.05), rng.choice([0.05, 0.1, 0.2]))
        for _ in range(80)
    ]


def main() -> None:
    paper = load_scene("paper_designed", ["run.t_end=0.35"])
    tilted, base = load_scene("tilt_p10"), load_scene("tilt_0")
    run = replace(base.run, rtol=1e-5, t_end=5.0, after_latch=None)
    base = replace(base, run=run, rail=None, string=None)
    points = [placed(base, Approach(*a)) for a in approaches()]
    # an earlier state makes no scene of a path that touches nothing
    points = [p for p in points if p is not None and math.isfinite(travel_to_touch(p))]
    decided = np.arange(int(run_to_verdict(tilted).t * tilted.run.rate) + 1) / tilted.run.rate
    long = [simulate(load_scene(name, ["run.after_latch=null"])) for name in ("tilt_0", "tilt_p10")]
    usual = simulate(load_scene("tilt_m10"))

    def advance_paper(bench: Bench) -> object:
        return bench.advance(bench.times(0, 351))

    found = {
        "`Bench.advance` of paper_designed to 0.35 s": least(advance_paper, lambda: Bench(paper)),
        "`simulate` of the same": least(lambda: simulate(paper)),
        "kernel, tilt_p10 to its verdict": least(
            lambda bench: bench.advance(decided), lambda: Bench(tilted)
        ),
        "the run to its verdict": least(lambda: run_to_verdict(tilted)),
        "an approach to its verdict": least(lambda: [run_to_verdict(p) for p in points])
        / len(points),
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        found["a run written as MCAP"] = least(lambda: write_run(usual, path))
        found["... and read"] = least(lambda: read_bag(path))
        found["`.rrd` of two runs of 20 s"] = least(lambda: save_rrd(long, Path(folder) / "x.rrd"))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
