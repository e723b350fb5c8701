"""Restitution, energy and load of a rig in the loop; writes docs/evidence/hardware_checked.md.

python -m benchmarks.hardware_in_the_loop    # half an hour, in one process
"""

from __future__ import annotations

import math
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np

from benchmarks.pages import table, write_parts
from capture_sim import load_scene, simulate
from capture_sim.hardware.law import WallLaw
from capture_sim.hardware.loop import METHODS, N_AT_REST, Loop
from capture_sim.hardware.pacing import LoopPacer, request_priority
from capture_sim.hardware.rig import Cell, Rig, Servo, Transport
from capture_sim.hardware.stage import LoopStage
from tests.plate import (
    MASS,
    SCENE,
    STEP,
    WIDE,
    close,
    close_often,
    ideal_rig,
    plate_law,
    predicted_restitution,
    response_of,
    restitution_on,
    vehicles_restitution,
)

SERVOS = {"100 Hz": 100.0, "10 Hz": 10.0}
WALLS = (("soft", 0.2), ("hard", 0.02))  # duration of an elastic touch, s
DELAYS = (0.0005, 0.002, 0.005, 0.02)  # s, of the servo
LIMITS = replace(WIDE, energy=1.0, force=2000.0, latency=0.1)


def touch(method, duration, true, servo, offset=2e-5, seed=0):
    """Return the loop of the touch that counts (the second with model), and why it stopped."""
    law, t_end = plate_law(MASS, duration, true, offset), 0.35 + 3.0 * duration
    cell = Cell(force_range=5000.0)

    def rig(number):
        return Rig(SCENE, law, servo, cell, Transport(), seed=2 * seed + number)

    guess = WallLaw(0.5 * law.stiffness)
    if method == "model":
        return close_often(2, guess, rig, t_end, LIMITS)[-1]
    return close(SCENE, rig(0), method, guess, LIMITS, t_end)


def methods(_, __):
    """Each method on four walls at five delays, with both servos."""
    parts = []
    for method in METHODS:
        rows = []
        for kind, true in (("elastic", 1.0), ("dissipative", 0.5)):
            for name, duration in WALLS:
                for delay in DELAYS:
                    row = [f"{name}, {kind}", f"{delay * 1e3:g}"]
                    for bandwidth in SERVOS.values():
                        servo = Servo(bandwidth, delay)
                        loop, why = touch(method, duration, true, servo)
                        row += cells(loop, why, servo, duration, vehicles_on(duration, true))
                    rows.append(row)
        head = ["wall", "delay ms"]
        for name in SERVOS:
            head += [f"{name}: lag / T", "e / rig's e", "energy mJ", "rig N"]
        parts += [f"**{method}**", "", table(head, rows), ""]
    return [
        f"A plate against {MASS:.2f} kg at 0.1 m/s, in one process at 1 kHz. Soft and hard: an",
        "elastic touch lasts T = 200 ms and 20 ms; dissipative: e = 0.5. Rig: load cell and",
        "transport with their defaults, wall 20 um nearer than the scene's, servo of 100 Hz and of",
        "10 Hz; the delay is the servo's. `model` starts with half the stiffness; its rows show",
        "the second touch, the rows of the other methods the first. Energy: largest increase of",
        "the energy of vehicles, buffer and law over its lowest value before the contact;",
        "energy_limit 1 J, force_limit 2000 N. The rig's e is simulated with the same vehicles",
        "on its wall.",
        "",
        *parts,
    ]


def vehicles_on(duration, true, offset=2e-5):
    """Return the restitution of the vehicles on the rig's wall, simulated without a rig."""
    return restitution_on(plate_law(MASS, duration, true, offset), 0.35 + 3.0 * duration)


def cells(loop, why, servo, duration, true):
    """Return the four cells of a run: lag over duration, restitution, energy, load."""
    lag = f"{servo.lag / duration:.2f}"
    load = f"{loop.contact.peak_force:.0f}"
    energy = f"{1e3 * loop.energy_excess:.3g}"
    if why or not loop.episodes:
        reason = why.partition(": ")[2].partition(" = ")[0] if why else "no touch"
        return [lag, f"stops: {reason}" if why else reason, energy, load]
    return [lag, f"{loop.episodes[0].restitution / true:.3f}", energy, load]


