"""What the rules say of recordings as laboratories make them (tests/dirty.py)."""

from __future__ import annotations

import math

import dirty
import pytest
from cases import cases

import capture_sim
from capture_sim.errors import RecordingError
from capture_sim.plausibility.rules import RULES, Grade
from capture_sim.recording.read import read_run
from capture_sim.run.run import checked, detect
from capture_sim.trial.interlocks import TrialLimits
from tests.live_measurements import check

#: The rules that each kind breaks; nothing else may be said.
RULES_OF = {
    "plain": set(),
    "poses_in_mm": {"position_units"},
    "poses_in_inch": {"position_units"},
    "headings_in_degrees": {"not_facing"},
    "y_up": {"tilted", "out_of_plane"},
    "w_first": {"tilted"},
    "no_quaternion": {"no_pose"},
    "target_not_tracked": {"no_pose"},
    "poses_an_hour_ahead": {"clock_offset"},
    "poses_120_ms_ahead": {"clock_offset"},
    "chaser_drifts_by_500_ppm": {"clock_drifts"},
    "poses_on_a_steady_clock": {"clock_offset"},
    "stamps_zero": {"stamps_unset"},
    "bodies_swapped": {"not_facing"},
    "one_body_on_both": {"bodies_overlap"},
    "frames_differ": {"frames_differ"},
    "joints_nan": {"no_value"},
    "encoder_in_mm": {"buffer_units"},
    "encoder_inverted": {"buffer_against_poses"},
    "joints_exchanged": {"buffer_against_poses"},
    "hole_at_contact": {"gap"},
    "encoder_off_zero": {"buffer_zero"},
    "stroke_halved": {"buffer_scale"},
    "stroke_doubled": {"buffer_scale"},
    "encoder_stuck": {"buffer_against_poses"},
    "encoder_stuck_in_flight": {"buffer_against_poses"},
    "cell_drifts": set(),  # it is slow, and removed
    "cell_offset": set(),  # removed, too
    "cell_inverted": {"force_impulse"},
    "cell_saturated": {"force_saturated"},
    "target_stands": {"poses_stand"},
    "both_stand": {"poses_stand"},
    "poses_twice": set(),  # the detector leaves the repeated ones out
    "poses_ten_times": set(),
    "two_trials": {"several_trials", "gap"},
    "hinge_a_turn_off": {"buffer_units", "buffer_zero"},
    "cell_turned_by_45": {"force_impulse"},
    "cell_turned_by_90": {"force_impulse"},
    "cell_inverted_at_250_hz": {"force_impulse"},
    "cell_in_counts": {"force_impulse"},
    "cell_repeats_when_loaded": {"force_impulse", "force_saturated"},
}


@pytest.fixture(scope="module")
def scene():
    return capture_sim.load_scene("tilt_p10")


@pytest.mark.parametrize("kind", RULES_OF)
def test_each_kind_breaks_its_rules_and_no_other(kind, scene, tmp_path):
    run = read_run(dirty.write(tmp_path, kind), scene=scene)
    assert {doubt.rule.name for doubt in run.doubts} == RULES_OF[kind]
    refused = [doubt for doubt in run.doubts if doubt.grade is Grade.REFUSED]
    assert all(
        "must be" in d.text or "never tracked" in d.text or "are 0" in d.text for d in refused
    )
    if not refused:
        assert checked(run).doubts == run.doubts
        return
    for judge in (checked, detect):
        with pytest.raises(RecordingError) as error:
            judge(run)
        assert refused[0].rule.name in str(error.value)
        assert "\n" not in str(error.value)
    assert run.statuses == ()
    waived = run.replaced(waived=[doubt.rule.name for doubt in refused])
    assert not any(doubt.rule.name in waived.waived for doubt in waived.doubts)


@pytest.mark.parametrize(
    "kind, grade",
    [
        ("poses_an_hour_ahead", Grade.REFUSED),
        ("poses_120_ms_ahead", Grade.NOTED),
        ("stamps_zero", Grade.REFUSED),
        ("no_quaternion", Grade.REFUSED),
        ("target_stands", Grade.REFUSED),
    ],
)
def test_the_grade_follows_from_the_size_of_the_fault(kind, grade, scene, tmp_path):
    run = read_run(dirty.write(tmp_path, kind), scene=scene)
    assert {doubt.grade for doubt in run.doubts} == {grade}


