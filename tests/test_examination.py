"""Recorded runs examined: judged and simulated anew, compared, exported, fitted."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from matplotlib.figure import Figure
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import capture_sim
from capture_sim.cli import main
from capture_sim.errors import RecordingError
from capture_sim.messages.convert import EPOCH_NS
from capture_sim.messages.topics import CAPTURE_STATUS, RECORDED, topic_named
from capture_sim.recording import LiveRecorder, read_run, write_run
from capture_sim.recording.comparing import SAMPLED_FORCE, characteristics, comparable
from capture_sim.recording.definitions import typestore
from capture_sim.recording.export import flat_columns, save_npz
from capture_sim.recording.judging import judge_recording
from capture_sim.recording.measured import first_contact, measurements
from capture_sim.studies.compare import gaps
from capture_sim.studies.measurements import Measurements, Series, measured_in
from capture_sim.studies.resimulate import agreement
from capture_sim.studies.touches import in_force
from capture_sim.viewing.comparison import draw_touches, impulse_so_far

TF = "tf2_msgs/msg/TFMessage"
#: What a real bench records at least.
BENCH_TOPICS = (
    ("/chaser/odom", "nav_msgs/msg/Odometry"),
    ("/target/odom", "nav_msgs/msg/Odometry"),
    ("/bench/buffer", "capture_sim/msg/BufferState"),
    ("/contact/wrench", "geometry_msgs/msg/WrenchStamped"),
)


@pytest.fixture(scope="module")
def result():
    return capture_sim.simulate(capture_sim.load_scene("tilt_0"))


@pytest.fixture(scope="module")
def path(result, tmp_path_factory):
    return write_run(result, tmp_path_factory.mktemp("runs") / "tilt_0.mcap")


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    scene = capture_sim.load_scene("tilt_0", ["friction.mu=0.25", "buffer.c_A=11"])
    folder = tmp_path_factory.mktemp("others")
    return write_run(capture_sim.simulate(scene), folder / "other.mcap")


@pytest.fixture(scope="module")
def bench_bag(path, tmp_path_factory):
    """A bag as a real bench makes one: standard topics and BufferState, no scene, no state."""
    run = read_run(path)
    folder = tmp_path_factory.mktemp("bench") / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, type_name in BENCH_TOPICS:
            connection = writer.add_connection(name, type_name, typestore=typestore())
            for time, data in zip(run.log_times(name).tolist(), run.raw(name), strict=True):
                writer.write(connection, time, data)
    return folder


def rewritten(path, folder, change, topics=BENCH_TOPICS):
    """A bag of some topics of a run, each message changed: times and message, or left out."""
    run, store = read_run(path), typestore()
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, type_name in topics:
            connection = writer.add_connection(name, type_name, typestore=store)
            for time, data in zip(run.log_times(name).tolist(), run.raw(name), strict=True):
                message = store.deserialize_cdr(data, type_name)
                for when, what in change(time, message):
                    writer.write(connection, when, store.serialize_cdr(what, type_name))
    return folder


def test_bench_whose_clock_is_the_walls_is_fitted_as_well(path, tmp_path, capsys):
    epoch = 1_700_000_000

    def later(time, message):
        message.header.stamp.sec += epoch
        yield time + epoch * 1_000_000_000, message

    bag = rewritten(path, tmp_path / "bag", later)
    seen = measurements(read_run(bag))
    for (_, mine), (_, theirs) in zip(
        seen.items(), measurements(read_run(path)).items(), strict=True
    ):
        np.testing.assert_allclose(mine.t, theirs.t, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(mine.values, theirs.values)
    command = ["identify", str(bag), "mu", "--scene", "tilt_0", "--set", "friction.mu=0.3"]
    assert main([*command, "--starts", "1"]) == 0
    value = float(capsys.readouterr().out.splitlines()[1].split()[1])
    assert value == pytest.approx(0.33, rel=1e-3)


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
    for _, series in measurements(read_run(bag)).items():
        assert np.isfinite(series.values).all()
        assert (np.diff(series.t) > 0.0).all()
    assert main(["identify", str(bag), "mu", "--scene", "tilt_0", "--starts", "1"]) == 0
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
    seen = measurements(read_run(rewritten(path, tmp_path / "bag", swapped, topics)))
    told = measurements(read_run(path))
    np.testing.assert_array_equal(seen.stroke.values, told.stroke.values)
    np.testing.assert_array_equal(seen.torsion.values, told.torsion.values)


def test_bag_by_another_recorder_has_the_scene_of_its_announcement(path, tmp_path, capsys):
    """As `ros2 bag record` leaves it: no attachment, and the wall's time for the log's."""
    topics = [
        (topic.absolute_name, topic.type_name) for topic in RECORDED if topic is not CAPTURE_STATUS
    ]

    def as_it_is(time, message):
        yield time + 1_700_000_000_000_000_000, message

    ours, theirs = read_run(path), read_run(rewritten(path, tmp_path / "bag", as_it_is, topics))
    assert theirs.scene == ours.scene
    assert (theirs.run_id, theirs.name) == (ours.run_id, ours.name)
    assert set(ours.metadata) - set(theirs.metadata) <= {"part", "origin"}
    assert main(["resimulate", str(tmp_path / "bag")]) == 0
    assert "identical, bit for bit" in capsys.readouterr().out
    assert main(["detect", str(tmp_path / "bag")]) == 0
    for command in ("run", "view"):  # a bag's folder like a file
        assert main([command, str(tmp_path / "bag"), "--out", str(tmp_path / command)]) == 0

    def lost(time, message):
        if getattr(message, "seq", None) != 5:
            yield time, message

    lossy = read_run(rewritten(path, tmp_path / "lossy", lost, topics))
    assert any("bench/state: 1 messages missing" in problem for problem in lossy.problems), (
        lossy.problems
    )
    assert lossy.scene == ours.scene


def test_topic_of_another_type_is_not_taken_for_the_benchs(path, tmp_path, capsys):
    run = read_run(path)
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
    assert "/target/odom is of type geometry_msgs/msg/PoseStamped: wanted is nav_msgs" in said
    with pytest.raises(RecordingError, match="/bench/state is of type"):
        _ = read_run(folder).samples


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


def test_export_of_nothing_says_so(path, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:100])
    assert main(["export", str(cut), "--to", "csv", "--out", str(tmp_path / "out")]) == 2
    assert "holds no messages" in capsys.readouterr().err


def test_bag_with_two_runs_is_not_judged_as_one(result, path, tmp_path, capsys):
    again = write_run(result, tmp_path / "again.mcap")
    folder = tmp_path / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = (*BENCH_TOPICS, ("/bench/run_info", "capture_sim/msg/RunInfo"))
        opened = [writer.add_connection(name, kind, typestore=typestore()) for name, kind in topics]
        for run in map(read_run, (path, again)):
            for connection, (name, _) in zip(opened, topics, strict=True):
                for time, data in zip(run.log_times(name).tolist(), run.raw(name), strict=True):
                    writer.write(connection, time, data)
    for command in (["detect"], ["identify", "mu"]):
        line = [command[0], str(folder), *command[1:], "--scene", "tilt_0"]
        assert main(line) == 2
        assert "holds 2 runs" in capsys.readouterr().err
    assert main(["export", str(folder), "--to", "npz", "--out", str(tmp_path)]) == 0


def test_resimulation_fails_where_an_event_is_missing(path, tmp_path, capsys):
    run = read_run(path)
    recorder = LiveRecorder(tmp_path)
    for name in ("bench/run_info", "bench/state", "bench/event"):
        for data in run.raw(name)[: -2 if name == "bench/event" else None]:
            recorder.take(topic_named(name), data)
    file = str(recorder.close().path)
    assert main(["resimulate", file]) == 1
    assert "the events differ" in capsys.readouterr().out
    assert main(["resimulate", file, "--tolerance", "1e-9"]) == 0


# judged anew


def test_detector_judges_a_bag_as_it_judged_the_run(path):
    run = read_run(path)
    again = judge_recording(run)
    assert [(s.t, s.state, s.final, s.reason) for s in again] == [
        (s.t, s.state, s.final, s.reason) for s in run.statuses
    ]
    for mine, theirs in zip(again, run.statuses, strict=True):
        # the heading went through a quaternion
        assert mine.distance == pytest.approx(theirs.distance, abs=1e-12)


def test_detector_with_other_limits(path, capsys):
    assert main(["detect", str(path)]) == 0
    assert "the same" in capsys.readouterr().out
    # the tip rests 1.7 mm from BE, so it never comes within 1 mm
    assert main(["detect", str(path), "--set", "detector.radius=0.001"]) == 0
    said = capsys.readouterr().out
    assert "verdict: stuck" in said
    assert "DIFFERENT" in said
    assert read_run(path).criteria == read_run(path).scene.detector


@pytest.mark.parametrize("change", ["buffer.c_A=3", "detector.radus=0.004", "detector=1"])
def test_detect_takes_limits_alone(change, path, capsys):
    assert main(["detect", str(path), "--set", change]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"capture-sim: --set {change}: what is recorded is judged, so allowed")
    assert "detector.radius, detector.dwell" in said
    assert said.count("\n") == 1


def test_bag_of_a_bench_is_judged_with_a_scene_given(bench_bag, path, capsys):
    assert main(["detect", str(bench_bag)]) == 2
    assert "name one by --scene" in capsys.readouterr().err
    assert main(["detect", str(bench_bag), "--scene", "tilt_0"]) == 0
    assert "verdict: captured" in capsys.readouterr().out
    assert read_run(bench_bag).samples.size == 0
    assert first_contact(read_run(bench_bag)) == pytest.approx(
        first_contact(read_run(path)), abs=0.05
    )


def test_topic_that_the_detector_needs_is_named(path, tmp_path):
    run = read_run(path)
    folder = tmp_path / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(
            "/chaser/odom", "nav_msgs/msg/Odometry", typestore=typestore()
        )
        writer.write(connection, EPOCH_NS, run.raw("chaser/odom")[0])
    with pytest.raises(RecordingError, match="holds no target/odom, which the detector needs"):
        judge_recording(read_run(folder), run.scene)


# simulated anew


def test_resimulation_is_identical_and_a_difference_is_found(result, path, capsys):
    assert main(["resimulate", str(path)]) == 0
    assert "identical, bit for bit" in capsys.readouterr().out
    changed = result.samples.copy()
    changed["q"][4321, 5] = np.nextafter(changed["q"][4321, 5], 1.0)
    found = agreement(result.samples, changed, result.events, result.events[:-1])
    (difference,) = found.differences
    assert (difference.name, difference.first) == ("q", 4.321)
    assert 0.0 < difference.largest < 1e-15
    assert not found.same_events
    assert not found.identical


def test_samples_of_another_run_are_foreign(result):
    """At other times, or at the run's own once more: neither is passed over."""
    other = result.samples[1000:1958].copy()
    other["t"] += 2e-4
    for mixed in (np.concatenate([result.samples, other]), result.samples[[0, 1, 1, 2]]):
        found = agreement(mixed, result.samples, result.events, result.events)
        assert found.foreign == (958 if mixed.size > 4 else 1)
        assert not found.identical
    cut = agreement(result.samples[:500], result.samples, [], [])
    assert (cut.compared, cut.foreign, cut.missing, cut.identical) == (500, 0, 0, True)
    lossy = agreement(result.samples[::2], result.samples, result.events, result.events)
    assert lossy.missing == lossy.compared - 1
    assert not agreement(result.samples[:0], result.samples, [], []).identical


