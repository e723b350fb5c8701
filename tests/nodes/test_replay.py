"""Recordings played again over real DDS: same bytes, same timing, same verdict."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer

import capture_sim
from capture_sim.errors import RecordingError
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import CAPTURE_DETECTOR, TOPICS, topic_named
from capture_sim.recording.live import LiveRecorder, Split
from capture_sim.recording.offline import write_run
from capture_sim.recording.playback import Playback, Rewritten
from capture_sim.recording.read import read_run

NAME = "tilt_m10"


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    scene = capture_sim.load_scene(NAME)
    folder = tmp_path_factory.mktemp("runs")
    return write_run(capture_sim.simulate(scene), folder / f"{NAME}.mcap", run_id="a run")


# what is played


def test_messages_come_in_the_order_of_their_times(path):
    run = read_run(path)
    played = list(Playback(path).messages())
    times = [time for time, *_ in played]
    assert times == sorted(times)
    assert len(played) == sum(run.topics.values())
    for topic in run.topics:
        assert [data for _, name, data in played if name == topic] == run.raw(topic)
    assert played[0][1] == "/bench/run_info"
    assert [name for _, name, _ in played[-3:]] == ["/bench/stream_counts"] * 3


def test_what_is_latched_is_played_before_an_offset(path):
    run = read_run(path)
    begin = 10**9 + 3 * 10**9
    played = list(Playback(path).messages(3.0, {"/bench/run_info", "/bench/event", "/bench/state"}))
    assert played[0][:2] == (begin, "/bench/run_info")
    states = [data for _, name, data in played if name == "/bench/state"]
    assert states == run.raw("bench/state")[3000:]
    events = [data for _, name, data in played if name == "/bench/event"]
    assert events == run.raw("bench/event")
    assert min(time for time, *_ in played) == begin


def test_split_recording_is_played_as_one(path, tmp_path):
    recorder = LiveRecorder(tmp_path, split=Split(size=300_000))
    for _, name, data in Playback(path).messages():
        recorder.take(topic_named(name), data)
    folder = recorder.close().path
    assert len(list(folder.glob("*.mcap"))) > 3
    states = [data for _, name, data in Playback(folder).messages() if name == "/bench/state"]
    assert states == read_run(path).raw("bench/state")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="holds no"):
        Playback(tmp_path / "empty")


def test_what_a_cut_recording_lacks_is_said(path, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-100_000])
    (line,) = Playback(cut).damage
    assert "cut.mcap: the file ends without its end mark" in line
    assert Playback(path).damage == []


# the node

LISTENER = """
import json, sys, time
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger
from capture_sim.nodes.node import message_class

def qos(latched):
    kind = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE, durability=kind)

got = {}
rclpy.init()
node = rclpy.create_node("listener")

def listen(name, type_name, latched=False):
    got[name] = []
    node.create_subscription(
        message_class(type_name), name, got[name].append, qos(latched), raw=True)

def spin(holds, limit=30.0):
    end = time.monotonic() + limit
    while not holds() and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.05)
    return holds()

def call(name):
    client = node.create_client(Trigger, f"/player/{name}")
    assert client.wait_for_service(30.0)
    time.sleep(0.2)  # until it knows where to answer
    future = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, future, timeout_sec=30.0)
    return future.result().success

"""


@pytest.fixture
def listen(tmp_path):
    """Run a program that listens; return a function for its answer."""
    started = []

    def listen(program):
        process = subprocess.Popen(
            [sys.executable, "-c", LISTENER + program + "\nprint(json.dumps(answer))"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)

        def answer():
            out, err = process.communicate(timeout=90)
            assert process.returncode == 0, err
            return json.loads(out.splitlines()[-1])

        return answer

    yield listen
    for process in started:
        if process.poll() is None:
            process.kill()
        process.wait()


@pytest.fixture
def play(tmp_path):
    """Start the player's node with parameters."""
    started = []

    def play(**parameters):
        file = tmp_path / "player.yaml"
        file.write_text(yaml.safe_dump({"player": {"ros__parameters": parameters}}))
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "capture_sim.nodes.player"),
                *("--ros-args", "--params-file", str(file)),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        started.append(process)
        return process

    yield play
    for process in started:
        if process.poll() is None:
            process.kill()
        process.wait()


def padded(data):
    """Return a serialised message as DDS delivers it: in whole words of 4 bytes."""
    return data + bytes(-len(data) % 4)