def map_of_methods(_, __):
    """Over lag and duration: where each method is within 5 %, and whether the loop says so."""
    points, offset = {method: [] for method in METHODS}, 2e-5
    for name, servo in (("100 Hz, 1 ms", Servo(100.0, 0.001)), ("10 Hz, 10 ms", Servo())):
        for ratio in (0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 1.3, 2.0):
            duration = servo.lag / ratio
            if duration > 0.25:  # deeper than the plate's 15 mm
                continue
            for true in (1.0, 0.3):
                offset = -offset if true < 1.0 else offset
                expected = vehicles_on(duration, true, offset)
                for method in METHODS:
                    loop, why = touch(method, duration, true, servo, offset, int(ratio * 100))
                    points[method].append(point(loop, why, name, ratio, expected))
    rows = []
    for method, found in points.items():
        for name in dict.fromkeys(p[0] for p in found):
            row = [method, name]
            for low, high in ((0.0, 0.1), (0.1, 0.35), (0.35, 1.0), (1.0, 3.0)):
                some = [p for p in found if p[0] == name and low < p[1] <= high]
                good = sum(p[3] <= 0.05 for p in some)
                reported = sum(p[4] for p in some if p[3] > 0.05)
                row.append(f"{good} of {len(some)}; {reported} of {len(some) - good}")
            rows.append(row)
    head = ["method", "servo", "lag / T <= 0.1", "0.1 to 0.35", "0.35 to 1", "1 to 2"]
    return f"""\
Touches with e = 1 and 0.3, the wall 20 um nearer or farther. Each cell: number of touches
within 5 % of the rig's restitution; number of the others at which the loop stopped, or which
it reported as not held or not known.

{table(head, rows)}""".splitlines()


def point(loop, why, name, ratio, true):
    """Return servo, lag over duration, e, error of the restitution, and whether it is reported."""
    touches = loop.episodes
    if why or not touches:
        return name, ratio, true, math.inf, bool(why)
    error = abs(touches[0].restitution / true - 1.0)
    return name, ratio, true, error, touches[0].is_held is not True


def closed_forms(_, __):
    """Measured against predicted, elastic plates through the standard rig."""
    rows = []
    for name, servo, duration in (
        ("100 Hz, 1 ms", Servo(100.0, 0.001), 0.2),
        ("100 Hz, 1 ms", Servo(100.0, 0.001), 0.05),
        ("100 Hz, 1 ms", Servo(100.0, 0.001), 0.02),
        ("10 Hz, 10 ms", Servo(), 0.25),
    ):
        law = plate_law(MASS, duration)
        for method in ("none", "prediction"):
            rig = Rig(SCENE, law, servo, Cell(force_range=5000.0), Transport())
            loop, _ = close(SCENE, rig, method, limits=LIMITS, t_end=0.35 + 3.0 * duration)
            lag = loop.lag if method == "prediction" else None
            expected = predicted_restitution(duration, response_of(rig, loop.lags.latency, lag))
            whole = servo.lag + loop.lags.latency + 1e-3
            row = [name, f"{whole / duration:.3f}", method]
            measured = loop.episodes[0].restitution if loop.episodes else math.nan
            rows.append([*row, f"{measured:.3f}", f"{expected:.3f}"])
    return table(["servo", "whole lag / T", "method", "measured e", "predicted e"], rows).split(
        "\n"
    )


def conditions(_, __):
    """Eighty random rigs under the conditions of the page: the second contact with model."""
    rng, rows, shares = np.random.default_rng(5), [], []
    for number in range(80):
        servo = (Servo(100.0, 0.001), Servo(50.0, 0.002), Servo())[number % 3]
        duration = 0.0
        while not 0.005 <= duration <= 0.25:
            ratio = math.exp(rng.uniform(math.log(0.02), 0.0))
            duration = servo.lag / ratio
        law = plate_law(MASS, duration, rng.uniform(0.3, 1.0), rng.choice([-2e-5, 2e-5]))
        t_end = 0.35 + 3.0 * duration
        expected = restitution_on(law, t_end)
        loops = close_often(
            2,
            WallLaw(0.5 * law.stiffness),
            lambda k, law=law, servo=servo, n=number: Rig(
                SCENE, law, servo, Cell(force_range=5000.0), Transport(), seed=2 * n + k
            ),
            t_end,
            replace(LIMITS, force=5000.0),
        )
        errors = [
            math.inf if why else abs(vehicles_restitution(loop.stage) / expected - 1.0)
            for loop, why in loops
        ]
        shares.append((ratio, *errors))
    for low, high in ((0.0, 0.1), (0.1, 0.2), (0.2, 1.0)):
        some = [entry for entry in shares if low < entry[0] <= high]
        within = [sum(entry[k] <= 0.05 for entry in some) for k in (1, 2)]
        rows.append([f"{low:g} to {high:g}", *(f"{n} of {len(some)}" for n in within)])
    head = ["servo lag / T", "first contact", "second contact"]
    return [
        "Contacts within 5 % of the vehicles on the rig's wall; T from 5 to 250 ms, e from 0.3 to",
        "1, servos of 10, 50 and 100 Hz, wall 20 um nearer or farther. The first law is elastic",
        "and has half the wall's stiffness.",
        "",
        table(head, rows),
    ]


