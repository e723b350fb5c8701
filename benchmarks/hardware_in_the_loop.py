"""What the loop's delay does to a contact; writes it into docs/hardware_in_the_loop.md.

    .venv/bin/python benchmarks/hardware_in_the_loop.py

Takes about a minute.  Uses ROS_DOMAIN_ID, or 60.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.machine import processor
from capture_sim import load_scene
from capture_sim.hardware.contact_rig import ContactRig, bounce_with_delay, gain_rate

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE, PICTURE = DOCS / "hardware_in_the_loop.md", DOCS / "hardware_in_the_loop.svg"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"

STIFFNESS = 2000.0  # N/m, of the soft plate
STEP = 1e-3  # s
LAGS = (0, 1, 2, 5, 10, 20)
TOUCHED = 50  # first step in touch: 5 mm before the plate at 0.1 m/s


def plate_mass(scene):
    """Return the mass that the plate feels: the chaser head on, the target off its centre."""
    off = scene.initial.target.y - scene.initial.chaser.y
    yields = 1.0 / scene.chaser_total_mass + 1.0 / scene.target.mass
    return 1.0 / (yields + off**2 / scene.target.inertia)


def soft(lines, points):
    """The soft plate, loop closed in one process."""
    scene = load_scene("_loop")
    mass = plate_mass(scene)
    w = math.sqrt(STIFFNESS / mass)
    rig = ContactRig(scene, STIFFNESS)
    lines += [
        f"**Soft plate**, {STIFFNESS:g} N/m against {mass:.2f} kg at 0.1 m/s: a touch of "
        f"{math.pi / w * 1e3:.0f} ms. Loop closed in one process, steps of 1 ms; the delay is that "
        "of the answer and half a step.",
        "",
        "| delay ms | restitution | exp(pi w tau / 2) | energy made mJ | (pi/2) k tau v^2 / w mJ |",
        "|---|---|---|---|---|",
    ]
    for lag in LAGS:
        tau = (lag + 0.5) * STEP
        got = bounce_with_delay(scene, rig, lag * STEP, STEP, 1.0, 40, mass)
        made = 0.5 * math.pi * STIFFNESS * tau * got.approach_speed**2 / w
        lines.append(
            f"| {tau * 1e3:g} | {got.restitution:.4f} | {math.exp(math.pi * w * tau / 2):.4f} "
            f"| {got.work * 1e3:.3g} | {made * 1e3:.3g} |"
        )
        points.append(("soft plate, one process", tau * w / math.pi, got.restitution))


def over_dds(lines, points):
    """The soft plate, through two processes and DDS, in real time."""
    scene = load_scene("_loop")
    mass = plate_mass(scene)
    w = math.sqrt(STIFFNESS / mass)
    lines += [
        "",
        "**The same through DDS**: two processes, 1 kHz, real time. `lag` is how many messages the "
        "rig answers late on purpose; a trip is the time from a place sent to its answer, the "
        "delay the mean age of the wrench when it was used (weighted with v^2, as it counts) and "
        "half a step. Of three runs the one with the middle delay.",
        "",
        "| lag | trip ms: p50 | p99 | steps late | delay ms | restitution | exp(pi w tau / 2) |",
        "|---|---|---|---|---|---|---|",
    ]
    for lag in LAGS:
        runs = [through_nodes(lag=lag, mass=mass, timeout=0.1) for _ in range(3)]
        found, tau = sorted(((run, delay_of(run)) for run in runs), key=lambda item: item[1])[1]
        trips = np.array(found["round_trips"]) * 1e3
        trip = [f"{np.percentile(trips, p):.2f}" if lag == 0 else "" for p in (50, 99)]
        e = math.sqrt(1.0 + found["bounce"]["work"] / found["bounce"]["energy"])
        lines.append(
            f"| {lag} | {trip[0]} | {trip[1]} | {found['late_steps']} | {tau * 1e3:.2f} "
            f"| {e:.4f} | {math.exp(math.pi * w * tau / 2):.4f} |"
        )
        points.append(("soft plate, DDS", tau * w / math.pi, e))


def delay_of(found):
    """Return the delay that counted while in touch, s."""
    steps = round(found["bounce"]["duration"] / STEP)
    weights = np.cos(np.pi * np.arange(steps) / steps) ** 2
    ages = found["ages"][TOUCHED : TOUCHED + steps]
    return float(np.average(ages, weights=weights)) + 0.5 * STEP


def stiff(lines, points):
    """The paper's contact."""
    scene = load_scene("paper_designed")
    rig = ContactRig(scene, scene.contact_stiffness, 1.5)
    base = bounce_with_delay(scene, rig, 0.0, 1e-7, 0.005, 1)
    g = gain_rate(1.5)
    lines += [
        "",
        f"**The paper's contact**, Hertz of aluminium on aluminium (elastic here): its first touch "
        f"lasts {base.duration * 1e3:.3f} ms with {base.peak_force:.0f} N. In one process:",
        "",
        f"| delay us | delay / duration | restitution | exp({g:.2f} tau / T) | peak N |",
        "|---|---|---|---|---|",
    ]
    for step, lag in ((1e-6, 0), (1e-6, 5), (1e-6, 20), (1e-6, 50), (1e-5, 10), (1e-4, 1)):
        tau = (lag + 0.5) * step
        got = bounce_with_delay(scene, rig, lag * step, step, 0.02, max(1, round(step / 1e-6)))
        lines.append(
            f"| {tau * 1e6:g} | {tau / base.duration:.3g} | {got.restitution:.4g} "
            f"| {math.exp(g * tau / base.duration):.4g} | {got.peak_force:.0f} |"
        )
        points.append(("paper's contact, one process", tau / base.duration, got.restitution))
    at_1_khz = bounce_with_delay(scene, rig, 0.0, STEP, 0.02, 1000)
    found = through_nodes(
        scene="paper_designed",
        rig={"stiffness": scene.contact_stiffness, "exponent": 1.5},
    )
    lines += [
        "",
        f"At 1 kHz, answered at once, {at_1_khz.peak_force:.0f} N come back, and the tip leaves "
        f"{at_1_khz.restitution:.0f} times as fast as it came. Through DDS, with the default limit "
        f"of 500 N: `{found['stopped']}`.",
    ]


