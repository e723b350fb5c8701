"""What looking at runs costs: rerun files, plots, the report, the live viewer.

    python -m benchmarks.viewing             # about three minutes
    python -m benchmarks.viewing live --seconds 6

Writes the parts of docs/evidence/node_suite.md.  The live part runs the real nodes at real time,
with and without the viewer, and reads from the operating system what their processes took.
"""

from __future__ import annotations

import signal
import socket
from argparse import Namespace
from pathlib import Path

from benchmarks.node_suite import Suite
from benchmarks.pages import Spread, repeated, table, write_parts
from capture_sim import load_scene, simulate
from capture_sim.commands.recordings import RecordingReader
from capture_sim.viewing.canvas import save
from capture_sim.viewing.plots import draw_overview, draw_run
from capture_sim.viewing.report import save_report
from capture_sim.viewing.rerun_view import save_rrd
from tests.nodes.bench_processes import processes

NAMES = ("tilt_0", "tilt_p10", "tilt_m10")
REPEATS = 5


def files(_: Namespace, folder: Path) -> list[str]:
    """What each kind of file takes, and its size."""
    long = [simulate(load_scene(name, ["run.after_latch=null"])) for name in NAMES]
    assert all(len(run.samples) == 20_001 for run in long)
    short = [simulate(load_scene(name)) for name in NAMES]
    opened = RecordingReader().runs(NAMES)
    rows = []
    for what, make, path in (
        ("`.rrd` of three runs of 20 s at 1 kHz", lambda p: save_rrd(long, p), folder / "a.rrd"),
        ("plot of one run", lambda p: save(draw_run(short[1]), p), folder / "a.png"),
        ("plot of three runs", lambda p: save(draw_overview(short), p), folder / "b.png"),
        ("report of three runs", lambda p: save_report(opened, p), folder / "a.html"),
    ):
        took = repeated(lambda make=make, path=path: make(path), REPEATS)
        spread = f"{min(took):.2f} to {max(took):.2f}"
        size = f"{path.stat().st_size / 1e6:.1f}"
        rows.append([what, f"{Spread.of(took).median:.2f}", spread, size])
    head = ["file", f"median of {REPEATS}, s", "fastest to slowest, s", "size, MB"]
    return [table(head, rows)]


def live(asked: Namespace, folder: Path) -> list[str]:
    """What a paced run takes with and without the viewer, in shares of a core."""
    rows, seconds = [], asked.seconds
    for rate in (100.0, 1000.0):
        row = [f"{rate:g}"]
        for viewed in (False, True):
            with processes() as start:
                if viewed:
                    with socket.socket() as probe:
                        probe.bind(("127.0.0.1", 0))
                        port = probe.getsockname()[1]
                    viewer = start("viewer", port=port)
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
    head = ["standard topics, Hz", "nodes without viewer", "viewer and its server", "nodes with it"]
    return [
        f"tilt_p10 for {seconds:g} s at real time; shares of one core.",
        "",
        table(head, rows),
    ]


if __name__ == "__main__":
    parts = {"files": files, "live_view": live}
    write_parts("node_suite", __doc__, parts, seconds=(20.0, "of the live run"))
