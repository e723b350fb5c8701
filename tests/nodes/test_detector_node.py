"""The capture detector's node: its parameters, and poses that no simulator sent."""

import math
import signal
import time
from dataclasses import fields, replace

import numpy as np
import pytest
import rclpy
from bench_processes import PATIENCE, Client, join_dds, wait_until
from capture_sim.srv import BeginTrial
from noisy_replay import Disturbance, disturbed, judge
from rcl_interfaces.srv import DescribeParameters, GetParameters
from rclpy.parameter import parameter_value_to_python
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from std_srvs.srv import Trigger

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.detection.align import Source
from capture_sim.detection.exact import CaptureState
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import (
    BUFFER_STATE,
    CAPTURE_CRITERIA,
    CAPTURE_DETECTOR,
    CAPTURE_STATUS,
    CAPTURE_VERDICT,
    CHASER_POSE,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    TARGET_POSE,
    topics_of,
)
from capture_sim.nodes.node import BenchNode
from capture_sim.recording.detect import detect_again
from capture_sim.recording.live import LiveRecorder
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.scene.parts import Detector

SENSED = ["sensors.motion_capture={}", "sensors.seed=3"]


# parameters


def test_criteria_are_described_and_recorded(start, tmp_path, capsys):
    names = [field.name for field in fields(Detector)]
    nodes = [
        start("capture_detector", min_dwell=0.3),
        start("launcher"),
        start("recorder", out=tmp_path),
    ]
    detector = nodes[0]
    detector.wait_for("ready")
    with Client() as client:
        described = client.ask(
            DescribeParameters, "/capture_detector/describe_parameters", names=names
        )
        by_name = {d.name: d for d in described.descriptors}
        for field in fields(Detector):
            descriptor = by_name[field.name]
            assert descriptor.description.startswith(f"{field.metadata['unit']}, ")
            assert field.metadata["doc"] in descriptor.description
            allowed = f"{field.metadata['allowed']} {field.metadata['unit']}"
            assert descriptor.additional_constraints.endswith(f"decimal point, {allowed}")
        assert client.set("capture_detector", min_retreat=0.03)[0]
        nodes.append(
            start("simulator", rtf=0.001, consumers="[launcher, capture_detector, recorder]")
        )
        nodes[-1].wait_for("released")
        # right, but of no effect on the run that is on
        assert client.set("capture_detector", capture_radius=1e-6)[0]
        assert client.set("simulator", rtf=0.0)[0]
    assert [node.status() for node in nodes] == [0, 0, 0, 0]
    said = detector.text
    assert "evaluated by min_dwell = 0.3 s, min_retreat = 0.03 m; else by the scene" in said
    assert "captured, within 5 mm of BE for 0.3 s" in said
    path = tmp_path / "tilt_0.mcap"
    run = read_run(path)
    assert run.problems == ()
    assert run.criteria == replace(run.scene.detector, min_dwell=0.3, min_retreat=0.03)
    assert detect_again(run) == list(run.statuses)
    assert main(["detect", str(path)]) == 0
    said = capsys.readouterr().out
    assert "recorded criterion: min_dwell = 0.3 s (scene: 0.2 s)" in said
    assert "; the same" in said
    # a change stands over what was recorded, and over nothing else
    assert main(["detect", str(path), "--set", "detector.min_dwell=0.2"]) == 0
    said = capsys.readouterr().out
    assert "within 5 mm of BE for 0.2 s" in said
    assert "recorded criterion: min_retreat = 0.03 m" in said
    # an older recording does not hold them
    older = LiveRecorder(tmp_path / "older")
    for topic in (*topics_of(SIMULATOR), *topics_of(CAPTURE_DETECTOR)):
        for data in run.raw(topic) if topic is not CAPTURE_CRITERIA else ():
            older.take(topic, data)
    old = older.close().path
    assert read_run(old).criteria is None
    assert main(["detect", str(old)]) == 1
    said = capsys.readouterr().out
    assert "DIFFERENT" in said
    assert "contains no criteria" in said


