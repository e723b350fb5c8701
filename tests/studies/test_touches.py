"""Touches found in forces and messages that are known."""

import numpy as np
import pytest
from noisy_bench import cell_force, noisy_run, tip_force

import capture_sim
from capture_sim.dynamics.bench import Bench
from capture_sim.run.touches import above, in_force, in_messages, quiet_before_contact


def test_touches_in_a_fast_force_are_those_that_made_it():
    """Half sines, whose peak, time and impulse 2 F T / pi are known."""
    t = np.arange(0.0, 0.2, 2e-5)
    size = np.zeros_like(t)
    made = [(0.1, 1e-3, 130.0), (0.12, 2e-3, 60.0), (0.15, 5e-4, 40.0)]
    for start, lasts, peak in made:
        inside = (t > start) & (t < start + lasts)
        size[inside] = peak * np.sin(np.pi * (t[inside] - start) / lasts)
    force = np.stack([-0.6 * size, 0.8 * size], axis=1)
    found = in_force(t, force + np.array([0.3, -0.2]))  # a bias
    assert found.start == pytest.approx([start for start, _, _ in made], abs=3e-5)
    assert found.lasted == pytest.approx([lasts for _, lasts, _ in made], abs=6e-5)
    assert found.peak == pytest.approx([peak for _, _, peak in made], rel=1e-2)
    assert found.impulse == pytest.approx([2 / np.pi * lasts * f for _, lasts, f in made], rel=1e-2)
    assert in_force(t[::50], force[::50]) is None  # 1 kHz shows one sample of a touch


def test_noise_alone_is_no_contact():
    rng = np.random.default_rng(24)
    for _ in range(50):
        force = rng.normal(size=(4000, 2)) * 3.0 + (20.0, -7.0)
        quiet = quiet_before_contact(np.arange(4000) * 1e-3, force)
        assert quiet.sigma == pytest.approx(3.0, rel=0.1)
        assert not above(np.hypot(*(force - quiet.bias).T), quiet.threshold)


def half_sines(rate, starts, peaks, lasting, wall, mu, cone, attitude):
    """Force on the tip in its own frame: known pulses normal to a wall, friction along it."""
    t = np.arange(0.0, 0.5, 1.0 / rate)
    normal = np.zeros(t.size)
    for start, peak in zip(starts, peaks, strict=True):
        inside = (t >= start) & (t <= start + lasting)
        normal[inside] += peak * np.sin(np.pi * (t[inside] - start) / lasting)
    into = np.array([-np.sin(cone.half_angle), -wall * np.cos(cone.half_angle)])
    along = np.array([-np.cos(cone.half_angle), wall * np.sin(cone.half_angle)])
    x, y = (into[:, None] + mu * along[:, None]) * normal
    c, s = np.cos(attitude), np.sin(attitude)
    return t, np.stack([c * x + s * y, c * y - s * x], axis=1)


@pytest.mark.parametrize("wall, attitude", [(1, 0.0), (-1, 0.2), (1, -0.3)])
def test_pulses_of_known_height_are_found_whatever_the_friction(wall, attitude):
    cone = capture_sim.load_scene("tilt_0").cone
    starts, peaks = (0.30007, 0.31301), (120.0, 60.0)
    known = (starts, peaks, 3.5e-4, wall, 0.4, cone, attitude)
    t, force = half_sines(2e4, *known)
    turned = np.full(t.size, attitude)
    found = in_force(t, force, turned, cone)
    assert found.start == pytest.approx(starts, abs=1.0 / 2e4)
    assert found.peak == pytest.approx(peaks, rel=0.01)
    # too slow for the peak
    t, force = half_sines(5e3, *known)
    assert in_force(t, force, np.full(t.size, attitude), cone) is None


def test_slow_force_that_shows_one_touch_only_is_not_used():
    run = noisy_run("tilt_0", 25)
    t = np.arange(0.0, 4.0, 0.01)
    samples = Bench(run.scene).advance(t)
    force = samples["contact_force"]
    found = in_force(t, force, np.zeros(t.size), run.scene.cone)
    # the last touch of the first contact lasts 0.1 s, those before a third of a millisecond
    assert found.start[0] > run.touches.start[3]
    assert found.may_miss(3.5e-4)


