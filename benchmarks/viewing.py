"""What looking at runs costs: rerun files, pictures, the report, the live viewer.

    .venv/bin/python benchmarks/viewing.py             # about three minutes
    .venv/bin/python benchmarks/viewing.py --seconds 6 # a shorter live run

Writes docs/viewing.md.  The live part starts the real nodes at real time, with and without the
viewer, and reads from the operating system what their processes took.
"""

import argparse
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.machine import clock_rate, describe
from capture_sim import load_scene, simulate
from capture_sim.bench import compile_kernels
from capture_sim.commands.inputs import open_runs
from capture_sim.viewing.canvas import save
from capture_sim.viewing.plots import draw_overview, draw_run
from capture_sim.viewing.report import save_report
from capture_sim.viewing.rerun_view import save_rrd

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "viewing.md"
NAMES = ("tilt_0", "tilt_p10", "tilt_m10")
REPEATS = 5
TICK = os.sysconf("SC_CLK_TCK")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="of the live run (20)")
    options = parser.parse_args()
    # the viewer finds the suite in one domain with it
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    compile_kernels()
    with tempfile.TemporaryDirectory(prefix="viewing_") as name:
        folder = Path(name)
        files = measure_files(folder)
        live = [measure_live(folder, options.seconds, rate) for rate in (100.0, 1000.0)]
    load = os.getloadavg()[0]
    PAGE.write_text(page(files, live, options.seconds, describe(clock_rate()), load))
    print(PAGE.read_text())


def measure_files(folder):
    """Return rows: what is made, seconds of all repeats, bytes."""
    runs = [simulate(load_scene(name, ["run.after_latch=null"])) for name in NAMES]
    assert all(len(run.samples) == 20_001 for run in runs)
    short = [simulate(load_scene(name)) for name in NAMES]
    opened = open_runs(NAMES, None)
    return [
        timed(
            "`.rrd` of three runs of 20 s at 1 kHz", lambda p: save_rrd(runs, p), folder / "a.rrd"
        ),
        timed("picture of one run", lambda p: save(draw_run(short[1]), p), folder / "a.png"),
        timed("picture of the three", lambda p: save(draw_overview(short), p), folder / "b.png"),
        timed("report of the three", lambda p: save_report(opened, p), folder / "a.html"),
    ]


def timed(what, make, path):
    taken = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        make(path)
        taken.append(time.perf_counter() - began)
    return what, taken, path.stat().st_size


def measure_live(folder, seconds, rate):
    """Return what a paced run takes with and without the viewer, in s of processor time."""
    without = suite(folder, seconds, rate)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    log = folder / "viewer.log"
    with log.open("w") as output:
        viewer = subprocess.Popen(
            [sys.executable, "-m", "capture_sim.nodes.viewer", "--ros-args", "-p", f"port:={port}"],
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        while "waiting for a run" not in log.read_text():
            time.sleep(0.1)
        before = processor_time(viewer.pid)
        beside = suite(folder, seconds, rate)
        spent = [now - was for now, was in zip(processor_time(viewer.pid), before, strict=True)]
    finally:
        viewer.send_signal(signal.SIGINT)
        viewer.wait(20)
    return {
        "rate": rate,
        "node": spent[0],
        "server": spent[1],
        "suite without": without,
        "suite beside": beside,
        "shown": "shown" in log.read_text(),
    }


def suite(folder, seconds, rate):
    """Run the suite at real time; return the processor time of all its nodes, s."""
    program = (
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from capture_sim import load_scene\n"
        "from capture_sim.nodes.supervisor import run_suite\n"
        f"scene = load_scene('tilt_p10', ['run.rate={rate}', 'run.t_end={seconds}', "
        "'run.after_latch=null'])\n"
        f"status = run_suite([scene], Path({str(folder)!r}), record=False, rtf=1.0)\n"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN)\n"
        "print('USED', used.ru_utime + used.ru_stime)\n"
        "sys.exit(status)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return float(done.stdout.rpartition("USED ")[2])


def processor_time(pid):
    """Return the processor time of a process and of its children that live, s."""
    children = [
        int(entry.name)
        for entry in Path("/proc").iterdir()
        if entry.name.isdigit() and parent_of(entry) == pid
    ]
    return ticks(pid), sum(ticks(child) for child in children)


def parent_of(entry):
    try:
        return int((entry / "stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def ticks(pid):
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK


def page(files, live, seconds, machine, load):
    lines = [
        "# What looking at runs costs",
        "",
        "Made by `benchmarks/viewing.py`.",
        "",
        f"| made | median of {REPEATS}, s | fastest to slowest, s | size, MB |",
        "|---|---|---|---|",
    ]
    for what, taken, size in files:
        median = statistics.median(taken)
        spread = f"{min(taken):.2f} to {max(taken):.2f}"
        lines.append(f"| {what} | {median:.2f} | {spread} | {size / 1e6:.1f} |")
    lines += [
        "",
        f"Live: tilt_p10 for {seconds:g} s at real time, BenchState at 1 kHz, the viewer at its",
        "defaults (50 instants a second, 10 pictures a second, 64 MB). Shares are of one core.",
        "",
        "| other topics, Hz | viewer node | its server | suite without viewer | suite beside it "
        "| added by viewing |",
        "|---|---|---|---|---|---|",
    ]
    for one in live:
        assert one["shown"]

        def share(s):
            return f"{100.0 * s / seconds:.1f} %"

        added = one["node"] + one["server"] + one["suite beside"] - one["suite without"]
        lines.append(
            f"| {one['rate']:g} | {share(one['node'])} | {share(one['server'])} "
            f"| {share(one['suite without'])} | {share(one['suite beside'])} | {share(added)} |"
        )
    lines += [
        "",
        "The suite's shares hold its start (compiled kernels, DDS) too, which differs from run to",
        "run.",
        "",
        f"*{machine['date']}, {machine['cores']} cores {machine['processor']}, "
        f"{machine['clock under load']}, Python {machine['Python']}, load average {load:.1f}.*",
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
