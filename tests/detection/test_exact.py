"""The capture detector on motions made by hand, whose verdict is plain."""

import math

import numpy as np
import pytest
from observations import observation

from capture_sim import load_scene, simulate
from capture_sim.detection.criteria import CaptureState
from capture_sim.detection.detector import CaptureDetector
from capture_sim.detection.exact import ExactDetector
from capture_sim.dynamics.samples import SAMPLE
from capture_sim.run.summary_table import table


def tip_motion(scene, places, rate=100.0, turn=0.0):
    """Return samples of a tip led through (axial m, lateral m) places in the cone's frame.

    The target is turned by ``turn`` and stands somewhere; the chaser is led rigidly.
    """
    samples = np.zeros(len(places), SAMPLE)
    places = np.asarray(places, dtype=float)
    speeds = np.gradient(places, 1 / rate, axis=0) if len(places) > 1 else places * 0
    reach = scene.buffer.hinge_offset + scene.rest_length
    c, s = math.cos(turn), math.sin(turn)
    for k, ((axial, lateral), (axial_rate, lateral_rate)) in enumerate(
        zip(places, speeds, strict=True)
    ):
        px, py = -(axial + scene.cone.L_T), lateral
        tip = (3.0 + c * px - s * py, -2.0 + s * px + c * py)
        u = (-axial_rate, lateral_rate)
        sample = samples[k]
        sample["t"] = k / rate
        sample["q"] = (tip[0] - reach, tip[1], 0.0, 0.0, scene.rest_length, 3.0, -2.0, turn)
        sample["v"][:2] = c * u[0] - s * u[1], s * u[0] + c * u[1]
        sample["tip_axial"], sample["tip_lateral"] = axial, lateral
        sample["tip_distance"] = math.hypot(axial, lateral)
    return samples


def lead(*legs):
    """Places on straight legs: (axial, lateral, seconds to get there) after the start."""
    (a0, l0, _), *rest = legs
    parts = [np.array([[a0, l0]])]
    for a, b, seconds in rest:
        n = round(seconds * 100)
        parts.append(np.linspace([a0, l0], [a, b], n + 1)[1:])
        a0, l0 = a, b
    return np.concatenate(parts)


def verdict(scene, places, turn=0.0, cut=False):
    """Return the statuses; measurements without noise must give the same."""
    samples = tip_motion(scene, places, turn=turn)
    exact, noisy = ExactDetector(scene), CaptureDetector(scene)
    statuses = [*exact.update(samples), exact.finish(cut=cut)]
    measured = [*(noisy.update(observation(s)) for s in samples), *noisy.finish(cut=cut)]
    for one, other in zip(statuses, measured, strict=True):
        assert (one.t, one.state, one.final, one.reason) == (
            *(other.t, other.state, other.final, other.reason),
        )
        assert one == pytest.approx(other, abs=1e-12)
    return statuses


@pytest.fixture(scope="module")
def scene():
    return load_scene("tilt_0")


@pytest.mark.parametrize("turn", [0.0, 0.3, -2.0, 3.5, -5.0, 7.0, -13.0])
def test_offsets_are_those_that_were_led(scene, turn):
    detector = CaptureDetector(scene)
    for sample in tip_motion(scene, [(0.08, 0.01), (0.07, -0.02)], turn=turn):
        status = detector.update(observation(sample))
    assert status.axial_offset == pytest.approx(0.07, abs=1e-12)
    assert status.lateral_offset == pytest.approx(-0.02, abs=1e-12)
    assert status.distance == pytest.approx(math.hypot(0.07, 0.02), abs=1e-12)
    assert status.relative_attitude == pytest.approx(math.remainder(-turn, math.tau))
    assert status.relative_speed == pytest.approx(100 * math.hypot(0.01, 0.03), rel=1e-9)
    assert status.nearest_distance == pytest.approx(status.distance)


def test_staying_in_the_zone_is_a_capture_after_the_dwell(scene):
    path = lead((0.1, 0.02, 0), (0.02, 0.02, 0.8), (0.003, 0.0, 0.3), (0.003, 0.0, 1.0))
    statuses = verdict(scene, path)
    assert statuses[0].state is CaptureState.APPROACH
    captured = next(s for s in statuses if s.state is CaptureState.CAPTURED)
    entered = next(s.t for s in statuses if s.distance <= scene.detector.capture_radius)
    assert captured.t == pytest.approx(entered + scene.detector.min_dwell, abs=1e-9)
    assert captured.final
    assert statuses[-1].state is CaptureState.CAPTURED
    assert statuses[-1].time_in_state == pytest.approx(statuses[-1].t - captured.t)


# the face at lateral 0.03 is met where the tip is R_t away from it
FACE = (0.03625, 0.03, 0.6)
TO_THE_FACE = (0.1, 0.03, 0), FACE


