"""Measurements of a bench with disturbed sensors, from seeds: no node, no clock, many in a second.

The bench and its disturbances are those of examples/disturbed_rig.py.
"""

import math

import numpy as np

from capture_sim.detection.measurements import Source

TARGET, STOP, SPEED, DROP, ASIDE = 0.66, 0.2125, 0.105, 0.1, 0.12  # m, m/s
RETURNED, STROKE, PUSH = 0.4, 0.003, 0.1  # speed after a rebound by that before; m; s
BUSY = {"burst_loss": 0.02, "repeated": 0.05, "step_back": 0.02}
STANDARD = {"rate": 120.0, "noise": 5e-5, "moving": 2e-3, "latency": 0.007, "hidden": 0.1}
HARD = {**BUSY, "noise": 3e-4, "moving": 1e-2, "latency": 0.025, "hidden": 0.5}
#: Disturbances of the sensors by name.
SENSORS = {
    "1 % lost": {"loss": 0.01},
    "bursts, repeats, a step back": BUSY,
    "standard": STANDARD,
    "hard, hidden as silence": HARD,
    "hard, hidden as a frozen pose": {**HARD, "lost_as": "frozen"},
    "hard, hidden as NaN": {**HARD, "lost_as": "void"},
    "no noise": {"noise": 0.0},
}
#: Time of the contact, s after the release.
CONTACT = 2.0 * DROP / SPEED + (STOP - DROP) / SPEED


def chaser_at(t, outcome, share=1.0, stuck=math.inf):
    """Return the travel (m) at t s after the chaser was let go."""
    if t <= 0.0 or share == 0.0:
        return 0.0
    speed, sinking = share * SPEED, 2.0 * DROP / (share * SPEED)
    ramp = min(t, sinking)
    travel = 0.5 * speed * ramp * ramp / sinking + speed * (t - ramp)
    if travel >= STOP <= stuck and outcome != "missed":
        return STOP - (RETURNED * (travel - STOP) if outcome == "rebound" else 0.0)
    return min(travel, stuck)


def stream(
    rng,
    outcome,
    share=1.0,
    stuck=math.inf,
    *,
    rate=100.0,
    noise=1e-5,
    moving=0.0,
    latency=0.0,
    loss=0.0,
    burst_loss=0.0,
    repeated=0.0,
    step_back=0.0,
    hidden=0.0,
    lost_as="silence",
    late=0.0,
    before=4.0,
    duration=6.0,
):
    """Return (arrival, stamp, values by source) in the order of arrival, s, m and rad."""
    messages, left, poses, contact = [], 0, None, math.inf
    y = ASIDE if outcome == "missed" else 0.0
    n = round((before + late + duration) * rate)
    noises = rng.normal(0.0, 1.0, (n, 6)) * (2 * (1.0, 1.0, math.sqrt(2.0) / 0.15))
    delays = np.maximum(0.0, rng.normal(latency, latency / 6.0, n))
    shares = np.array([[loss], [repeated], [burst_loss / 12.5]])
    is_single, is_twice, is_burst = rng.random((3, n)) < shares
    for k in range(n):
        t = k / rate - before
        travel = chaser_at(t - late, outcome, share, stuck)
        if outcome != "missed" and travel >= STOP - 1e-9:
            contact = min(contact, t)
        left = rng.integers(5, 21) if is_burst[k] else left - 1
        is_lost = left > 0 or 0.0 <= t - contact < hidden or is_single[k]
        sigma = math.hypot(noise, moving * SPEED * (0.0 < travel < STOP))
        dx, dy, turn, target_x, target_y, target_turn = noises[k].tolist()
        push = STROKE * max(0.0, math.sin(math.pi * min(1.0, max(t - contact, 0.0) / PUSH)))
        measured = (
            (travel + push + sigma * dx, y + sigma * dy, noise * turn),
            (TARGET + noise * target_x, noise * target_y, noise * target_turn),
        )
        if is_lost:
            measured = {"silence": None, "void": ((math.nan,) * 3,) * 2, "frozen": poses}[lost_as]
        stamp = t - step_back * (0.0 <= t - late - 1.0 < 1.0 / rate)
        if measured is not None:
            poses = measured
            seen = dict(zip((Source.CHASER, Source.TARGET), measured, strict=True))
            messages += [(t + delays[k], stamp, seen)] * (1 + is_twice[k])
        messages.append((t + delays[k], t, {Source.BUFFER: (-push, 0.0)}))
    return sorted(messages, key=lambda message: message[0])