def test_a_recording_with_foreign_samples_is_not_identical(path, tmp_path, capsys):
    def doubled(time, message):
        yield time, message
        if getattr(message, "t", 0.0) > 2.0:
            message.t += 2e-4
            yield time, message

    topics = [(t.absolute_name, t.type_name) for t in RECORDED if t is not CAPTURE_STATUS]
    rewritten(path, tmp_path / "bag", doubled, topics)
    assert main(["resimulate", str(tmp_path / "bag")]) == 1
    said = capsys.readouterr().out
    assert "none of this run's" in said
    assert "identical" not in said


def test_another_scene_agrees_until_the_tip_touches(path):
    run = read_run(path)
    scene = capture_sim.load_scene("tilt_0", ["friction.mu=0.331"])
    result = capture_sim.simulate(scene)
    found = agreement(run.samples, result.samples, run.events, result.events)
    assert {d.name for d in found.differences} >= {"q", "v", "friction_force"}
    assert min(d.first for d in found.differences) >= first_contact(run)


# compared


def test_comparison_with_itself_and_with_another_run(path, other):
    one, two = read_run(path), read_run(other)
    at, at_other = first_contact(one), first_contact(two)
    same = gaps(measurements(one), measurements(one), at, at, 1.0)
    assert [f"{gap.series}.{gap.part.label}" for gap in same] == [
        *("chaser.x", "chaser.y", "chaser.theta", "target.x", "target.y", "target.theta"),
        *("stroke.", "torsion."),
    ]
    assert all(gap.largest == 0.0 for gap in same)
    different = gaps(measurements(one), measurements(two), at, at_other, 1.0)
    assert next(gap for gap in different if gap.series == "stroke").rms > 1e-4


