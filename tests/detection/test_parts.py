"""The parts of the detector's pipeline: noise, smoother, order of stamps, common instants, gate."""

import math

import numpy as np
import pytest

from capture_sim import load_scene
from capture_sim.detection.align import Aligner
from capture_sim.detection.gate import Gate, PoseLimits
from capture_sim.detection.measurements import MAX_LEAD, Counts, Reason, Sequencer, Source
from capture_sim.detection.noise import NoiseEstimate, Resolution, third_difference
from capture_sim.detection.smoother import MeasuredTip, TipPath

# what is known of the noise and of the path


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_noise_is_found_in_a_parabola_with_holes(noise):
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.005, 0.03, 2000))
    x = 3.0 - 0.2 * t + 0.4 * t**2 + noise * rng.standard_normal(t.size)
    estimate = NoiseEstimate()
    for k in range(3, t.size):
        estimate.add(float(np.dot(third_difference(list(t[k - 3 : k + 1])), x[k - 3 : k + 1])))
    assert estimate.known
    # the median of 200 correlated differences is good to some 10 %
    assert estimate.deviation == pytest.approx(noise, rel=0.3, abs=1e-12)


def path():
    return TipPath(radius=0.005, delay=0.25, clean=5e-5, gap=0.1, keep=4.0)


def seen_at(axial, lateral, rate=None):
    return MeasuredTip((axial, lateral), (axial, lateral), rate)


def test_the_path_errs_by_what_it_says():
    """The normalised error of the fitted places has unit variance, and no bias."""
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(60):
        t = np.arange(0.0, 2.0, 0.01)
        true = np.column_stack([0.08 - 0.05 * t + 0.05 * t**2, 0.02 - 0.01 * t])
        seen = true + 1.5e-3 * rng.standard_normal(true.shape)
        smoothed = path()
        places = []
        for k in range(t.size):
            places += smoothed.add(float(t[k]), seen_at(*seen[k]))
        # well apart: neighbours share their measurements
        for place in (p for p in places if p.size > 1 and abs(p.t - round(p.t, 0)) < 1e-9):
            k = round(place.t * 100)
            errors.append((place.axial - true[k, 0]) / math.sqrt(place.axial_variance))
            errors.append((place.lateral - true[k, 1]) / math.sqrt(place.lateral_variance))
    assert len(errors) >= 100
    assert np.mean(errors) == pytest.approx(0.0, abs=0.4)
    assert np.std(errors) == pytest.approx(1.0, rel=0.3)
    assert smoothed.half_window == pytest.approx(0.25)


@pytest.mark.parametrize("length", [0.12, 0.3])
def test_a_hit_in_a_gap_bends_no_place_beside_it(length):
    """The path turns round at 1 s, unseen; the fits before and after do not know of each other."""
    rng = np.random.default_rng(6)
    errors = []
    for _ in range(40):
        smoothed, places = path(), []
        for k in range(200):
            t = k / 100
            if abs(t - 1.0) > 0.5 * length:
                seen = np.array([0.1 * abs(t - 1.0), 0.0]) + 1e-3 * rng.standard_normal(2)
                places += smoothed.add(t, seen_at(*seen))
        places += smoothed.finish()
        near = [p for p in places if 0.7 < p.t < 1.3]
        assert len(near) == sum(
            0.7 < k / 100 < 1.3 and abs(k / 100 - 1) > length / 2 for k in range(200)
        )
        for p in near:
            errors.append((p.axial - 0.1 * abs(p.t - 1.0)) / math.sqrt(p.axial_variance))
    assert np.mean(errors) == pytest.approx(0.0, abs=0.25)
    assert np.std(errors) == pytest.approx(1.0, rel=0.3)


def test_measurements_alone_between_two_gaps_give_no_place():
    """Two of them with noise tell nothing of a speed; without noise each is a place."""
    rng = np.random.default_rng(7)
    for noise in (1e-3, 0.0):
        smoothed, places = path(), []
        for k in range(300):
            if not 150 <= k < 185 or k in (165, 166):
                seen = np.array([0.1, 0.0]) + noise * rng.standard_normal(2)
                places += smoothed.add(k / 100, seen_at(*seen))
        places += smoothed.finish()
        alone = [p for p in places if 1.5 < p.t < 1.8]
        assert len(alone) == (0 if noise else 2)
        assert {1.49, 1.85} <= {p.t for p in places}


