"""What a delay does to a contact, and each compensation; into docs/hardware_in_the_loop.md.

.venv/bin/python -m benchmarks.hardware_in_the_loop    # two minutes, half of it through nodes
"""

from __future__ import annotations

import json
import math
import signal
import time

import numpy as np

from benchmarks.pages import DOCS, table, write_parts
from capture_sim import load_scene
from capture_sim.errors import CaptureSimError
from capture_sim.hardware.closed_loop import Loop, close, late
from capture_sim.hardware.compensation import WAYS, compensation, critical_damping, gain_rate
from capture_sim.hardware.in_the_loop import LoopStage
from capture_sim.hardware.walls import NOTHING, WallLaw, contact_rig
from capture_sim.viewing.canvas import new_figure, save
from tests.nodes.bench_processes import processes
from tests.plate import first_touch, plate_mass

STIFFNESS = 2000.0  # N/m, of the soft plate
STEP = 1e-3  # s
LAGS = (0, 1, 2, 5, 10, 20)
TOUCHED = 50  # first step in touch: 5 mm before the plate at 0.1 m/s


def delays(asked, _):
    """Both contacts without compensation, in one process."""
    scene, paper = load_scene("_loop"), load_scene("paper_designed")
    mass = plate_mass(scene)
    w, rows, points = math.sqrt(STIFFNESS / mass), [], []
    for lag in LAGS:
        tau = (lag + 0.5) * STEP
        got = first_touch(scene, WallLaw(STIFFNESS), lag, STEP, 1.0, 40, mass)
        made = 0.5 * math.pi * STIFFNESS * tau * got.approach_speed**2 / w
        expected = math.exp(math.pi * w * tau / 2)
        row = f"{tau * 1e3:g} {got.restitution:.4f} {expected:.4f}"
        rows.append([*row.split(), f"{got.work * 1e3:.3g}", f"{made * 1e3:.3g}"])
        points.append(("soft plate", tau * w / math.pi, got.restitution - 1.0))
    head = "delay ms|restitution|exp(pi w tau / 2)|energy made mJ|(pi/2) k tau v^2 / w mJ"
    soft = table(head.split("|"), rows)
    law, g, rows = WallLaw(paper.contact_stiffness, 1.5), gain_rate(1.5), []
    base = first_touch(paper, law, 0, 1e-7, 0.005, 1)
    for step, lag in ((1e-6, 0), (1e-6, 5), (1e-6, 20), (1e-6, 50), (1e-5, 10), (1e-4, 1)):
        tau = (lag + 0.5) * step
        ratio = tau / base.duration
        got = first_touch(paper, law, lag, step, 0.02, max(1, round(step / 1e-6)))
        row = f"{tau * 1e6:g} {ratio:.3g} {got.restitution:.4g} {math.exp(g * ratio):.4g}"
        rows.append([*row.split(), f"{got.peak_force:.0f}"])
        points.append(("paper's contact", ratio, got.restitution - 1.0))
    head = f"delay us|delay / duration|restitution|exp({g:.2f} tau / T)|peak N"
    at_1_khz = first_touch(paper, law, 0, STEP, 0.02, 1000)
    ratio = np.geomspace(1e-3, 0.5, 100)
    lines = [(f"exp({g:.2f} tau/T) - 1", ratio, np.exp(g * ratio) - 1) for g in (4.93, 5.57)]
    ylabel = "restitution - 1 (an elastic contact has 0)"
    if not asked.dry:
        draw("hardware_in_the_loop.svg", points, lines, ylabel)
    return f"""\
**Soft plate**, {STIFFNESS:g} N/m against {mass:.2f} kg at 0.1 m/s: a touch of \
{math.pi / w * 1e3:.0f} ms. Loop closed in one process, steps of 1 ms; the delay is that of the \
answer and half a step.

{soft}

**The paper's contact**, Hertz of aluminium on aluminium (elastic here): its first touch lasts
{base.duration * 1e3:.3f} ms with {base.peak_force:.0f} N.

{table(head.split("|"), rows)}

At 1 kHz, answered at once, {at_1_khz.peak_force:.0f} N come back, and the tip leaves \
{at_1_khz.restitution:.0f} times as fast as it came.

![Restitution against delay](hardware_in_the_loop.svg)""".splitlines()