def test_runs_are_compared_by_what_the_run_itself_was(result, path, other):
    """As results.json has it of the run; at 100 Hz the torsion comes out 0.5 % lower."""
    sides = comparable(read_run(path), read_run(other))
    found = characteristics(sides[0])
    expected = result.summary
    for name, key, factor in (
        ("largest torsion, mrad", "max_torsion", 1e3),
        ("largest stroke inwards, mm", "max_axial_stroke", 1e3),
        ("nearest to BE, mm", "nearest_distance", 1e3),
        ("largest force, N", "peak_force", 1.0),
        ("normal impulse, N s", "normal_impulse", 1.0),
    ):
        assert found[name].value == expected[key] * factor, name
    assert found["largest torsion, mrad"].source == "bench/state, 1000 Hz"
    assert found["largest force, N"].source == "bench/event"
    assert characteristics(sides[1])["largest stroke inwards, mm"].value > (
        found["largest stroke inwards, mm"].value
    )
    assert sides[0].touches.peak.tolist() == result.touches["peak_force"].tolist()


def test_both_runs_are_compared_by_a_series_that_both_hold(bench_bag, path):
    bench, run = comparable(read_run(bench_bag), read_run(path))
    assert bench.sources == {
        "chaser": "chaser/odom, 100 Hz",
        "target": "target/odom, 100 Hz",
        "stroke": "bench/buffer, 100 Hz",
        "torsion": "bench/buffer, 100 Hz",
        "force": "contact/wrench, 100 Hz",
    }
    assert {name: run.sources[name] for name in bench.sources} == bench.sources
    assert run.sources["distance"] == "bench/state, 1000 Hz"  # the bench's bag has none
    assert bench.touches is None
    assert "too slow for touches of 0.348 ms as the other has" in bench.touch_source
    assert "largest force, N" not in characteristics(bench)  # a sample is no peak
    assert SAMPLED_FORCE in characteristics(bench, sampled=True)


