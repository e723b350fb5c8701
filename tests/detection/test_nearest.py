"""The closest approach of a path that is measured with noise: no noise pulls it to zero."""

from __future__ import annotations

import json
import math

import dirty
import numpy as np
import pytest

import capture_sim
from capture_sim.cli import main
from capture_sim.detection.nearest import ClosestApproach, Half
from capture_sim.recording.read import read_run
from capture_sim.run.run import detect
from capture_sim.studies.compare.compare import characteristics, sides

RNG_SEED = 4
#: A rebound that comes within 2 mm.
REBOUND = ("latch=null", "buffer.c_A=1", "run.t_end=4")


def halves(point, sigma, rng):
    """Return both halves' positions of a point, with independent noise."""
    found = [rng.normal(point, sigma) for _ in range(2)]
    return tuple(Half(x, y, sigma**2, sigma**2) for x, y in found)


@pytest.mark.parametrize("distance", [2.0, 5.0, 30.0])
def test_estimate_at_rest_has_no_bias_and_the_error_that_it_says(distance):
    """A tip at rest, seen at 200 instants: the minimum of the noisy distances is far too small."""
    rng = np.random.default_rng(RNG_SEED)
    point = distance * np.array([math.cos(0.4), math.sin(0.4)])
    pulls, smallest = [], []
    for _ in range(100):
        closest, distances = ClosestApproach(), []
        for _ in range(200):
            pair = halves(point, 0.5, rng)
            closest.add(pair)
            distances.append(math.hypot(pair[0].axial, pair[0].lateral))
        value, error = closest.estimate
        smallest.append(min(distances))
        if math.isfinite(error):
            pulls.append((value - distance) / error)
    assert np.mean(smallest) < distance - 1.0
    assert len(pulls) > 80
    assert abs(np.mean(pulls)) < 0.35
    assert 0.7 < np.std(pulls) < 1.4


def test_distance_within_the_noise_is_only_limited():
    rng = np.random.default_rng(RNG_SEED)
    limits = []
    for _ in range(100):
        closest = ClosestApproach()
        closest.add(halves((0.3, 0.0), 1.0, rng))
        value, error = closest.estimate
        if math.isinf(error):
            limits.append(value)
    assert len(limits) > 60
    assert np.mean(np.array(limits) > 0.3) > 0.95


def test_exact_path_has_its_smallest_sample():
    closest = ClosestApproach()
    assert closest.estimate == (math.inf, 0.0)
    for distance in (3.0, 1.0, 2.0):
        closest.add_exact(distance)
    assert closest.estimate == (1.0, 0.0)


@pytest.mark.parametrize("changes", [(), REBOUND], ids=["captured", "rebound"])
@pytest.mark.parametrize("noise", [3e-4, 1e-3])
def test_estimate_of_a_run_covers_what_happened(changes, noise):
    """Poses with noise, at 100 Hz; the tip turns round at a wall and stops within a hundredth."""
    known = 0
    for seed in range(3):
        cameras = f"{{position_noise: {noise}, heading_noise: {noise}}}"
        sensors = [f"sensors.motion_capture={cameras}", f"sensors.seed={seed}"]
        run = capture_sim.simulate("tilt_p10", [*sensors, *changes])
        status, true = detect(run)[-1], run.loads["nearest_distance"]
        if math.isinf(status.nearest_deviation):
            assert status.nearest_distance > true
        else:
            known += 1
            assert status.nearest_deviation > 0.0
            assert abs(status.nearest_distance - true) < 3.5 * status.nearest_deviation
    assert known == 3 or noise > 5e-4


def test_every_command_gives_the_same_figure(tmp_path, capsys):
    quiet = "sensors.motion_capture={position_noise: 3e-4, heading_noise: 3e-4}"
    records = dirty.clean("tilt_p10", quiet)
    path = dirty.write_mcap(tmp_path / "rig.mcap", records)
    scene = capture_sim.load_scene("tilt_p10")
    run = read_run(path, scene=scene)
    status = run.statuses[-1]
    value, error = status.nearest_distance, status.nearest_deviation
    assert 0.0 < error < 5e-4
    assert value == pytest.approx(dirty.TRUE.nearest, abs=4.0 * error)
    assert run.summary["nearest_distance"] == run.loads["nearest_distance"] == value
    assert run.summary["nearest_distance_error"] == error
    assert json.loads(json.dumps(run.summary))["nearest_distance_time"] is None
    figure = characteristics(sides(run, run)[0])["closest approach to BE, mm"]
    assert figure.value == pytest.approx(value * 1e3)
    assert f"+- {error * 1e3:.2f} mm" in figure.source
    assert main(["detect", str(path), "--scene", "tilt_p10"]) == 0
    text = f"closest approach {value * 1e3:.2f} mm +- {error * 1e3:.2f} mm"
    assert text in capsys.readouterr().out


def test_noise_that_hides_it_is_said(tmp_path, capsys):
    loud = "sensors.motion_capture={position_noise: 3e-3, heading_noise: 3e-3}"
    path = dirty.write_mcap(tmp_path / "rig.mcap", dirty.clean("tilt_p10", loud))
    run = read_run(path, scene=capture_sim.load_scene("tilt_p10"))
    assert math.isinf(run.statuses[-1].nearest_deviation)
    assert run.summary["nearest_distance"] is run.summary["nearest_distance_error"] is None
    assert "closest approach to BE, mm" not in characteristics(sides(run, run)[0])
    assert main(["detect", str(path), "--scene", "tilt_p10"]) == 0
    assert "closest approach hidden by noise or a gap, below" in capsys.readouterr().out


def test_located_closest_approach_is_that_of_every_output(tmp_path, capsys):
    """Of a run that was simulated: between the detector's samples the tip came nearer."""
    from capture_sim.recording.offline import write_run

    run = capture_sim.simulate("tilt_p10")
    path = write_run(run, tmp_path / "run.mcap")
    true = run.loads["nearest_distance"]
    assert run.statuses[-1].nearest_distance > true + 5e-5
    assert read_run(path).summary["nearest_distance"] == run.summary["nearest_distance"] == true
    assert run.summary["nearest_distance_error"] == 0.0
    assert main(["detect", str(path)]) == 0
    assert f"closest approach {true * 1e3:.3f} mm, " in capsys.readouterr().out
