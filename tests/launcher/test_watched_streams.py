"""Launches watched by the streams of a bench with real sensors and a busy node, from seeds.

`CAPTURE_SIM_CASES=200` repeats the study of docs/evidence/node_suite.md.
"""

import math

import numpy as np
import pytest
from cases import cases
from disturbed_streams import BUSY, HARD, SENSORS, stream

from capture_sim import load_scene
from capture_sim.detection.measurements import Source
from capture_sim.launcher.state_machine import Launcher, LauncherPhase
from capture_sim.trial.bench_watch import BenchWatch

SCENE = load_scene("tilt_0")
#: By name: a disturbance of the sensors, or of the node that watches.
DISTURBANCES = {
    **SENSORS,
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
SEEDS = range(cases(few=1, all=1))


def watched(seed, outcome, *failure, backlog=0.0, clump=0.0, **disturbance):
    """Return the launcher at the end; it releases at 0 s.

    Poses that arrive up to ``backlog``, s, before that wait for it in the queue; every ``clump``,
    s, the node evaluates what has come since.
    """
    launcher = Launcher(SCENE)
    watch = BenchWatch(launcher, SCENE)
    for arrival, stamp, measured in stream(
        np.random.default_rng(seed), outcome, *failure, **disturbance
    ):
        if Source.CHASER not in measured:
            continue
        evaluated = math.ceil(arrival / clump) * clump if clump else arrival
        if arrival > -backlog:
            evaluated = max(evaluated, 1e-4)
            if launcher.status.state is LauncherPhase.ARMED:
                launcher.release()
                watch.release(0.0)
        watch.add_target(measured[Source.TARGET], evaluated)
        watch.add_chaser(1.2e9 + stamp, measured[Source.CHASER], evaluated)
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