def test_peaks_between_messages_come_before_samples(path, tmp_path):
    """bench/contact tells the first touch's peak at 100 Hz too; contact/wrench shows none."""

    def as_it_is(time, message):
        yield time, message

    topics = [*BENCH_TOPICS, ("/bench/contact", "capture_sim/msg/ContactState")]
    bag = read_run(rewritten(path, tmp_path / "bag", as_it_is, topics))
    side, _ = comparable(bag, read_run(path))
    assert side.touch_source == "bench/contact, 100 Hz, as long as each message counts one"
    assert side.touches.within(side.contact, 1.0).start[0] == 0.0
    located = read_run(path).touches
    assert side.touches.peak[0] == located["peak_force"][0]
    assert side.touches.start[0] == pytest.approx(located["start"][0], abs=0.01)
    assert np.isnan(side.touches.impulse).all()


def test_a_fast_bench_is_compared_by_the_fast_series_of_the_run(result, path, tmp_path):
    """The bench's encoders at 500 Hz: the run's bench/buffer at 100 Hz would be the slower."""
    fast = capture_sim.load_scene("tilt_0", ["run.rate=500"])
    recorded = write_run(capture_sim.simulate(fast), tmp_path / "fast.mcap")

    def as_it_is(time, message):
        yield time, message

    sides = comparable(read_run(rewritten(recorded, tmp_path / "bag", as_it_is)), read_run(path))
    assert [of.sources["stroke"] for of in sides] == [
        "bench/buffer, 500 Hz",
        "bench/state, 1000 Hz",
    ]
    assert [of.sources["chaser"] for of in sides] == ["chaser/odom, 500 Hz", "bench/state, 1000 Hz"]
    mine, theirs = (characteristics(of)["largest torsion, mrad"].value for of in sides)
    assert mine == pytest.approx(theirs, rel=1e-3)
    assert theirs == result.summary["max_torsion"] * 1e3


