"""The capture envelope: the map, its refinement, its file, and that it is the same everywhere."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.commands.envelope import experiments
from capture_sim.detection.exact import CaptureState
from capture_sim.errors import SceneError
from capture_sim.recording.envelope_file import read_envelope, write_envelope
from capture_sim.studies.approach import approach_of, placed
from capture_sim.studies.envelope import ROW, Plan, Slices, Span, evaluate, explore, replay
from capture_sim.studies.envelope_runs import KeptRuns, plan_from_mapping
from capture_sim.studies.executors import ExecutorError, InProcess, answers, open_executor
from capture_sim.studies.outcome import run_to_end, run_to_verdict


def plan(levels=1, runs=10_000, cells=3):
    return Plan(
        load_scene("tilt_0"),
        angle=Span(-0.4, 0.4, cells),
        offset=Span(-0.05, 0.05, cells),
        speed=Slices((0.1,)),
        levels=levels,
        runs=runs,
    )


def disc(plan, keys, radius):
    """Rows of an invented bench that captures within a circle."""
    rows = np.zeros(len(keys), ROW)
    for row, key in zip(rows, keys, strict=True):
        row["slice"], row["i"], row["j"] = key
        row["angle"], row["offset"], row["speed"] = plan.values(key)
        inside = math.hypot(row["angle"] / 0.4, row["offset"] / 0.05) < radius
        row["verdict"] = CaptureState.CAPTURED if inside else CaptureState.REBOUND
        row["finer_verdict"] = row["verdict"]
    return rows


@pytest.mark.parametrize("radius", [0.55, 0.8])
def test_area_of_a_disc_is_bracketed_ever_closer(radius):
    """The plane is [-1, 1]^2 in units of its half widths: pi r^2 / 4 of it is captured."""
    true, widths, counts = math.pi * radius**2 / 4.0, [], []
    for levels in (0, 2, 4):
        p = plan(levels, cells=6)
        e = explore(p, lambda name, keys, rtol, p=p: disc(p, keys, radius))
        share = e.shares[0]
        assert share["surely"] <= true <= share["perhaps"]
        assert sum(e.area(cell) for cell in e.cells) == pytest.approx(1.0)
        widths.append(share["perhaps"] - share["surely"])
        counts.append(len(e.rows))
    assert widths[2] < widths[0] / 8
    # the boundary is a line: runs grow as 2^level, those of a full grid as 4^level
    assert counts[2] < 0.2 * (6 * 16 + 1) ** 2


def test_boundary_is_refined_to_the_finest_level_everywhere():
    p = plan(4, cells=4)
    e = explore(p, lambda name, keys, rtol: disc(p, keys, 0.7))
    assert {cell.level for cell in e.cells if e.is_boundary(cell)} == {4}


def test_a_map_of_few_runs_keeps_to_them_and_is_whole():
    p = plan(5, runs=300, cells=4)
    e = explore(p, lambda name, keys, rtol: disc(p, keys, 0.7))
    assert 280 <= len(e.rows) <= 300
    assert sum(e.area(cell) for cell in e.cells) == pytest.approx(1.0)


def test_verdicts_that_hang_on_the_tolerance_are_flagged():
    p = plan(2)

    def run(name, keys, rtol):
        rows = disc(p, keys, 0.7)
        if name == "check":
            assert rtol == p.rtol / 2.0
            rows["verdict"][rows["angle"] > 0] = CaptureState.STUCK
        return rows

    e = explore(p, run)
    flips = e.rows["verdict"] != e.rows["finer_verdict"]
    assert np.all(e.rows["checked"][flips])
    assert flips.any()
    assert np.all(e.rows["angle"][flips] > 0)
    assert 0.0 < e.shares[0]["ill_conditioned"] < e.shares[0]["perhaps"] - e.shares[0]["surely"]


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "tilt_m10"])
def test_an_experiment_is_the_point_of_the_map_that_it_is(name):
    """Launched by the string along the rail, or placed before the touch at its speed.

    Placed, the buffer has not yet felt the rolling resistance: m_P a / k_A is 3 um.
    """
    launched = simulate(load_scene(name))
    angle, offset, speed = approach_of(launched.scene)
    assert angle == pytest.approx(math.radians({"0": 0, "p10": 10, "m10": -10}[name[5:]]))
    assert (offset, speed) == (pytest.approx(0.005), pytest.approx(0.1))
    near = simulate(placed(load_scene(name), angle, offset, speed), t_end=4.0)
    assert near.verdict is launched.verdict
    for key in (
        "impact_speed",
        "first_contact_duration",
        "first_contact_peak_force",
        "max_normal_force",
    ):
        assert near.summary[key] == pytest.approx(launched.summary[key], rel=2e-3)
    assert near.summary["first_contact_time"] == pytest.approx(2e-3 / speed, rel=2e-3)


def test_run_to_verdict_is_the_whole_runs_verdict():
    for name in ("paper_designed", "paper_undamped", "paper_case_1", "tilt_p10"):
        whole = simulate(load_scene(name))
        final = next(status for status in whole.statuses if status.final)
        short = run_to_verdict(whole.scene)
        assert (short.verdict, short.t, short.reason) == (final.state, final.t, final.reason)
        before = whole.touches[whole.touches["start"] <= final.t]
        assert short.loads["max_normal_force"] == pytest.approx(
            before["peak_force"].max(), rel=1e-12
        )
        assert short.first_touch == whole.summary["first_contact_time"]
        # the extremes are of the motion, up to a fifth of a second later than the verdict
        sampled = whole.samples[whole.t <= final.t]["tip_distance"].min()
        later = whole.samples[whole.t <= final.t + 0.2]["tip_distance"].min()
        assert run_to_end(whole.scene).loads == whole.loads
        assert (
            later - 0.2 * 1e-3 < short.loads["nearest_distance"] <= sampled
        )  # 0.2 m/s for a sample's interval


def test_offset_and_angle_mirrored_give_the_mirrored_map():
    p = plan(0)
    left = evaluate(p, [(0, 1, 3), (0, 2, 2)], p.rtol)
    right = evaluate(p, [(0, 2, 0), (0, 1, 1)], p.rtol)
    assert left["angle"] == pytest.approx(-right["angle"], abs=1e-15)
    assert left["offset"] == pytest.approx(-right["offset"], abs=1e-15)
    assert list(left["verdict"]) == list(right["verdict"])
    assert left["peak_force"] == pytest.approx(right["peak_force"], rel=1e-4)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A small map, run in this process; and its file."""
    folder = tmp_path_factory.mktemp("alone")
    e = explore(plan(), KeptRuns(plan(), InProcess(), folder / "e.runs"))
    return e, write_envelope(e, folder / "e.parquet").read_bytes()