def test_parameters_show_the_criteria_in_force(start):
    """As `ros2 param get` and `dump` read them; a node with the dumped file behaves equally."""
    names = [*(field.name for field in fields(Detector)), "scene_criteria"]
    default = Detector()

    def shown(client):
        answer = client.ask(GetParameters, "/capture_detector/get_parameters", names=names)
        values = map(parameter_value_to_python, answer.values)
        return dict(zip(names, values, strict=True))

    def shown_in_a_trial(client, **overrides):
        changes = [f"detector.{name}={value}" for name, value in overrides.items()]
        begin = {"scene": "tilt_0", "overrides": changes}
        assert client.ask(BeginTrial, "/capture_detector/begin_trial", **begin).success
        wait_until(lambda: not math.isnan(shown(client)["capture_radius"]))
        time.sleep(0.2)  # the announcement comes after the response
        values = shown(client)
        assert client.ask(Trigger, "/capture_detector/end_trial").success
        wait_until(lambda: "undecided, " in node.text)
        node.lines.clear()
        return values

    def expected(**given):
        of_scene = [name for name in names[:-1] if name not in ("min_dwell", *set_here)]
        return {**vars(default), "min_dwell": 0.3, **given, "scene_criteria": of_scene}

    set_here = ()
    with Client() as client:
        node = start("capture_detector", min_dwell=0.3, exit_when_done="false")
        before = shown(client)
        assert math.isnan(before["capture_radius"])
        assert (before["min_dwell"], before["scene_criteria"]) == (0.3, [""])
        assert shown_in_a_trial(client, min_dwell=0.1, capture_radius=0.004) == expected(
            capture_radius=0.004
        )
        assert shown_in_a_trial(client) == expected()  # of the next scene
        assert client.set("capture_detector", max_delay=0.1)[0]
        set_here = ("max_delay",)
        dumped = shown_in_a_trial(client, max_delay=0.2)
        assert dumped == expected(max_delay=0.1)
        assert not client.set("capture_detector", scene_criteria=["radius"])[0]
        node.process.send_signal(signal.SIGINT)
        assert node.status() == 0
        node = start("capture_detector", exit_when_done="false", **dumped)
        node.wait_for("ready")
        assert shown_in_a_trial(client, capture_radius=0.004, max_delay=0.2) == expected(
            capture_radius=0.004, max_delay=0.1
        )
        set_here = ()
        assert client.set("capture_detector", max_delay=math.nan)[0]
        assert shown_in_a_trial(client, max_delay=0.2) == expected(max_delay=0.2)


# benches without simulator


def test_judging_a_bag_without_sensors_gives_the_recorded_judgements(tmp_path):
    result = simulate(load_scene("paper_undamped"))
    again = detect_again(read_run(write_run(result, tmp_path / "run.mcap")))
    assert len(again) == len(result.statuses)
    for a, b in zip(again, result.statuses, strict=True):
        assert (a.t, a.state, a.final, a.reason) == (b.t, b.state, b.final, b.reason)
        assert a.distance == pytest.approx(b.distance, rel=1e-12)


class Bench(BenchNode):
    """Stands in for the simulator: sends what cameras and encoders of a bench would."""

    def __init__(self):
        join_dds()
        super().__init__("real_bench")
        self.open((RUN_INFO, CHASER_POSE, TARGET_POSE, BUFFER_STATE, STREAM_COUNTS))

    def run(self, scene, measurements, readers):
        publishers = [SIMULATOR, CAPTURE_DETECTOR]
        # the detector then waits for its own reader
        run = RunDescription.of(scene, "on the bench", publishers, consumers=["recorder"])
        ours = (CHASER_POSE, TARGET_POSE, BUFFER_STATE, STREAM_COUNTS)
        wait_until(lambda: all(self.matched(topic) >= readers for topic in ours))
        self.send(RUN_INFO, self.messages.serialise(self.messages.run_info(run)))
        assert self.drain(20.0)
        counts = {RUN_INFO.name: 1, **self.measure(measurements)}
        assert self.drain(20.0)
        ended = self.messages.stream_counts(SIMULATOR, run.run_id, counts)
        self.send(STREAM_COUNTS, self.messages.serialise(ended))
        assert self.drain(20.0)

    def measure(self, measurements):
        """Send measurements; return how many by topic."""
        counts = {}
        for source, t, values in measurements:
            if source is Source.BUFFER:
                topic = BUFFER_STATE
                message = self.messages.new(
                    BUFFER_STATE.type_name,
                    header=self.messages.header(t, ""),
                    seq=counts.get(topic.name, 0),
                    axial_stroke=values[0],
                    torsion=values[1],
                )
            else:
                topic = CHASER_POSE if source is Source.CHASER else TARGET_POSE
                message = self.messages.new(
                    topic.type_name,
                    header=self.messages.header(t, "world"),
                    **{
                        "pose.position.x": values[0],
                        "pose.position.y": values[1],
                        "pose.orientation.z": math.sin(values[2] / 2.0),
                        "pose.orientation.w": math.cos(values[2] / 2.0),
                    },
                )
            self.send(topic, self.messages.serialise(message))
            counts[topic.name] = counts.get(topic.name, 0) + 1
        return counts


# as on a busy machine: a node is seen before its callbacks run
LATE = """
    import time
    from capture_sim.nodes import process as base
    begin = base._Spinner.__init__
    def late(self, node):
        time.sleep(2.0)
        begin(self, node)
    base._Spinner.__init__ = late
"""