def test_detector_comes_to_the_same_verdict_and_nothing_is_lost(path, tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS")
    command = [sys.executable, "-m", "capture_sim.cli", "replay", str(path)]
    command += [
        "--rate",
        "10",
        "--with",
        "capture_detector",
        "recorder",
        "--out",
        str(tmp_path / "out"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    one, two = read_run(path), read_run(tmp_path / "out" / f"{NAME}.mcap")
    assert two.problems == ()
    played = [topic for topic in TOPICS if CAPTURE_DETECTOR not in topic.publishers]
    for topic in played:
        if topic.name != "bench/run_info":
            assert two.raw(topic.name) == [padded(data) for data in one.raw(topic.name)], topic.name
    # announced as recorded, but for those that take part now
    announced = [dict(run.columns("bench/run_info")) for run in (one, two)]
    assert announced[1].pop("consumers").tolist() == [["capture_detector", "recorder"]]
    del announced[0]["consumers"]
    for name, column in announced[0].items():
        assert np.array_equal(column, announced[1][name]), name
    # judged anew, from the played messages: by the same criteria, state by state at the same time
    criteria = [dict(run.columns("capture/criteria")) for run in (one, two)]
    assert criteria[0].keys() == criteria[1].keys()
    for name, column in criteria[0].items():
        assert np.array_equal(column, criteria[1][name]), name
    assert [(s.t, s.state, s.final, s.reason) for s in two.statuses] == [
        (s.t, s.state, s.final, s.reason) for s in one.statuses
    ]


def test_what_is_left_out_is_not_missed(path, tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS")
    command = [sys.executable, "-m", "capture_sim.cli", "replay", str(path), "--rate", "0"]
    command += ["--with", "recorder", "--out", str(tmp_path)]
    state = ("/bench/state", "/bench/run_info", "/bench/stream_counts")
    one = read_run(path)
    for number, (options, first) in enumerate(
        ((("--start", "3"), 3000), (("--topics", *state), 0))
    ):
        done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
        two = read_run(tmp_path / f"{NAME}{f'_{number + 1}' if number else ''}.mcap")
        assert two.problems == ()
        assert two.raw("bench/state") == one.raw("bench/state")[first:]


def test_what_the_recording_lacks_is_missed_still(path):
    run = read_run(path)
    counts = run.raw("bench/stream_counts")[0]
    store = typestore()
    told = store.deserialize_cdr(counts, "capture_sim/msg/StreamCounts")
    before = dict(zip(told.topics, told.counts.tolist(), strict=True))
    skipped = Playback(path).skipped(3.0, {"/bench/state", "/bench/event"})
    rewritten = Rewritten("/2", skipped=skipped)("/bench/stream_counts", counts)
    told = store.deserialize_cdr(rewritten, "capture_sim/msg/StreamCounts")
    after = dict(zip(told.topics, told.counts.tolist(), strict=True))
    # what is promised does not hang on what the file holds: 3000 states come before 3 s
    assert after["bench/state"] == before["bench/state"] - 3000
    assert after["bench/event"] == before["bench/event"]  # latched: played from the start
    assert "bench/buffer" not in after
    assert told.run_id == "a run/2"


@pytest.fixture(scope="module")
def bench_bag(path, tmp_path_factory):
    """Poses of a bench, and a topic that is declared and was silent; nobody announced a run."""
    run, store = read_run(path), typestore()
    folder = tmp_path_factory.mktemp("bench") / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/target/odom", "nav_msgs/msg/Odometry", typestore=store)
        poses = writer.add_connection("/chaser/odom", "nav_msgs/msg/Odometry", typestore=store)
        for time_, data in zip(
            run.log_times("chaser/odom").tolist(), run.raw("chaser/odom"), strict=True
        ):
            writer.write(poses, time_, data)
    return folder


def test_nothing_played_is_a_failure(bench_bag, play):
    pytest.importorskip("rclpy", reason="needs ROS")
    # looped, it would play nothing for ever
    for loop in (False, True):
        node = play(bag=str(bench_bag), topics=["/target/odom"], rtf=0.0, delay=0.0, loop=loop)
        said, _ = node.communicate(timeout=30)
        assert node.returncode == 1, said
        assert "nothing was played" in said


def test_run_that_nobody_announced_cannot_be_followed(bench_bag):
    pytest.importorskip("rclpy", reason="needs ROS")
    command = [sys.executable, "-m", "capture_sim.cli", "replay", str(bench_bag)]
    # the time allowed is shorter than the player's start_timeout of 60 s
    done = subprocess.run(
        [*command, "--with", "capture_detector"], capture_output=True, text=True, timeout=50
    )
    assert done.returncode == 2
    (said,) = [line for line in done.stderr.splitlines() if line.startswith("capture-sim: ")]
    assert "error:" not in done.stderr
    assert "consumers = ['capture_detector']: allowed are none, as no bench/run_info" in said


def test_pause_step_and_latched_topics(path, play, listen):
    pytest.importorskip("rclpy", reason="needs ROS")
    play(bag=str(path), paused=True, rtf=0.0, delay=0.5)
    answer = listen(
        """
listen("/bench/state", "capture_sim/msg/BenchState")
answer = {"paused": not spin(lambda: got["/bench/state"], 2.0)}
answer["step"] = call("play_next")  # all of the first time: the announcement and a state
answer["first"] = spin(lambda: got["/bench/state"]) and len(got["/bench/state"])
# a late subscriber gets what is latched, and nothing else moves
listen("/bench/run_info", "capture_sim/msg/RunInfo", latched=True)
answer["latched"] = spin(lambda: got["/bench/run_info"]) and len(got["/bench/run_info"])
answer["again"] = call("play_next") and spin(lambda: len(got["/bench/state"]) == 2)
answer["pause"] = call("pause")
answer["resume"] = call("resume")
answer["more"] = spin(lambda: len(got["/bench/state"]) > 1000)
"""
    )()
    assert answer == {
        "paused": True,
        "step": True,
        "first": 1,
        "latched": 1,
        "again": True,
        "pause": False,  # it is
        "resume": True,
        "more": True,
    }


def test_services_of_simulation_interfaces(path, play, listen):
    pytest.importorskip("rclpy", reason="needs ROS")
    # at real time: an unpaced one is through before it can be asked again
    play(bag=str(path), paused=True, rtf=1.0, delay=0.5)
    answer = listen(
        """
from importlib import import_module
from capture_sim.nodes.services import definitions
services = import_module(f"{definitions()}.srv")

def ask(name, service, **fields):
    kind = getattr(services, service)
    client = node.create_client(kind, f"/player/{name}")
    assert client.wait_for_service(30.0)
    time.sleep(0.2)  # until it knows where to answer
    request = kind.Request()
    for field, value in fields.items():
        setattr(request, field, value)
    future = client.call_async(request)
    rclpy.spin_until_future_complete(node, future, timeout_sec=40.0)
    return future.result()

def set_state(number):
    request = services.SetSimulationState.Request()
    request.state.state = number
    return ask("set_simulation_state", "SetSimulationState", state=request.state).result.result

listen("/bench/state", "capture_sim/msg/BenchState")
answer = {"state": ask("get_simulation_state", "GetSimulationState").state.state}
spin(lambda: False, 1.0)  # until the topics are connected
answer["step"] = ask("step_simulation", "StepSimulation", steps=5).result.result
answer["stepped"] = spin(lambda: len(got["/bench/state"]) >= 5) and len(got["/bench/state"])
answer["pause"] = set_state(2)
answer["stop"] = set_state(0)
answer["reset"] = ask("reset_simulation", "ResetSimulation").result.result
answer["features"] = list(ask("get_simulator_features", "GetSimulatorFeatures").features.features)
answer["play"] = set_state(1)
answer["step of a playing one"] = ask("step_simulation", "StepSimulation", steps=1).result.result
"""
    )()
    assert answer == {
        "state": 2,
        "step": 1,
        "stepped": 5,
        "pause": 101,  # already
        "stop": 103,
        "reset": 0,
        "features": [24, 25, 26, 31, 32],
        "play": 1,
        "step of a playing one": 4,
    }


def test_bag_of_others_is_played_with_a_clock(tmp_path, play, listen):
    pytest.importorskip("rclpy", reason="needs ROS")
    store = typestore()
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
    hear = listen(
        """
listen("/hello", "std_msgs/msg/String")
listen("/clock", "rosgraph_msgs/msg/Clock")
spin(lambda: node.count_publishers("/hello") > 0)
time.sleep(0.5)
assert call("resume")
spin(lambda: len(got["/hello"]) >= 20)
answer = {"hello": [m.hex() for m in got["/hello"]], "clocks": len(got["/clock"])}
"""
    )
    process = play(bag=str(folder), rtf=2.0, paused=True)
    answer = hear()
    assert process.wait(30) == 0
    assert "/strange: type foo_msgs/msg/Bar is not installed" in process.stdout.read()
    texts = [bytes.fromhex(data)[8:] for data in answer["hello"]]
    assert [text.split(b"\0")[0].decode() for text in texts] == [f"message {i}" for i in range(20)]
    assert answer["clocks"] > 5


@pytest.mark.parametrize(
    "parameters, said",
    [
        ({}, "parameter bag"),
        ({"bag": "/nowhere.mcap"}, "/nowhere.mcap: cannot read"),
        ({"rtf": -1.0}, "parameter rtf"),
    ],
)
def test_bad_parameters_are_refused_in_one_line(path, play, parameters, said):
    pytest.importorskip("rclpy", reason="needs ROS")
    if parameters:
        parameters = {"bag": str(path), **parameters}
    process = play(**parameters) if parameters else play(loop=False)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 2
    assert said in output
    assert "Traceback" not in output


@pytest.mark.parametrize(
    "options, said",
    [
        (["--start", "100"], "parameter start = 100 s: allowed is 0 to 6.0"),
        (["--topics", "/no/such"], "/no/such not in the recording"),
        (None, "damaged at byte"),
    ],
)
def test_command_says_what_is_wrong_as_every_command(options, said, path, tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS")
    file = path
    if options is None:
        data = bytearray(path.read_bytes())
        data[-700] ^= 1
        file = tmp_path / "broken.mcap"
        file.write_bytes(data)
    command = [sys.executable, "-m", "capture_sim.cli", "replay", str(file), *(options or ())]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("capture-sim: ")
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
