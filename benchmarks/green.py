"""``make test`` again and again, as a newcomer runs it: is it ever red?

    python -m benchmarks.green                     10 times idle, 10 times beside 16 busy processes
    python -m benchmarks.green --idle 1 --beside 0 --dry      once, and only shows what it finds

Each run is one of a fresh clone, with an empty home folder and no variables of the environment but
PATH.  The output of a red run stays in build/green.  After a SIGTERM no further run begins, and
what was run is reported.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
from argparse import Namespace
from contextlib import ExitStack
from pathlib import Path

from benchmarks.node_suite import burn
from benchmarks.pages import table, write_parts

ROOT = Path(__file__).resolve().parents[1]
RED = ROOT / "build" / "green"


def run_once(folder: Path, name: str) -> str:
    """Run ``make test`` in a clone that is made for it; return its last line on the tests."""
    clone, home = folder / "clone", folder / "home"
    for each in (clone, home):
        shutil.rmtree(each, ignore_errors=True)
    home.mkdir()
    subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
    fresh = {"HOME": str(home), "PATH": os.environ["PATH"]}
    done = subprocess.run(["make", "test"], cwd=clone, env=fresh, capture_output=True, text=True)
    if done.returncode != 0:
        RED.mkdir(parents=True, exist_ok=True)
        (RED / f"{name}.txt").write_text(done.stdout + done.stderr)
    said = [line for line in done.stdout.splitlines() if " tests passed, " in line]
    return said[-1] if said else f"exit status {done.returncode}"


def measure_green(options: Namespace, folder: Path) -> list[str]:
    """Run the tests as often as it is asked for; return a table of the runs."""
    shutil.rmtree(RED, ignore_errors=True)
    enough = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: enough.set())
    rows = []
    for number, busy in enumerate([0] * options.idle + [options.busy] * options.beside, start=1):
        if enough.is_set():
            break
        with ExitStack() as stack:
            burn(stack, busy)
            said = run_once(folder, str(number))
        rows.append([busy, f"{os.getloadavg()[2]:.0f}", said])
        print(f"run {number} beside {busy}: {said}", file=sys.stderr, flush=True)
    return [table(["busy processes beside it", "load (15 min)", "last line"], rows)]


if __name__ == "__main__":
    write_parts(
        "node_suite",
        __doc__,
        {"green": measure_green},
        untimed={"green"},
        idle=(10, "runs with nothing beside"),
        beside=(10, "runs beside busy processes"),
        busy=(16, "of these processes"),
    )
