"""Flights past the cone's lip that cross BE's plane beside the throat, at any rate."""

import math

import numpy as np
import pytest
from noisy_replay import Disturbance, disturbed, judge

from capture_sim import load_scene, simulate
from capture_sim.studies.evaluate.outcome import run_to_verdict

CLEAN = Disturbance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
LENGTH = 0.206  # m, from the start to the crossing


def flight(speed, rate, *, beside, slope):
    """Return a scene whose tip crosses BE's plane ``beside`` (m) the axis, at ``slope`` degrees."""
    scene = load_scene("tilt_0")
    reach = scene.buffer.hinge_offset + scene.rest_length
    c, s = math.cos(math.radians(slope)), math.sin(math.radians(slope))
    changes = {
        **{"rail": None, "string": None, "supports": None, "latch": None},
        "initial.target.x": 1.0 + scene.cone.L_T,  # BE's centre is at x = 1
        "initial.chaser.x": 1.0 - reach - LENGTH * c,
        "initial.chaser.y": beside + LENGTH * s,
        "initial.chaser.vx": speed * c,
        "initial.chaser.vy": -speed * s,
        "run.t_end": 2.0 * LENGTH / speed,
        "run.rate": rate,
    }
    return load_scene("tilt_0", changes)


# 50 mm a sample: at the first one behind BE the tip is less than R_c off the axis
@pytest.mark.parametrize(
    "speed, rate", [(0.5, 10.0), (5.0, 100.0), (0.05, 1.0), (0.2, 4.0), (0.1, 2.0)]
)
def test_a_flight_beside_the_throat_is_missed_at_any_rate(speed, rate):
    for finer, noise in ((1, CLEAN), (10, CLEAN), (10, Disturbance(jitter=0.0))):
        scene = flight(speed, rate * finer, beside=0.05, slope=60.0)
        result = simulate(scene)
        assert result.touches.size == 0
        measurements = disturbed(result, noise, np.random.default_rng(0), rate * finer)
        measured, _ = judge(scene, measurements)
        for status in (result.statuses[-1], run_to_verdict(scene), measured):
            assert "off the axis" in status.reason
        verdicts = result.verdict, run_to_verdict(scene).verdict, measured.state.label
        assert set(verdicts) == {"missed"}


def test_a_flight_through_the_throat_is_captured_at_any_rate():
    for rate in (10.0, 100.0, 1000.0):
        result = simulate(flight(0.5, rate, beside=0.0, slope=0.0))
        assert result.verdict == "captured"
        assert result.statuses[-1].reason == "tip passed BE"
