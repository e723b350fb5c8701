"""Recorded runs judged anew and exported; bags that are not as they should be."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from recorded_bags import BENCH_TOPICS, rewritten
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from capture_sim.cli import main
from capture_sim.dynamics.samples import columns_of
from capture_sim.errors import RecordingError
from capture_sim.messages.convert import EPOCH_NS
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import CAPTURE_STATUS, SHOWN, TOPICS
from capture_sim.recording.bag import read_bag
from capture_sim.recording.export import save_tables, tables_of
from capture_sim.recording.read import read_run

TF = "tf2_msgs/msg/TFMessage"


def test_bag_by_another_recorder_has_the_scene_of_its_announcement(path, tmp_path, capsys):
    """As `ros2 bag record` leaves it: no attachment, and the wall's time for the log's."""
    topics = [
        (topic.absolute_name, topic.type_name) for topic in TOPICS if topic is not CAPTURE_STATUS
    ]

    def as_it_is(time, message):
        yield time + 1_700_000_000_000_000_000, message

    ours, theirs = read_bag(path), read_bag(rewritten(path, tmp_path / "bag", topics=topics))
    assert theirs.scene == ours.scene
    assert (theirs.run_id, theirs.name) == (ours.run_id, ours.name)
    assert set(ours.metadata) - set(theirs.metadata) <= {"part", "origin"}
    assert main(["compare", str(tmp_path / "bag"), "--simulated", "--out", str(tmp_path)]) == 0
    assert "bit-identical" in capsys.readouterr().out
    assert main(["detect", str(tmp_path / "bag")]) == 0

    def lost(time, message):
        if getattr(message, "seq", None) != 5:
            yield time, message

    lossy = read_bag(rewritten(path, tmp_path / "lossy", lost, topics))
    assert any("bench/state: 1 messages missing" in problem for problem in lossy.problems), (
        lossy.problems
    )
    assert lossy.scene == ours.scene


def test_times_of_a_table_count_from_the_release(path, tmp_path):
    """Whatever the log's clock is, and where the first message comes later."""

    def from_2_s(time, message):
        if not hasattr(message, "pose") or message.header.stamp.sec >= EPOCH_NS // 10**9 + 2:
            yield time + 1_700_000_000_000_000_000, message

    topics = (BENCH_TOPICS[0], ("/bench/run_info", "capture_sim/msg/RunInfo"))
    theirs = read_bag(rewritten(path, tmp_path / "bag", from_2_s, topics))
    times = tables_of(read_bag(path))["/chaser/odom"].fields["t"]
    assert tables_of(theirs)["/chaser/odom"].fields["t"] == pytest.approx(
        times[times > 1.995], abs=1e-9
    )