@pytest.mark.parametrize("share", np.arange(8) / 8)
def test_peak_and_impulse_do_not_depend_on_where_the_samples_fall(share):
    """Of Hertz's contact: half sines to the power 1.5, 7 samples each.

    A parabola through the largest three samples is up to 2.2 % low.  The trapezoidal rule over a
    pulse that ends as t^1.5 is wrong by some (7 samples)^-2.5, i.e. 0.8 %.
    """
    t = (np.arange(4000) + share) / 2e4
    inside = (t > 0.1) & (t < 0.10035)
    pulse = np.where(inside, np.sin(np.pi * (t - 0.1) / 3.5e-4), 0.0)
    force = np.stack([np.zeros_like(t), 130.0 * np.abs(pulse) ** 1.5], axis=1)
    found = in_force(t, force)
    assert found.peak == pytest.approx([130.0], rel=3e-3)
    # the integral of sin^1.5 over half a turn is 1.748
    assert found.impulse == pytest.approx([130.0 * 3.5e-4 * 1.74804 / np.pi], rel=8e-3)


def test_the_noise_of_touches_is_the_spread_of_their_times_and_impulses():
    """400 samplings of the same three touches by Hertz's law, at any phase, with noise of 0.5 N."""
    cone, rng = capture_sim.load_scene("tilt_0").cone, np.random.default_rng(7)
    starts, peaks, lasts = np.array(
        [[0.2, 0.22, 0.24], [130.0, 60.0, 130.0], [3.5e-4, 4e-4, 1.5e-3]]
    )
    true = 1.74804 / np.pi * peaks * lasts
    into_wall = np.array([-np.sin(cone.half_angle), -np.cos(cone.half_angle)])
    times, impulses = [], []
    for _ in range(400):
        t = (np.arange(5200) + rng.uniform()) / 2e4
        phase = np.clip((t[:, None] - starts) / lasts, 0.0, 1.0)
        normal = (peaks * np.maximum(np.sin(np.pi * phase), 0.0) ** 1.5).sum(axis=1)
        force = normal[:, None] * into_wall + 0.5 * rng.normal(size=(t.size, 2))
        found = in_force(t, force, np.zeros_like(t), cone)
        if found is not None and found.start.size == 3:  # noise is taken for a touch in 1 of 1000
            times.append((found.start - starts) / found.start_noise)
            impulses.append((found.impulse - true) / found.strength_noise)
    assert len(times) > 390
    # 0.1 % quantiles of 400 draws are at 0.89 and 1.11
    assert np.std(times, axis=0) == pytest.approx(1.0, abs=0.11)
    # the flanks count as two samples, and noise of one to two is in the impulse
    assert np.std(impulses, axis=0) == pytest.approx(0.95, abs=0.11)


def test_the_peak_of_many_noisy_samples_is_not_that_of_the_largest():
    """8 N over 0.1 s with noise of 0.5 N: the largest of 2000 samples reads 1.2 N high."""
    t = np.arange(0.0, 0.3, 5e-5)
    held = 4.0 * (np.tanh((t - 0.1) / 2e-3) - np.tanh((t - 0.2) / 2e-3))
    force = np.stack([held, np.zeros_like(t)], axis=1)
    noisy = force + 0.5 * np.random.default_rng(3).normal(size=force.shape)
    assert noisy[:, 0].max() > 9.2
    # 0.3 N is the error of the mean of three neighbours of 0.5 N
    assert in_force(t, noisy).peak == pytest.approx([8.0], abs=0.3)


def test_a_filter_lowers_the_peaks_of_touches_and_leaves_their_impulses():
    run = noisy_run("tilt_0", 31, true=(0.001, 0.6, 0.33, 13.0))
    cone, rng = run.scene.cone, np.random.default_rng(31)
    direct, filtered = tip_force(run, rng), cell_force(run, rng, bandwidth=4e3)
    expected = in_force(direct.t, direct.values, np.zeros(direct.t.size), cone).of(slice(4))
    found = in_force(filtered.t, filtered.values, np.zeros(filtered.t.size), cone).of(slice(4))
    assert np.all(found.peak < 0.96 * expected.peak)
    # the noise of both: 0.5 N and a bias known to 0.5 N / sqrt(300), over 9 samples of 50 us
    noise = np.sqrt(2.0) * 0.5 * 5e-5 * np.sqrt(9.0 + 9.0**2 / 300.0)
    assert found.impulse == pytest.approx(expected.impulse, abs=4.0 * noise)
    assert found.strength == "impulse"


def test_peaks_since_the_last_message_are_touches():
    t = np.arange(8) * 0.01
    begun = np.array([0, 0, 1, 0, 1, 0, 2, 0])
    peak = np.array([0.0, 0.0, 90.0, 0.0, 40.0, 55.0, 20.0, 0.0])
    in_touch = np.array([0, 0, 0, 0, 1, 0, 0, 0], dtype=bool)
    found = in_messages(t, begun, peak, in_touch)
    assert found.start == pytest.approx([0.015, 0.035])
    assert found.peak.tolist() == [90.0, 55.0]
    assert found.start_noise == pytest.approx(0.01 / np.sqrt(12.0))
