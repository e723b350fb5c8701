"""The rig in software: servo, load cell, walls and transport do what their figures say."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from plate import ideal_rig, plate_scene

from capture_sim.hardware.law import TipState, WallLaw
from capture_sim.hardware.rig import IDEAL, Cell, Rig, Servo, Transport

SCENE = plate_scene()
LAW = WallLaw(2000.0)
STEP = 1e-3


def moved(rig, path, n):
    """Send n positions along a path x(t); return all answers."""
    answers = []
    for k in range(n):
        t = k * STEP
        v = (path(t + 1e-6) - path(t - 1e-6)) / 2e-6
        answers += rig.answer(TipState(t, path(t), 0.045, 0.0, v, 0.0, 0.0))
    return answers


def far(t):
    return -1.0


def test_the_tip_of_a_servo_is_behind_by_its_lag():
    for servo in (Servo(), Servo(100.0, 0.001), Servo(0.0, 0.005)):
        rig = Rig(SCENE, LAW, servo, IDEAL[1], IDEAL[2])
        answer = moved(rig, lambda t: -1.0 + 0.1 * t, 1000)[-1]
        behind = (-1.0 + 0.1 * answer.stamp - answer.tip.x) / 0.1
        # of the commands each is held for a step
        assert behind == pytest.approx(servo.lag, abs=0.6 * STEP)


def test_a_servo_passes_half_the_power_at_its_bandwidth():
    """A second-order system with zeta = 0.7 has its -3 dB there."""
    rig = Rig(SCENE, LAW, Servo(10.0, 0.0, acceleration=1e6), IDEAL[1], IDEAL[2])
    answers = moved(rig, lambda t: -1.0 + 1e-3 * math.sin(2 * math.pi * 10 * t), 2000)
    xs = np.array([answer.tip.x for answer in answers[1000:]]) + 1.0
    assert np.abs(xs).max() == pytest.approx(1e-3 / (2 * 0.7), rel=0.02)


def test_a_servo_saturates():
    rig = Rig(SCENE, LAW, Servo(100.0, 0.0, acceleration=5.0), IDEAL[1], IDEAL[2])
    answers = moved(rig, lambda t: -1.0 if t < 0.01 else -0.9, 60)
    v = np.array([answer.tip.vx for answer in answers])
    assert np.abs(np.diff(v)).max() / STEP == pytest.approx(5.0, rel=1e-6)


def test_the_cell_reads_bias_noise_steps_and_saturates():
    cell = Cell(noise=0.1, bias=0.5, resolution=0.006, force_range=20.0)
    rig = Rig(SCENE, LAW, *IDEAL[:1], cell, IDEAL[2])
    read = np.array([answer.wrench for answer in moved(rig, far, 3000)])
    assert read[:, :3].mean(axis=0) == pytest.approx([0.5] * 3, abs=0.01)
    assert read[:, :3].std(axis=0) == pytest.approx([0.1] * 3, rel=0.05)
    assert read[:, 3:].std(axis=0) == pytest.approx([0.005] * 3, rel=0.2)
    assert read / 0.006 == pytest.approx(np.round(read / 0.006), abs=1e-6)
    stiff = Rig(SCENE, WallLaw(2e5), *IDEAL[:1], cell, IDEAL[2])
    pressed = moved(stiff, lambda t: 0.0, 3)
    assert abs(pressed[-1].wrench.fx) == pytest.approx(20.0, abs=0.006)


def test_the_cell_filters():
    """A step of force through a first order of 50 Hz."""
    rig = Rig(SCENE, LAW, *IDEAL[:1], Cell(50.0, 0.0, 0.0, 0.0, 0.0), IDEAL[2])
    answers = moved(rig, lambda t: -1.0 if t < 0.005 else 0.0, 30)
    final = rig._walls.wrench(LAW, answers[-1].tip).force
    for answer in answers[6:20]:
        since = answer.stamp - 0.005 + 1e-4  # with the servo's step
        expected = final * -math.expm1(-since * 2 * math.pi * 50)
        assert answer.wrench.force == pytest.approx(expected, rel=0.01)


def test_a_wall_has_its_offset():
    deep = [moved(ideal_rig(SCENE, replace(LAW, offset=o)), lambda t: 0.0, 2) for o in (0.0, 1e-5)]
    gained = deep[1][-1].wrench.force - deep[0][-1].wrench.force
    assert gained == pytest.approx(2000.0 * 1e-5, rel=1e-6)


def test_a_hidden_lag_is_in_the_force_and_not_in_stamp_or_tip():
    rig = ideal_rig(SCENE, LAW, hidden_lag=0.004)
    answers = moved(rig, lambda t: -1.0 if t < 0.01 else 0.0, 30)
    first = next(answer for answer in answers if answer.wrench.force > 0.0)
    assert first.stamp == pytest.approx(0.014)
    assert first.tip.t == pytest.approx(first.stamp)


def test_transport_delays_jitters_drops_and_doubles():
    rig = Rig(SCENE, LAW, *IDEAL[:2], Transport(0.005, 0.002, 0.1, 0.1), seed=3)
    latencies, stamps = [], []
    for k in range(4000):
        for answer in rig.answer(TipState(k * STEP, -1.0, 0.045, 0.0, 0.0, 0.0, 0.0)):
            latencies.append(k * STEP - answer.stamp)
            stamps.append(answer.stamp)
    assert min(latencies[1:]) >= 0.005 - 1e-9
    assert np.std(latencies) == pytest.approx(0.0012, rel=0.2)  # of a half normal, in steps
    assert len(set(stamps)) == pytest.approx(3600, rel=0.02)
    assert len(stamps) - len(set(stamps)) == pytest.approx(360, rel=0.2)
    assert any(b < a for a, b in itertools.pairwise(stamps))


def test_the_first_position_is_answered_as_often_as_it_comes():
    rig = Rig(SCENE, LAW)
    rest = TipState(0.0, -0.02, 0.045, 0.0, 0.1, 0.0, 0.0)
    answers = [rig.answer(rest) for _ in range(100)]
    assert all(len(some) == 1 and some[0].stamp == 0.0 for some in answers)
    assert len({some[0].wrench for some in answers}) > 90
