"""Launches watched by the streams of a bench with real sensors and a busy node, from seeds.

`CAPTURE_SIM_EXAMPLES=200` repeats the study of docs/rig_flows.md.
"""

import math
import os

import numpy as np
import pytest

from capture_sim import load_scene
from capture_sim.launch.bench_watch import BenchWatch
from capture_sim.launch.watch import Launcher, LauncherPhase

SCENE = load_scene("tilt_0")
TARGET, STOP, SPEED, DROP, ASIDE = 0.66, 0.2125, 0.105, 0.1, 0.12  # m, m/s: as of the fake rig
RETURNED = 0.4  # speed after a rebound, by that before
BUSY = {"burst_loss": 0.02, "repeated": 0.05, "step_back": 0.02}
STANDARD = {"rate": 120.0, "noise": 5e-5, "moving": 2e-3, "latency": 0.007, "hidden": 0.1}
HARD = {**BUSY, "noise": 3e-4, "moving": 1e-2, "latency": 0.025, "hidden": 0.5}
#: By name: a disturbance of the sensors, or of the node that watches.
DISTURBANCES = {
    "1 % lost": {"loss": 0.01},
    "bursts, repeats, a step back": BUSY,
    "standard": STANDARD,
    "hard, hidden as silence": HARD,
    "hard, hidden as a frozen pose": {**HARD, "lost_as": "frozen"},
    "hard, hidden as NaN": {**HARD, "lost_as": "void"},
    "no noise": {"noise": 0.0},
    "backlog 0.1 s": {**BUSY, "backlog": 0.1},
    "backlog 0.3 s": {**BUSY, "backlog": 0.3},
    "backlog 1 s": {**BUSY, "backlog": 1.0},
    "backlog 3 s": {**BUSY, "backlog": 3.0},
    "backlog 1 s, hard": {**HARD, "backlog": 1.0},
    "first pose 1 s before, backlog 1 s": {**BUSY, "before": 1.0, "backlog": 1.0},
    "evaluated in clumps of 0.2 s": {**BUSY, "clump": 0.2, "backlog": 0.2},
    "let go 1.5 s late": {**BUSY, "late": 1.5},
}
#: By name: share of the planned speed, and where the chaser gets stuck, m.
FAILURES = {"too slow": (0.6, math.inf), "stuck": (1.0, 0.05), "never let go": (0.0, 0.0)}
SEEDS = range(int(os.environ.get("CAPTURE_SIM_EXAMPLES", "1")))


def chaser_at(t, outcome, share, stuck):
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
):
    """Return (arrival, stamp, chaser's pose, target's pose) in the order of arrival, s and m."""
    messages, left, poses, contact = [], 0, None, math.inf
    y = ASIDE if outcome == "missed" else 0.0
    n = round((before + late + 6.0) * rate)
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
        measured = (
            (travel + sigma * dx, y + sigma * dy, noise * turn),
            (TARGET + noise * target_x, noise * target_y, noise * target_turn),
        )
        if is_lost:
            measured = {"silence": None, "void": ((math.nan,) * 3,) * 2, "frozen": poses}[lost_as]
        if measured is None:
            continue
        poses = measured
        stamp = t - step_back * (0.0 <= t - late - 1.0 < 1.0 / rate)
        messages += [(t + delays[k], stamp, *poses)] * (1 + is_twice[k])
    return sorted(messages, key=lambda message: message[0])


def watched(seed, outcome, *failure, backlog=0.0, clump=0.0, **disturbance):
    """Return the launcher at the end; it releases at 0 s.

    Poses that arrive up to ``backlog``, s, before that wait for it in the queue; every ``clump``,
    s, the node evaluates what has come since.
    """
    launcher = Launcher(SCENE)
    watch = BenchWatch(launcher, SCENE)
    for arrival, stamp, chaser, target in stream(
        np.random.default_rng(seed), outcome, *failure, **disturbance
    ):
        evaluated = math.ceil(arrival / clump) * clump if clump else arrival
        if arrival > -backlog:
            evaluated = max(evaluated, 1e-4)
            if launcher.status.state is LauncherPhase.ARMED:
                launcher.release()
                watch.release(0.0)
        watch.add_target(target)
        watch.add_chaser(1.2e9 + stamp, chaser, evaluated)
        if launcher.status.state in (LauncherPhase.DELIVERED, LauncherPhase.ABORTED):
            break
    return launcher


@pytest.mark.parametrize("name", DISTURBANCES)
@pytest.mark.parametrize("outcome", ["captured", "rebound"])
def test_a_launch_to_the_cone_is_delivered(name, outcome):
    wrong = [
        (seed, launcher.status.reason)
        for seed in SEEDS
        for launcher in (watched(seed, outcome, **DISTURBANCES[name]),)
        if launcher.status.state is not LauncherPhase.DELIVERED
    ]
    assert wrong == []


@pytest.mark.parametrize("name", DISTURBANCES)
@pytest.mark.parametrize("failure", ["missed", *FAILURES])
def test_a_launch_that_does_not_reach_the_cone_is_aborted(name, failure):
    outcome, how = ("captured", FAILURES[failure]) if failure in FAILURES else (failure, ())
    not_aborted = [
        seed
        for seed in SEEDS
        if watched(seed, outcome, *how, **DISTURBANCES[name]).status.state
        is not LauncherPhase.ABORTED
    ]
    assert not_aborted == []