def test_with_motion_capture_the_true_path_is_taken_where_both_hold_it(path, tmp_path):
    scene = capture_sim.load_scene("tilt_0", ["sensors.motion_capture.rate=100"])
    seen = capture_sim.simulate(scene)
    noisy = write_run(seen, tmp_path / "noisy.mcap")
    found = characteristics(comparable(read_run(noisy), read_run(path))[0])["nearest to BE, mm"]
    assert found == (seen.summary["nearest_distance"] * 1e3, "bench/state, 1000 Hz")
    # a bench knows it by its detector alone, and so it is taken of both
    topics = [*BENCH_TOPICS, ("/capture/status", "capture_sim/msg/CaptureStatus")]

    def as_it_is(time, message):
        yield time, message

    bag = rewritten(path, tmp_path / "bag", as_it_is, topics)
    sides = comparable(read_run(noisy), read_run(bag))
    assert [of.sources["distance"] for of in sides] == ["capture/status, 100 Hz"] * 2


def test_touches_in_a_fast_force_are_those_that_made_it():
    """Half sines, whose peak, time and impulse 2 F T / pi are known."""
    t = np.arange(0.0, 0.2, 2e-5)
    size = np.zeros_like(t)
    made = [(0.1, 1e-3, 130.0), (0.12, 2e-3, 60.0), (0.15, 5e-4, 40.0)]
    for start, lasts, peak in made:
        inside = (t > start) & (t < start + lasts)
        size[inside] = peak * np.sin(np.pi * (t[inside] - start) / lasts)
    force = np.stack([-0.6 * size, 0.8 * size], axis=1)
    found = in_force(t, force + np.array([0.3, -0.2]))  # a bias
    assert found.start == pytest.approx([start for start, _, _ in made], abs=3e-5)
    assert found.lasted == pytest.approx([lasts for _, lasts, _ in made], abs=6e-5)
    assert found.peak == pytest.approx([peak for _, _, peak in made], rel=1e-2)
    assert found.impulse == pytest.approx([2 / np.pi * lasts * f for _, lasts, f in made], rel=1e-2)
    assert in_force(t[::50], force[::50]) is None  # 1 kHz shows one sample of a touch