def test_many_measurements_are_used_without_a_place_for_each():
    rng = np.random.default_rng(5)
    smoothed, places = path(), []
    for k in range(2000):
        places += smoothed.add(k / 1000, seen_at(*(1e-3 * rng.standard_normal(2) + [0.1, 0.0])))
    late = [p for p in places if p.t > 1.0]
    assert 0.0 < smoothed.half_window < 0.25
    assert np.diff([p.t for p in late]) == pytest.approx(0.003)
    assert late[-1].size == pytest.approx(2 * smoothed.half_window * 1000, abs=2)


def test_an_outlier_does_not_move_the_path():
    rng = np.random.default_rng(3)
    smoothed, places = path(), []
    for k in range(200):
        tip = tuple(1e-3 * rng.standard_normal(2) + [0.1, 0.0])
        if k == 100:
            tip = (0.4, 0.3)  # markers swapped
        places += smoothed.add(k / 100, seen_at(*tip))
    near = [p for p in places if 0.8 < p.t < 1.2]
    assert len(near) > 30
    assert max(abs(p.axial - 0.1) for p in near) < 2e-3


def test_clean_measurements_are_taken_as_they_are():
    smoothed = path()
    for k in range(300):
        tip = (0.1 - 0.0003 * k, 0.01)
        (place,) = smoothed.add(k / 100, seen_at(*tip, (-0.03, 0.0)))
        assert (place.t, place.axial, place.lateral) == (k / 100, *tip)
        assert (place.axial_variance, place.lateral_variance) == (0.0, 0.0)


# order of stamps and common instants

MS = 1_000_000
SIZES = {Source.CHASER: 3, Source.TARGET: 3, Source.BUFFER: 2}


def observations(measured, max_gap=0.1, counts=None):
    """Return what sequencer and aligner make of measurements, with times in s."""
    counts = Counts() if counts is None else counts
    sequencer, aligner = Sequencer(counts, reorder=0), Aligner(max_gap, counts)
    ordered = []
    for source, t, values in measured:
        ordered += sequencer.add(source, round(t * 1e9), values)
    for each in [*ordered, *sequencer.finish()]:
        aligner.add(each.source, each.stamp / 1e9, each.values)
    return aligner.complete(None)


def test_sources_are_brought_to_the_chasers_times():
    measured = []
    for k in range(20):
        t = k / 100
        measured += [
            (Source.TARGET, t + 0.004, (2.0 + t + 0.004, 0.0, math.pi - 0.01 * k)),
            (Source.CHASER, t, (t, 0.0, 0.0)),
            (Source.BUFFER, t + 0.007, (1e-3 * (t + 0.007), 0.0)),
        ]
    counts = Counts()
    got = observations(measured, counts=counts)
    assert [o.t for o in got] == pytest.approx([k / 100 for k in range(1, 20)])
    for seen in got:
        assert seen.target[0] == pytest.approx(2.0 + seen.t)
        assert seen.target[2] == pytest.approx(math.pi - (seen.t - 0.004))
        assert seen.buffer[0] == pytest.approx(1e-3 * seen.t)
    # the first instant, before the others began
    assert counts.rejected == {(s, Reason.GAP): 1 for s in (Source.TARGET, Source.BUFFER)}


def test_headings_are_interpolated_the_short_way():
    ends = ((0.0, math.pi - 0.1), (1.0, -math.pi + 0.1))
    others = [(Source.TARGET, t, (0.0, 0.0, theta)) for t, theta in ends]
    others += [(Source.BUFFER, t, (0.0, 0.0)) for t, _ in ends]
    (seen,) = observations([*others, (Source.CHASER, 0.5, (0.0, 0.0, 0.0))], max_gap=2.0)
    assert math.cos(seen.target[2]) == pytest.approx(-1.0)


def test_nothing_is_interpolated_over_a_gap():
    counts = Counts()
    measured = [
        (source, k / 100, (k / 100, *[0.0] * (size - 1)))
        for k in range(40)
        for source, size in SIZES.items()
        if source is not Source.TARGET or not 10 <= k < 30
    ]
    got = observations(measured, 0.05, counts)
    assert [round(o.t * 100) for o in got] == [*range(10), *range(30, 40)]
    assert counts.rejected == {(Source.TARGET, Reason.GAP): 20}


def sequence(order, reorder):
    counts = Counts()
    sequencer = Sequencer(counts, reorder)
    released = [each for item in order for each in sequencer.add(*item)]
    return [*released, *sequencer.finish()], counts


