"""What users' commands and the parts of a run cost, beside an earlier state, in turn with it.

    .venv/bin/python -m benchmarks.before --before CHECKOUT    # fifteen minutes

CHECKOUT has a .venv of its own.  Writes a part of docs/benchmark.md: the least of some rounds, and
processor time wherever that is what counts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from pathlib import Path

from benchmarks.envelope import AXES
from benchmarks.pages import ratio, table, write_parts

ROOT = Path(__file__).resolve().parent.parent
CLI = ("-m", "capture_sim.cli")
#: What an interpreter is to run in a fresh process, with its kernels cached.
COMMANDS = {
    "import, load_scene, simulate": (
        "-c",
        "import capture_sim as c; c.simulate(c.load_scene('tilt_0'))",
    ),
    "`--help`": (*CLI, "--help"),
    "`run paper_designed --no-record`": (*CLI, "run", "paper_designed", "--no-record"),
    "`run paper_designed`": (*CLI, "run", "paper_designed"),
    "`bench` of the three experiments": (*CLI, "bench", "tilt_0", "tilt_p10", "tilt_m10"),
}
#: What they write, in a folder that goes.
WRITTEN = {"run": "runs", "bench": "runs", "envelope": "envelope.parquet"}
COMPILE = ("-c", "from capture_sim.bench import compile_kernels; compile_kernels()")


def spent(checkout: Path, arguments: tuple[str, ...], **more: str) -> tuple[float, float, float]:
    """Run a Python of a checkout; return processor time and time on the clock (s), and GB."""
    with tempfile.TemporaryDirectory() as folder:
        out = [f"--out={folder}/{WRITTEN[name]}" for name in arguments if name in WRITTEN]
        process = subprocess.Popen(
            [python(checkout), *arguments, *out],
            cwd=folder,
            env=environment(checkout) | more,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        began = time.monotonic()
        _, status, used = os.wait4(process.pid, 0)
        clock = time.monotonic() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0, f"{checkout}: {' '.join(arguments)} failed"
    return used.ru_utime + used.ru_stime, clock, used.ru_maxrss / 1e6


def python(checkout: Path) -> str:
    own = checkout / ".venv" / "bin" / "python"
    return str(own) if own.exists() else sys.executable


def environment(checkout: Path) -> dict[str, str]:
    domain = {"ROS_DOMAIN_ID": str(1 + os.getpid() % 101)}
    # the wheels' libraries are looked up anew: those of this interpreter are not another's
    left_out = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
    kept = {name: value for name, value in os.environ.items() if name not in left_out}
    return domain | kept | {"PYTHONPATH": str(checkout)}


def measured(checkout: Path, times: int, points: int) -> dict[str, float]:
    """Return all figures of a checkout, by name and unit."""
    spent(checkout, COMMANDS["import, load_scene, simulate"])  # compiles, where that is to do
    found = {}
    with tempfile.TemporaryDirectory() as empty:
        cpu, _, memory = spent(checkout, COMPILE, CAPTURE_SIM_CACHE=empty)
        found |= {"compiling the kernels, processor s": cpu, "... memory, GB": memory}
    axes = (f"--{name}={text}" for name, text in AXES.items())
    envelope = (*CLI, "envelope", *axes, "--levels=5", f"--runs={points}")
    for name, command in (COMMANDS | {f"`envelope`, {points} points": envelope}).items():
        cpu, clock, _ = spent(checkout, command)
        found |= {f"{name}, processor s": cpu, f"{name}, on the clock, s": clock}
    command = [python(checkout), str(ROOT / "benchmarks" / "same_work.py"), str(times)]
    given = {"env": environment(checkout), "capture_output": True, "text": True}
    parts = json.loads(subprocess.run(command, check=True, **given).stdout)
    return found | {f"{name}, processor ms": value for name, value in parts.items()}


def compared(asked: Namespace, _: Path) -> list[str]:
    """The least of all figures of both states, in turn."""
    states = [ROOT] if asked.before is None else [asked.before.resolve(), ROOT]
    rounds = [
        [measured(state, asked.times, asked.points) for state in states]
        for _ in range(asked.rounds)
    ]
    rows = []
    for name in rounds[0][0]:
        best = [min(values) for values in zip(*([f[name] for f in r] for r in rounds), strict=True)]
        shown = [f"{value:.3g}" for value in best]
        rows.append([name, *shown, ratio(best[-1] / best[0])])
    head = ["what", *(["before", "now"] if len(states) > 1 else ["now"]), "now / before"]
    return [table(head, rows)]


if __name__ == "__main__":
    write_parts(
        "benchmark",
        __doc__,
        {"before": compared},
        before=(None, "checkout of an earlier state"),
        rounds=(3, "of everything, in turn"),
        times=(15, "that a part is repeated in a round"),
        points=(7000, "of the envelope"),
    )
