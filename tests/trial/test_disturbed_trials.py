"""Trials on disturbed sensors: detector and trial are fed with one stream, on a simulated clock.

`CAPTURE_SIM_CASES=100` repeats the study of docs/evidence/node_suite.md.
"""

import itertools
import math

import numpy as np
import pytest
from cases import cases
from disturbed_streams import CONTACT, SENSORS, stream

from capture_sim import load_scene
from capture_sim.detection.detector import CaptureDetector
from capture_sim.detection.measurements import Source
from capture_sim.launcher.state_machine import Launcher
from capture_sim.trial.interlocks import Interlocks, TrialLimits
from capture_sim.trial.trial import Trial, TrialGoal, TrialPhase

SCENE = load_scene("tilt_0")
SEEDS = range(cases(few=1, all=2))
TOPICS = {source: (source.value,) for source in Source}


def tried(seed, outcome, *how, end=None, offset=0.0, **disturbance):
    """Return the trial and the detector's last status after 12 s.

    ``end``: source and time, s, when it falls silent; ``offset``: of the buffer's clock, s.
    """
    # a chaser that is to miss starts aside
    interlocks = Interlocks(TrialLimits(time_limit=10.0), TOPICS, waived=["start"])
    interlocks.readers.note(["/driver"], {}, -math.inf)
    messages = stream(np.random.default_rng(seed), outcome, *how, before=3.0, **disturbance)
    trial = Trial(
        TrialGoal("a trial"), SCENE, Launcher(SCENE), interlocks, has_actuator=True, now=-3.0
    )
    detector = CaptureDetector(SCENE, is_released=False)
    now, held_at = -3.0, math.inf
    for arrival, stamp, measured in messages:
        # held, the chaser of a bench does what nobody knows
        now = max(now, arrival)
        if trial.failure:
            break
        for source, values in measured.items():
            if end is not None and source is end[0] and stamp > end[1]:
                continue
            own = stamp + 1.2e9 + offset * (source is Source.BUFFER)
            interlocks.add(source.value, round(own * 1e9), values, now)
            if source is Source.BUFFER:
                trial.add_buffer(source.value, *values)
            else:
                trial.add_pose(source, source.value, round(own * 1e9), values, now)
            for status in detector.measure(source, round(own * 1e9), values, round(now * 1e9)):
                trial.add_verdict(status.state.label, status.reason, is_final=status.final)
        # the other nodes join as the stream's release is due
        trial.set_others(ready=now >= 0.0, done=False, pending="")
        trial.advance(now)
        if trial.holds and trial.is_released:
            held_at = min(held_at, now)
    return trial, detector.finish()[-1], held_at


def longest_silence(seed, outcome, **disturbance):
    """Return the longest time without a new pose before the contact, s."""
    messages = stream(np.random.default_rng(seed), outcome, before=3.0, **disturbance)
    poses = [(t, m[Source.CHASER]) for t, _, m in messages if Source.CHASER in m]
    new = [t for t, pose in poses if math.isfinite(pose[0]) and 0.0 < t < CONTACT + 0.5]
    return max(later - earlier for earlier, later in itertools.pairwise(new))


#: Each of the sensors, and each of the outcomes, at least once.
OUTCOMES = [*itertools.product(SENSORS, ["captured", "rebound", "missed"])]


@pytest.mark.parametrize("name, outcome", cases(few=OUTCOMES[::2], all=OUTCOMES))
def test_the_verdict_is_that_of_the_bench(name, outcome):
    for seed in SEEDS:
        trial, last, _ = tried(seed, outcome, **SENSORS[name])
        if "no measurement" in trial.failure or "last measurement" in trial.failure:
            # bursts of losses follow each other: the approach was blind for 0.3 s
            assert longest_silence(seed, outcome, **SENSORS[name]) > 0.29
            continue
        assert (trial.verdict, trial.failure) == (outcome, ""), (seed, last.reason)
        assert last.state.label == outcome
        since = last.t - 1.2e9 - last.time_in_state
        assert (
            CONTACT - 0.5 < since < CONTACT + 1.2
        )  # hidden for 0.5 s, and the delay of the smoothing
        assert trial.phase >= TrialPhase.DECIDED


#: Share of the speed, and travel at which the chaser sticks, m.
FAILURES = [(0.6, math.inf), (1.0, 0.05), (0.0, 0.0)]
FAILED_LAUNCHES = [*itertools.product(FAILURES, ["standard", "hard, hidden as NaN", "no noise"])]


@pytest.mark.parametrize("how, name", cases(few=FAILED_LAUNCHES[::4], all=FAILED_LAUNCHES))
def test_a_launch_that_fails_is_held(name, how):
    for seed in SEEDS:
        trial, _, held_at = tried(seed, "captured", *how, **SENSORS[name])
        assert trial.failure
        assert trial.is_released
        assert held_at < 5.0


@pytest.mark.parametrize("source", [Source.CHASER, Source.TARGET])
@pytest.mark.parametrize("when", [0.5, 1.0, 2.0])
def test_cameras_that_die_under_way_hold_the_chaser(source, when):
    trial, _, held_at = tried(0, "captured", end=(source, when), **SENSORS["standard"])
    assert f"{source.value}: last measurement 0.3" in trial.failure
    assert when + 0.3 < held_at < when + 0.4


def test_encoders_that_die_under_way_leave_no_verdict():
    trial, last, _ = tried(0, "captured", end=(Source.BUFFER, 1.0))
    assert trial.failure == ""
    assert last.state.label == "undecided"


def test_clocks_that_differ_leave_no_verdict():
    _, last, _ = tried(0, "captured", offset=0.4)
    assert last.state.label == "undecided"
    assert "0.4" in last.reason or "400" in last.reason
