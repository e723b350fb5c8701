"""Whether a chaser stands, by noisy poses, and whether it stops once it is held."""

import itertools
import random

import pytest

from capture_sim.trial.standstill import MAX_DRIFT, N_NEWEST, WINDOW, HeldWatch, Standstill

RATE = 100.0  # Hz


def watched(speed, *, sigma=0.0, turn=0.0, wild=0.0, duration=2.0, rate=RATE, seed=0):
    """Return the watch of a chaser that moves at a speed, m/s, and turns, rad/s."""
    rng, watch = random.Random(seed), Standstill()
    for k in range(round(duration * rate)):
        t = k / rate
        x = rng.gauss(speed * t, sigma) + (0.02 if rng.random() < wild else 0.0)
        watch.add((x, rng.gauss(0.0, sigma), rng.gauss(turn * t, sigma)), t)
    return watch, (round(duration * rate) - 1) / rate


@pytest.mark.parametrize("rate", [10.0, 100.0, 1000.0])
@pytest.mark.parametrize("sigma", [0.0, 3e-4, 1e-3])
def test_a_chaser_that_stands_stands_in_noise(sigma, rate):
    for seed in range(20):
        watch, now = watched(0.0, sigma=sigma if rate > 10.0 else 0.3 * sigma, rate=rate, seed=seed)
        assert watch.stands(now), watch.motion(now)


@pytest.mark.parametrize("sigma", [0.0, 3e-4, 1e-3])
def test_one_that_moves_or_turns_does_not(sigma):
    for seed, speed in itertools.product(range(20), (0.015, -0.05, 0.1)):
        watch, now = watched(speed, sigma=sigma, seed=seed)
        assert not watch.stands(now)
        assert "moves by" in watch.motion(now)
    assert not watched(0.0, turn=0.1)[0].stands(1.99)


def test_wild_poses_are_no_motion_and_no_poses_are_no_standstill():
    for seed in range(20):
        watch, now = watched(0.0, wild=0.1, seed=seed)
        assert watch.stands(now)
    assert not Standstill().stands(0.0)
    watch, now = watched(0.0)
    assert not watch.stands(now + 1.0)  # the cameras have lost it
    assert watch.motion(now + 1.0) == ""


def followed(position, duration, *, timeout=3.0, hole=(0.0, 0.0)):
    """Hold a chaser at t = 0 whose position, m, is a function of time; return alarms by time.

    No poses arrive between the ends of the ``hole``, s.
    """
    watch, held, alarms = Standstill(), HeldWatch(timeout), []
    held.let_go((0.0, 0.0, 0.0))
    for k in range(-100, round(duration * RATE)):
        t = k / RATE
        if not hole[0] < t < hole[1]:
            watch.add((position(t), 0.0, 0.0), t)
        if k == 0:
            held.hold(t)
        held.update(watch, t)
        alarms.append((t, held.alarm))
    return alarms


def test_a_chaser_that_stops_and_is_pulled_back_alarms_nobody():
    """Braked in 0.2 s, pulled back from 1 s on for longer than the timeout."""
    alarms = followed(lambda t: 0.1 * min(t, 0.2) - 0.05 * max(t - 1.0, 0.0), 8.0)
    assert {text for _, text in alarms} == {""}


def test_a_driver_that_ignores_the_hold_is_an_alarm_until_its_chaser_is_back():
    def position(t):
        if t < 5.0:
            return 0.1 * t  # rolls on
        return 0.5 if t < 7.0 else max(0.5 - 0.2 * (t - 7.0), 0.0)  # stands away, pulled back

    alarms = followed(position, 12.0)
    begin = min(t for t, text in alarms if text)
    end = max(t for t, text in alarms if text)
    assert begin == pytest.approx(3.0, abs=0.02)
    assert 9.5 - 0.3 < end < 9.5 + 0.7  # at its start, and not where it stood for 2 s
    [text] = {text for _, text in alarms} - {""}
    assert "its driver does not hold it" in text


def test_the_limit_of_a_steady_motion_is_that_from_the_first_third_to_the_newest_poses():
    seconds = WINDOW * 5.0 / 6.0 - 0.5 * N_NEWEST / RATE
    for share, stands in ((0.9, True), (1.1, False)):
        watch, now = watched(share * MAX_DRIFT / seconds)
        assert watch.stands(now) is stands


@pytest.mark.parametrize("rate", [30.0, 90.0, 200.0])
@pytest.mark.parametrize("speed", [0.2, 0.5, 1.5])
def test_one_that_is_pushed_stands_for_three_more_poses_at_most(rate, speed):
    """As somebody pulls the chaser back in the moment of a release."""
    for seed in range(20):
        rng, watch, stood = random.Random(seed), Standstill(), []
        pushed = 1.0 + rng.uniform(0.0, 1.0) / rate
        for k in range(round(2.0 * rate)):
            t = k / rate
            watch.add((rng.gauss(speed * max(t - pushed, 0.0), 1e-5), 0.0, 0.0), t)
            if watch.stands(t):
                stood.append(t)
        assert max(stood) < pushed + 3.0 / rate + MAX_DRIFT / speed


@pytest.mark.parametrize("hole", [(2.5, 3.2), (0.0, 6.0)])
def test_a_dropout_of_poses_at_the_timeout_delays_the_alarm(hole):
    alarms = followed(lambda t: 0.1 * t, 8.0, hole=hole)
    begin = min(t for t, text in alarms if text)
    assert hole[1] < begin < hole[1] + WINDOW + 0.1
