"""The bounds of a measured run's first contact, verdict and closest approach."""

from __future__ import annotations

import math

import dirty
import pytest
from cases import cases

import capture_sim
from benchmarks.detection import bound
from capture_sim.cli import main
from capture_sim.recording.read import read_run
from capture_sim.run.run import detect

#: The first pose of the rig is a second before the release; times count from it.
CONTACT = dirty.TRUE.first_contact


def rig(folder, records):
    path = dirty.write_mcap(folder / "rig.mcap", records)
    return read_run(path, scene=capture_sim.load_scene("tilt_p10"))


def begin(records):
    return min(r.t for r in records if r.topic in dirty.BODIES)


def without(records, low, high, *topics):
    return [r for r in records if not (low < r.t < high and (not topics or r.topic in topics))]


@pytest.mark.parametrize(
    "lost, why, width",
    [
        ((), "", 0.015),
        ((dirty.CELL,), "", 0.015),  # the buffer shows it
        ((dirty.JOINTS,), "a source has no data", 0.3),
        (dirty.BODIES, "a source has no data", 0.4),
        ((dirty.CELL, dirty.JOINTS, *dirty.BODIES), "no data", 1.05),
    ],
)
def test_a_hole_is_in_the_bounds_of_what_it_may_hide(lost, why, width, tmp_path):
    records = without(dirty.clean(), 2.3, 3.3, *lost) if lost else list(dirty.clean())
    run = rig(tmp_path, records)
    bounds, offset = run.contact_bounds, begin(records)
    assert bounds.low + offset <= CONTACT <= bounds.high + offset
    assert bounds.high - bounds.low < width
    assert bounds.why == why
    assert {doubt.rule.name for doubt in run.doubts} == ({"gap"} if lost else set())
    assert bounds.low <= run.first_contact.t <= bounds.high
    assert run.summary["first_contact_time_low"] == bounds.low
    assert run.summary["first_contact_time_high"] == bounds.high
    last = detect(run)[-1]
    since = last.t - last.time_in_state
    assert since - last.may_precede <= 3.41 - offset <= since + last.may_follow + 1e-9
    true = capture_sim.simulate("tilt_p10").loads
    for key in ("max_axial_stroke_in", "max_axial_stroke_out", "max_torsion"):
        low, high = (run.summary[f"{key}_{end}"] for end in ("low", "high"))
        assert low <= true[key]
        if dirty.JOINTS in lost:
            assert high is None
        else:
            assert true[key] <= high < true[key] * 1.1
    assert run.summary["max_normal_force_low"] <= true["max_normal_force"]
    assert run.summary["max_normal_force_high"] is None


@pytest.mark.parametrize("first", [2.7, 4.0])
def test_a_recording_that_begins_after_the_contact_does_not_know_it(first, tmp_path, capsys):
    records = [r for r in dirty.clean() if r.t > first]
    run = rig(tmp_path, records)
    assert run.contact_bounds.low == -math.inf
    assert run.summary["first_contact_time_low"] is None
    loads = ("max_axial_stroke_in", "max_axial_stroke_out", "max_torsion")
    bounds = {run.summary[f"{load}_{end}"] for load in loads for end in ("low", "high")}
    assert bounds == {None}  # the zero of the encoders is not known
    assert any("the zero is not known and counts as 0" in doubt.line for doubt in run.doubts)
    main(["detect", str(tmp_path / "rig.mcap"), "--scene", "tilt_p10"])
    (line,) = (x for x in capsys.readouterr().out.splitlines() if x.startswith("first contact"))
    assert line.startswith("first contact before ")
    assert line.endswith("(the recording begins with the tip at the walls)")


@pytest.mark.parametrize("number", [134, 165])
def test_a_tip_at_rest_somewhere_is_undecided_if_the_zero_is_not_known(number):
    """Before, these two of the drawn recordings, which begin in the contact, were 'stuck'."""
    names, _, verdict, _ = bound(number)
    assert {"zero", "late begin"} <= set(names)
    assert verdict == "undecided, not captured"


@pytest.mark.parametrize("stroke", [2e-4, 5e-3, -5e-3])
def test_commands_agree_on_the_first_contact_whatever_the_zero(stroke, tmp_path, capsys):
    """Before, `detect` and `compare` differed by 0.25 s for a zero of 0.2 mm."""
    records = dirty.changed(
        dirty.thinned(dirty.clean(), 4), dirty.JOINTS, dirty.off_zero(stroke, 0.0)
    )
    run = rig(tmp_path, records)
    bounds = run.contact_bounds
    assert bounds.high - bounds.low < 0.015
    path = str(tmp_path / "rig.mcap")
    text = f"{run.first_contact.t:.3f} s"
    for command in ("detect", "inspect"):
        main([command, path, "--scene", "tilt_p10"])
        (line,) = (x for x in capsys.readouterr().out.splitlines() if x.startswith("first contact"))
        assert text in line
    main(["compare", path, path, "--scene", "tilt_p10", f"--out={tmp_path}"])
    (line,) = (x for x in capsys.readouterr().out.splitlines() if "first contact, s" in x)
    assert f"{run.first_contact.t:.4f}" in line


def test_a_gap_hides_the_closest_approach(tmp_path):
    quiet = dirty.clean("tilt_p10", "sensors.motion_capture.position_noise=1e-5")
    whole, holed = (rig(tmp_path, r) for r in (quiet, without(quiet, 2.8, 5.0)))
    assert math.isfinite(detect(whole)[-1].nearest_deviation)
    last = detect(holed)[-1]
    assert math.isinf(last.nearest_deviation)
    assert last.nearest_distance > dirty.TRUE.nearest


def test_a_simulated_run_knows_its_times():
    summary = capture_sim.simulate("paper_designed").summary
    low, value, high = (summary[f"first_contact_time{end}"] for end in ("_low", "", "_high"))
    assert low == value == high
    assert summary["impact_speed_error"] == 0.0


def test_a_driver_that_repeats_poses_gives_the_noise_of_its_cameras(tmp_path):
    """Before, each pose twice made the closest approach 'below 0.9 mm', and it was 1.79 mm."""
    found = [detect(rig(tmp_path, dirty.repeated(dirty.clean(), n)))[-1] for n in (1, 2, 10)]
    for last in found:
        assert math.isinf(last.nearest_deviation)
        assert last.nearest_distance == pytest.approx(found[0].nearest_distance, rel=0.1)


@pytest.mark.parametrize("number", range(cases(3, 30)))
def test_drawn_faults_leave_the_truth_within_the_bounds(number):
    """All but stamps that are late, of which bounds know only where the sources differ."""
    names, first, verdict, peaks = bound(1000 + number, has_latency=False)
    assert first is None or first[0], (names, first)
    assert not isinstance(verdict, tuple) or verdict[0], (names, verdict)
    assert all(peak[0] for peak in peaks), (names, peaks)