def test_the_file_gives_the_map_again(alone, tmp_path):
    e, data = alone
    (tmp_path / "e.parquet").write_bytes(data)
    again = read_envelope(tmp_path / "e.parquet")
    assert again.plan == e.plan
    assert again.cells == e.cells
    assert again.rows.tobytes() == e.rows.tobytes()
    assert replay(e.plan, e.rows).cells == e.cells


def test_any_reader_has_table_units_and_plan(alone, tmp_path):
    import pyarrow.parquet as pq

    (tmp_path / "e.parquet").write_bytes(alone[1])
    table = pq.read_table(tmp_path / "e.parquet")
    assert table.num_rows == len(alone[0].rows)
    assert set(table.column("verdict").to_pylist()) <= {s.label for s in CaptureState}
    assert table.schema.field("speed").metadata == {b"unit": b"m/s"}
    stored = json.loads(table.schema.metadata[b"capture_sim.envelope"])
    assert plan_from_mapping(stored) == plan()
    assert "c_rr" in stored["scene"]
    with pytest.raises(SceneError, match="plan of an envelope: 'offset' is missing"):
        plan_from_mapping({"angle": stored["angle"]})


def test_two_processes_give_the_same_file(alone, tmp_path):
    with open_executor(2) as executor:
        e = explore(plan(), KeptRuns(plan(), executor, tmp_path / "e.runs"))
        told = []  # answers come back in order
        found = answers(executor, math.sqrt, [4.0, 9.0, 16.0], lambda *done: told.append(done))
        assert list(found) == [2.0, 3.0, 4.0]
        assert told == [(1, 3), (2, 3), (3, 3)]
    assert write_envelope(e, tmp_path / "e.parquet").read_bytes() == alone[1]


def test_a_dask_cluster_gives_the_same_file(alone, tmp_path):
    distributed = pytest.importorskip("distributed", reason="Dask is optional: the extra cluster")
    with (
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address=None,
            processes=True,
        ) as cluster,
        open_executor(scheduler=cluster.scheduler_address) as executor,
    ):
        e = explore(plan(), KeptRuns(plan(), executor, tmp_path / "e.runs"))
    assert write_envelope(e, tmp_path / "e.parquet").read_bytes() == alone[1]