@pytest.mark.parametrize("name", ["tilt_0", "tilt_m10", "tilt_p10"])
def test_exchanged_joints_are_recognised(name, tmp_path):
    scene = capture_sim.load_scene(name)
    records = dirty.CHANGES["joints_exchanged"](dirty.clean(name))
    run = read_run(dirty.write(tmp_path, "plain", records), scene=scene)
    [doubt] = run.doubts
    assert "stroke and torsion look exchanged" in doubt.text


@pytest.mark.parametrize("factor", [0.4, 2.0])
def test_the_scale_of_the_stroke_is_doubted_where_the_speed_changes_enough(factor, tmp_path):
    """By the chaser's momentum; in tilt_p10, 1 mm of noise in the poses hides a factor of 2."""
    records = dirty.changed(dirty.clean("tilt_0"), dirty.JOINTS, dirty.joints_times(factor, 1.0))
    run = read_run(dirty.write(tmp_path, "plain", records), scene=capture_sim.load_scene("tilt_0"))
    assert [doubt.rule.name for doubt in run.doubts] == ["buffer_scale"]


def test_a_rule_that_is_not_applied_is_named_with_its_reason(scene, tmp_path):
    slow = [r for k, r in enumerate(dirty.clean()) if r.topic != dirty.CELL or k % 60 == 0]
    run = read_run(dirty.write(tmp_path, "plain", slow), scene=scene)
    reasons = {rule.name: reason for rule, reason in run.unapplied}
    assert reasons["force_impulse"].endswith("Hz: must be 50 Hz or more")
    without = read_run(dirty.write(tmp_path, "poses_in_mm"), scene=scene)
    reasons = {rule.name: reason for rule, reason in without.unapplied}
    assert reasons["not_facing"] == "poses refused (position_units)"
    assert "buffer_units" not in reasons  # it does not rest on poses


def evaluated(scene, folder, stroke, torsion):
    """Return the run with these zeros of the encoders, and what is compared of it."""
    records = dirty.changed(dirty.clean("tilt_p10"), dirty.JOINTS, dirty.off_zero(stroke, torsion))
    run = read_run(dirty.write(folder, "plain", records), scene=scene)
    peaks = [run.summary[key] for key in ("max_axial_stroke_in", "max_torsion")]
    statuses = detect(run)
    since = {s.state: s.t - s.time_in_state for s in statuses}
    series = [run.series[name]["joint_states"] for name in ("stroke", "torsion")]
    return run, ((since, statuses[-1].nearest_distance), peaks, *series)


@pytest.fixture(scope="module")
def right_zero(scene, tmp_path_factory):
    return evaluated(scene, tmp_path_factory.mktemp("clean"), 0.0, 0.0)[1]


ZEROS = [(2e-4, 0.0), (-3e-3, -0.05), (5e-3, 0.0)]
MORE_ZEROS = [(5e-4, 0.0), (2e-3, 0.0), (-5e-3, 0.0), (0.0, 0.02)]


@pytest.mark.parametrize("stroke, torsion", cases(few=ZEROS, all=ZEROS + MORE_ZEROS))
def test_the_zero_of_an_encoder_changes_no_result(stroke, torsion, right_zero, scene, tmp_path):
    """Before: 0.2 mm moved the first contact by 0.25 s, and -5 mm made the capture undecided."""
    run, found = evaluated(scene, tmp_path, stroke, torsion)
    [doubt] = run.doubts
    assert doubt.rule.name == "buffer_zero"
    assert doubt.line.endswith("at rest before the contact: taken out")
    (before, peaks, *series), (after, peaks_off, *zeroed) = right_zero, found
    assert peaks_off == pytest.approx(peaks, abs=1e-5)
    assert after[0] == pytest.approx(before[0], abs=1e-6)
    assert after[1] == pytest.approx(before[1], abs=2e-5)
    for one, other in zip(series, zeroed, strict=True):
        assert other.values == pytest.approx(one.values, abs=1e-5)


