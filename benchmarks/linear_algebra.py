"""What threads of NumPy's linear algebra cost on a busy machine: one, or one for each core.

    python -m benchmarks.linear_algebra      # a minute; writes the table

The product of the columns of a fit (1600 x 38), the eigenvalues of its matrix, and a whole fit, in
processes of their own, alone and beside as many busy processes as there are cores.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from argparse import Namespace
from contextlib import ExitStack
from pathlib import Path

from benchmarks.before import ROOT, environment
from benchmarks.node_suite import burn
from benchmarks.pages import table, write_parts

#: Prints the CPU time and the wall time of each, ms.
WORK = """
import json, time
import numpy as np
import capture_sim
J = np.random.default_rng(1).normal(size=(1600, 38))
trial = capture_sim.simulate("tilt_0", {"run.t_end": 3.2})
work = {"J.T @ J": (200, lambda: J.T @ J), "eigenvalues": (200, lambda: np.linalg.eigh(J.T @ J))}
work["fit of two parameters"] = 1, lambda: capture_sim.calibrate([trial], ["mu", "c_A"], restarts=0)
found = {}
for name, (times, job) in work.items():
    job()
    cpu, wall = time.process_time(), time.monotonic()
    for _ in range(times):
        job()
    spent = time.process_time() - cpu, time.monotonic() - wall
    found[name] = [1e3 * value / times for value in spent]
print(json.dumps(found))
"""


def measured(threads: int, busy: int) -> dict[str, list[float]]:
    """Return CPU time and wall time of each, ms."""
    with ExitStack() as stack:
        burn(stack, busy)
        done = subprocess.run(
            [sys.executable, "-c", WORK],
            env=environment(ROOT) | {"OPENBLAS_NUM_THREADS": str(threads)},
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        )
    found: dict[str, list[float]] = json.loads(done.stdout)
    return found


def linear_algebra(_: Namespace, folder: Path) -> list[str]:
    """Measure each with one thread and with one for each core."""
    del folder
    cores = os.cpu_count() or 1
    rows = []
    for busy in (0, cores):
        one, many = measured(1, busy), measured(cores, busy)
        for name, found in one.items():
            cells = [f"{value:.3g}" for value in (*found, *many[name])]
            rows.append([f"{name}, {busy} busy processes", *cells])
    times = [f"{n} threads, {what} ms" for n in (1, cores) for what in ("CPU", "wall")]
    return [table(["what", *times], rows)]


if __name__ == "__main__":
    write_parts("benchmark", __doc__, {"linear_algebra": linear_algebra})
