"""The load cell: its frame is used, its drift is removed, and a contact without it is found."""

from __future__ import annotations

import dirty
import numpy as np
import pytest
from live_measurements import LiveMeasurements

import capture_sim
from capture_sim.plausibility.axes import FORCE_FRAMES
from capture_sim.plausibility.force import MAX_REST_FORCE, MAX_ZERO, REST_TIME
from capture_sim.recording.read import read_run
from capture_sim.run.touches import first_above
from tests.live_measurements import check


@pytest.fixture(scope="module")
def scene():
    return capture_sim.load_scene("tilt_p10")


def in_frame(frame, force_of):
    def change(message, t):
        message.header.frame_id = frame
        force = message.wrench.force
        force.x, force.y = force_of(force.x, force.y, t)

    return lambda records: dirty.changed(records, dirty.CELL, change)


@pytest.mark.parametrize("frame", FORCE_FRAMES)
def test_a_force_is_turned_from_the_axes_of_its_frame(frame, scene, tmp_path):
    """Independently turned into the frame by the simulated attitudes, it comes back as it was."""
    truth = capture_sim.simulate("tilt_p10")
    own = {"chaser/tip": 3, "chaser/base_link": 2, "target/cone": 7, "target/base_link": 7}
    q = truth.q[:, own[frame]] if frame in own else np.zeros(truth.t.size)
    angle = q - truth.q[:, 7]  # of the frame, in the target's

    def of(x, y, t):
        a = -np.interp(t, truth.t, angle)
        return float(np.cos(a) * x - np.sin(a) * y), float(np.sin(a) * x + np.cos(a) * y)

    records = in_frame(frame, of)(dirty.clean())
    run = read_run(dirty.write_mcap(tmp_path / "turned.mcap", records), scene=scene)
    plain = read_run(dirty.write(tmp_path, "plain"), scene=scene)
    assert run.doubts == ()
    difference = run.cone_force.values - plain.cone_force.values
    largest = np.abs(plain.cone_force.values).max()
    # the measured headings have a noise of some mrad
    assert np.abs(difference).max() < 0.02 * largest
    assert largest > 5.0


@pytest.mark.parametrize("frame", ["ft_sensor", ""])
def test_a_force_in_unknown_axes_is_left_out(frame, scene, tmp_path):
    records = in_frame(frame, lambda x, y, _: (x, y))(dirty.clean())
    run = read_run(dirty.write_mcap(tmp_path / "turned.mcap", records), scene=scene)
    [doubt] = run.doubts
    assert doubt.rule.name == ("force_frame" if frame else "force_frame_empty")
    assert all(name in doubt.text for name in FORCE_FRAMES)
    assert bool(run.measured("cone_force").t.size) is not frame
    # without the force, the contact is that of the buffer
    assert run.first_contact.t == pytest.approx(dirty.TRUE.first_contact, abs=0.011)


@pytest.mark.parametrize("rate", [0.013, 0.05, 0.2])
@pytest.mark.parametrize("noise", [0.02, 0.1, 0.5])
def test_a_slow_drift_makes_no_contact(rate, noise):
    """A contact at 2.6 s, of touches of 20 N, on a cell whose zero drifts."""
    rng = np.random.default_rng(round(1e4 * rate + 10 * noise))
    t = np.arange(0.0, 6.0, 1e-3)
    for _ in range(5):
        contact = rng.uniform(1.0, 4.0)
        force = rng.normal(size=(t.size, 2)) * noise + np.outer(rate * t, [1.0, -0.5])
        force[(t >= contact) & (t < contact + 0.004), 0] -= 20.0
        assert first_above(t, force) == pytest.approx(contact, abs=2e-3)


def test_a_wavering_zero_makes_no_contact():
    """As of a cell that warms up: no line, but slow."""
    t = np.arange(0.0, 30.0, 1e-3)
    force = np.random.default_rng(5).normal(size=(t.size, 2)) * 0.1
    force[:, 0] += 1.5 * (1.0 - np.exp(-t / 8.0)) + 0.2 * np.sin(0.5 * t)
    assert first_above(t, force) is None
    force[t >= 20.0, 0] -= 15.0
    assert first_above(t, force) == pytest.approx(20.0, abs=2e-3)


