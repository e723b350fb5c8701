"""Files as a user may have them: every command reports in one line what is wrong, and where."""

from __future__ import annotations

import zipfile
from collections import Counter

import numpy as np
import pytest
from bags import copied, of_a_bench
from mcap.reader import make_reader
from mcap.writer import Writer
from recorded import n_sent

import capture_sim
from capture_sim.cli import main
from capture_sim.errors import RecordingError
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import CHASER_ODOMETRY, JOINT_STATES
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import PUBLISHERS, run_stream, write_run
from capture_sim.recording.playback import Playback
from capture_sim.recording.read import read_run
from capture_sim.recording.write import RunWriter
from capture_sim.run.run import detect
from capture_sim.run.series import PARTS

#: Commands that read a recording, with the least that they need.
COMMANDS = {
    "view": ["--scene", "tilt_0"],
    "report": ["--scene", "tilt_0"],
    "detect": ["--scene", "tilt_0"],
    "calibrate": ["--fit", "mu", "--scene", "tilt_0", "--restarts", "0"],
    "compare": [],
    "export": [],
}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    result = capture_sim.simulate(capture_sim.load_scene("tilt_0"), t_end=0.8)
    return write_run(result, tmp_path_factory.mktemp("runs") / "tilt_0.mcap")


def answers(file, folder, capsys, commands=tuple(COMMANDS)):
    """Yield each command with its status, lines of standard error, and standard output."""
    for command in commands:
        options = COMMANDS[command]
        if command != "detect":
            suffix = ".html" if command == "report" else ""
            options = [*options, "--out", str(folder / f"{command}{suffix}")]
        others = [str(file)] if command == "compare" else []
        status = main([command, str(file), *others, *options])
        printed = capsys.readouterr()
        yield command, status, printed.err.splitlines(), printed.out


@pytest.mark.parametrize("kind", ["empty", "zip"])
def test_file_of_another_kind_is_named_as_such(kind, tmp_path, capsys):
    file = tmp_path / "run.mcap"
    file.touch()
    if kind == "zip":
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("a.txt", "text " * 1000)
    for _, status, errors, _ in answers(file, tmp_path, capsys):
        assert status == 2
        why = ": it is empty" if kind == "empty" else ""
        assert errors == [f"capture-sim: {file}: not an MCAP file{why}"]
    with pytest.raises(RecordingError, match="not an MCAP file"):
        Playback(file)
    assert {p.name for p in tmp_path.iterdir()} <= {"run.mcap", "compare", "view"}


def test_recording_cut_before_its_first_message_names_file_and_byte(path, tmp_path, capsys):
    file = tmp_path / "head.mcap"
    file.write_bytes(path.read_bytes()[:100])
    damage = f"{file}: read up to byte 46 of 100 (incomplete record): 0 messages"
    for command, status, errors, _ in answers(file, tmp_path, capsys):
        assert status == 2, command
        assert errors[0] == f"capture-sim: {damage}", command
        assert len(errors) <= 3, command
    with pytest.raises(RecordingError, match="nothing to play: read up to byte 46 of 100"):
        Playback(file)


def test_two_recordings_one_behind_the_other_are_not_read_as_one(path, tmp_path, capsys):
    """As `cat a.mcap b.mcap` leaves them: only the first is read, which is reported."""
    file, size = tmp_path / "both.mcap", path.stat().st_size
    file.write_bytes(path.read_bytes() * 2)
    line = f"read up to byte {size} of {2 * size} (more bytes follow the end mark)"
    for _, _, errors, _ in answers(file, tmp_path, capsys, ("detect",)):
        assert line in "\n".join(errors)
    run = read_bag(file)
    assert run.topics == read_bag(path).topics
    assert not run.complete
    assert run.extremes is not None  # what precedes the end mark has its checksum