def test_the_sequence_is_that_of_the_stamps_for_any_arrival():
    """Sources that are late by any time, and messages that overtake those of their source."""
    measured = [
        (source, (10 * k + shift) * MS, (float(k), *[0.0] * (SIZES[source] - 1)))
        for k in range(100)
        for source, shift in ((Source.CHASER, 0), (Source.TARGET, 3), (Source.BUFFER, 7))
    ]
    expected = [each[1] for each in sorted(measured, key=lambda each: each[1])]
    for seed in range(20):
        rng = np.random.default_rng(seed)
        pause = dict(zip(Source, rng.uniform(0.0, 3000.0, 3) * MS, strict=True))
        late = [each[1] + pause[each[0]] + rng.uniform(0.0, 99.0) * MS for each in measured]
        order = [measured[i] for i in np.argsort(late)]
        released, counts = sequence(order, 100 * MS)
        assert [each.stamp for each in released] == expected
        assert counts.text == ""


@pytest.mark.parametrize("source", Source)
def test_wrong_stamps_and_values_are_counted(source):
    good = [(each, 10 * k * MS, (0.0,) * SIZES[each]) for k in range(50) for each in Source]
    values = (0.0,) * SIZES[source]
    for stamp, bad, reason in (
        (200 * MS, values, Reason.LATE),  # a stamp that repeats
        (10 * MS, values, Reason.LATE),
        (300 * MS + 2 * MAX_LEAD, values, Reason.AHEAD),
        (305 * MS, (math.nan, *values[1:]), Reason.NOT_FINITE),
    ):
        order = [*good[:90], (source, stamp, bad), *good[90:]]
        released, counts = sequence(order, 100 * MS)
        assert [each.stamp for each in released] == [each[1] for each in good]
        assert counts.rejected == {(source, reason): 1}
        assert counts.received[source] == 51
        assert counts.text.startswith(f"{source.value}: 1 {reason.value} of 51 (likely ")
        assert counts.warnings == [counts.text]


def test_a_twist_that_is_not_finite_is_missing():
    good = [(each, 10 * MS, (0.0,) * SIZES[each]) for each in Source]
    released, counts = sequence(
        [*good, (Source.CHASER, 20 * MS, (1.0, 0.0, 0.0, *[math.nan] * 3))], 0
    )
    assert [each.values for each in released if each.stamp == 20 * MS] == [(1.0, 0.0, 0.0)]
    assert counts.text == ""


def test_a_source_that_falls_silent_is_named():
    sequencer = Sequencer(Counts())
    for k in range(100):
        for source, size in SIZES.items():
            if source is not Source.TARGET or k < 40:
                sequencer.add(source, 10 * k * MS, (0.0,) * size)
        assert sequencer.silent(500 * MS) == ([Source.TARGET] if k > 89 else [])


# gate


def gated(poses, rate=240.0):
    """Return which poses (n, 3) of the chaser pass, and the gate."""
    counts = Counts()
    scene = load_scene("tilt_0")
    gate = Gate(Source.CHASER, PoseLimits.of(scene, Source.CHASER), counts)
    passed = []
    for k, pose in enumerate(np.asarray(poses).tolist()):
        if not math.isnan(pose[0]):
            passed += gate.add(k / rate, tuple(pose), 0.11)
    passed += gate.finish()
    is_passed = np.zeros(len(poses), dtype=bool)
    is_passed[[round(pose.t * rate) for pose in passed]] = True
    lost = np.isnan(np.asarray(poses)[:, 0])
    assert counts.of(Source.CHASER) == (~is_passed & ~lost).sum()
    return is_passed, gate


def path_with_a_bounce(rate, seconds=2.0, noise=5e-5):
    t = np.arange(0.0, seconds, 1.0 / rate)
    x = np.where(t < 1.0, 0.1 * t, 0.1 - 0.1 * (t - 1.0))  # turns round at once
    pose = np.column_stack([x, np.zeros_like(t), np.where(t < 1.0, 0.0, 0.25 * (t - 1.0))])
    return pose + noise * np.random.default_rng(0).standard_normal(pose.shape)


