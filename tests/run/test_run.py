"""The one Run: what a file gives is what the call gives, and what is derived exists for all."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import capture_sim
from capture_sim import SceneError, load_scene, read_run, simulate
from capture_sim.recording.offline import write_run
from capture_sim.run.given import Given
from capture_sim.run.run import MeasuredRun, detect
from capture_sim.run.series import Series
from capture_sim.studies.evaluate.executors import InProcess
from capture_sim.studies.evaluate.sweep import RTOL

NOISY = ["sensors.motion_capture.rate=100", "sensors.load_cell.rate=1000"]


@pytest.fixture(scope="module")
def run():
    return simulate("tilt_p10", {"buffer.c_A": 14})


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    return read_run(write_run(run, tmp_path_factory.mktemp("runs") / "run.mcap"))


def test_a_file_gives_what_the_call_gave(run, recorded):
    assert recorded.samples.tobytes() == run.samples.tobytes()
    assert [(e.kind, e.t, e.wall) for e in recorded.events] == [
        (e.kind, e.t, e.wall) for e in run.events
    ]
    for name in ("start", "end", "wall", "peak_force", "impulse"):
        assert np.array_equal(recorded.touches[name], run.touches[name])
    assert [(s.t, s.state, s.reason) for s in recorded.statuses] == [
        (s.t, s.state, s.reason) for s in run.statuses
    ]
    source = {"wall_time", "real_time_factor", "made_by"}
    assert {k: v for k, v in recorded.summary.items() if k not in source} == {
        k: v for k, v in run.summary.items() if k not in source
    }
    assert recorded.first_contact == run.first_contact
    assert recorded.plan.hanging_mass == run.plan.hanging_mass
    assert repr(recorded) == repr(run)


def test_what_made_a_run_is_the_same_in_call_and_file(run, recorded):
    in_call, in_file = dict(run.made_by), dict(recorded.made_by)
    assert in_call.pop("source") == "simulated"
    assert in_file.pop("source").endswith("run.mcap")
    assert in_call == in_file
    assert in_call["overrides"] == ["buffer.c_A=14"]
    assert in_call["seed"] is None
    assert simulate("tilt_0", NOISY, t_end=0.1).made_by["seed"] == 0
    titled = simulate("tilt_0", ["title=mine", "friction.mu=0.2", "buffer.c_A=3"], t_end=0.1)
    assert titled.made_by["overrides"] == ["friction.mu=0.2", "buffer.c_A=3"]


def test_a_recording_of_exact_samples_is_detected_as_the_call_was(run, recorded):
    """By the compiled detector; through the pipeline of a bench the heading has another bit."""
    again, live = detect(recorded), run.statuses
    assert [(s.t, s.state, s.distance) for s in again] == [(s.t, s.state, s.distance) for s in live]
    of_series = detect(recorded, from_series=True)
    assert [(s.t, s.state, s.final, s.reason) for s in of_series] == [
        (s.t, s.state, s.final, s.reason) for s in live
    ]
    assert [s.distance for s in of_series] == pytest.approx([s.distance for s in live], abs=1e-12)


def test_simulated_sensors_are_series_of_a_call_too(tmp_path):
    run = simulate("tilt_0", NOISY)
    recorded = read_run(write_run(run, tmp_path / "noisy.mcap"))
    for quantity, source in (
        ("chaser", "motion_capture/chaser"),
        ("target", "motion_capture/target"),
        ("cone_force", "load_cell/wrench"),
        ("torsion", "bench/buffer"),
    ):
        of_call, of_file = run.series[quantity][source], recorded.series[quantity][source]
        assert of_call.t == pytest.approx(of_file.t, abs=1e-9)
        assert of_call.values == pytest.approx(of_file.values, abs=1e-12)
    assert [s.label for s in run.statuses] == [s.label for s in recorded.statuses]


def test_a_load_cell_alone_shows_touches_by_their_normal_force():
    """A slow push on the +y wall, in the cone's axes, with the friction of mu = 0.3."""
    scene = load_scene("tilt_0")
    t = np.arange(0.0, 1.0, 1e-3)
    beta, peak = scene.cone.half_angle, 80.0
    size = peak * np.maximum(np.sin((t - 0.5) / 0.02 * np.pi), 0.0) * (t >= 0.5) * (t < 0.52)
    normal, along = (
        np.array([-np.sin(beta), -np.cos(beta)]),
        np.array([np.cos(beta), -np.sin(beta)]),
    )
    force = size[:, None] * (normal + 0.3 * along)
    series = {"cone_force": {"load_cell/wrench": Series(t, force)}}
    run = MeasuredRun("rig", Given(scene=scene, series=series))
    touches, source = run.resolved_touches
    assert source.startswith("load_cell/wrench, 1000 Hz")
    assert touches.wall.tolist() == [1.0]
    assert touches.peak == pytest.approx([peak], rel=0.01)
    assert touches.start == pytest.approx([0.5], abs=2e-3)
    assert np.hypot(*force.T).max() > 1.04 * peak  # the magnitude has the friction
    assert run.first_contact.t == pytest.approx(0.5, abs=2e-3)


