"""Recordings played again over real DDS: same bytes, same timing, same verdict."""

from __future__ import annotations

import time

import numpy as np
import pytest
from bags import in_two_files
from recorded import counts_of
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from std_srvs.srv import Trigger

import capture_sim
from capture_sim.cli import main
from capture_sim.errors import RecordingError
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import (
    BENCH_STATE,
    CAPTURE_DETECTOR,
    RUN_INFO,
    TOPICS,
    Rate,
    Topic,
)
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import write_run
from capture_sim.recording.playback import Playback, PlayedCounts
from tests.nodes.bench_client import Client, wait_until
from tests.nodes.changes import shared_numbers

NAME = "tilt_m10"


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    scene = capture_sim.load_scene(NAME)
    folder = tmp_path_factory.mktemp("runs")
    return write_run(capture_sim.simulate(scene), folder / f"{NAME}.mcap", run_id="a run")


# what is played


def test_messages_come_in_the_order_of_their_times(path):
    run = read_bag(path)
    played = list(Playback(path).messages())
    times = [time for time, *_ in played]
    assert times == sorted(times)
    assert len(played) == sum(run.topics.values())
    for topic in run.topics:
        assert [data for _, name, data in played if name == topic] == run.raw(topic)
    assert played[0][1] == "/bench/run_info"
    assert [name for _, name, _ in played[-3:]] == ["/bench/stream_counts"] * 3


def test_what_is_latched_is_played_before_an_offset(path):
    run = read_bag(path)
    begin = 10**9 + 3 * 10**9
    played = list(Playback(path).messages(3.0, {"/bench/run_info", "/bench/event", "/bench/state"}))
    assert played[0][:2] == (begin, "/bench/run_info")
    states = [data for _, name, data in played if name == "/bench/state"]
    assert states == run.raw("bench/state")[3000:]
    events = [data for _, name, data in played if name == "/bench/event"]
    assert events == run.raw("bench/event")
    assert min(time for time, *_ in played) == begin


@pytest.mark.parametrize(
    "topic, depth",
    [
        ("/capture/status", 0),
        ("/capture/verdict", 1),
        ("/launcher/state", 0),
        ("/launcher/phase", 1),
        ("/launcher/command", 10),
    ],
)
def test_late_start_plays_what_the_publisher_would_have_kept(path, topic, depth):
    """As a late subscriber gets it: nothing of streams, the last of transient-local topics."""
    run = read_bag(path)
    earlier = sum(run.log_times(topic) < 4 * 10**9)
    assert earlier > 1
    played = [data for *_, data in Playback(path).messages(3.0, {topic})]
    assert played == run.raw(topic)[max(0, earlier - depth) :]
    skipped = Playback(path).skipped(3.0, {topic})
    assert skipped.get(topic, 0) == max(0, earlier - depth)


def test_folder_is_played_as_one(path, tmp_path):
    folder = in_two_files(path, tmp_path / "bag", 3.0)
    states = [data for _, name, data in Playback(folder).messages() if name == "/bench/state"]
    assert states == read_bag(path).raw("bench/state")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="contains no"):
        Playback(tmp_path / "empty")


def test_what_a_cut_recording_lacks_is_said(path, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-100_000])
    (line,) = Playback(cut).damage
    assert line.startswith("read up to byte ")
    assert Playback(path).damage == ()


# the node


def padded(data):
    """Return a serialised message as DDS delivers it: in whole words of 4 bytes."""
    return data + bytes(-len(data) % 4)


def test_detector_comes_to_the_same_verdict_and_nothing_is_lost(path, tmp_path):
    options = ["--rtf", "10", "--with", "capture_detector", "recorder"]
    assert main(["replay", str(path), *options, "--out", str(tmp_path / "out")]) == 0
    one, two = read_bag(path), read_bag(tmp_path / "out" / f"{NAME}.mcap")
    assert two.problems == ()
    played = [topic for topic in TOPICS if CAPTURE_DETECTOR not in topic.publishers]
    for topic in played:
        if topic.name != "bench/run_info":
            # of a state, one may be replaced by the next on its way
            first = -1 if topic.holds_state else 0
            recorded = [padded(data) for data in one.raw(topic.name)]
            assert two.raw(topic.name)[first:] == recorded[first:], topic.name
    # announced as recorded, but for who announces it and who takes part
    announced = [dict(run.columns("bench/run_info")) for run in (one, two)]
    assert announced[1]["source"].tolist() == ["replay"]
    (participants,) = announced[1]["participants"].tolist()
    assert [name.partition("#")[0] for name in participants] == ["/capture_detector", "/recorder"]
    for name in announced[0].keys() - {"source", "announcer", "participants"}:
        assert np.array_equal(announced[0][name], announced[1][name]), name
    # judged anew, from the played messages: by the same criteria, state by state at the same time
    criteria = [dict(run.columns("capture/criteria")) for run in (one, two)]
    assert criteria[0].keys() == criteria[1].keys()
    for name, column in criteria[0].items():
        assert np.array_equal(column, criteria[1][name]), name
    assert [(s.t, s.state, s.final, s.reason) for s in two.statuses] == [
        (s.t, s.state, s.final, s.reason) for s in one.statuses
    ]


def test_what_the_recording_lacks_is_missed_still(path):
    run = read_bag(path)
    counts = run.raw("bench/stream_counts")[0]
    store = typestore()
    told = store.deserialize_cdr(counts, "capture_sim/msg/StreamCounts")
    before = dict(zip(told.topics, told.counts.tolist(), strict=True))
    skipped = Playback(path).skipped(3.0, {"/bench/state", "/bench/event"})
    rewritten = PlayedCounts(skipped=skipped)(counts)
    told = store.deserialize_cdr(rewritten, "capture_sim/msg/StreamCounts")
    after = dict(zip(told.topics, told.counts.tolist(), strict=True))
    # what is promised does not hang on what the file holds: 3000 states come before 3 s
    assert after["bench/state"] == before["bench/state"] - 3000
    assert after["bench/event"] == before["bench/event"]  # transient local: played from the start
    assert "bench/buffer" not in after