def through_nodes(*, scene="_loop", lag=0, mass=0.0, timeout=0.02, rig=None):
    """Close the loop through two nodes; return their report."""
    environment = dict(os.environ)
    environment.setdefault("ROS_DOMAIN_ID", "60")
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        environment["ROS_LOG_DIR"] = folder

        def start(name, **parameters):
            arguments = [f"-p{key}:={value}" for key, value in parameters.items()]
            return subprocess.Popen(
                [sys.executable, "-m", f"capture_sim.nodes.{name}", "--ros-args"]
                + [part for a in arguments for part in ("-p", a[2:])],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )

        other = start("contact_rig", scene=scene, lag=lag, **(rig or {}))
        try:
            time.sleep(1.0)
            loop = start("loop_simulator", scene=scene, mass=mass, timeout=timeout, report=report)
            loop.wait(120.0)
        finally:
            other.send_signal(signal.SIGINT)
            other.wait(20.0)
        return json.loads(report.read_text(encoding="utf-8"))


def draw(points):
    """Draw restitution over delay / duration."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "capture_sim"
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 4.0), layout="constrained")
    ratio = np.geomspace(1e-3, 0.5, 100)
    axes.loglog(ratio, np.exp(gain_rate(1.0) * ratio) - 1, "k-", lw=1, label="exp(4.93 tau/T) - 1")
    axes.loglog(ratio, np.exp(gain_rate(1.5) * ratio) - 1, "k--", lw=1, label="exp(5.57 tau/T) - 1")
    for name, marker in (
        ("soft plate, one process", "o"),
        ("soft plate, DDS", "x"),
        ("paper's contact, one process", "s"),
    ):
        chosen = [(x, e - 1.0) for what, x, e in points if what == name]
        axes.loglog(*zip(*chosen, strict=True), marker, mfc="none", label=name)
    axes.set_xlabel("delay / duration of the touch")
    axes.set_ylabel("restitution - 1 (an elastic contact has 0)")
    axes.grid(which="both", alpha=0.2)
    axes.legend(frameon=False)
    figure.savefig(PICTURE, metadata={"Date": None})


def main():
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dry", action="store_true", help="show, do not write")
    asked = parser.parse_args()
    lines = [f"{processor()}, {os.cpu_count()} cores, shared with other work.", ""]
    points: list[tuple[str, float, float]] = []
    soft(lines, points)
    over_dds(lines, points)
    stiff(lines, points)
    print("\n".join(lines))
    if asked.dry:
        return
    draw(points)
    lines += ["", f"![Restitution against delay]({PICTURE.name})"]
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    PAGE.write_text(before + "\n".join([BEGIN, "", *lines, "", END]) + after, encoding="utf-8")


if __name__ == "__main__":
    main()
