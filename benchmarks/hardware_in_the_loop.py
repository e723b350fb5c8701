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
from capture_sim.hardware.closed_loop import Loop, close, late
from capture_sim.hardware.compensation import compensation, critical_damping
from capture_sim.hardware.contact_rig import ContactRig, gain_rate
from capture_sim.hardware.in_the_loop import LoopStage
from capture_sim.hardware.walls import NOTHING, WallLaw

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE = DOCS / "hardware_in_the_loop.md"
PICTURE = DOCS / "hardware_in_the_loop.svg"
COMPENSATED = DOCS / "hardware_in_the_loop_compensated.svg"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"

STIFFNESS = 2000.0  # N/m, of the soft plate
STEP = 1e-3  # s
LAGS = (0, 1, 2, 5, 10, 20)
TOUCHED = 50  # first step in touch: 5 mm before the plate at 0.1 m/s
WAYS = ("none", "passivity", "hybrid", "prediction1", "prediction2", "model")


def plate_mass(scene):
    """Return the mass that the plate feels: the chaser head on, the target off its centre."""
    off = scene.initial.target.y - scene.initial.chaser.y
    yields = 1.0 / scene.chaser_total_mass + 1.0 / scene.target.mass
    return 1.0 / (yields + off**2 / scene.target.inertia)


def first_touch(scene, law, lag, step, t_end, substeps, mass=None):
    """Close the loop in one process, a rig that answers ``lag`` steps late; its first touch."""
    loop = Loop(LoopStage(scene, step, substeps), mass=mass)
    close(loop, late(ContactRig(scene, law).wrench, lag), t_end, touches=1)
    return loop.touches[0]


def soft(lines, points):
    """The soft plate, loop closed in one process."""
    scene = load_scene("_loop")
    mass = plate_mass(scene)
    w = math.sqrt(STIFFNESS / mass)
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
        got = first_touch(scene, WallLaw(STIFFNESS), lag, STEP, 1.0, 40, mass)
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
        runs = [
            through_nodes({"lag": lag}, {"mass": mass, "timeout": 0.1, "energy_limit": 1.0})
            for _ in range(3)
        ]
        found, tau = sorted(((run, delay_of(run)) for run in runs), key=lambda item: item[1])[1]
        trips = np.array(found["round_trips"]) * 1e3
        trip = [f"{np.percentile(trips, p):.2f}" if lag == 0 else "" for p in (50, 99)]
        e = math.sqrt(1.0 + found["touches"][0]["work"] / found["touches"][0]["energy"])
        lines.append(
            f"| {lag} | {trip[0]} | {trip[1]} | {found['late_steps']} | {tau * 1e3:.2f} "
            f"| {e:.4f} | {math.exp(math.pi * w * tau / 2):.4f} |"
        )
        points.append(("soft plate, DDS", tau * w / math.pi, e))


def delay_of(found):
    """Return the delay that counted while in touch, s."""
    steps = round(found["touches"][0]["duration"] / STEP)
    weights = np.cos(np.pi * np.arange(steps) / steps) ** 2
    ages = found["ages"][TOUCHED : TOUCHED + steps]
    return float(np.average(ages, weights=weights)) + 0.5 * STEP


def stiff(lines, points, dds):
    """The paper's contact."""
    scene = load_scene("paper_designed")
    law = WallLaw(scene.contact_stiffness, 1.5)
    base = first_touch(scene, law, 0, 1e-7, 0.005, 1)
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
        got = first_touch(scene, law, lag, step, 0.02, max(1, round(step / 1e-6)))
        lines.append(
            f"| {tau * 1e6:g} | {tau / base.duration:.3g} | {got.restitution:.4g} "
            f"| {math.exp(g * tau / base.duration):.4g} | {got.peak_force:.0f} |"
        )
        points.append(("paper's contact, one process", tau / base.duration, got.restitution))
    at_1_khz = first_touch(scene, law, 0, STEP, 0.02, 1000)
    found = through_nodes(paper_rig(scene), {"scene": "paper_designed"}) if dds else {}
    lines += [
        "",
        f"At 1 kHz, answered at once, {at_1_khz.peak_force:.0f} N come back, and the tip leaves "
        f"{at_1_khz.restitution:.0f} times as fast as it came. Through DDS, with the default limit "
        f"of 500 N: `{found.get('stopped', 'not run')}`.",
    ]