def test_load_cell_alone_shows_when_the_contact_was(path, tmp_path, capsys):
    scene = capture_sim.load_scene(
        "tilt_0", ["sensors.motion_capture.rate=100", "sensors.load_cell.force_noise=0.5"]
    )
    recorded = write_run(capture_sim.simulate(scene), tmp_path / "run.mcap")
    topics = [
        ("/motion_capture/chaser", "geometry_msgs/msg/PoseStamped"),
        ("/motion_capture/target", "geometry_msgs/msg/PoseStamped"),
        ("/bench/buffer", "capture_sim/msg/BufferState"),
        ("/load_cell/wrench", "geometry_msgs/msg/WrenchStamped"),
    ]

    def as_it_is(time, message):
        yield time, message

    bag = rewritten(recorded, tmp_path / "bag", as_it_is, topics)
    assert first_contact(read_run(bag)) == pytest.approx(first_contact(read_run(path)), abs=0.01)
    assert main(["compare", str(bag), str(path), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "load_cell/wrench, 1000 Hz" in said
    assert "nan" not in said


def test_gaps_of_known_series():
    t = np.linspace(0.0, 3.0, 301)
    a = Measurements(stroke=Series(t, np.sin(t)))
    b = Measurements(stroke=Series(t + 0.25, np.sin(t) + 0.1))  # later, and 0.1 larger
    (gap,) = gaps(a, b, 1.0, 1.25, 1.5)
    assert gap.rms == pytest.approx(0.1)
    assert gap.largest == pytest.approx(0.1)  # second less first, as in the table


def test_measurements_of_a_bag_are_those_of_the_samples(result, path):
    every = round(result.scene.run.state_rate / result.scene.run.rate)
    exact = measured_in(result.samples[::every])
    for name, series in measurements(read_run(path)).items():
        assert series.t == pytest.approx(getattr(exact, name).t, abs=1e-9)
        assert series.values == pytest.approx(getattr(exact, name).values, abs=1e-12)


def test_compare_command(path, other, bench_bag, tmp_path, capsys):
    assert main(["compare", str(path), str(other), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "peak force of first contact, N" in said
    assert "stroke        rms" in said
    assert "force" not in said.split("B - A over 1 s")[1]  # of samples it says nothing
    # touch by touch: the first row is the first touch of both
    row = next(line.split() for line in said.splitlines() if line.startswith("  1 "))
    first = [read_run(file).touches[0] for file in (path, other)]
    assert row[1:5] == ["-" if first[0]["wall"] < 0 else "+"] * 2 + ["0.000"] * 2
    assert [float(cell) for cell in row[6:8]] == pytest.approx(
        [touch["peak_force"] for touch in first], abs=0.005
    )
    assert [float(cell) for cell in row[11:13]] == pytest.approx(
        [touch["impulse"] * 1e3 for touch in first], abs=0.0005
    )
    (picture,) = tmp_path.glob("*.png")
    assert picture.stat().st_size > 20_000
    assert "is aligned where" not in said
    assert "identical" not in said
    assert main(["compare", str(path), str(path), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    table, series = said.split("B - A over 1 s")
    assert table.count("identical") == table.count("bench/state") + table.count("bench/event") - 1
    assert series.count("identical") == 8
    assert main(["compare", str(bench_bag), str(path), "--out", str(tmp_path)]) == 0
    assert "A is aligned where contact/wrench first shows a force" in capsys.readouterr().out
    far = capture_sim.simulate(capture_sim.load_scene("tilt_0", ["run.t_end=1.0"]))
    untouched = write_run(far, tmp_path / "far.mcap")
    capsys.readouterr()
    assert main(["compare", str(path), str(untouched), "--out", str(tmp_path)]) == 2
    assert "no contact in it" in capsys.readouterr().err


@pytest.mark.parametrize("window", ["0.0001", "0"])
def test_window_without_samples_is_refused(window, path, other, bench_bag, tmp_path, capsys):
    command = ["compare", str(path), "--out", str(tmp_path), "--window", window]
    for theirs, least in ((other, "0.004 s (4 samples"), (bench_bag, "0.04 s (4 samples")):
        assert main([*command, str(theirs)]) == 2
        said = capsys.readouterr().err
        assert f"--window {float(window):g} s: allowed is {least}" in said
        assert said.count("\n") == 1


def test_what_two_runs_really_share_is_said(result, path, tmp_path, capsys):
    end = first_contact(read_run(path)) + 0.05
    short = capture_sim.simulate(capture_sim.load_scene("tilt_0", [f"run.t_end={end:.3f}"]))
    file = write_run(short, tmp_path / "short.mcap")
    assert main(["compare", str(path), str(file), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "B - A over 0.05" in said
    assert "1 s were asked for" in said
    scene = capture_sim.load_scene("tilt_0", [f"run.t_end={end - 0.048:.3f}"])
    file = write_run(capture_sim.simulate(scene), tmp_path / "touched.mcap")
    assert main(["compare", str(path), str(file), "--out", str(tmp_path)]) == 2
    assert "in common: that is fewer than 4 samples" in capsys.readouterr().err


def test_diagram_shows_the_peak_of_every_touch(result, path, tmp_path):
    """Read off the figure's own markers."""
    sides = comparable(read_run(path), read_run(path))
    told = sides[0].touches.within(sides[0].contact, 1.0)
    assert told.peak.max() == result.touches["peak_force"].max()
    axes = Figure().subplots()
    draw_touches(axes, told, "A", "blue", "o")
    (marks,) = axes.lines
    assert marks.get_ydata().tolist() == told.peak.tolist()
    for bar, impulse in zip(axes.patches, told.impulse, strict=True):
        assert bar.get_width() * bar.get_height() == pytest.approx(impulse)
    t, total = impulse_so_far(told, 1.0)
    assert total[-1] == pytest.approx(result.touches["impulse"].sum())
    assert (np.diff(total) >= 0.0).all()
    assert t[-1] == 1.0


# exported


def test_csv_gives_the_same_bits(path, tmp_path, capsys):
    assert main(["export", str(path), "--to", "csv", "--out", str(tmp_path)]) == 0
    run = read_run(path)
    assert capsys.readouterr().out.count("written: ") == sum(map(bool, run.topics.values()))
    with (tmp_path / "bench_state.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = flat_columns(run, "bench/state")
    assert list(rows[0]) == list(columns)
    for name in ("t", "q.0", "v.7", "energy_residual"):
        assert [float(row[name]) for row in rows] == columns[name].tolist()
    assert [int(row["log_time_ns"]) for row in rows] == run.log_times("bench/state").tolist()
    with (tmp_path / "bench_event.csv").open() as file:
        kinds = [row["kind"] for row in csv.DictReader(file)]
    assert kinds == [event.kind.label for event in run.events]


def test_npz_holds_everything_without_pickle(path, tmp_path):
    run = read_run(path)
    with np.load(save_npz(run, tmp_path / "x.npz"), allow_pickle=False) as data:
        for topic in filter(run.raw, run.topics):
            for name, column in run.columns(topic).items():
                kept = data[f"{topic.strip('/')}/{name}"]
                if column.dtype != object:
                    assert kept.tobytes() == np.ascontiguousarray(column).tobytes()
        assert str(data["scene"]) == run.scene_text
        assert data["bench/event/kind"].tolist() == [e.kind.label for e in run.events]


def test_parquet_gives_the_same_bits(path, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    assert main(["export", str(path), "--to", "parquet", "--out", str(tmp_path)]) == 0
    run = read_run(path)
    for topic in filter(run.raw, run.topics):
        table = parquet.read_table(tmp_path / f"{topic.strip('/').replace('/', '_')}.parquet")
        for name, column in flat_columns(run, topic).items():
            if column.dtype != object:
                assert table[name].to_numpy().tobytes() == np.ascontiguousarray(column).tobytes()


def test_unwritable_folder_is_refused_before_anything(path, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for command in (["export", str(path), "--to", "csv"], ["compare", str(path), str(path)]):
        assert main([*command, "--out", str(tmp_path / "file" / "x")]) == 2
        assert capsys.readouterr().err.count("\n") == 1


# fitted


def test_identify_command_finds_what_the_run_was_made_with(path, capsys):
    command = ["identify", str(path), "mu", "c_A"]
    changed = ["--set", "friction.mu=0.25", "--set", "buffer.c_A=16"]
    assert main([*command, *changed]) == 0
    said = capsys.readouterr().out
    fitted = {word.split("=")[0]: word.split("=")[1] for word in said.split() if "=" in word}
    assert float(fitted["friction.mu"]) == pytest.approx(0.33, rel=1e-4)
    assert float(fitted["buffer.c_A"]) == pytest.approx(13.0, rel=1e-4)
    # a scene that is wrong elsewhere does not explain the run
    assert main([*command, "--set", "buffer.k_A=400", "--starts", "1"]) == 1
    assert "does not explain" in capsys.readouterr().out
    assert main(["identify", str(path), "colour"]) == 2
    assert "parameter colour: allowed are c_rr, e, mu, c_A" in capsys.readouterr().err