AWAY = (0.2, 0.0, 0), (0.15, 0.0, 0.5)
IN_ZONE = (0.003, 2e-4, 0.5), (0.003, 2e-4, 0.1)  # for less than the dwell
VERDICTS = [
    ([(0.1, 0.0, 0), *IN_ZONE, (0.05, 0.0, 0.5)], "rebound", "retreated 20 mm from 3.01 mm"),
    # past BE, inside the throat and outside of it
    ([(0.101, 0.0, 0), (-0.02, 0.0, 0.3)], "captured", "tip passed BE"),
    ([(0.1, 0.09, 0), (-0.02, 0.09, 0.5)], "missed", "tip passed BE 90.00 mm off the axis"),
    ([*AWAY, (0.2, 0.0, 0.5)], "missed", "moved away without contact; closest"),
    # a run that ends: before and after a contact, at the wall, leaving it by 4 and by 7 mm
    ([*AWAY, (0.15, 0.0, 0.1)], "missed", "run ended without contact, tip 150.00 mm from BE"),
    ([*AWAY, (0.16, 0.0, 0.1)], "missed", "run ended without contact, tip 160.00 mm from BE"),
    (AWAY, "undecided", "run ended before any contact, tip 150.00 mm from BE"),
    (TO_THE_FACE, "undecided", "run ended after a contact, tip 47.05 mm from BE"),
    ([*TO_THE_FACE, FACE, (*FACE[:2], 0.1)], "stuck", "run ended with the tip at rest 47.05 mm"),
    ([*TO_THE_FACE, (0.041, 0.03, 0.2)], "undecided", "run ended after a contact, tip 50.80 mm"),
    ([*TO_THE_FACE, (0.045, 0.03, 0.2)], "rebound", "run ended with the tip 54.08 mm from BE and"),
    (
        [(0.1, 0.0, 0), (0.003, 0.0, 0.5), (0.003, 0.0, 0.1)],
        "undecided",
        "run ended before any contact, tip 3.00 mm",
    ),
]


@pytest.mark.parametrize("legs, label, reason", VERDICTS, ids=[row[2] for row in VERDICTS])
def test_verdict_of_a_path(scene, legs, label, reason):
    final = verdict(scene, lead(*legs))[-1]
    assert (final.state.label, final.final) == (label, True)
    assert final.reason.startswith(reason)


def test_retreat_after_contact_is_a_rebound(scene):
    statuses = verdict(scene, lead(*TO_THE_FACE, (0.09, 0.01, 0.5)))
    assert CaptureState.CONTACT in {s.state for s in statuses}
    rebound = next(s for s in statuses if s.state is CaptureState.REBOUND)
    assert rebound.distance > rebound.nearest_distance + scene.detector.min_retreat
    assert statuses[-1].state is CaptureState.REBOUND


def test_nothing_measured_is_undecided(scene):
    for nothing in (ExactDetector(scene).finish(), CaptureDetector(scene).finish()[-1]):
        assert (nothing.label, nothing.reason) == ("undecided", "nothing was measured")
        assert nothing.final
        assert math.isnan(nothing.distance)


def test_a_run_that_is_cut_gets_no_verdict_that_it_has_not_come_to(scene):
    def cut(*legs):
        return verdict(scene, lead(*legs), cut=True)[-1]

    for legs, reason in (
        (AWAY, "run ended before any contact, tip 150.00 mm from BE"),
        (TO_THE_FACE, "run ended after a contact, tip 47.05 mm from BE"),
        # complete runs of these are missed, stuck and rebound
        ((*AWAY, (0.15, 0.0, 0.1)), "run ended before any contact, tip 150.00 mm from BE"),
        ((*TO_THE_FACE, (*FACE[:2], 0.1)), "run ended after a contact, tip 47.05 mm from BE"),
        ((*TO_THE_FACE, (0.045, 0.03, 0.2)), "run ended after a contact, tip 54.08 mm from BE"),
    ):
        status = cut(*legs)
        assert (status.label, status.final, status.reason) == ("undecided", False, reason)
    held = cut((0.1, 0.0, 0), (0.003, 0.0, 0.5), (0.003, 0.0, 0.5))
    assert (held.state, held.final) == (CaptureState.CAPTURED, True)


def test_a_capture_that_does_not_last_says_so(scene):
    """The verdict stays, and tables and reason say that the tip is outside the zone again."""
    held = (0.1, 0.0, 0), (0.003, 0.0, 0.5), (0.003, 0.0, 0.5)
    texts = [(s.label, s.reason) for s in verdict(scene, lead(*held, (0.008652, 0.0, 0.5)))]
    assert texts[100] == ("captured", "within 5 mm of BE for 0.2 s")
    outside = "within 5 mm of BE for 0.2 s, but outside again: 8.65 mm"
    assert texts[-1] == ("captured, left", outside)
    back = verdict(scene, lead(*held, (0.008652, 0.0, 0.5), (0.003, 0.0, 0.5)))[-1]
    assert (back.label, back.reason) == ("captured", "within 5 mm of BE for 0.2 s")
    through = (0.101, 0.0, 0), (-0.02, 0.0, 0.3)
    out = verdict(scene, lead(*through, (0.03, 0.0, 0.5)))[-1]
    assert (out.label, out.reason) == (
        "captured, left",
        "tip passed BE, but outside again: 30.00 mm",
    )