class Case:
    """A contact, met again and again, to compare the ways on."""

    def __init__(self, name, scene, law, mass=None):
        self.name, self.scene, self.law, self.mass = name, scene, law, mass
        self.t_end = 1.0 if mass else 0.1  # a plate is met once
        self.exact = Loop(LoopStage(scene, STEP / 20, 40), mass=mass)
        self.exact.stage.take_law(law, gated=False)
        close(self.exact, lambda k, place: (place.t, NOTHING), self.t_end)
        touch = self.exact.touches[0]
        self.duration, self.felt = touch.duration, 2.0 * touch.energy / touch.approach_speed**2

    def run(self, way, lag):
        """Return restitution over the model's, energy made (mJ), peak force and impulse so."""
        chosen, delay = compensation(way), (lag + 0.5) * STEP
        law = self.law._replace(stiffness=0.5 * self.law.stiffness, damping=0.0)  # a guess
        if chosen.hybrid:
            linear = self.felt * (math.pi / self.duration) ** 2
            law = WallLaw(0.0, drag=critical_damping(self.felt, linear, delay))
        for _ in range(4 if self.mass and chosen.model else 1):
            loop = Loop(LoopStage(self.scene, STEP, 40), chosen, law, mass=self.mass)
            channel = late(contact_rig(self.scene, self.law), lag)
            close(loop, channel, self.t_end + (4 * delay if self.mass else 0.0))
            law = loop.fit.law if chosen.model else law
        nth = 3 if chosen.model and not self.mass else 0
        touch, true = loop.touches[nth], self.exact.touches[nth]
        speeds = true.approach_speed / touch.approach_speed
        if self.mass:  # what chatters is one touch
            ratio, made = parting(loop) / parting(self.exact), loop.work - self.exact.work
            impulse = sum(touch.impulse for touch in loop.touches) / true.impulse
            peak = max(touch.peak_force for touch in loop.touches)
        else:
            ratio, peak = touch.restitution / true.restitution, touch.peak_force
            made = touch.work - true.work / speeds**2
            impulse = touch.impulse / true.impulse * speeds
        power = 2.0 * self.law.exponent / (self.law.exponent + 1.0)
        return ratio, 1e3 * made, peak / true.peak_force * speeds**power, impulse


def parting(loop):
    """Return the vehicles' speed apart, m/s."""
    return loop.stage.v[5] - loop.stage.v[0]


def ways(asked, _):
    """What each way makes of each contact and delay, in one process."""
    slow = load_scene("_loop", ["initial.chaser.vx=0.02", "buffer.k_A=1e7"])
    paper, mass = load_scene("paper_designed"), plate_mass(slow)
    cases = [
        Case("plate, 235 ms", slow, WallLaw(2e3), mass),
        Case("plate that loses, 240 ms", slow, WallLaw(2e3, damping=0.3 * 2e3 / 0.02), mass),
        Case("plate, 23.5 ms", slow, WallLaw(2e5), mass),
        Case("rubber, 2.4 ms", paper, WallLaw(3.3e5)),
        Case("the paper's, 0.33 ms", paper, WallLaw(paper.contact_stiffness, 1.5)),
    ]
    rows, points = [], []
    for case in cases:
        for lag in (0, 2, 5, 20) + ((234,) if case.duration > 0.1 else ()):
            row = [case.name, f"{lag + 0.5:g}"]
            for way in WAYS:
                try:
                    found = case.run(way, lag)
                except CaptureSimError:
                    row.append("refused")
                except IndexError:
                    row.append("no end")
                else:
                    row.append("{:.3g} / {:.2g} / {:.3g} / {:.3g}".format(*found))
                    ratio = (lag + 0.5) * STEP / case.duration
                    points.append((way, ratio, max(abs(found[0] - 1.0), 1e-5)))
            rows.append(row)
    ylabel = "|restitution / the model's - 1|"
    lines = [("5 %", [1e-3, 100.0], [0.05, 0.05])]
    if not asked.dry:
        draw("hardware_in_the_loop_compensated.svg", points, lines, ylabel)
    return f"""\
Each cell: restitution over the model's (of the vehicles' speeds apart for the plates, of the
touch's energy for the others) / energy made, mJ / peak force over the model's / impulse over the
model's. `hybrid` has the damper of the critical delay; `model` begins with half the stiffness, its
cell is the fourth touch, that of the others the first. Plates at 0.02 m/s, the others at 0.1 m/s.
`no end`: the touch had not ended after 0.1 s; `refused`: so large a damper cannot be integrated.

{table(["contact", "delay ms", *WAYS], rows)}

![Restitution of each way against delay](hardware_in_the_loop_compensated.svg)""".splitlines()


