"""At rest means at rest: motions, noise, rates and pushes on both sides of each limit."""

import itertools
import math

import numpy as np
import pytest
from cases import cases

from capture_sim.trial.rest import (
    BUFFER_LIMITS,
    MAX_AGE,
    MAX_GAP,
    POSE_LIMITS,
    SETTLE,
    WINDOW,
    HeldWatch,
    Rest,
)

EXCURSION, SPEED = POSE_LIMITS[0].excursion, POSE_LIMITS[0].speed
RATES = (100.0, 30.0, 10.5)


def still(t):
    return 0.0 * t


def creep(speed):
    return lambda t: speed * t


def swing(amplitude, frequency):
    return lambda t: amplitude * np.sin(2.0 * math.pi * frequency * t)


def sway(t):
    """Fifty millimetres that decay with a time constant of 2 s."""
    return 0.05 * np.exp(-t / 2.0) * np.sin(2.0 * math.pi * 0.7 * t)


def instants(motion, rate, noise, *, axis=0, seed=0, duration=4.0, lag=0.0):
    """Return times, (n,), s, and whether a body is at rest at each by its noisy measurements.

    ``motion``: position, m or rad, of a time; ``axis``: coordinate that moves; ``lag``: of the
    measurements, s.
    """
    rng, rest = np.random.default_rng(seed), Rest()
    times = np.arange(0.0, duration + WINDOW + SETTLE, 1.0 / rate)
    table = rng.normal(0.0, 1.0, (len(times), 3)) * noise
    table[:, axis] += motion(times - lag)
    found = []
    for t, row in zip(times.tolist(), table.tolist(), strict=True):
        rest.add(row, t)
        found.append(rest.is_at_rest(t))
    return times, np.array(found)


def fastest(motion, times):
    return np.abs(motion(times + 1e-4) - motion(times - 1e-4)) / 2e-4


@pytest.mark.parametrize("rate", [10.5, 30.0, 100.0, 500.0])
@pytest.mark.parametrize("noise", [0.0, 2e-4, 1e-3])
def test_a_body_at_rest_is_found_so_within_three_seconds(noise, rate):
    for seed in range(cases(few=1, all=3)):
        times, found = instants(still, rate, noise, seed=seed)
        waits = np.diff(np.concatenate([[0.0], times[found], [times[-1]]]))
        assert waits.max() < 3.0


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize(
    "motion",
    [
        *itertools.starmap(swing, [(0.004, 1.0), (0.008, 1.0), (0.02, 1.0), (0.04, 0.5)]),
        *itertools.starmap(swing, [(0.01, 3.0), (0.04, 0.1), (0.005, 0.3)]),
        *map(creep, (0.005, 0.008, -0.05)),
    ],
)
@pytest.mark.parametrize("noise", [2e-4, 1e-3])
def test_no_instant_of_a_motion_is_rest(motion, rate, noise):
    assert not instants(motion, rate, noise, axis=1)[1].any()


@pytest.mark.parametrize("rate", RATES)
def test_what_passes_as_rest_changes_the_impact_by_less_than_two_percent(rate):
    """A release at v adds v^2 / (2 v_0) to the speed v_0 of the impact, here 0.1 m/s."""
    motions = [sway, swing(0.001, 1.0), swing(0.0012, 0.5), swing(0.01, 0.1), creep(0.002)]
    for motion, noise in itertools.product(motions, (2e-4, 1e-3)):
        times, found = instants(motion, rate, noise, duration=8.0)
        speed = fastest(motion, times[found]).max(initial=0.0)
        assert speed**2 / (2.0 * 0.1) < 0.02 * 0.1


@pytest.mark.parametrize("share, is_rest", [(0.9, True), (1.1, False)])
def test_the_limits_of_excursion_and_speed(share, is_rest):
    """A step of the excursion is slow enough only if the line through it is not too steep."""
    assert instants(creep(share * min(SPEED, EXCURSION / WINDOW)), 100.0, 0.0)[1][-1] == is_rest
    # from -A to A as a fast vibration, whose line is flat
    vibration = swing(0.5 * share * EXCURSION, 5.5)
    assert instants(lambda t: np.sign(vibration(t)) * 0.5 * share * EXCURSION, 1000.0, 0.0)[1][
        -1
    ] == (is_rest)


def test_a_turn_counts_and_a_whole_turn_does_not():
    assert not instants(creep(0.02), 100.0, 1e-4, axis=2)[1].any()
    wrapped, angles = Rest(), itertools.cycle([math.pi - 1e-3, 1e-3 - math.pi])
    for k in range(300):
        wrapped.add((0.0, 0.0, next(angles)), 0.01 * k)
    assert wrapped.is_at_rest(2.99)
    assert abs(wrapped.median(2.99)[2]) == pytest.approx(math.pi, abs=2e-3)


