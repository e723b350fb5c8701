"""What a start costs, by stage, in CPU time, beside an earlier state.

    python -m benchmarks.start [stages commands] [--before CHECKOUT]

``stages`` imports in one process what ``run tilt_0 --no-record`` needs, in that order, and runs the
scene; ``commands`` runs commands, each in processes of its own.  Both states run with the present
Python: the packages of another environment would be compared too.
Writes the parts of docs/evidence/start.md.
"""

from __future__ import annotations

import json
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

from benchmarks.before import CLI, COMPILE, ROOT, environment, spent
from benchmarks.pages import ratio, table, write_parts

#: Prints the CPU time, s, at the end of each stage, the start of Python first.
_STAGES = """
import time
spent = {"Python, with the start-up files of the installed packages": time.process_time()}
def end(name):
    spent[name] = time.process_time() - sum(spent.values())
import numpy
end("numpy")
from capture_sim import load_scene
scene = load_scene("tilt_0")
end("scene")
import numba
end("numba")
from capture_sim import Bench
bench = Bench(scene)
bench.advance(bench.times(0, 2))
end("kernels, from the cache")
from capture_sim import simulate
run = simulate(scene)
end("first call of `simulate`")
run.summary
import rich.console, rich.table
end("summary, and the imports of rich for tables")
import json
print(json.dumps(spent))
"""
#: What an interpreter runs in a fresh process, with its kernels cached.
COMMANDS = {
    "`run tilt_0 --no-record`": (*CLI, "run", "tilt_0", "--no-record"),
    "`--help`": (*CLI, "--help"),
    "`compare --help`": (*CLI, "compare", "--help"),
    "`calibrate --help`": (*CLI, "calibrate", "--help"),
    "`show tilt_0`": (*CLI, "show", "tilt_0"),
}


def _stages(checkout: Path) -> dict[str, float]:
    """Return the CPU time of each stage, s."""
    found: dict[str, float] = json.loads(
        subprocess.run(
            [sys.executable, "-c", _STAGES],
            cwd=checkout,
            env=environment(checkout),
            capture_output=True,
            check=True,
            text=True,
        ).stdout.splitlines()[-1]
    )
    return found


def _commands(checkout: Path) -> dict[str, float]:
    """Return the CPU time of each command, s."""
    return {name: spent(checkout, command, sys.executable)[0] for name, command in COMMANDS.items()}


def _measured(asked: Namespace, measure: Callable[[Path], dict[str, float]]) -> list[str]:
    """Return the table of the least CPU time of some rounds, of both states in turn."""
    states = [ROOT] if asked.before is None else [asked.before.resolve(), ROOT]
    for state in states:
        spent(state, COMPILE, sys.executable)
    rounds = [[measure(state) for state in states] for _ in range(asked.rounds)]
    rows = []
    for name in rounds[0][0]:
        best = [min(found[name] for found in of_state) for of_state in zip(*rounds, strict=True)]
        cells = [f"{value * 1e3:.0f}" for value in best]
        rows.append([name, *cells, ratio(best[-1] / best[0]) if len(best) > 1 else "-"])
    head = ["CPU time, ms", *(["before", "now"] if len(states) > 1 else ["now"]), "now / before"]
    return [table(head, rows)]


def stages(asked: Namespace, _: Path) -> list[str]:
    """Stages of `run tilt_0 --no-record`."""
    return _measured(asked, _stages)


def commands(asked: Namespace, _: Path) -> list[str]:
    """Whole commands."""
    return _measured(asked, _commands)


if __name__ == "__main__":
    write_parts(
        "start",
        __doc__,
        {"stages": stages, "commands": commands},
        before=(None, "checkout of an earlier state"),
        rounds=(3, "of each figure"),
    )