def test_a_run_without_a_scene_says_how_to_give_one(recorded):
    bare = recorded.replaced(scene=None)
    with pytest.raises(SceneError, match="contains no scene: give it with --scene"):
        _ = bare.scene
    assert bare.measured("chaser").t.size
    assert "without a scene" in repr(bare)


def test_a_run_is_sent_to_another_process(run, recorded):
    for each in (run, recorded, simulate("tilt_0", NOISY, t_eval=[0.0, 1.0])):
        sent = pickle.loads(pickle.dumps(each))
        assert sent.samples.tobytes() == each.samples.tobytes()
        assert sent.verdict == each.verdict


def test_tables_have_names_in_place_of_numbers(run, recorded):
    pytest.importorskip("pandas", reason="pandas is not installed")
    samples, events = run.to_dataframe(), run.to_dataframe("events")
    assert samples["phase"].iloc[0] == "taut"
    assert set(samples["phase"].cat.categories) >= {"taut", "contact", "latched"}
    assert events["kind"].iloc[0] == "release"
    odometry = recorded.to_dataframe("chaser/odom")
    assert odometry.attrs["units"]["pose.pose.position.x"] == "m"
    assert odometry["pose.pose.position.x"].to_numpy() == pytest.approx(
        recorded.series["chaser"]["chaser/odom"].values[:, 0]
    )


def test_a_row_of_a_table_is_a_set_of_overrides():
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    table = pandas.DataFrame({"buffer.c_A": [5.0, 7.0], "friction.mu": [0.2, 0.3], "x": ["a", "b"]})
    run = simulate("tilt_0", table.loc[1, ["buffer.c_A", "friction.mu"]], t_end=0.1)
    assert (run.scene.buffer.c_A, run.scene.friction.mu) == (7.0, 0.3)
    changed = simulate(load_scene("tilt_0"), table.loc[0, ["buffer.c_A"]], t_end=0.1)
    assert changed.scene.buffer.c_A == 5.0
    assert capture_sim.read_run is read_run


def test_the_energy_residual_of_a_call_and_of_a_sweep_is_one_number():
    pytest.importorskip("pandas", reason="pandas is not installed")
    table = capture_sim.sweep("tilt_0", {"buffer.c_A": [7.0]}, executor=InProcess())
    run = simulate("tilt_0", {"buffer.c_A": 7.0}, rtol=RTOL)  # the default of a sweep
    assert table["energy_residual"].tolist() == [run.summary["energy_residual"]]


def test_a_scene_may_be_given_by_its_name_wherever_one_is(tmp_path):
    """``read_run(path, scene="tilt_0")`` ended in an AttributeError far from the call."""
    path = write_run(capture_sim.simulate("tilt_0", {"run.t_end": 1.0}), tmp_path / "run.mcap")
    for scene in ("tilt_0", capture_sim.load_scene("tilt_0")):
        assert capture_sim.read_run(path, scene=scene).scene.name == "tilt_0"
    with pytest.raises(SceneError, match="tilt_7"):
        capture_sim.read_run(path, scene="tilt_7")
    with pytest.raises(SceneError, match="tilt_7"):
        capture_sim.calibrate([capture_sim.read_run(path)], ["c_rr"], predict="tilt_7")