def test_killed_half_way_and_resumed_gives_the_same_file(tmp_path, capsys):
    """The command itself, killed without warning once a chunk is there, and started again."""
    out = tmp_path / "e.parquet"
    arguments = ["envelope", "--levels=1", "--mark"]
    arguments += ["--angle=-20:20:4", "--offset=-40:40:10", "--speed=0.1"]
    resumed = f"--out={tmp_path / 'killed.parquet'}"
    kept = tmp_path / "killed.runs"
    killed = subprocess.Popen(
        [sys.executable, "-m", "capture_sim.cli", *arguments, "--workers=2", resumed],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + 600
        while not (kept.exists() and kept.read_bytes().partition(b"\n")[2]):
            assert killed.poll() is None, "ended before it could be killed"
            assert time.monotonic() < deadline
            time.sleep(0.002)
    finally:
        os.kill(killed.pid, signal.SIGKILL)
        killed.wait()
    assert not (tmp_path / "killed.parquet").exists()
    assert main([*arguments, "--workers=1", resumed]) == 0
    assert "runs were there already" in capsys.readouterr().out
    assert not kept.exists()
    assert main([*arguments, "--workers=1", f"--out={out}"]) == 0
    assert out.read_bytes() == (tmp_path / "killed.parquet").read_bytes()


def test_half_a_row_and_runs_of_another_plan_are_not_taken(tmp_path):
    p, path = plan(0), tmp_path / "e.runs"
    e = explore(p, KeptRuns(p, InProcess(), path))
    whole = path.read_bytes()
    for lost in (10, len(whole) // 2, len(whole) - 100):
        path.write_bytes(whole[:-lost])
        runs = KeptRuns(p, InProcess(), path)
        head = len(whole) - ROW.itemsize * (len(e.rows) + int(e.rows["checked"].sum()))
        assert runs.resumed == max(len(whole) - lost - head, 0) // ROW.itemsize
        assert explore(p, runs).rows.tobytes() == e.rows.tobytes()
        assert len(path.read_bytes()) == len(whole)
    with pytest.raises(SceneError, match="another plan"):
        KeptRuns(replace(p, rtol=1e-6), InProcess(), path)


def test_only_experiments_of_the_maps_own_bench_are_marked():
    assert [s.name for s in experiments(load_scene("tilt_0"), None, ())] == [
        *("tilt_0", "tilt_p10", "tilt_m10"),
    ]
    softer = ["buffer.k_A=700"]
    marks = experiments(load_scene("tilt_0", softer), None, softer)
    assert [(s.name, s.buffer.k_A) for s in marks][1:] == [("tilt_p10", 700.0), ("tilt_m10", 700.0)]
    other = load_scene("paper_designed")
    assert experiments(other, None, ()) == [other]
    with pytest.raises(SceneError, match="--mark tilt_0: another bench than paper_designed: its"):
        experiments(other, ["tilt_0"], ())


def test_ctrl_c_ends_the_command_in_a_line(tmp_path):
    """Also while the workers start."""
    arguments = [sys.executable, "-m", "capture_sim.cli", "envelope", "--levels=0", "--mark"]
    arguments += ["--angle=-20:20:8", "--offset=-40:40:10", "--speed=0.1", "--workers=2"]
    process = subprocess.Popen(
        [*arguments, f"--out={tmp_path / 'e.parquet'}"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 600
    while not (tmp_path / "e.runs").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(0.3)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to the workers as well
    said = process.communicate(timeout=600)[1]
    assert process.returncode == 130
    assert "Traceback" not in said


def test_a_cluster_that_is_not_there_is_said_in_a_line(capsys):
    pytest.importorskip("distributed", reason="Dask is optional: the extra cluster")
    with (
        pytest.raises(ExecutorError, match="must be an address"),
        open_executor(scheduler="nowhere"),
    ):
        pass


def test_a_worker_that_the_cluster_gave_up_is_one_line():
    dask = pytest.importorskip("distributed")

    def fail(_):
        raise dask.scheduler.KilledWorker("run-7", SimpleNamespace(address="tcp://127.0.0.1:1"), 3)

    with pytest.raises(ExecutorError, match=r"^the workers were lost \(.*\); start again") as lost:
        list(answers(InProcess(), fail, [1]))
    assert "\n" not in str(lost.value)