def test_two_runs_merged_into_one_file_are_named_as_two(path, tmp_path, capsys):
    other = write_run(
        capture_sim.simulate(capture_sim.load_scene("tilt_p10"), t_end=0.5), tmp_path / "b.mcap"
    )
    file = tmp_path / "merged.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        for source in (path, other):
            ids = {}
            with source.open("rb") as read:
                for schema, channel, message in make_reader(read).iter_messages():
                    if channel.topic not in ids:
                        kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                        ids[channel.topic] = writer.register_channel(channel.topic, "cdr", kind)
                    times = (message.log_time, message.data, message.publish_time)
                    writer.add_message(ids[channel.topic], *times)
        writer.finish()
    for command, status, errors, _ in answers(file, tmp_path, capsys):
        assert status == (0 if command == "export" else 2), command
        assert len(errors) == 1, command
        assert errors[0].startswith(f"capture-sim: {file}: contains 2 runs"), command


def test_bag_of_another_robot_is_named_with_what_is_missing(path, tmp_path, capsys):
    def elsewhere(topic, data):
        yield f"/robot{topic}", "cdr", data

    topics = ("/chaser/odom", "/joint_states")
    file = copied(path, tmp_path / "robot.mcap", topics=topics, change=elsewhere)
    expected = {
        "view": f"{file}: contains no finite pose of the chaser",
        "report": f"{file}: contains no finite pose of the chaser",
        "detect": f"{file}: contains no motion_capture/chaser or chaser/odom,",
        "calibrate": f"{file}: contains no pose of the chaser",
        "compare": f"{file}: contains no contact to align it by",
    }
    for command, status, errors, printed in answers(file, tmp_path, capsys):
        assert status == (2 if command in expected else 0), command
        assert len(errors) == (command in expected), command
        if command in expected:
            assert errors[0].startswith(f"capture-sim: {expected[command]}"), command
        if command == "export":
            assert "robot_chaser_odom.csv" in printed


def with_x(x_of, source, path):
    """Copy a recording as a bench's, with the chaser's x changed."""
    store = typestore()

    def change(topic, data):
        if topic == "/chaser/odom":
            message = store.deserialize_cdr(data, CHASER_ODOMETRY.type_name)
            position = message.pose.pose.position
            position.x = x_of(position.x)
            data = bytes(store.serialize_cdr(message, CHASER_ODOMETRY.type_name))
        yield topic, "cdr", data

    bare = of_a_bench(source, path.with_stem("bare"))
    return copied(bare, path, change=change)


def test_poses_that_are_no_numbers_are_left_out(path, tmp_path, capsys):
    file = with_x(lambda x: np.nan, path, tmp_path / "nan.mcap")
    said = "/chaser/odom: refused (no_pose): chaser never tracked: all"
    for command, status, errors, _ in answers(file, tmp_path, capsys, ("detect", "view", "report")):
        assert status == 2, command
        assert f"{file}: {said}" in errors[0], command
        if command != "detect":  # what is drawn is not judged
            assert f"{file}: contains no finite pose of the chaser" in errors[-1], command


def of_the_first(n):
    """Return a change that keeps n messages of each topic."""
    counts = Counter()

    def change(topic, data):
        counts[topic] += 1
        if counts[topic] <= n:
            yield topic, "cdr", data

    return change


def test_poses_of_one_instant_decide_and_fit_nothing(path, tmp_path, capsys):
    bare = of_a_bench(path, tmp_path / "bare.mcap")
    file = copied(bare, tmp_path / "one.mcap", change=of_the_first(1))
    commands = ("detect", "calibrate", "export")
    (_, *detect), (_, *calibrate), (_, *export) = answers(file, tmp_path, capsys, commands)
    assert detect[:2] == [0, []]
    assert "verdict: undecided" in detect[2]
    status, errors, _ = calibrate
    assert (status, errors) == (
        2,
        [f"capture-sim: {file}: measurements of one instant: must be of two or more"],
    )
    assert export[:2] == [0, []]