def paper_rig(scene):
    """Return the parameters of a rig with the paper's contact."""
    return {"scene": "paper_designed", "stiffness": scene.contact_stiffness, "exponent": 1.5}


class Case:
    """A contact, met again and again, to compare the ways on."""

    def __init__(self, name, scene, law, *, mass=None, shots):
        self.name, self.scene, self.law, self.mass, self.shots = name, scene, law, mass, shots
        exact = Loop(LoopStage(scene, STEP / 20, 40), mass=mass)
        exact.stage.take_law(law, gated=False)
        close(exact, lambda k, place: (place.t, NOTHING), 1.0 if shots else 0.1)
        self.exact = exact
        self.felt = mass or 2.0 * exact.touches[0].energy / exact.touches[0].approach_speed ** 2

    def run(self, way, lag):
        """Return restitution over the model's, energy made (mJ), peak force and impulse so."""
        chosen = compensation(way)
        law = WallLaw(0.5 * self.law.stiffness, self.law.exponent)  # the model's guess is half
        delay = (lag + 0.5) * STEP
        if chosen.hybrid:
            law = WallLaw(0.0, drag=critical_damping(self.felt, self.law.stiffness, delay))
        for _ in range(4 if self.shots and chosen.model else 1):
            loop = Loop(LoopStage(self.scene, STEP, 40), chosen, law, mass=self.mass)
            channel = late(ContactRig(self.scene, self.law).wrench, lag)
            close(loop, channel, 1.0 + 4 * delay if self.shots else 0.1)
            law = loop.fit.law if chosen.model else law
        if not loop.touches:
            return None
        nth = 3 if chosen.model and not self.shots else 0
        touch, true = loop.touches[nth], self.exact.touches[nth]
        if self.shots:  # what chatters is one touch
            ratio = parting(loop) / parting(self.exact)
            made = loop.stage.work - self.exact.stage.work
            impulse = sum(touch.impulse for touch in loop.touches) / true.impulse
        else:
            ratio = touch.restitution / true.restitution
            made = touch.work - true.work * touch.energy / true.energy
            impulse = touch.impulse / touch.approach_speed * true.approach_speed / true.impulse
        power = 2.0 * self.law.exponent / (self.law.exponent + 1.0)
        speeds = true.approach_speed / touch.approach_speed
        peak = max(touch.peak_force for touch in loop.touches) if self.shots else touch.peak_force
        return ratio, 1e3 * made, peak / true.peak_force * speeds**power, impulse


def parting(loop):
    """Return the vehicles' speed apart, m/s."""
    return loop.stage.v[5] - loop.stage.v[0]


def ways(lines, points):
    """What each way makes of each contact and delay."""
    slow = load_scene("_loop", ["initial.chaser.vx=0.02", "buffer.k_A=1e7"])
    paper = load_scene("paper_designed")
    mass = plate_mass(slow)
    cases = [
        Case("plate, 235 ms", slow, WallLaw(2e3), mass=mass, shots=True),
        Case(
            "plate that loses, 240 ms",
            slow,
            WallLaw(2e3, damping=0.3 * 2e3 / 0.02),
            mass=mass,
            shots=True,
        ),
        Case("plate, 23.5 ms", slow, WallLaw(2e5), mass=mass, shots=True),
        Case("rubber, 2.4 ms", paper, WallLaw(3.3e5), shots=False),
        Case("the paper's, 0.33 ms", paper, WallLaw(paper.contact_stiffness, 1.5), shots=False),
    ]
    lines += [
        "",
        "**What is done against it**, in one process at 1 kHz. Each cell: restitution over the "
        "model's (of the vehicles' speeds apart for the plates, of the touch's energy for the "
        "others) / energy made, mJ / peak force over the model's / impulse over the model's. "
        "`hybrid` has the damper of the critical delay; `model` begins with half the stiffness, "
        "its cell is the fourth touch, that of the others the first. Plates at 0.02 m/s, the "
        "others at 0.1 m/s. `no end`: the touch had not ended after 0.1 s.",
        "",
        "| contact | delay ms | " + " | ".join(WAYS) + " |",
        "|---|---|" + "---|" * len(WAYS),
    ]
    for case in cases:
        for lag in (0, 2, 5, 20) + ((234,) if case.exact.touches[0].duration > 0.1 else ()):
            cells = []
            for way in WAYS:
                found = case.run(way, lag)
                if found is None:
                    cells.append("no end")
                    continue
                cells.append("{:.3g} / {:.2g} / {:.3g} / {:.3g}".format(*found))
                delay = (lag + 0.5) * STEP
                points.append((way, delay / case.exact.touches[0].duration, abs(found[0] - 1.0)))
            lines.append(f"| {case.name} | {lag + 0.5:g} | " + " | ".join(cells) + " |")