@pytest.fixture(scope="module")
def bench_bag(path, tmp_path_factory):
    """Poses of a bench, and a topic that is declared and was silent; nobody announced a run."""
    run, store = read_bag(path), typestore()
    folder = tmp_path_factory.mktemp("bench") / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/target/odom", "nav_msgs/msg/Odometry", typestore=store)
        poses = writer.add_connection("/chaser/odom", "nav_msgs/msg/Odometry", typestore=store)
        for time_, data in zip(
            run.log_times("chaser/odom").tolist(), run.raw("chaser/odom"), strict=True
        ):
            writer.write(poses, time_, data)
    return folder


def test_nothing_played_is_a_failure(bench_bag, start):
    options = {"bag": bench_bag, "topics": "[/target/odom]", "rtf": 0.0}
    player = start("player", **options)
    assert player.status() == 1, player.text
    assert "nothing was played" in player.text


def test_run_that_nobody_announced_cannot_be_followed(bench_bag, capsys):
    assert main(["replay", str(bench_bag), "--with", "capture_detector"]) == 2
    errors = capsys.readouterr().err
    (said,) = [line for line in errors.splitlines() if line.startswith("capture-sim: ")]
    assert "error:" not in errors
    assert "wait_for = ['capture_detector']: must be empty: the replay contains no" in said


def test_pause_resume_and_latched_topics(path, start, client, tmp_path):
    sent = shared_numbers(tmp_path / "sent")
    states, announced = client.listen(BENCH_STATE), client.listen(RUN_INFO)
    change = f"changes.count_sent({str(tmp_path / 'sent')!r}, {BENCH_STATE.name!r})"
    player = start("player", change, bag=path, paused="true", rtf=0.2)

    def ask(name):
        return client.ask(Trigger, f"/player/{name}").success

    def is_still():
        held = sent[0]
        time.sleep(0.2)
        wait_until(lambda: len(states) >= held)
        return sent[0] == len(states) == held

    assert not ask("pause")  # it is
    assert is_still()
    assert ask("resume")
    wait_until(lambda: len(states) > 100)
    assert ask("pause")
    assert is_still()
    # a late subscriber gets the transient-local messages, and nothing else moves
    late = client.listen(RUN_INFO)
    wait_until(lambda: late)
    assert [info.source for info in (*announced, *late)] == ["replay"] * 2
    assert is_still()
    held = len(states)
    assert ask("resume")
    wait_until(lambda: len(states) > held + 100)
    assert player.end() == 0


def test_players_in_turn_play_the_same_run_to_nodes_that_stay(path, start, tmp_path):
    """Unpaced, to a recorder and a detector: nothing that is counted is lost."""
    recorder, detector = start("recorder", out=tmp_path), start("capture_detector")
    for name in (NAME, f"{NAME}_2"):
        player = start("player", bag=path, rtf=0.0, wait_for="[recorder, capture_detector]")
        assert player.status() == 0, player.text
        played = read_bag(tmp_path / f"{name}.mcap")
        assert played.problems == ()
        assert counts_of(played) == counts_of(read_bag(path))
    assert detector.end() == 0
    # what is left out is not missed
    topics = "[/bench/state, /bench/run_info, /bench/stream_counts]"
    options = {"bag": path, "rtf": 0.0, "start": 3.0, "topics": topics}
    assert start("player", wait_for="[recorder]", **options).status() == 0
    part = read_bag(tmp_path / f"{NAME}_3.mcap")
    assert part.problems == ()
    assert part.raw("bench/state") == read_bag(path).raw("bench/state")[3000:]
    assert recorder.end() == 0


def test_bag_of_others_is_played(tmp_path, start):
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    folder = tmp_path / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        text, strange = (
            writer.add_connection("/hello", "std_msgs/msg/String", typestore=store),
            writer.add_connection(
                "/strange", "foo_msgs/msg/Bar", msgdef="int32 x", rihs01="RIHS01_" + "0" * 64
            ),
        )
        for i in range(20):
            message = types["std_msgs/msg/String"](data=f"message {i}")
            data = store.serialize_cdr(message, "std_msgs/msg/String")
            writer.write(text, 1_000_000_000 + i * 50_000_000, data)
            writer.write(strange, 1_000_000_000 + i * 50_000_000, b"\0\1\0\0\0\0\0\0")
    with Client() as client:
        heard = client.listen(Topic("/hello", "std_msgs/msg/String", (), Rate.EVENT))
        player = start("player", bag=folder, rtf=2.0, paused="true")
        # the player that answers a new client knows this subscription
        assert client.ask(Trigger, "/player/resume").success
        wait_until(lambda: len(heard) == 20)
        assert player.status() == 0
    assert [message.data for message in heard] == [f"message {i}" for i in range(20)]
    assert "/strange: type foo_msgs/msg/Bar is not installed" in player.text


def test_command_says_what_is_wrong_as_every_command(path, tmp_path, capsys):
    file = tmp_path / "cut.mcap"
    file.write_bytes(path.read_bytes()[:3000])
    for arguments, reason in (
        ([path, "--start", "100"], "parameter start = 100 s: must be 0 to 6.0"),
        ([file], "nothing to play: read up to byte"),
    ):
        assert main(["replay", *map(str, arguments)]) == 2
        errors = capsys.readouterr().err
        assert errors.startswith("capture-sim: ")
        assert reason in errors
        assert errors.count("\n") == 1