def nodes(_, folder):
    """Through two processes and DDS, 1 kHz, real time."""
    scene, paper = load_scene("_loop"), load_scene("paper_designed")
    mass = plate_mass(scene)
    LoopStage(scene)  # compiles the kernels, which the nodes would take for a silent rig
    w = math.sqrt(STIFFNESS / mass)
    plate = {"mass": mass, "timeout": 0.1, "energy_limit": 1.0, "stiffness": 0.5 * STIFFNESS}
    plate["exponent"] = 1.0
    stiff = {"scene": "paper_designed", "stiffness": paper.contact_stiffness, "exponent": 1.5}
    half = {"stiffness": 0.5 * paper.contact_stiffness, "overrides": "[run.t_end=0.15]"}
    runs = [("soft plate", "none", {"lag": lag}, plate) for lag in LAGS]
    for way in ("passivity", "prediction2", "model"):
        runs.append(("soft plate", way, {"lag": 5}, plate))
    for way in ("none", "passivity", "model"):
        limits = {} if way == "none" else {"timeout": 0.1, "force_limit": 1e5}
        runs.append(("the paper's", way, stiff, {"scene": "paper_designed", **half, **limits}))
    rows = []
    for contact, way, rig, loop in runs:
        loop = {**loop, "compensation": way}
        tried = [through_nodes(folder / "report.json", rig, loop) for _ in range(3)]
        found = sorted(tried, key=lambda run: np.median(run["ages"]))[1]
        trip = np.array(found["round_trips"]) * 1e3
        times = [f"{np.median(found['ages']) * 1e3:.1f}", f"{np.median(trip):.2f}"]
        restitutions = ", ".join(f"{touch['restitution']:.3f}" for touch in found["touches"][:4])
        tau = delay_of(found) if contact == "soft plate" and found["touches"] else math.nan
        foretold = f"{math.exp(math.pi * w * tau / 2):.3f}" if way == "none" and tau > 0.0 else ""
        late_steps = f"{found['late_steps']} of {found['steps']}"
        outcome = f"{restitutions} {found['stopped']}"
        rows.append([contact, rig.get("lag", 0), way, *times, late_steps, outcome, foretold])
    head = "contact|lag|compensation|age ms|trip ms|steps late|restitution of the touches|foretold"
    return f"""\
Two processes, 1 kHz, real time; medians, of three runs the one with the middle age. `lag`: how many
messages the rig answers late on purpose; age: of the wrench when it was used; trip: from a place
sent to its answer; foretold: exp(pi w tau / 2) with the mean age, weighted with v^2 as it counts,
and half a step. An elastic contact has 1.

{table(head.split("|"), rows)}""".splitlines()


def delay_of(found):
    """Return the delay that counted while in touch, s."""
    steps = round(found["touches"][0]["duration"] / STEP)
    ages = found["ages"][TOUCHED : TOUCHED + steps]
    weights = np.cos(np.pi * np.arange(len(ages)) / steps) ** 2
    return float(np.average(ages, weights=weights)) + 0.5 * STEP


def through_nodes(report, rig, loop):
    """Close the loop through two nodes with these parameters; return the loop's report."""
    with processes() as start:
        partner = start("contact_rig", **rig)
        time.sleep(1.0)
        start("loop_simulator", **loop, report=report).status(120.0)
        partner.process.send_signal(signal.SIGINT)
        partner.status(20.0)
    return json.loads(report.read_text(encoding="utf-8"))


def draw(name, points, lines, ylabel):
    """Draw points and lines (name, x, y) over delay / duration."""
    figure = new_figure(6.0, 4.0)
    axes = figure.subplots()
    for (label, x, y), style in zip(lines, ("k-", "k--"), strict=False):
        axes.loglog(x, y, style, lw=1, label=label)
    for what, marker in zip(dict.fromkeys(point[0] for point in points), "osv^Dx", strict=False):
        of_it = sorted(point[1:] for point in points if point[0] == what)
        axes.loglog(*zip(*of_it, strict=True), marker, mfc="none", label=what)
    axes.set_xlabel("delay / duration of the touch")
    axes.set_ylabel(ylabel)
    axes.grid(which="both", alpha=0.2)
    axes.legend(frameon=False)
    save(figure, DOCS / name)


if __name__ == "__main__":
    write_parts("hardware_in_the_loop", __doc__, {"delays": delays, "ways": ways, "nodes": nodes})