def test_compare_aligns_a_drifting_cell_by_its_contact(scene, tmp_path):
    run = read_run(dirty.write(tmp_path, "cell_drifts"), scene=scene)
    assert run.first_contact.t == pytest.approx(dirty.TRUE.first_contact, abs=1.5e-3)


def test_a_force_where_poses_allow_no_contact_does_not_align(scene, tmp_path):
    """A cable is pulled a second after the release."""

    def of(x, y, t):
        return (x + 9.0 if 1.0 <= t < 1.3 else x), y

    records = in_frame("target/base_link", of)(dirty.clean())
    run = read_run(dirty.write_mcap(tmp_path / "pulled.mcap", records), scene=scene)
    assert "force_without_contact" in {doubt.rule.name for doubt in run.doubts}
    assert run.first_contact.source == "joint_states"
    assert run.first_contact.t == pytest.approx(dirty.TRUE.first_contact, abs=0.011)


# before a release


def broken_at_rest(force_at, *, rate=100.0, noise=0.0, is_before_release=True, waived=()):
    """Return the lines about a load cell that read ``force_at(t)``, N, in the last 2 s."""
    live, source = LiveMeasurements(), np.random.default_rng(1)
    for k in range(round(2.0 * rate)):
        t = (k - 2.0 * rate) / rate + 2.0
        force = np.asarray(force_at(t)) + noise * source.standard_normal(3)
        live.add_force("load_cell/wrench", round(1e9 * t), round(1e9 * t), force, "target/cone")
    measured = live.measured(is_before_release=is_before_release)
    doubts = check(measured, waived=waived)
    return [doubt.line for doubt in doubts if doubt.rule.name == "force_at_rest"]


@pytest.mark.parametrize("rate", [50.0, 1000.0])
def test_the_zero_of_a_load_cell_at_its_bound(rate):
    share = 1.0 / np.sqrt(3.0)
    assert broken_at_rest(lambda t: 3 * [share * (MAX_ZERO - 0.01)], rate=rate) == []
    [line] = broken_at_rest(lambda t: 3 * [share * (MAX_ZERO + 0.01)], rate=rate)
    assert line.startswith("load_cell/wrench: refused (force_at_rest): 50.01 N at rest: must be")


@pytest.mark.parametrize("rate", [50.0, 1000.0])
def test_a_hand_at_the_cone_at_its_bound(rate):
    """It comes 0.2 s before the release, on a cell with an offset."""
    for push in (MAX_REST_FORCE - 0.01, -MAX_REST_FORCE - 0.01):
        lines = broken_at_rest(lambda t, x=push: (10.0, x * (t > 1.8), 0.0), rate=rate)
        assert len(lines) == (abs(push) > MAX_REST_FORCE), lines
    assert "changes by 3.01 N at rest: must be at most 3 N" in lines[0]


def test_what_is_no_hand_at_the_cone():
    assert broken_at_rest(lambda t: (2.0 + 0.05 * t, 0.0, 0.0), noise=0.5) == []  # a hard case
    assert broken_at_rest(lambda t: (0.0, 0.0, 0.0), noise=3.0) == []
    assert broken_at_rest(lambda t: (40.0 * (t < 2.0 - REST_TIME - 0.02), 0.0, 0.0)) == []  # over
    assert broken_at_rest(lambda t: (20.0 * (abs(t - 1.8) < 0.015), 0.0, 0.0)) == []  # a spike


def test_a_pushed_cone_can_be_waived_and_is_no_doubt_of_a_recording():
    def pushed(t):
        return 60.0 * (t > 1.7), 0.0, 0.0

    assert len(broken_at_rest(pushed)) == 2
    assert broken_at_rest(pushed, waived=["force_at_rest"]) == []
    assert broken_at_rest(pushed, is_before_release=False) == []