def engine(_, __):
    """Error and cost of a step of the vehicles."""
    changes = ["contact.restitution=1.0", "friction.law=none"]
    scene = load_scene("paper_designed", changes)
    stage = LoopStage(scene)
    stage.set_law(WallLaw(scene.contact_stiffness, 1.5))
    times = []
    for _ in range(400):
        begin = time.perf_counter()
        stage.take_step()
        times.append(1e6 * (time.perf_counter() - begin))
    exact = simulate(scene, t_end=0.4, rtol=1e-12)
    error = float(np.abs(stage.q - exact.q[-1]).max())
    loop = Loop(LoopStage(SCENE), "model", plate_law(MASS, 0.05), WIDE)
    rig, whole = ideal_rig(SCENE, plate_law(MASS, 0.05), 0.001), []
    for _ in range(N_AT_REST):
        loop.receive(*rig.answer(loop.pose)[0])
    loop.begin()
    while loop.t < 0.5:
        begin = time.perf_counter()
        loop.advance()
        whole.append(1e6 * (time.perf_counter() - begin))
        for answer in rig.answer(loop.pose):
            loop.receive(*answer)
    rows = [
        [
            "vehicles with a law, paper_designed",
            *(f"{q:.0f}" for q in np.percentile(times, (50, 99))),
        ],
        ["loop with model", *(f"{q:.0f}" for q in np.percentile(whole, (50, 99)))],
    ]
    return [
        f"Error of the coordinates after 0.4 s against rtol 1e-12: {error:.1e} m and rad.",
        "",
        table(["a step of 1 ms", "p50 us", "p99 us"], rows),
    ]


def intervals(_, __):
    """Intervals of the positions of a paced loop in a process, with and without a priority."""
    rows = []
    for priority in (0, 50):
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            refused, gaps, late = pool.submit(paced, priority).result()
        name = f"SCHED_FIFO {priority}" if priority else "ordinary"
        values = [f"{1e3 * q:.3f}" for q in (*np.percentile(gaps, (50, 99)), max(gaps), min(gaps))]
        rows.append([name + (", not granted" if refused else ""), *values, f"{late:.1%}"])
    return table(
        ["process", "p50 ms", "p99 ms", "largest ms", "least ms", "late steps"], rows
    ).split("\n")


def paced(priority, seconds=10.0):
    """Return why a priority was refused, intervals (s) at 1 kHz, and the share of late ones."""
    rig = ideal_rig(SCENE, plate_law(MASS, 0.05), 0.001)
    loop = Loop(LoopStage(SCENE), "model", plate_law(MASS, 0.05), WIDE)
    for _ in range(N_AT_REST):
        loop.receive(*rig.answer(loop.pose)[0])
    loop.begin()
    refused = request_priority(priority) if priority else ""
    pacer, sent = LoopPacer(STEP, 10.0, 1.0), []
    while loop.t < seconds:
        time.sleep(pacer.time_to_work())
        loop.advance()
        pacer.work_done()
        time.sleep(pacer.time_to_send())
        pacer.release()
        sent.append(time.monotonic())
        for answer in rig.answer(loop.pose):
            loop.receive(*answer)
    return refused, np.diff(sent), pacer.late_share


if __name__ == "__main__":
    parts = {
        "methods": methods,
        "map": map_of_methods,
        "conditions": conditions,
        "closed_forms": closed_forms,
        "engine": engine,
        "intervals": intervals,
    }
    untimed = set(parts) - {"engine", "intervals"}
    write_parts("hardware_checked", __doc__, parts, untimed=untimed)
