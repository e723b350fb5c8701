"""Restitution, energy and load of a rig in the loop; writes docs/hardware_checked.md.

.venv/bin/python -m benchmarks.hardware_in_the_loop    # ten minutes, in one process
"""

from __future__ import annotations

import math

from benchmarks.pages import table, write_parts
from capture_sim.hardware.law import WallLaw
from capture_sim.hardware.loop import METHODS
from capture_sim.hardware.rig import Cell, Rig, Servo, Transport
from tests.plate import (
    MASS,
    SCENE,
    WIDE,
    close,
    close_often,
    plate_law,
    predicted_restitution,
    response_of,
)

SERVOS = {"100 Hz": 100.0, "10 Hz": 10.0}
WALLS = (("soft", 0.2), ("hard", 0.02))  # duration of an elastic touch, s
DELAYS = (0.0005, 0.002, 0.005, 0.02)  # s, of the servo
LIMITS = WIDE._replace(energy=1.0, force=2000.0, latency=0.1)


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
                        row += cells(loop, why, servo, duration, true)
                    rows.append(row)
        head = ["wall", "delay ms"]
        for name in SERVOS:
            head += [f"{name}: lag / T", "e / rig's e", "energy mJ", "rig N"]
        parts += [f"**{method}**", "", table(head, rows), ""]
    return [
        f"A plate against {MASS:.2f} kg at 0.1 m/s, in one process at 1 kHz. Soft and hard: an",
        "elastic touch lasts T = 200 ms and 20 ms; dissipative: e = 0.5. Rig: load cell and",
        "transport with their defaults, wall 20 um nearer than the scene's, servo of 100 Hz and of",
        "10 Hz; the delay is the servo's. `model` starts with half the stiffness, and its row is",
        "the second touch; the others' is the first. Energy: the most that vehicles, buffer and",
        "law had above their energy at the touch; energy_limit 1 J, force_limit 2000 N.",
        "",
        *parts,
    ]


def cells(loop, why, servo, duration, true):
    """Return the four cells of a run: lag over duration, restitution, energy, load."""
    lag = f"{servo.lag / duration:.2f}"
    load = f"{loop.rig_peak_force:.0f}"
    energy = f"{1e3 * loop.energy.excess:.3g}"
    if why or not loop.touches:
        reason = why.partition(": ")[2].partition(" = ")[0] if why else "no touch"
        return [lag, f"stops: {reason}" if why else reason, energy, load]
    return [lag, f"{loop.touches[0].restitution / true:.3f}", energy, load]


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
                for method in METHODS:
                    loop, why = touch(method, duration, true, servo, offset, int(ratio * 100))
                    points[method].append(point(loop, why, name, ratio, true))
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
Touches with e = 1 and 0.3, the wall 20 um nearer or farther. Each cell: how many were
within 5 % of the rig's restitution; of the others, how many the loop stopped at, or reported
as not held or not known.

{table(head, rows)}""".splitlines()


def point(loop, why, name, ratio, true):
    """Return servo, lag over duration, e, error of the restitution, and whether it is reported."""
    touches = loop.touches
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
            expected = predicted_restitution(duration, response_of(rig, loop.latency, lag))
            whole = servo.lag + loop.latency + 1e-3
            row = [name, f"{whole / duration:.3f}", method]
            measured = loop.touches[0].restitution if loop.touches else math.nan
            rows.append([*row, f"{measured:.3f}", f"{expected:.3f}"])
    return table(["servo", "whole lag / T", "method", "measured e", "predicted e"], rows).split(
        "\n"
    )


if __name__ == "__main__":
    parts = {"methods": methods, "map": map_of_methods, "closed_forms": closed_forms}
    write_parts("hardware_checked", __doc__, parts, untimed=parts)
