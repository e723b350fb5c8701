"""What is measured in bags of other recorders and benches."""

from __future__ import annotations

import json
import math

import dirty
import numpy as np
import pytest
from recorded_bags import BENCH_TOPICS, rewritten

from capture_sim.cli import main
from capture_sim.recording.read import read_run
from capture_sim.run.series import PARTS, series_in
from capture_sim.studies.compare.frame import Frame


def test_what_is_no_number_or_comes_twice_is_left_out(path, tmp_path, capsys):
    counter = iter(range(10_000))

    def spoilt(time, message):
        if next(counter) % 7 == 3:
            if hasattr(message, "pose"):
                message.pose.pose.position.x = np.nan
            elif hasattr(message, "axial_stroke"):
                message.axial_stroke = np.nan
            else:
                message.wrench.force.x = np.nan
        yield time, message
        yield time, message

    bag = rewritten(path, tmp_path / "bag", spoilt)
    for series in map(read_run(bag).measured, (*PARTS, "force")):
        assert series.t.size
        assert np.isfinite(series.values).all()
        assert (np.diff(series.t) > 0.0).all()
    # its force is too slow to show every touch, so that none is fitted
    fit = ["--fit", "mu", "--scene", "tilt_0", "--restarts", "0", "--out", str(tmp_path / "fit")]
    assert main(["calibrate", str(bag), *fit]) == 0
    assert main(["compare", str(bag), str(path), "--out", str(tmp_path)]) == 0
    assert "nan" not in capsys.readouterr().out


def test_joints_are_known_by_their_names(path, tmp_path):
    def swapped(time, message):
        if hasattr(message, "name"):
            message.name = message.name[::-1]
            for field in ("position", "velocity"):
                setattr(message, field, getattr(message, field)[::-1].copy())
        yield time, message

    topics = [*BENCH_TOPICS[:2], ("/joint_states", "sensor_msgs/msg/JointState")]
    joints, simulated = read_run(rewritten(path, tmp_path / "bag", swapped, topics)), read_run(path)
    for name in ("stroke", "torsion"):
        found = joints.measured(name).values
        np.testing.assert_array_equal(found, simulated.measured(name).values)


def test_measurements_of_a_bag_are_those_of_the_samples(result, path):
    every = round(result.scene.run.state_rate / result.scene.run.rate)
    exact, run = series_in(result.samples[::every]), read_run(path)
    for name in (*PARTS, "force"):
        series = run.measured(name)
        assert series.t == pytest.approx(exact[name].t, abs=1e-9)
        assert series.values == pytest.approx(exact[name].values, abs=1e-12)


def test_calibrate_finds_what_one_run_was_made_with(path, tmp_path, capsys):
    command = ["calibrate", str(path), "--fit", "mu", "c_A", "--out", str(tmp_path)]
    changed = ["--set", "friction.mu=0.25", "--set", "buffer.c_A=16"]
    assert main([*command, *changed, "--restarts", "1"]) == 0
    found = json.loads((tmp_path / "calibration.json").read_text())
    fitted = dict(zip(found["names"], found["values"], strict=True))
    assert fitted["mu"] == pytest.approx(0.33, rel=1e-4)
    assert fitted["c_A"] == pytest.approx(13.0, rel=1e-4)
    # a scene that is wrong elsewhere does not explain the run
    assert main([*command, "--set", "buffer.k_A=400", "--restarts", "0"]) == 1
    assert "not found: " in capsys.readouterr().out
    assert main(["calibrate", str(path), "--fit", "colour"]) == 2
    assert "colour: no number of tilt_0; " in capsys.readouterr().err


def test_a_frame_of_the_cameras_that_is_taken_out_is_said(tmp_path, capsys):
    """The rig of tilt_p10, whose world is turned by 0.5 rad: rolling resistance is the same."""
    frame = Frame(0.5, 0.1, -0.2)

    def turn(message, _):
        p, o = message.pose.position, message.pose.orientation
        theta = 2.0 * math.atan2(o.z, o.w)
        ((p.x, p.y, theta),) = frame.applied(np.array([[p.x, p.y, theta]]))
        o.z, o.w = math.sin(0.5 * theta), math.cos(0.5 * theta)

    records = dirty.changed(dirty.clean(), dirty.BODIES, turn)
    path = str(dirty.write_mcap(tmp_path / "rig.mcap", records))
    fit = ["--fit", "c_rr", "--scene", "tilt_p10", "--restarts", "0", "--out", str(tmp_path)]
    main(["calibrate", path, *fit])
    said = capsys.readouterr().out
    assert "the frame of the poses is turned by -28.7 deg" in said or "by -28.6 deg" in said
    row = next(line.split() for line in said.splitlines() if line.startswith("c_rr"))
    assert float(row[1]) == pytest.approx(1e-3, rel=0.01)
