"""Clean recordings at the noise of real sensors break no rule, live or whole."""

from __future__ import annotations

import numpy as np
import pytest
import rig_noise
from live_measurements import LiveMeasurements

from capture_sim.plausibility.measured import Poses
from capture_sim.plausibility.rules import Grade
from tests.live_measurements import check

NAMES = list(rig_noise.CASES)


@pytest.mark.parametrize("seed", range(len(NAMES)))
def test_no_rule_is_broken_by_the_noise_of_sensors(seed):
    measured, scene = rig_noise.measured(NAMES[seed], seed)
    assert [doubt.line for doubt in check(measured, scene)] == []


@pytest.mark.long
@pytest.mark.parametrize("seed", range(200))
def test_no_rule_is_broken_by_200_clean_recordings(seed):
    measured, scene = rig_noise.measured(NAMES[seed % len(NAMES)], seed)
    assert [doubt.line for doubt in check(measured, scene)] == []


def live_of(measured, until, span=2.0):
    """Return what a node would have kept of measurements until a time, s."""
    live = LiveMeasurements(span)
    ns = 10**9
    rows = []
    for vehicle in ("chaser", "target"):
        poses = getattr(measured, vehicle)
        for k in range(poses.count):
            pose = poses.position[k], poses.quaternion[k], poses.frame_ids[0]
            rows.append((poses.arrival[k], poses.t[k], vehicle, poses.topic, pose))
    buffer = measured.buffer
    for k in range(buffer.count):
        state = buffer.stroke[k], buffer.torsion[k]
        rows.append((buffer.arrival[k], buffer.t[k], "buffer", buffer.topic, state))
    force = measured.force
    for k in range(force.count):
        rows.append((force.arrival[k], force.t[k], "force", force.topic, force.force[k]))
    for arrival, t, source, topic, values in sorted(rows, key=lambda row: row[0]):
        if arrival > until:
            break
        times = round(t * ns), round(arrival * ns)
        if source == "buffer":
            live.add_buffer(topic, *times, *values)
        elif source == "force":
            live.add_force(topic, *times, values, force.frame_ids[0])
        else:
            live.add_pose(source, topic, *times, *values)
    return live.measured(is_before_release=True)


@pytest.mark.parametrize("seed", range(4))
def test_before_the_release_nothing_is_refused_and_mm_are(seed):
    measured, scene = rig_noise.measured("tilt_0", seed)
    live = live_of(measured, 0.0)
    assert live.chaser.count > 50
    assert check(live, scene) == ()

    def in_mm(poses):
        names = ("topic", "t", "arrival", "frame_ids")
        return Poses(*(getattr(poses, n) for n in names), 1e3 * poses.position, poses.quaternion)

    wrong = type(live)(in_mm(live.chaser), in_mm(live.target), live.buffer, origin=live.origin)
    [doubt] = check(wrong, scene)
    assert (doubt.rule.name, doubt.grade) == ("position_units", Grade.REFUSED)
    assert "look like mm" in doubt.line


def test_only_the_last_seconds_are_kept():
    measured, _ = rig_noise.measured("tilt_0", 1)
    live = live_of(measured, 3.0, span=1.0)
    assert float(np.ptp(live.chaser.arrival)) <= 1.0
    assert live.chaser.count > 50