def test_topic_of_another_type_is_not_taken_for_the_benchs(path, tmp_path, capsys):
    run = read_bag(path)
    folder = tmp_path / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, type_name in (
            ("/chaser/odom", "nav_msgs/msg/Odometry"),
            ("/target/odom", "geometry_msgs/msg/PoseStamped"),
            ("/bench/buffer", "capture_sim/msg/BufferState"),
            ("/bench/state", "geometry_msgs/msg/PoseStamped"),
        ):
            connection = writer.add_connection(name, type_name, typestore=typestore())
            for time, data in zip(run.log_times(name)[:9].tolist(), run.raw(name), strict=False):
                writer.write(connection, time, data)
    assert main(["detect", str(folder), "--scene", "tilt_0"]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "type of /target/odom = geometry_msgs/msg/PoseStamped: must be nav_msgs" in said
    with pytest.raises(RecordingError, match="type of /bench/state = "):
        _ = read_bag(folder).samples
    odd = read_run(folder)  # a foreign topic hinders only what needs it
    assert odd.origin.left_out[1].startswith("/bench/state: left out: type = geometry_msgs")
    assert odd.measured("chaser").t.size == 9
    assert odd.given.samples.size == 0


def test_export_of_a_foreign_bag_leaves_out_what_makes_no_table(tmp_path, capsys):
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    types = jazzy.types
    folder = tmp_path / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        tf, text = (
            writer.add_connection(name, kind, typestore=jazzy)
            for name, kind in (("/tf", TF), ("/chatter", "std_msgs/msg/String"))
        )
        for i in range(3):
            writer.write(tf, 10 + i, jazzy.serialize_cdr(types[TF](transforms=[]), TF))
            data = types["std_msgs/msg/String"](data="x" * i)
            writer.write(text, 10 + i, jazzy.serialize_cdr(data, "std_msgs/msg/String"))
    for form in ("csv", "npz", "parquet"):
        out = tmp_path / form
        assert main(["export", str(folder), "--to", form, "--out", str(out)]) == 0
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1
        assert "/tf is left out" in said[0]
    with (tmp_path / "csv" / "chatter.csv").open() as file:
        assert [row["data"] for row in csv.DictReader(file)] == ["", "x", "xx"]


def test_detector_with_other_limits(path, capsys):
    assert main(["detect", str(path)]) == 0
    assert "the same" in capsys.readouterr().out
    # the tip rests 1.7 mm from BE, so it never comes within 1 mm
    assert main(["detect", str(path), "--set", "detector.capture_radius=0.001"]) == 0
    said = capsys.readouterr().out
    assert "verdict: stuck" in said
    assert "DIFFERENT" in said
    assert read_bag(path).criteria == read_bag(path).scene.detector


@pytest.mark.parametrize("change", ["buffer.c_A=3", "detector.radus=0.004", "detector=1"])
def test_detect_takes_limits_alone(change, path, capsys):
    assert main(["detect", str(path), "--set", change]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"capture-sim: --set {change}: must be one of detector.")
    assert "detector.capture_radius, detector.min_dwell" in said
    assert said.count("\n") == 1


def test_bag_of_a_bench_is_judged_with_a_scene_given(bench_bag, path, capsys):
    assert main(["detect", str(bench_bag)]) == 2
    assert "give it with --scene" in capsys.readouterr().err
    assert main(["detect", str(bench_bag), "--scene", "tilt_0"]) == 0
    assert "verdict: captured" in capsys.readouterr().out
    assert read_bag(bench_bag).samples.size == 0
    assert read_run(bench_bag).first_contact.t == pytest.approx(
        read_run(path).first_contact.t, abs=0.05
    )


def tabulated(run):
    """Return the topics with messages, without those that only show the bench."""
    shown = {topic.absolute_name for topic in SHOWN}
    return [name for name, count in run.topics.items() if count and name not in shown]


def test_csv_gives_the_same_bits(path, tmp_path, capsys):
    assert main(["export", str(path), "--to", "csv", "--out", str(tmp_path)]) == 0
    run = read_bag(path)
    tables = len(tabulated(run)) + 1  # and that of the touches
    assert capsys.readouterr().out.count("written: ") == tables
    with (tmp_path / "bench_state.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = columns_of(tables_of(run)["/bench/state"].fields)
    assert [head.partition(" [")[0] for head in rows[0]] == list(columns)
    for head in ("t [s]", "q.x_S [m]", "v.theta_T [rad/s]", "penetration.-y [m]", "kinetic [J]"):
        name, _, _ = head.partition(" ")
        assert [float(row[head]) for row in rows] == columns[name].tolist()
    assert [int(row["log_time_ns [ns]"]) for row in rows] == run.log_times("bench/state").tolist()
    with (tmp_path / "bench_event.csv").open() as file:
        kinds = [row["kind"] for row in csv.DictReader(file)]
    assert kinds == [event.kind.label for event in run.events]


def test_npz_holds_everything_without_pickle(path, tmp_path):
    run = read_bag(path)
    (file,) = save_tables(tables_of(run), tmp_path, "npz", name=path.stem, scene=run.scene_text)
    with np.load(file, allow_pickle=False) as data:
        for topic in tabulated(run):
            for name, column in run.columns(topic).items():
                kept = data[f"{topic.strip('/')}/{name}"]
                if column.dtype != object:
                    assert kept.tobytes() == np.ascontiguousarray(column).tobytes()
        assert str(data["scene"]) == run.scene_text
        units = json.loads(str(data["units"]))
        assert units["touches/impulse"] == "N s"
        assert units["contact/wrench/wrench.torque.z"] == "N m"
        assert data["bench/event/kind"].tolist() == [e.kind.label for e in run.events]


def test_topics_and_columns_are_chosen(path, tmp_path, capsys):
    run, wanted = read_bag(path), ["--topics", "bench/state", "/chaser/odom"]
    command = ["export", str(path), "--out", str(tmp_path), *wanted]
    assert main([*command, "--columns", "q.x_S", "impulse", "seq"]) == 0
    (file,) = tmp_path.iterdir()  # the odometry has none of them
    with file.open() as lines:
        head = ["t [s]", "seq", "q.x_S [m]", "impulse.+y [N s]", "impulse.-y [N s]"]
        assert next(csv.reader(lines)) == head
    for wrong in (["--columns", "no"], ["--topics", "no/such"]):
        assert main(["export", str(path), "--out", str(tmp_path), *wrong]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    for topic in tabulated(run):
        assert tables_of(run)[topic].fields["t"].min() >= 0.0


def test_parquet_gives_the_same_bits(path, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    assert main(["export", str(path), "--to", "parquet", "--out", str(tmp_path)]) == 0
    run = read_bag(path)
    for topic in tabulated(run):
        found = parquet.read_table(tmp_path / f"{topic.strip('/').replace('/', '_')}.parquet")
        for name, column in columns_of(tables_of(run)[topic].fields).items():
            if column.dtype != object:
                assert found[name].to_numpy().tobytes() == np.ascontiguousarray(column).tobytes()
    schema = parquet.read_schema(tmp_path / "touches.parquet")
    assert schema.field("peak_force").metadata == {b"unit": b"N"}
    assert schema.field("start").metadata == {b"unit": b"s"}