def ways_over_dds(lines):
    """A few of them through two processes and DDS."""
    scene, paper = load_scene("_loop"), load_scene("paper_designed")
    lines += [
        "",
        "**Through DDS**, two processes at 1 kHz in real time, the first touches' restitution "
        "(1 is the model's) and the median age of the wrench:",
        "",
        "| contact | compensation | age ms | restitution of the touches |",
        "|---|---|---|---|",
    ]
    soft_loop = {"mass": plate_mass(scene), "timeout": 0.1, "energy_limit": 1.0}
    stiff_loop = {
        "scene": "paper_designed",
        "overrides": "[run.t_end=0.15]",
        "timeout": 0.1,
        "force_limit": 1e5,
        "stiffness": 0.5 * paper.contact_stiffness,
    }
    for way in ("none", "passivity", "prediction2", "model"):
        guess = {"stiffness": 0.5 * STIFFNESS, "exponent": 1.0}
        found = through_nodes({"lag": 5}, {**soft_loop, **guess, "compensation": way})
        lines.append(dds_row("soft plate, 5 messages late", way, found))
    for way in ("passivity", "model"):
        found = through_nodes(paper_rig(paper), {**stiff_loop, "compensation": way})
        lines.append(dds_row("the paper's", way, found))


def dds_row(contact, way, found):
    """Return a line of the table."""
    touched = [
        f"{math.sqrt(max(1.0 + touch['work'] / touch['energy'], 0.0)):.3f}"
        for touch in found["touches"][:6]
    ]
    age = np.median(found["ages"]) * 1e3
    return f"| {contact} | {way} | {age:.1f} | {', '.join(touched)} {found['stopped']} |"


def through_nodes(rig, loop):
    """Close the loop through two nodes with these parameters; return the loop's report."""
    environment = dict(os.environ)
    environment.setdefault("ROS_DOMAIN_ID", "60")
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        environment["ROS_LOG_DIR"] = folder

        def start(name, parameters):
            given = [f"{key}:={value}" for key, value in parameters.items()]
            return subprocess.Popen(
                [sys.executable, "-m", f"capture_sim.nodes.{name}", "--ros-args"]
                + [part for value in given for part in ("-p", value)],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )

        other = start("contact_rig", rig)
        try:
            time.sleep(1.0)
            start("loop_simulator", {**loop, "report": report}).wait(120.0)
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


def draw_ways(points):
    """Draw how far each way is from the model's restitution, over delay / duration."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "capture_sim"
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 4.0), layout="constrained")
    for way, marker in zip(WAYS, "osv^Dx", strict=True):
        chosen = sorted((x, max(error, 1e-5)) for what, x, error in points if what == way)
        axes.loglog(*zip(*chosen, strict=True), marker, mfc="none", label=way)
    axes.axhline(0.05, color="k", lw=0.8, ls=":")
    axes.set_xlabel("delay / duration of the touch")
    axes.set_ylabel("|restitution / the model's - 1|")
    axes.grid(which="both", alpha=0.2)
    axes.legend(frameon=False)
    figure.savefig(COMPENSATED, metadata={"Date": None})


def main():
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dry", action="store_true", help="show, do not write")
    parser.add_argument("--one-process", action="store_true", help="without the nodes")
    asked = parser.parse_args()
    lines = [f"{processor()}, {os.cpu_count()} cores, shared with other work.", ""]
    points: list[tuple[str, float, float]] = []
    soft(lines, points)
    compared: list[tuple[str, float, float]] = []
    if not asked.one_process:
        over_dds(lines, points)
    stiff(lines, points, dds=not asked.one_process)
    ways(lines, compared)
    if not asked.one_process:
        ways_over_dds(lines)
    print("\n".join(lines))
    if asked.dry:
        return
    draw(points)
    draw_ways(compared)
    lines += [
        "",
        f"![Restitution against delay]({PICTURE.name})",
        "",
        f"![Restitution of each way against delay]({COMPENSATED.name})",
    ]
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    PAGE.write_text(before + "\n".join([BEGIN, "", *lines, "", END]) + after, encoding="utf-8")


if __name__ == "__main__":
    main()