def test_detector_and_recorder_serve_a_bench_without_simulator(start, tmp_path):
    name = "tilt_m10"
    scene = load_scene(name, SENSED)
    measured = list(disturbed(simulate(load_scene(name)), Disturbance(), np.random.default_rng(9)))
    nodes = [
        start("capture_detector", LATE, drain_timeout=20.0),
        start("recorder", LATE, out=tmp_path, drain_timeout=20.0),
    ]
    bench = Bench()
    bench.run(scene, measured, 2)
    bench.destroy_node()
    assert nodes[0].status() == 0, nodes[0].text
    assert nodes[1].status() == 0, nodes[1].text
    run = read_run(tmp_path / f"{name}.mcap")
    offline, _ = judge(scene, iter(measured))
    again = detect_again(run)[-1]
    live = run.statuses[-1]
    assert offline.final
    assert offline.state.label == simulate(load_scene(name)).verdict
    for other in (live, again):
        assert (other.state, other.reason.split(" from ")[0]) == (
            offline.state,
            offline.reason.split(" from ")[0],
        )
        # topics may overtake each other: an instant is then judged from other neighbours
        decided = other.t - other.time_in_state
        assert decided == pytest.approx(offline.t - offline.time_in_state, abs=0.1)


def test_changes_of_state_are_kept_for_a_busy_subscriber():
    """A publisher keeps the last for latecomers; who was there in time gets all of them."""
    join_dds()
    sender, reader = BenchNode("sender"), BenchNode("reader")
    sender.open((CAPTURE_VERDICT,))
    came = []
    reader.listen(CAPTURE_VERDICT, lambda status: came.append(status.state))

    def send(state):
        message = sender.messages.new(CAPTURE_VERDICT.type_name, state=state)
        sender.send(CAPTURE_VERDICT, sender.messages.serialise(message))

    def take(count):
        deadline = time.monotonic() + PATIENCE
        while len(came) < count and time.monotonic() < deadline:
            rclpy.spin_once(reader, timeout_sec=0.1)

    send(0)
    take(1)
    for state in (1, 2, 3):
        send(state)
    take(4)
    assert came == [0, 1, 2, 3]
    sender.destroy_node()
    reader.destroy_node()


def test_poses_alone_are_judged_by_a_scene_given_at_the_start(start):
    """As on a bench where cameras run and nobody announces anything."""
    name = "paper_undamped"
    measured = list(disturbed(simulate(load_scene(name)), Disturbance(), np.random.default_rng(4)))
    node = start("capture_detector", scene=name, overrides="['sensors.motion_capture={}']")
    node.wait_for("evaluated by paper_undamped")
    bench = Bench()
    statuses = []
    bench.listen(CAPTURE_STATUS, statuses.append)
    deadline = time.monotonic() + PATIENCE
    while any(bench.matched(t) < 1 for t in (CHASER_POSE, TARGET_POSE, BUFFER_STATE)):
        assert time.monotonic() < deadline
        rclpy.spin_once(bench, timeout_sec=0.05)
    bench.measure(measured)
    while not (statuses and statuses[-1].final):
        assert time.monotonic() < deadline
        rclpy.spin_once(bench, timeout_sec=0.05)
    bench.destroy_node()
    verdicts = [status for status in statuses if status.final]
    assert verdicts[-1].state == CaptureState.REBOUND
    assert verdicts[-1].reason.startswith("retreated 20 mm from ")
    node.process.send_signal(signal.SIGINT)
    assert node.status() == 0
    assert "Traceback" not in node.text


def test_played_as_any_bag_the_run_of_a_suite_is_judged_from_its_start(tmp_path, start):
    """Nobody waits for the detector, nor reads it, though the announcement names who did once."""
    path = write_run(simulate(load_scene("tilt_0")), tmp_path / "tilt_0.mcap")
    store, folder = typestore(), tmp_path / "bag"
    sent = {topic.absolute_name for topic in topics_of(SIMULATOR)}
    with (
        AnyReader([path], default_typestore=store) as reader,
        Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        copies = {
            c.id: writer.add_connection(
                c.topic,
                c.msgtype,
                typestore=store,
                offered_qos_profiles=c.ext.offered_qos_profiles,
            )
            for c in reader.connections
            if c.topic in sent
        }
        for c, when, data in reader.messages():
            if c.id in copies:
                if c.msgtype == RUN_INFO.type_name:
                    message = store.deserialize_cdr(data, c.msgtype)
                    message.consumers = ["recorder", "capture_detector", "launcher"]
                    data = store.serialize_cdr(message, c.msgtype)
                writer.write(copies[c.id], when, data)
    patience = "from capture_sim.nodes import participant\nparticipant.MATCHING_TIMEOUT = 2.0"
    detector = start("capture_detector", patience)
    detector.wait_for("ready")
    player = start("player", bag=folder, rtf=4.0)
    assert player.status() == 0, player.text
    assert detector.status() == 0, detector.text
    assert "tilt_0: captured" in detector.text