def test_poses_far_from_the_origin_of_their_frame_end_no_fit_in_an_error(
    path, tmp_path, capsys, monkeypatch
):
    """As of a map's grid, for one of the vehicles: nothing is fitted, or it explains nothing."""
    file = with_x(lambda x: x + 1e4, path, tmp_path / "far.mcap")
    ((_, status, errors, _),) = answers(file, tmp_path, capsys, ("calibrate",))
    assert status == 2
    assert "refused (position_units): distance between the vehicles" in errors[0]
    waived = [*COMMANDS["calibrate"], "--waive", "position_units", "--waive", "not_facing"]
    monkeypatch.setitem(COMMANDS, "calibrate", waived)
    ((_, status, errors, printed),) = answers(file, tmp_path, capsys, ("calibrate",))
    assert (status, errors) == (1, [])
    assert "not found: " in printed


def test_joints_of_other_nodes_on_the_topic_are_left_out(path, tmp_path):
    """joint_states is one topic for all joints of a system."""
    store, other = typestore(), Counter()

    def beside(topic, data):
        yield topic, "cdr", data
        if topic == "/joint_states":
            message = store.deserialize_cdr(data, JOINT_STATES.type_name)
            message.header.stamp.nanosec += 1_000_000
            message.name, message.position = ["gripper"], np.ones(1)
            message.velocity = message.effort = np.zeros(0)
            other[topic] += 1
            yield topic, "cdr", bytes(store.serialize_cdr(message, JOINT_STATES.type_name))

    bare = of_a_bench(path, tmp_path / "bare.mcap")
    beside_others = copied(bare, tmp_path / "both.mcap", change=beside)
    count = len(read_bag(bare).raw(JOINT_STATES))
    assert len(read_bag(beside_others).raw(JOINT_STATES)) == count + other.total()
    scene = capture_sim.load_scene("tilt_0")
    run, both = (read_run(file, scene=scene) for file in (bare, beside_others))
    for name in PARTS:
        np.testing.assert_array_equal(both.measured(name).values, run.measured(name).values)
    assert detect(both) == detect(run)


def test_recording_that_is_being_written_is_read_up_to_what_is_there(tmp_path, capsys):
    result = capture_sim.simulate(capture_sim.load_scene("tilt_0"), t_end=0.8)
    run = RunDescription.of(result.scene, "x", PUBLISHERS)
    file = tmp_path / "growing.mcap"
    writer = RunWriter(file, run)
    stream = list(run_stream(result, run))
    for topic, stamp, data in stream[: len(stream) // 2]:
        writer.write(topic, data, stamp)
    writer.flush()
    for command, status, errors, _ in answers(file, tmp_path, capsys, ("detect", "export")):
        assert status == 0, command
        assert len(errors) == 1, command
        assert f"{file}: read up to byte {file.stat().st_size} of" in errors[0], command
    assert n_sent(read_bag(file)) == len(stream) // 2
    writer.close()


def test_file_that_shrinks_while_it_is_read_ends_no_process(path, tmp_path, monkeypatch):
    """As a copy over it begins.  Of a mapped file the system would kill the reader."""
    from capture_sim.recording import scan

    file = tmp_path / "run.mcap"
    file.write_bytes(path.read_bytes())
    check = scan._check

    def shrink(*args):
        file.write_bytes(b"")
        check(*args)

    monkeypatch.setattr(scan, "_check", shrink)
    (line,) = read_bag(file).damage
    assert "read up to byte" in line


@pytest.mark.parametrize("command", ["view", "report", "compare", "export"])
def test_folder_that_nothing_can_be_written_to_is_named(command, path, capsys):
    """/proc refuses every user, root included."""
    name = "x.html" if command == "report" else "x"
    others = [str(path)] if command == "compare" else []
    assert main([command, str(path), *others, "--out", f"/proc/{name}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "/proc" in line
    assert ": cannot be written: " in line or ": cannot write: " in line
