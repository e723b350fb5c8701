"""What grows faster than its work: CPU time and memory by size, on docs/evidence/benchmark.md.

    python -m benchmarks.growth          # four minutes; writes the table
    python -m benchmarks.growth --dry    # only shows it

Each size has a fresh process.  An exponent is that between the last two sizes.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.before import ROOT, environment
from benchmarks.pages import seconds, table, write_parts

#: A scene whose buffer swings without end.
SWINGS = "paper_undamped"


def run_for(t_end: float, folder: Path, part: str = "summary") -> Callable[[], object]:
    """Return a run of ``t_end`` (s) whose buffer swings without end."""
    from capture_sim import simulate

    return lambda: getattr(simulate(SWINGS, t_end=t_end), part)


def sampled_for(t_end: float, folder: Path) -> Callable[[], object]:
    """Return a run whose samples are read."""
    return run_for(t_end, folder, "samples")


def swept_rows(rows: float, folder: Path) -> Callable[[], object]:
    """Return a sweep of some short runs, in one process."""
    from capture_sim import sweep
    from capture_sim.studies.evaluate.executors import InProcess

    given = {"scene": "paper_designed", "vary": {"buffer.k_A": "normal(500, 5%)"}}
    short = {"run.t_end": 0.02}
    return lambda: sweep(**given, overrides=short, runs=int(rows), executor=InProcess())


def written_for(t_end: float, folder: Path) -> Callable[[], object]:
    """Return the recording of a run."""
    from capture_sim import simulate
    from capture_sim.recording.offline import write_run

    run = simulate(SWINGS, t_end=t_end)
    assert run.samples.size  # integrated before
    return lambda: write_run(run, folder / "run.mcap")


def read_for(t_end: float, folder: Path) -> Callable[[], object]:
    """Return the reading of a recording with its samples."""
    from capture_sim import read_run

    path = written_for(t_end, folder)()
    return lambda: read_run(path).samples


#: Work that grows: what, its unit, what does it, and its sizes.
GROWTH = {
    "run, `.summary`": ("s", run_for, (0.1, 1.0, 10.0, 100.0, 1000.0)),
    "run, `.samples`": ("s", sampled_for, (0.1, 1.0, 10.0, 100.0, 1000.0)),
    "`sweep`": ("rows", swept_rows, (10, 100, 1000, 10_000, 100_000)),
    "writing a recording": ("s", written_for, (1.0, 10.0, 60.0, 600.0)),
    "`read_run(path).samples`": ("s", read_for, (1.0, 10.0, 60.0, 600.0)),
}


def grow(what: str, size: float) -> None:
    """Print the processor time (s) and the memory (MB) of some work, after a small one of it."""
    make, smallest = GROWTH[what][1], GROWTH[what][2][0]
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as folder:
        make(smallest, Path(first))()
        work = make(size, Path(folder))
        before = memory("VmRSS")
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")  # the peak begins anew
        began = time.process_time()
        kept = work()
        spent = time.process_time() - began
        print(json.dumps([spent, memory("VmHWM") - before, memory("VmRSS") - before]))
        del kept


def memory(name: str) -> float:
    """Return memory of this process by its name in Linux' status, MB."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(name)) / 1024


def growth(asked: Namespace, _: Path) -> list[str]:
    """Measure processor time and memory over the size of the work."""
    rows = []
    for what, (unit, _make, sizes) in GROWTH.items():
        found = []
        for size in sizes:
            command = [sys.executable, str(Path(__file__).resolve()), "--grow", what, str(size)]
            done = subprocess.run(
                command, env=environment(ROOT), check=True, stdout=subprocess.PIPE, text=True
            )
            found.append(json.loads(done.stdout))
        spent, peak, held = np.array(found).T
        rows.append([f"{what}: {sizes[0]:g} to {sizes[-1]:g} {unit}"])
        rows[-1] += [", ".join(f"{seconds(x)}" for x in spent), exponent(sizes, spent)]
        rows[-1] += [f"{peak[-1]:.0f} MB", f"{held[-1]:.0f} MB", exponent(sizes, peak)]
    head = ["what", "CPU time", "exponent", "most memory", "kept", "exponent"]
    return [table(head, rows)]


def exponent(sizes: Sequence[float], values: np.ndarray) -> str:
    """Return the exponent of growth between the last two sizes."""
    if min(values[-2:]) <= 0.0:
        return "-"
    return f"{math.log(values[-1] / values[-2]) / math.log(sizes[-1] / sizes[-2]):.2f}"


if __name__ == "__main__":
    if sys.argv[1:2] == ["--grow"]:
        grow(sys.argv[2], float(sys.argv[3]))
    else:
        write_parts("benchmark", __doc__, {"growth": growth})
