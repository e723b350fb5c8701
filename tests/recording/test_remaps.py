"""Recordings whose topics have other names than the bench's: read by remaps, given or recorded."""

import json
import re

import pytest
from bags import copied, of_a_bench
from mcap.reader import make_reader

import capture_sim
from capture_sim.cli import main
from capture_sim.errors import RecordingError
from capture_sim.messages.topics import CHASER_ODOMETRY, TARGET_ODOMETRY, topic_named
from capture_sim.recording.bag import read_bag
from capture_sim.recording.live import LiveRecorder
from capture_sim.recording.offline import write_run
from capture_sim.recording.playback import Playback

NAMES = {"/chaser/odom": "/mocap/rb1/odom", "/target/odom": "/mocap/rb2/odom"}
REMAPS = [part for pair in NAMES.items() for part in ("--remap", ":=".join(pair).lstrip("/"))]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    run = capture_sim.simulate(capture_sim.load_scene("tilt_0"))
    return write_run(run, tmp_path_factory.mktemp("runs") / "tilt_0.mcap")


def renamed(source, target):
    """A copy with the names of the rig, as `ros2 bag record` leaves it."""

    def change(topic, data):
        yield NAMES.get(topic, topic), "cdr", data

    return copied(source, target, change=change)


@pytest.fixture(scope="module")
def rig_bag(path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    return renamed(of_a_bench(path, folder / "bench.mcap"), folder / "rig.mcap")


def test_every_command_reads_remapped_topics(path, rig_bag, tmp_path, capsys):
    scene = ["--scene", "tilt_0"]
    out = ["--out", str(tmp_path / "out")]
    for command, *options in (
        ("detect", *scene),
        ("export", *out),
        ("view", *scene, *out),
        ("report", *scene, "--out", str(tmp_path / "report.html")),
        ("calibrate", "--fit=c_rr", *scene, "--touches=0", "--restarts=0", *out),
        ("compare", str(path), *out),
    ):
        arguments = [command, str(rig_bag), *options]
        assert main([*arguments, *REMAPS]) == 0, (command, capsys.readouterr())
    assert "/chaser/odom" in set(Playback(rig_bag, NAMES).types)
    capsys.readouterr()
    assert main(["detect", str(rig_bag), *scene]) == 2
    assert "chaser/odom" in capsys.readouterr().err
    assert (tmp_path / "out" / "chaser_odom.csv").is_file()


def test_remaps_that_the_recorder_noted_are_applied_by_themselves(path, tmp_path):
    run = read_bag(path)
    remaps = {CHASER_ODOMETRY: "/mocap/rb1/odom", TARGET_ODOMETRY: "/mocap/rb2/odom"}
    (_, _, info), *others = Playback(path).messages()
    recorder = LiveRecorder(tmp_path, info, remaps=remaps)
    for _, name, data in others:
        recorder.take(topic_named(name), data)
    file = recorder.close().path
    again = read_bag(file)
    assert again.complete
    assert again.topics == run.topics
    assert again.raw("chaser/odom") == run.raw("chaser/odom")
    assert main(["detect", str(file)]) == 0
    info = json.dumps(read_bag(file).metadata)
    assert "/chaser/odom:=/mocap/rb1/odom" in info
    # other tools see the names that the rig has
    with file.open("rb") as stream:
        names = {channel.topic for channel in make_reader(stream).get_summary().channels.values()}
    assert "/mocap/rb1/odom" in names
    assert "/chaser/odom" not in names


@pytest.mark.parametrize(
    "remaps, reason",
    [
        ({"chaser/odom": "/mocap/rb3/odom"}, "/mocap/rb3/odom is not recorded; available topics: "),
        ({"joint_states": "/mocap/rb1/odom"}, "both topics are recorded"),
    ],
)
def test_remap_that_does_not_fit_is_rejected(remaps, reason, rig_bag):
    for read in (read_bag, Playback):
        with pytest.raises(RecordingError, match=rf"{re.escape(str(rig_bag))}: .*{reason}"):
            read(rig_bag, remaps=remaps)


@pytest.mark.parametrize("text", ["chaser/odom", "chaser/odom:=", "no/topic:=/x", ":=/x"])
def test_remap_that_is_none_is_rejected(text, rig_bag, capsys):
    for command in ("detect", "replay"):
        assert main([command, str(rig_bag), "--remap", text]) == 2
        assert "must be TOPIC:=RECORDED_TOPIC" in capsys.readouterr().err
