"""What looking at runs costs: rerun files, pictures, the report, the live viewer.

    .venv/bin/python -m benchmarks.viewing             # about three minutes
    .venv/bin/python -m benchmarks.viewing live --seconds 6

Writes the parts of docs/viewing.md.  The live part runs the real nodes at real time, with and
without the viewer, and reads from the operating system what their processes took.
"""

from __future__ import annotations

import os
import signal
import socket
import tempfile
import time
from pathlib import Path

from benchmarks.node_suite import Suite
from benchmarks.pages import Page, Spread, arguments, table
from capture_sim import load_scene, simulate
from capture_sim.bench import compile_kernels
from capture_sim.commands.inputs import open_runs
from capture_sim.viewing.canvas import save
from capture_sim.viewing.plots import draw_overview, draw_run
from capture_sim.viewing.report import save_report
from capture_sim.viewing.rerun_view import save_rrd
from tests.nodes.bench_processes import processes

NAMES = ("tilt_0", "tilt_p10", "tilt_m10")
REPEATS = 5


def files(folder: Path) -> list[str]:
    """What each kind of file takes, and its size."""
    long = [simulate(load_scene(name, ["run.after_latch=null"])) for name in NAMES]
    assert all(len(run.samples) == 20_001 for run in long)
    short = [simulate(load_scene(name)) for name in NAMES]
    opened = open_runs(NAMES, None)
    rows = []
    for what, make, path in (
        ("`.rrd` of three runs of 20 s at 1 kHz", lambda p: save_rrd(long, p), folder / "a.rrd"),
        ("picture of one run", lambda p: save(draw_run(short[1]), p), folder / "a.png"),
        ("picture of the three", lambda p: save(draw_overview(short), p), folder / "b.png"),
        ("report of the three", lambda p: save_report(opened, p), folder / "a.html"),
    ):
        took = []
        for _ in range(REPEATS):
            began = time.perf_counter()
            make(path)
            took.append(time.perf_counter() - began)
        spread = f"{min(took):.2f} to {max(took):.2f}"
        size = f"{path.stat().st_size / 1e6:.1f}"
        rows.append([what, f"{Spread.of(took).median:.2f}", spread, size])
    head = ["made", f"median of {REPEATS}, s", "fastest to slowest, s", "size, MB"]
    return [table(head, rows)]


def live(folder: Path, seconds: float) -> list[str]:
    """What a paced run takes with and without the viewer, in shares of a core."""
    rows = []
    for rate in (100.0, 1000.0):
        row = [f"{rate:g}"]
        for viewed in (False, True):
            with processes() as start:
                if viewed:
                    with socket.socket() as probe:
                        probe.bind(("127.0.0.1", 0))
                        port = probe.getsockname()[1]
                    viewer = start("viewer", port=port, exit_when_done="false")
                    viewer.wait_for("waiting for a run")
                changes = f"[run.rate={rate}, run.t_end={seconds}, latch=null]"
                order = ("simulator", "launcher", "capture_detector")
                given = {"scenes": "[tilt_p10]", "overrides": changes}
                suite = Suite(start, folder, order, rtf=1.0, **given)
                if viewed:
                    suite.nodes["viewer"] = viewer
                shares = suite.shares(seconds - 2.0)
                if viewed:
                    viewer.wait_for("shown")
                    viewer.process.send_signal(signal.SIGINT)
                    row.append(f"{shares.pop('viewer'):.1%}")
                row.append(f"{sum(shares.values()):.1%}")
                suite.end()
        rows.append(row)
    return [
        f"tilt_p10 for {seconds:g} s at real time; shares of one core.",
        "",
        table(
            [
                "standard topics, Hz",
                "suite without viewer",
                "viewer and its server",
                "suite beside",
            ],
            rows,
        ),
    ]


def main() -> None:
    asked = arguments(__doc__, ("files", "live"), seconds=(20.0, "of the live run"))
    # the viewer finds the suite in one domain with it
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    compile_kernels()
    page = Page("viewing", asked.dry)
    with tempfile.TemporaryDirectory() as folder:
        if "files" in asked.parts:
            page.write("files", *files(Path(folder)))
        if "live" in asked.parts:
            page.write("live", *live(Path(folder), asked.seconds))


if __name__ == "__main__":
    main()
