"""The contact at the integrator's own steps: sent, recorded, read, exported, drawn."""

import csv
import itertools

import numpy as np
import pytest

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.dynamics.samples import TRACE
from capture_sim.errors import SimulationError
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import (
    BENCH_STATE,
    CONTACT_TRACE,
    RUN_INFO,
    STREAM_COUNTS,
)
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import PUBLISHERS, run_stream, write_run
from capture_sim.viewing.source import normal_force_with_peaks

NAME = "tilt_p10"


@pytest.fixture(scope="module")
def result():
    return simulate(load_scene(NAME, ["run.trace=true"]))


@pytest.fixture(scope="module")
def path(result, tmp_path_factory):
    return write_run(result, tmp_path_factory.mktemp("trace") / f"{NAME}.mcap")


def touch_of(run, touch):
    """Return times and normal force of a recorded touch, its ends included."""
    inside = (run.trace["t"] > touch["start"]) & (run.trace["t"] < touch["end"])
    wall = 0 if touch["wall"] > 0 else 1
    t = np.concatenate([[touch["start"]], run.trace["t"][inside], [touch["end"]]])
    force = np.concatenate([[0.0], run.trace["normal_force"][inside, wall], [0.0]])
    return t, force


def curvature(t, force):
    """Return the largest second derivative near each interval, by divided differences."""
    slope = np.diff(force) / np.diff(t)
    second = np.abs(np.diff(slope)) / (0.5 * (t[2:] - t[:-2]))
    return np.maximum(np.append(second, second[-1]), np.insert(second, 0, second[0]))


def test_recorded_trace_is_the_core_s_to_the_bit(result, path):
    run = read_bag(path)
    assert run.complete
    assert run.trace.dtype == TRACE
    assert len(run.trace) == len(result.trace) > 1000
    for name in TRACE.names:
        assert run.trace[name].tobytes() == result.trace[name].tobytes(), name


@pytest.mark.parametrize("rtol", [1e-6, 1e-8, 1e-11])
def test_trace_agrees_with_the_recorded_touches_as_its_steps_allow(rtol, tmp_path):
    """The trapezoid rule errs by h^3/12 of the curvature, the highest point by h^2/8 of it."""
    scene = load_scene(NAME, ["run.trace=true", f"run.rtol={rtol}"])
    run = read_bag(write_run(simulate(scene), tmp_path / "x.mcap"))
    assert len(run.touches) == 15
    shares = []
    for touch in run.touches:
        t, force = touch_of(run, touch)
        h, second = np.diff(t), curvature(t, force)
        impulse = (0.5 * h * (force[1:] + force[:-1])).sum()
        allowed = (h**3 / 12.0 * second).sum()
        assert abs(impulse - touch["impulse"]) < allowed
        shares.append(allowed / touch["impulse"])
        top = int(force.argmax())
        near = slice(top - 1, top + 1)
        assert force[top] <= touch["peak_force"] * (1.0 + 1e-12)
        assert touch["peak_force"] - force[top] < (h[near] ** 2 / 8.0 * second[near]).max()
        assert t[top - 1] < touch["peak_time"] < t[top + 1]
    # and what the steps allow is little
    assert max(shares) < {1e-6: 0.1, 1e-8: 0.04, 1e-11: 0.01}[rtol]


def test_points_are_told_with_the_first_sample_behind_them(result):
    description = RunDescription.of(result.scene, "a run", PUBLISHERS)
    sent = [
        (topic, typestore().deserialize_cdr(data, topic.type_name))
        for topic, _, data in run_stream(result, description)
        if topic in (BENCH_STATE, CONTACT_TRACE)
    ]
    told = 0
    for (before, state), (topic, message) in itertools.pairwise(sent):
        if topic is CONTACT_TRACE:
            assert before is BENCH_STATE  # so at most one for each sample
            assert message.header.stamp == state.header.stamp
            period = 1.0 / result.scene.run.state_rate
            assert state.t - 1.001 * period <= message.t.min() <= message.t.max() < state.t
            assert message.seq == told
            told += 1
    assert told > 100


def test_trace_changes_nothing_else_and_is_off_unless_asked_for(result):
    plain = simulate(load_scene(NAME))
    assert plain.trace.size == 0

    def others(one):
        description = RunDescription.of(one.scene, "a run", PUBLISHERS)
        return [
            (topic.name, data)
            for topic, _, data in run_stream(one, description)
            if topic not in (CONTACT_TRACE, RUN_INFO, STREAM_COUNTS)
        ]

    assert others(plain) == others(result)
    assert plain.statistics == result.statistics


def test_run_that_fails_in_a_touch_tells_the_points_up_to_there(tmp_path):
    scene = load_scene("paper_designed", ["run.trace=true", "run.max_steps=200"])
    with pytest.raises(SimulationError, match="max_steps") as failed:
        simulate(scene)
    result = failed.value.result
    run = read_bag(write_run(result, tmp_path / "x.mcap"))
    assert [problem for problem in run.problems if "ended the run early" not in problem] == []
    assert run.trace["t"].tobytes() == result.trace["t"].tobytes()
    assert run.trace["t"][-1] > run.samples["t"][-1]


def test_table_of_the_trace_has_a_row_for_each_point(result, path, tmp_path):
    assert main(["export", str(path), "--to", "csv", "--out", str(tmp_path)]) == 0
    with (tmp_path / "bench_contact_trace.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(result.trace)
    for key, column in (
        ("t [s]", result.trace["t"]),
        ("q.theta_T [rad]", result.trace["q"][:, 7]),
        ("normal_force.-y [N]", result.trace["normal_force"][:, 1]),
    ):
        assert [float(row[key]) for row in rows] == column.tolist()
    assert main(["export", str(path), "--to", "npz", "--out", str(tmp_path)]) == 0
    with np.load(tmp_path / f"{NAME}.npz") as arrays:
        penetration = arrays["bench/contact_trace/penetration"]
    assert penetration.tobytes() == result.trace["penetration"].tobytes()


def test_trace_is_simulated_again_and_compared(path, tmp_path, capsys):
    assert main(["compare", str(path), "--simulated", "--out", str(tmp_path)]) == 0
    assert "bit-identical" in capsys.readouterr().out


def test_force_that_is_drawn_goes_through_the_trace(result, path):
    plain, traced = (normal_force_with_peaks(r) for r in (simulate(load_scene(NAME)), result))
    assert len(traced[0]) > len(plain[0]) + 1000
    assert np.isin(result.trace["t"], traced[0]).all()
    assert traced[1].max() == plain[1].max() == result.touches["peak_force"].max()
    read = normal_force_with_peaks(read_bag(path))
    assert np.array_equal(read, traced)
