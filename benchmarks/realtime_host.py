"""How late a host in C wakes at 1 kHz, and how long a step takes; writes a part of docs/fmu.md.

python -m benchmarks.realtime_host
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.pages import table, write_parts
from capture_sim.fmu.library import make_unit, write_library
from capture_sim.scene.loading import load_scene

SCENE = "tilt_0"
_PRIORITY = 50


def host(asked: argparse.Namespace, folder: Path) -> Sequence[str]:
    """Build the host and run it with the ordinary scheduler and with SCHED_FIFO."""
    scene = load_scene(SCENE, {"run.t_end": 1e4, "run.after_latch": None})
    write_library(make_unit(scene), folder)
    shutil.copy(Path(__file__).with_suffix(".c"), folder / "host.c")
    command = ["cc", "-O2", "-o", "host", "host.c", "-L.", f"-l{SCENE}", "-Wl,-rpath,."]
    subprocess.run(command, cwd=folder, check=True)
    rows = []
    for name, priority in (("ordinary", 0), (f"SCHED_FIFO, {_PRIORITY}", _PRIORITY)):
        words = ["./host", str(round(asked.seconds * 1000)), str(priority)]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
        if done.returncode:
            rows.append([name, done.stderr.strip() or f"status {done.returncode}", *"-----"])
            continue
        late, step = np.array([line.split() for line in done.stdout.splitlines()], float).T
        quantiles = [*np.percentile(late, [50, 99, 99.9]), late.max(), np.median(step), step.max()]
        rows.append([name, *(f"{value:.0f}" for value in quantiles)])
    head = ["scheduler", "late p50, us", "p99", "p99.9", "max", "step p50, us", "max"]
    return [table(head, rows)]


if __name__ == "__main__":
    write_parts("fmu", __doc__, {"host": host}, seconds=(20.0, "s of each run"))
