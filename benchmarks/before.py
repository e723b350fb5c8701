"""What users' commands cost, beside an earlier state, in turn with it.

    python -m benchmarks.before --before CHECKOUT    # twenty minutes

CHECKOUT has a .venv of its own.  Shows two tables: the least of some rounds, and processor time
wherever that is what counts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.pages import own_domain, ratio, table, write_parts

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
WRITTEN = {"run": "runs", "bench": "runs"}
#: By public names alone: deep ones differ from state to state.
COMPILE = (
    "-c",
    "from capture_sim import Bench, load_scene\n"
    "bench = Bench(load_scene('paper_designed'))\n"
    "bench.advance(bench.times(0, 2))",
)


def spent(
    checkout: Path, arguments: tuple[str, ...], interpreter: str = "", **more: str
) -> tuple[float, float, float]:
    """Run a Python of a checkout, or another one; return CPU time and wall time (s), and GB."""
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as output:
        out = [f"--out={folder}/{WRITTEN[name]}" for name in arguments if name in WRITTEN]
        process = subprocess.Popen(
            [interpreter or python(checkout), *arguments, *out],
            cwd=folder,
            env=environment(checkout) | more,
            stdout=output,
            stderr=output,
        )
        began = time.monotonic()
        _, status, used = os.wait4(process.pid, 0)
        clock = time.monotonic() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        assert process.returncode == 0, f"{checkout}: {' '.join(arguments)}: {output.read()}"
    return used.ru_utime + used.ru_stime, clock, used.ru_maxrss / 1e6


#: Runs a script of this state's benchmarks with the package of a checkout.
_SERVE = """
import runpy, sys
root, checkout, *sys.argv = sys.argv[1:]
sys.path[:0] = [root]
import benchmarks, tools.run_tests
sys.path[:1] = [checkout]
sys.path.append(root)
runpy.run_path(sys.argv[0], run_name="__main__")
"""


class Server:
    """A process of a checkout, or of a copy, that runs a benchmark with ``--serve TIMES``.

    It answers each line on its standard input with a line of JSON, and may begin with some.
    """

    def __init__(self, script: str, checkout: Path, times: int) -> None:
        given = [str(ROOT), str(checkout), script, "--serve", str(times)]
        self._process = subprocess.Popen(
            [python(checkout), "-c", _SERVE, *given],
            env=environment(checkout),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def answer(self) -> Any:
        """Return the next line."""
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def ask(self) -> Any:
        """Ask for a line; return it."""
        assert self._process.stdin is not None
        print(file=self._process.stdin, flush=True)
        return self.answer()

    def end(self) -> None:
        """End the process, whose input ends."""
        self._process.communicate()


def python(checkout: Path) -> str:
    own = checkout / ".venv" / "bin" / "python"
    return str(own) if own.exists() else sys.executable


def environment(checkout: Path) -> dict[str, str]:
    domain = {"ROS_DOMAIN_ID": own_domain()}
    # the wheels' libraries are looked up anew: those of this interpreter are not another's
    left_out = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
    kept = {name: value for name, value in os.environ.items() if name not in left_out}
    return domain | kept | {"PYTHONPATH": str(checkout)}


def compiling(checkout: Path) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as empty:
        cpu, _, memory = spent(checkout, COMPILE, CAPTURE_SIM_CACHE=empty)
    return {"compiling the kernels, CPU time, s": cpu, "... memory, GB": memory}


def running(name: str, command: tuple[str, ...], checkout: Path) -> dict[str, float]:
    cpu, clock, _ = spent(checkout, command)
    return {f"{name}, CPU time, s": cpu, f"{name}, wall time, s": clock}


def starting(checkout: Path) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        command = [python(checkout), "-u", *CLI, "bench", "tilt_0", f"--out={folder}/runs"]
        given = {"cwd": folder, "env": environment(checkout), "text": True}
        began = time.monotonic()
        piped = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        with subprocess.Popen(command, **given, **piped) as process:
            next(line for line in process.stdout if "released" in line)
            took = time.monotonic() - began
            process.stdout.read()
    return {"from the command `bench` to the release, wall time, s": took}


def set_up(checkout: Path) -> dict[str, float]:
    """Time `make run` in a fresh clone of what is committed, and once more."""
    took = []
    with tempfile.TemporaryDirectory() as folder:
        clone = f"{folder}/clone"
        subprocess.run(["git", "clone", "-q", str(checkout), clone], check=True)
        given = environment(checkout) | {"CAPTURE_SIM_CACHE": f"{folder}/cache"}
        for _ in range(2):
            began = time.monotonic()
            subprocess.run(["make", "run"], cwd=clone, check=True, capture_output=True, env=given)
            took.append(time.monotonic() - began)
    return {
        "fresh clone to three results, wall time, s": took[0],
        "`make run` again, wall time, s": took[1],
    }


def compared(
    asked: Namespace, work: Iterable[tuple[int, Callable[[Path], dict[str, float]]]]
) -> list[str]:
    """The least of each figure of both states, taken in turn: a machine may change its speed."""
    states = [ROOT] if asked.before is None else [asked.before.resolve(), ROOT]
    for state in states:
        spent(state, COMPILE)
    rows = []
    for rounds, measure in work:
        found = [[measure(state) for state in states] for _ in range(rounds)]
        for name in found[0][0]:
            best = [min(of[name] for of in turns) for turns in zip(*found, strict=True)]
            rows.append([name, *(f"{value:.3g}" for value in best), ratio(best[-1] / best[0])])
    head = ["what", *(["before", "now"] if len(states) > 1 else ["now"]), "now / before"]
    return [table(head, rows)]


def commands(asked: Namespace, _: Path) -> list[str]:
    few = max(asked.rounds // 2, 1)
    work = [
        (few, compiling),
        *((asked.rounds, partial(running, name, command)) for name, command in COMMANDS.items()),
        (asked.rounds, starting),
    ]
    return compared(asked, work)


def fresh(asked: Namespace, _: Path) -> list[str]:
    return compared(asked, [(max(asked.rounds // 2, 1), set_up)])


if __name__ == "__main__":
    write_parts(
        None,
        __doc__,
        {"before": commands, "fresh": fresh},
        before=(None, "checkout of an earlier state"),
        rounds=(4, "of each figure, half as many of the long ones"),
    )