def test_the_zero_is_that_of_the_scene_that_a_run_has_now(scene, tmp_path):
    records = dirty.changed(dirty.clean("tilt_p10"), dirty.JOINTS, dirty.off_zero(5e-3, 0.0))
    run = read_run(dirty.write(tmp_path, "plain", records))
    assert run.measured("stroke").values[0] == pytest.approx(5e-3, abs=1e-4)  # no scene: no zero
    known = run.replaced(scene=scene)
    assert known.measured("stroke").values[0] == pytest.approx(0.0, abs=1e-4)
    own = {"stroke": {"joint_states": known.measured("stroke")}}
    assert known.replaced(series=own).replaced(scene=scene).series is own


@pytest.mark.parametrize("kind", ["poses_in_mm", "w_first", "no_quaternion", "clocks"])
def test_rules_that_need_no_scene_are_checked_without_one(kind, tmp_path):
    kind = "poses_an_hour_ahead" if kind == "clocks" else kind
    run = read_run(dirty.write(tmp_path, kind))
    assert {doubt.rule.name for doubt in run.doubts} == RULES_OF[kind]
    assert not any("scene" in doubt.rule.needs for doubt in run.doubts)


def test_series_that_are_left_out_are_gone_and_others_are_not(scene, tmp_path):
    run = read_run(dirty.write(tmp_path, "joints_nan"), scene=scene)
    series, doubts = checked(run)
    assert "stroke" not in series
    assert "torsion" not in series
    assert series["chaser"].keys() == {"motion_capture/chaser"}
    assert [doubt.topic for doubt in doubts] == ["/joint_states"]


def test_a_simulated_run_needs_no_rules(scene):
    run = capture_sim.simulate("tilt_p10", t_end=0.1)
    assert run.given.evidence == ()
    assert checked(run) == (run.series, ())


def test_a_rule_that_does_not_exist_cannot_be_waived(scene):
    with pytest.raises(capture_sim.SceneError, match=r"rule 'mm': not found; rules: .*tilted"):
        check(capture_sim.plausibility.measured.Measured(), scene, waived=["mm"])


def test_every_rule_has_a_grade_a_threshold_and_a_reason():
    assert len(RULES) > 25
    for rule in RULES.values():
        assert rule.grade in Grade
        assert rule.compares
        assert rule.threshold
        assert rule.reason


def refusing(run):
    """Return the names of the rules that make a verdict undecided."""
    return {d.rule.name for d in run.doubts if d.grade is Grade.REFUSED or d.leaves_out_topic}


#: Kinds that refuse a verdict of any of the three experiments.
IN_FLIGHT = ("encoder_inverted", "joints_exchanged", "encoder_stuck", "encoder_stuck_in_flight")
IN_FLIGHT += ("encoder_in_mm", "target_stands", "frames_differ")


@pytest.mark.long
@pytest.mark.parametrize("experiment", ["tilt_0", "tilt_p10", "tilt_m10"])
@pytest.mark.parametrize("kind", IN_FLIGHT)
def test_a_verdict_is_refused_by_what_has_come_within_a_second_of_it(kind, experiment, tmp_path):
    """A trial's detector checks the rules again `after_verdict` after a verdict.

    Before, it checked them with the verdict only, and an inverted encoder was 'captured'.
    """
    records = dirty.CHANGES[kind](dirty.clean(experiment))
    scene = capture_sim.load_scene(experiment)
    run = read_run(dirty.write_mcap(tmp_path / "whole.mcap", records), scene=scene)
    assert refusing(run)
    statuses = detect(run.replaced(waived=tuple(refusing(run))))
    first = min(r.t for r in records if r.topic in dirty.BODIES)
    verdicts = [status.t + first for status in statuses if status.state.is_verdict]
    held = min(verdicts, default=math.inf) + TrialLimits().after_verdict
    cut = [record for record in records if record.t <= held]
    assert refusing(read_run(dirty.write_mcap(tmp_path / "held.mcap", cut), scene=scene))