@pytest.mark.parametrize(
    "outside, left", [(0.19, False), (0.20, True)], ids=["shorter", "as long as the dwell"]
)
def test_on_a_bench_a_capture_has_not_lasted_after_the_dwell_outside(scene, outside, left):
    """What cameras show for a moment only may be wrong; a simulated run says so at once."""
    held = (0.1, 0.0, 0), (0.003, 0.0, 0.5), (0.003, 0.0, 0.5)
    # after one step outside, and back in with the last one
    places = lead(*held, (0.0305, 0.0, 0.01), (0.0305, 0.0, outside), (0.003, 0.0, 0.01))
    samples = tip_motion(scene, places)
    bench, simulated = (CaptureDetector(scene, is_released=released) for released in (False, True))
    of_bench, at_once = ([d.update(observation(s)) for s in samples] for d in (bench, simulated))
    assert [s.label for s in at_once].count("captured, left") == round(outside * 100) + 1
    assert any(s.left_again for s in of_bench) == left
    assert (of_bench[-1].label, bench.finish()[-1].label) == ("captured", "captured")
    gone = CaptureDetector(scene, is_released=False)
    far = tip_motion(scene, lead(*held, (0.0305, 0.0, 0.01), (0.0305, 0.0, 0.3)))
    assert [gone.update(observation(s)) for s in far][-1].label == "captured, left"


def test_an_undamped_capture_is_reported_as_left():
    result = simulate(load_scene("paper_designed"))
    assert result.verdict == "captured"
    assert result.summary["verdict"] == "captured"
    assert result.summary["left_again"]
    assert "captured, left" in table([result.summary])
    assert "outside again: 8.65 mm" in result.statuses[-1].reason
    assert not simulate(load_scene("tilt_0")).summary["left_again"]


def test_a_tip_that_swings_by_less_than_the_bound_is_at_rest(scene):
    """It is faster than max_still_speed at nearly every instant."""
    t = np.arange(0.0, 2.0, 0.01)
    swing = FACE[0] + 1e-4 * np.sin(2 * math.pi * 8.0 * t)
    path = np.concatenate([lead(*TO_THE_FACE), np.column_stack([swing, np.full(t.size, 0.03)])])
    stuck = next(s for s in verdict(scene, path) if s.state is CaptureState.STUCK)
    assert stuck.reason.startswith("at rest 47.")
    assert stuck.t == pytest.approx(0.6 + scene.detector.min_still_time, abs=0.05)


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "paper_undamped", "paper_designed"])
def test_the_detector_sees_the_same_tip_as_the_core(name):
    result = simulate(load_scene(name))
    detector = CaptureDetector(result.scene)
    for sample in result.samples[::10]:
        status = detector.update(observation(sample))
        assert status.axial_offset == pytest.approx(sample["tip_axial"], abs=1e-12)
        assert status.lateral_offset == pytest.approx(sample["tip_lateral"], abs=1e-12)
    # contact is noticed no later than 20 ms after the first touch
    touched = next(s.t for s in result.statuses if s.state is not CaptureState.APPROACH)
    assert touched == pytest.approx(result.touches[0]["start"], abs=0.02)


@pytest.mark.parametrize("name", ["tilt_p10", "tilt_m10", "paper_clamped"])
def test_blocks_of_any_size_give_the_same_statuses(name):
    result = simulate(load_scene(name))
    samples = result.samples[:: round(result.scene.run.state_rate / result.scene.run.rate)]
    for size in (1, 7, 1000):
        detector, statuses = ExactDetector(result.scene), []
        for start in range(0, samples.size, size):
            statuses += detector.update(samples[start : start + size])
        assert [*statuses, detector.finish()] == result.statuses
    detector, used = ExactDetector(result.scene), 0
    while not detector.final:
        used += detector.until_verdict(samples[used : used + 50])
    first = next(status for status in result.statuses if status.final)
    assert samples["t"][used - 1] == first.t
    assert detector.finish() == first


@pytest.mark.parametrize("name", ["tilt_0", "paper_undamped", "paper_case_3", "paper_designed"])
@pytest.mark.parametrize("latch", [True, False])
def test_a_final_verdict_never_changes(name, latch):
    """Also where the tip leaves again, or touches for many seconds more."""
    changes = {"run.t_end": 12.0, "run.after_latch": None, **({} if latch else {"latch": None})}
    statuses = simulate(name, changes).statuses
    first = next(k for k, status in enumerate(statuses) if status.final)
    assert len(statuses) > first + 50
    assert {s.state for s in statuses[first:]} == {statuses[first].state}
    assert all(status.final for status in statuses[first:])
