"""What is cut is undecided: no end of a recording is taken for the end of its run."""

from __future__ import annotations

import math

import dirty
import numpy as np
import pytest
from cases import cases

import capture_sim
from capture_sim.cli import main
from capture_sim.messages.definitions import blank, typestore
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.run.run import detect

#: A capture, and a rebound that retreats far; 20 mm from the closest approach are a verdict.
CAPTURED, REBOUND = ("tilt_p10",), ("tilt_p10", "latch=null", "buffer.c_A=1", "run.t_end=5")


def recorded(case, t_end, path, *, finish):
    """Write what cameras and encoders recorded until a time, s since the release."""
    records = [r for r in dirty.clean(*case) if r.t < t_end and r.topic != dirty.CELL]
    return dirty.write_mcap(path, records, finish=finish, chunk_size=20_000)


@pytest.mark.parametrize("finish", [True, False], ids=["closed", "killed"])
@pytest.mark.parametrize("case", [CAPTURED, REBOUND], ids=["captured", "rebound"])
def test_cut_at_any_time_gives_no_verdict_that_the_motion_has_not_given(case, finish, tmp_path):
    scene = capture_sim.load_scene("tilt_p10", case[1:])
    whole = recorded(case, math.inf, tmp_path / "whole.mcap", finish=True)
    final = detect(read_run(whole, scene=scene))[-1]
    since = final.t - final.time_in_state
    assert final.state.is_verdict
    rng = np.random.default_rng(1)
    drawn = rng.uniform(2.5, since + 0.5, 4)
    for t in cases(few=[2.65, drawn[0]], all=[2.2, 2.59, 2.65, 3.2, *drawn]):
        run = read_run(recorded(case, t, tmp_path / "cut.mcap", finish=finish), scene=scene)
        verdict = detect(run)[-1]
        if verdict.state.is_verdict:
            assert verdict.state is final.state, t
            assert t > since, t
        else:
            assert verdict.label == "undecided", t
            if t > 1.0:
                assert "the recording was cut, with the tip" in verdict.reason, t
        assert run.summary["verdict"] == run.verdict == verdict.state.label


def test_killed_recorder_is_undecided_in_every_command(tmp_path, capsys):
    path = str(dirty.write(tmp_path, "recorder_killed"))
    assert main(["detect", path, "--scene", "tilt_p10"]) == 0
    printed = capsys.readouterr().out
    assert "verdict: undecided" in printed
    assert "the recording was cut, with the tip" in printed
    page = tmp_path / "page.html"
    assert main(["report", path, "--scene", "tilt_p10", "--out", str(page)]) == 0
    assert "undecided" in page.read_text(encoding="utf-8")
    for word in ("rebound", "missed"):
        assert f">{word}<" not in page.read_text(encoding="utf-8")


def test_chaser_that_is_held_again_is_the_end_of_a_run(tmp_path):
    """While the tip moves out, after a contact: without the holding device it is a cut."""
    scene = capture_sim.load_scene("tilt_p10", REBOUND[1:])
    final = detect(read_run(recorded(REBOUND, 9.0, tmp_path / "a.mcap", finish=True), scene=scene))
    # it has retreated by more than 5 mm, the capture zone, and less than 20 mm
    t = final[-1].t - final[-1].time_in_state - 0.1
    held = blank("std_msgs/msg/Bool")
    held.data = True
    data = bytes(typestore().serialize_cdr(held, "std_msgs/msg/Bool"))
    records = [r for r in dirty.clean(*REBOUND) if r.t < t and r.topic != dirty.CELL]
    cut = read_run(dirty.write_mcap(tmp_path / "cut.mcap", records), scene=scene)
    hold = dirty.Record("/launcher/hold", "std_msgs/msg/Bool", records[-1].log_time, data)
    ended = read_run(dirty.write_mcap(tmp_path / "held.mcap", [*records, hold]), scene=scene)
    assert detect(cut)[-1].label == "undecided"
    assert detect(ended)[-1].label == "rebound"


@pytest.mark.parametrize("share", [0.3, 0.35])
def test_cut_recording_of_the_suite_is_undecided_as_its_detector_left_it(share, tmp_path, capsys):
    """The detector's last status is 'contact' there, which is no verdict."""
    path = write_run(capture_sim.simulate("tilt_p10"), tmp_path / "whole.mcap")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    run = read_run(path)
    assert run.given.statuses[-1].label == "contact"
    assert run.verdict == run.summary["verdict"] == "undecided"
    assert "the recording was cut" in run.statuses[-1].reason
    assert main(["detect", str(path)]) == 0
    assert capsys.readouterr().out.rstrip().endswith("the same")