@pytest.mark.parametrize("rate", [60.0, 120.0, 240.0])
def test_a_bounce_passes_and_wrong_frames_do_not(rate):
    poses = path_with_a_bounce(rate)
    assert gated(poses, rate)[0].all()
    middle = round(rate)
    # at 60 Hz a contact explains smaller shifts
    least = 0.011 if rate < 100.0 else 0.006
    for offset in ((least, 0.0, 0.0), (-least, 0.0, 0.0), (0.0, 0.0, 0.03), (0.05, 0.0, 0.1)):
        for begin in (middle - 20, middle - 1, middle, middle + 1, middle + 20):
            for frames in range(1, 5):
                wrong = poses.copy()
                wrong[begin : begin + frames] += offset
                is_passed, gate = gated(wrong, rate)
                assert np.flatnonzero(~is_passed).tolist() == [*range(begin, begin + frames)]
                assert gate.jump is None


def test_a_jump_that_stays_is_a_new_place():
    poses = path_with_a_bounce(240.0)
    for frames, stays in ((70, False), (90, True)):
        wrong = poses.copy()
        wrong[120 : 120 + frames] += (0.02, 0.0, 0.0)
        is_passed, gate = gated(wrong)
        assert is_passed[120 : 120 + frames].all() == stays
        assert (gate.jump is not None) == stays


def without(poses, first, count):
    """Return poses (n, 3) of which some are lost, NaN, and whether each is there."""
    is_there = np.ones(len(poses), dtype=bool)
    is_there[first : first + count] = False
    return np.where(is_there[:, None], poses, math.nan), is_there


@pytest.mark.parametrize("rate", [60.0, 120.0, 240.0])
@pytest.mark.parametrize("begin", [0.5, 1.0, 1.4], ids=["coasting", "bounce", "afterwards"])
def test_wrong_frames_after_lost_ones_do_not_pass(rate, begin):
    """Within the gap the vehicle can have gone as far as they are."""
    lost, first = math.ceil(0.0875 * rate), round(begin * rate)
    poses, is_there = without(path_with_a_bounce(rate), first, lost)
    assert (gated(poses, rate)[0] == is_there).all()
    for offset in ((0.015, -0.01, 0.026), (-0.018, 0.0, 0.0)):
        for frames in range(1, 6):
            wrong, expected = poses.copy(), is_there.copy()
            wrong[first + lost : first + lost + frames] += offset
            expected[first + lost : first + lost + frames] = False
            is_passed, gate = gated(wrong, rate)
            assert np.flatnonzero(is_passed ^ expected).tolist() == []
            assert gate.jump is None


@pytest.mark.parametrize("begin", [0.5, 1.4])
def test_a_stream_that_ends_with_far_poses_ends_before_them(begin):
    rate, lost, first = 240.0, 21, round(240.0 * begin)
    for frames in range(1, 7):
        poses, _ = without(path_with_a_bounce(rate)[: first + lost + frames], first, lost)
        poses[first + lost :, 0] += 0.018
        is_passed, _ = gated(poses, rate)
        assert is_passed[:first].all()
        assert (is_passed[first + lost :] == (frames > 5)).all()


def test_a_source_that_repeats_is_frozen_only_if_its_noise_is_above_its_resolution():
    rng = np.random.default_rng(1)
    noisy = path_with_a_bounce(240.0, noise=2e-4)
    frozen = noisy.copy()
    frozen[300:330] = frozen[299]
    assert np.flatnonzero(~gated(frozen)[0]).tolist() == [*range(301, 330)]
    clamped = np.zeros((400, 3))
    quantised = np.round(path_with_a_bounce(240.0, noise=0.0) / 1e-4) * 1e-4
    stopped = np.concatenate([quantised, np.repeat(quantised[-1:], 100, axis=0)])
    slow = np.cumsum(rng.uniform(0.0, 1e-6, (400, 3)), axis=0)
    for poses in (clamped, quantised, stopped, np.concatenate([slow, np.repeat(slow[-1:], 50, 0)])):
        assert gated(poses)[0].all()


def test_the_step_of_a_quantised_signal_is_found():
    t = np.arange(0.0, 2.0, 1.0 / 240.0)
    slow, fast = (np.round(speed * t / 1e-4) * 1e-4 for speed in (0.005, 0.1))
    smooth = (0.05 * t, 0.01 * t * t, 0.0 * t)
    for x, step in ((slow, 1e-4), (fast, 1e-4), *((x, 0.0) for x in smooth)):
        resolution = Resolution()
        for difference in np.diff(x):
            resolution.add(float(difference))
        assert resolution.value == pytest.approx(step, abs=1e-9)