@pytest.mark.parametrize("rate", [30.0, 90.0, 200.0])
@pytest.mark.parametrize("speed", [0.1, 0.2, 0.5, 1.5])
def test_a_body_that_is_pushed_is_at_rest_for_two_more_measurements_at_most(rate, speed):
    for seed, lag in itertools.product(range(cases(few=2, all=5)), (0.0, 0.03)):
        pushed = 2.0 + seed / (7.0 * rate)
        times, found = instants(
            lambda t, pushed=pushed: speed * np.maximum(t - pushed, 0.0),
            *(rate, 1e-5),
            seed=seed,
            duration=2.0,
            lag=lag,
        )
        assert times[found].max() < pushed + lag + 3.0 / rate + 1.1 * EXCURSION / speed


def test_measurements_of_before_show_no_present_rest():
    rest = Rest()
    for k in range(300):
        rest.add((0.0, 0.0, 0.0), 0.01 * k)
    assert rest.is_at_rest(2.99 + MAX_AGE - 1e-6)
    assert "was last measured 0.1" in rest.problem(2.99 + MAX_AGE + 1e-3)
    rest.add((0.0, 0.0, 0.0), 3.0 + MAX_GAP)  # who knows what was in the gap
    assert "too few measurements" in rest.problem(3.0 + MAX_GAP)
    assert Rest().problem(0.0) == "has no measurement that tells whether it is at rest"


def test_what_moves_is_named_with_its_speed():
    rest = Rest()
    for k in range(300):
        rest.add((0.0, 0.02 * 0.01 * k, 0.0), 0.01 * k)
    assert rest.motion(2.99) == "moves by 18.7 mm within 1 s, at 20 mm/s"
    buffer = Rest(BUFFER_LIMITS)
    for k in range(300):
        buffer.add((0.0, 0.05 * math.sin(0.2 * k)), 0.01 * k)
    assert "degrees within 1 s" in buffer.motion(2.99)


# after a hold


def followed(position, duration, *, timeout=3.0, hole=(0.0, 0.0), noise=0.0):
    """Hold a chaser at t = 0 whose position, m, is a function of time; return alarms by time.

    No poses arrive between the ends of the ``hole``, s.
    """
    rest, held, alarms, rng = Rest(), HeldWatch(timeout), [], np.random.default_rng(0)
    held.let_go((0.0, 0.0, 0.0))
    for k in range(-200, round(duration * 100.0)):
        t = k / 100.0
        if not hole[0] < t < hole[1]:
            rest.add((position(t) + noise * rng.normal(), 0.0, 0.0), t)
        if k == 0:
            held.hold(t)
        held.update(rest, t)
        alarms.append((t, held.alarm))
    return alarms


def test_a_chaser_that_stops_and_is_pulled_back_alarms_nobody():
    """Braked in 0.2 s, pulled back from 2 s on for longer than the timeout."""
    for noise in (0.0, 1e-3):
        alarms = followed(
            lambda t: 0.1 * min(max(t, -2.0), 0.2) - 0.05 * max(t - 2.0, 0.0), 8.0, noise=noise
        )
        assert {text for _, text in alarms} == {""}


def test_a_driver_that_ignores_the_hold_is_an_alarm_until_its_chaser_is_back():
    def position(t):
        if t < 5.0:
            return 0.1 * max(t, 0.0)  # rolls on
        return 0.5 if t < 7.0 else max(0.5 - 0.2 * (t - 7.0), 0.0)  # at rest away, pulled back

    alarms = followed(position, 13.0)
    begin = min(t for t, text in alarms if text)
    end = max(t for t, text in alarms if text)
    assert begin == pytest.approx(3.0, abs=0.02)
    assert 9.5 < end < 9.5 + WINDOW + SETTLE + 0.1  # at its start, and not where it was for 2 s
    [text] = {text for _, text in alarms} - {""}
    assert "its driver does not hold it" in text


@pytest.mark.parametrize("amplitude, frequency", [(0.01, 1.0), (0.04, 0.25), (0.02, 0.5)])
def test_a_chaser_that_bounces_has_not_stopped(amplitude, frequency):
    alarms = followed(lambda t: amplitude * abs(math.sin(math.pi * frequency * t)), 8.0, noise=1e-4)
    assert alarms[-1][1]


@pytest.mark.parametrize("hole", [(2.5, 3.2), (0.0, 6.0)])
def test_a_dropout_of_poses_at_the_timeout_delays_the_alarm(hole):
    alarms = followed(lambda t: 0.1 * t, 8.0, hole=hole)
    begin = min(t for t, text in alarms if text)
    assert hole[1] < begin < hole[1] + WINDOW + 0.1
