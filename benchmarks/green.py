"""The node part of ``make test`` again and again on a busy machine: is it ever red?

    python -m benchmarks.green                  30 times, 2 hours; for docs/evidence/node_suite.md
    python -m benchmarks.green --runs 2 --dry   only shows what it finds

Two processes keep the processors busy, a suite of three experiments runs in a loop in a domain of
its own, and two runs go on at a time.  The output of a red run stays in build/green.  After a
SIGTERM no further run begins, and what was run is reported.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import xml.etree.ElementTree as ET
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

from benchmarks.node_suite import burn
from benchmarks.pages import write_parts

ROOT = Path(__file__).resolve().parents[1]
RED = ROOT / "build" / "green"
#: A run of the node tests is ended after this long, s.
LIMIT = 3600.0
TESTS = ("-m", "pytest", "tests/nodes", "-n", "auto", "--dist", "loadfile", "-q")
SUITE = ("-m", "capture_sim.cli", "bench", "tilt_0", "tilt_p10", "tilt_m10")


class Loop:
    """A suite that is run again and again beside something else; counts those that failed."""

    def __init__(self, folder: Path) -> None:
        self.runs = self.failed = 0
        self._folder = folder / "loop"
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._repeat)

    def __enter__(self) -> Loop:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()

    def _repeat(self) -> None:
        while not self._over.is_set():
            command = [sys.executable, *SUITE, "--out", str(self._folder)]
            done = subprocess.run(command, capture_output=True, text=True)
            shutil.rmtree(self._folder, ignore_errors=True)
            self.runs += 1
            if done.returncode != 0:
                self.failed += 1
                RED.mkdir(parents=True, exist_ok=True)
                (RED / f"suite_{self.runs}.txt").write_text(done.stdout + done.stderr)


def run_tests(folder: Path, number: int) -> tuple[int, list[str]]:
    """Run the node tests once; return how many there are and the names of those that failed."""
    report = folder / f"{number}.xml"
    command = [sys.executable, *TESTS, f"--junitxml={report}"]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return 0, [f"no end within {LIMIT:g} s"]
    cases = ET.parse(report).getroot().findall(".//testcase") if report.exists() else []
    failed = [
        f"{case.get('classname', '').rpartition('.')[2]}::{case.get('name')}"
        for case in cases
        if case.find("failure") is not None or case.find("error") is not None
    ]
    if done.returncode != 0:
        failed = failed or [f"exit status {done.returncode}"]
        RED.mkdir(parents=True, exist_ok=True)
        (RED / f"tests_{number}.txt").write_text(done.stdout + done.stderr)
    return len(cases), failed


def measure_green(options: Namespace, folder: Path) -> list[str]:
    """Run the tests as often as it is asked for; return what is to be said of them."""
    shutil.rmtree(RED, ignore_errors=True)
    enough = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: enough.set())
    took, counts, red, loads = [], [], [], []

    def run(number: int) -> None:
        if enough.is_set():
            return
        began = time.monotonic()
        count, failed = run_tests(folder, number)
        took.append(time.monotonic() - began)
        counts.append(count)
        loads.append(os.getloadavg()[1])
        if failed:
            red.append(f"- run {number}: {', '.join(failed)}")
        text = f"run {number}: {count} tests, {len(failed)} failed, {took[-1]:.0f} s"
        print(f"{text}, load {loads[-1]:.1f}", file=sys.stderr, flush=True)

    with ExitStack() as stack:
        burn(stack, options.busy)
        loop = stack.enter_context(Loop(folder))
        with ThreadPoolExecutor(options.at_once) as lanes:
            list(lanes.map(run, range(1, options.runs + 1)))
    return [
        f"{len(took)} runs of `tests/nodes` ({max(counts)} tests), {options.at_once} at a time, "
        f"beside {options.busy} busy processes and {loop.runs} suites of three experiments in a "
        f"loop (load {min(loads):.0f} to {max(loads):.0f}): green {len(took) - len(red)}, red "
        f"{len(red)}; {min(took):.0f} to {max(took):.0f} s each. Suites that failed: "
        f"{loop.failed}.",
        *(["", *red] if red else []),
    ]


if __name__ == "__main__":
    write_parts(
        "node_suite",
        __doc__,
        {"green": measure_green},
        untimed={"green"},
        runs=(30, "of the node tests"),
        busy=(2, "processes that keep the processors busy"),
        at_once=(2, "of these runs"),
    )
