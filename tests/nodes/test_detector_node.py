"""The capture detector's node: its parameters, and poses that no simulator sent."""

import math
import time
from dataclasses import fields, replace

import numpy as np
import pytest
from noisy_replay import Disturbance, disturbed
from rcl_interfaces.srv import DescribeParameters, GetParameters
from rclpy.parameter import parameter_value_to_python

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.detection.criteria import CaptureState
from capture_sim.detection.measurements import Source
from capture_sim.messages.convert import Messages, RunDescription
from capture_sim.messages.topics import (
    BUFFER_STATE,
    CAPTURE_CRITERIA,
    CAPTURE_DETECTOR,
    CAPTURE_STATUS,
    CAPTURE_VERDICT,
    CHASER_POSE,
    ROLL,
    RUN_INFO,
    SIMULATOR,
    TARGET_POSE,
    RunSource,
    topics_of,
)
from capture_sim.nodes.base.endpoints import message_class
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.protocol.roll import FREE, READY
from capture_sim.recording.bag import read_bag
from capture_sim.recording.live import LiveRecorder
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run, run_of
from capture_sim.run.run import detect
from capture_sim.scene.parts import Detector
from tests.nodes.bench_client import LONGEST, Client, wait_until
from tests.nodes.own_domain import participant

#: The contact comes after 1.4 s, in place of 4.
QUICK = "[string.impact_speed=0.3, run.t_end=2.5]"


@pytest.fixture
def make_bench(_domain):
    """Make nodes that send what cameras and encoders of a bench would."""
    nodes = []

    def make(name, topics=()):
        nodes.append(BenchNode(name, context=participant()))
        nodes[-1].open(topics)
        return nodes[-1]

    yield make
    for node in nodes:
        node.close()


# parameters


def test_criteria_are_described_set_and_recorded(start, tmp_path, capfd):
    """One that is set stays; one that is not is the scene's, and reads as nan."""
    names = [field.name for field in fields(Detector)]
    detector = start("capture_detector", min_dwell=0.3)
    nodes = [detector, start("launcher"), start("recorder", out=tmp_path)]
    with Client() as client:

        def ask(kind, verb):
            return client.ask(kind, f"/capture_detector/{verb}_parameters", names=names)

        def shown():
            values = map(parameter_value_to_python, ask(GetParameters, "get").values)
            known = zip(names, values, strict=True)
            return {name: value for name, value in known if not math.isnan(value)}

        by_name = {d.name: d for d in ask(DescribeParameters, "describe").descriptors}
        for field in fields(Detector):
            descriptor = by_name[field.name]
            assert descriptor.description.startswith(f"{field.metadata['unit']}, ")
            assert field.metadata["doc"] in descriptor.description
            allowed = f"{field.metadata['allowed']} {field.metadata['unit']}"
            assert descriptor.additional_constraints.endswith(f"decimal point, {allowed}")
        assert shown() == {"min_dwell": 0.3}
        for name, value in (("min_retreat", 0.03), ("max_delay", 0.1), ("max_delay", math.nan)):
            assert client.set("capture_detector", **{name: value})[0]
        assert shown() == {"min_dwell": 0.3, "min_retreat": 0.03}
        wait_for = "[launcher, capture_detector, recorder]"
        nodes.append(start("simulator", rtf=0.001, wait_for=wait_for, overrides=QUICK))
        nodes[-1].wait_for("released")
        # right, but of no effect on the run that is on
        assert client.set("capture_detector", capture_radius=1e-6)[0]
        assert client.set("simulator", rtf=0.0)[0]
    assert nodes.pop().status() == 0
    assert [node.end() for node in nodes] == [0, 0, 0]
    said = detector.text
    assert "evaluated by min_dwell = 0.3 s, min_retreat = 0.03 m; else by the scene" in said
    assert "captured, within 5 mm of BE for 0.3 s" in said
    path = tmp_path / "tilt_0.mcap"
    run = read_bag(path)
    assert run.problems == ()
    assert run.criteria == replace(run.scene.detector, min_dwell=0.3, min_retreat=0.03)
    assert detect(run_of(run), from_series=True) == list(run.statuses)
    assert main(["detect", str(path)]) == 0
    said = capfd.readouterr().out
    assert "recorded criterion: min_dwell = 0.3 s (scene: 0.2 s)" in said
    assert "; the same" in said
    # a change stands over what was recorded, and over nothing else
    assert main(["detect", str(path), "--set", "detector.min_dwell=0.2"]) == 0
    said = capfd.readouterr().out
    assert "within 5 mm of BE for 0.2 s" in said
    assert "recorded criterion: min_retreat = 0.03 m" in said
    # an older recording does not hold them
    (info,) = run.raw(RUN_INFO)
    older = LiveRecorder(tmp_path / "older", info)
    for topic in (*topics_of(SIMULATOR), *topics_of(CAPTURE_DETECTOR)):
        for data in run.raw(topic) if topic not in (RUN_INFO, CAPTURE_CRITERIA) else ():
            older.take(topic, data)
    old = older.close().path
    assert read_bag(old).criteria is None
    assert main(["detect", str(old)]) == 1
    said = capfd.readouterr().out
    assert "DIFFERENT" in said
    assert "contains no criteria" in said


# benches without simulator


def test_a_trial_waits_until_the_detector_has_measurements(start, client, make_bench):
    """Else a chaser is let go whose approach it misses, and there is no verdict."""
    reports = client.listen(ROLL)
    detector = start("capture_detector", "node.SOURCES_TIMEOUT = 0.0", min_dwell=0.3)
    wait_until(lambda: reports)

    def states():
        return {report.state for report in reports}

    scene = load_scene("tilt_0")
    run = RunDescription.of(scene, "a trial", (), source=RunSource.TRIAL, announcer="/launcher#1")
    launcher = make_bench("launcher", [RUN_INFO])
    make = Messages()
    launcher.send(RUN_INFO, make.serialise(make.run_info(run)))
    detector.wait_for("this node joins once there is one")
    # a detector that does not wait for measurements joins before it answers
    client.await_answers_of("/capture_detector")
    assert states() == {FREE}
    rig = make_bench("rig", [CHASER_POSE, TARGET_POSE])
    kind = message_class(CHASER_POSE.type_name)

    def is_ready():
        for topic in (CHASER_POSE, TARGET_POSE):
            message = kind()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
            message.pose.orientation.w = 1.0
            rig.send(topic, message)
        return READY in states()

    wait_until(is_ready)


def test_judging_a_bag_without_sensors_gives_the_recorded_judgements(tmp_path):
    result = simulate(load_scene("paper_undamped"))
    again = detect(read_run(write_run(result, tmp_path / "run.mcap")), from_series=True)
    assert len(again) == len(result.statuses)
    for a, b in zip(again, result.statuses, strict=True):
        assert (a.t, a.state, a.final, a.reason) == (b.t, b.state, b.final, b.reason)
        assert a.distance == pytest.approx(b.distance, rel=1e-12)


def measure(bench, measurements):
    """Send measurements as a bench does."""
    new, count = bench.messages.new, 0
    for source, t, values in measurements:
        if source is Source.BUFFER:
            topic, frame = BUFFER_STATE, ""
            content = {"seq": count, "axial_stroke": values[0], "torsion": values[1]}
            count += 1
        else:
            topic, frame = (CHASER_POSE if source is Source.CHASER else TARGET_POSE), "world"
            content = {"pose.position.x": values[0], "pose.position.y": values[1]}
            content["pose.orientation.z"] = math.sin(values[2] / 2.0)
            content["pose.orientation.w"] = math.cos(values[2] / 2.0)
        header = bench.messages.header(t, frame)
        message = new(topic.type_name, header=header, **content)
        bench.send(topic, bench.messages.serialise(message))


def test_changes_of_state_are_kept_for_a_busy_subscriber(make_bench):
    """A publisher keeps the last for latecomers; who was there in time gets all of them."""
    sender, reader = make_bench("sender", (CAPTURE_VERDICT,)), make_bench("reader")
    came = []
    reader.listen(CAPTURE_VERDICT, lambda status: came.append(status.state))

    def send(state):
        message = sender.messages.new(CAPTURE_VERDICT.type_name, state=state)
        sender.send(CAPTURE_VERDICT, sender.messages.serialise(message))

    send(0)
    assert reader.wait(lambda: came, LONGEST)
    assert sender.wait(lambda: sender.topic_publishers.matched(CAPTURE_VERDICT), LONGEST)
    for state in (1, 2, 3):
        send(state)
    assert reader.wait(lambda: len(came) == 4, LONGEST)
    assert came == [0, 1, 2, 3]


def test_poses_alone_are_judged_by_a_scene_given_at_the_start(start, make_bench):
    """As on a bench where cameras run and nobody announces anything."""
    name = "paper_undamped"
    measured = list(disturbed(simulate(load_scene(name)), Disturbance(), np.random.default_rng(4)))
    node = start("capture_detector", scene=name, overrides="['sensors.motion_capture={}']")
    node.wait_for("evaluated by paper_undamped")
    topics = (CHASER_POSE, TARGET_POSE, BUFFER_STATE)
    bench = make_bench("real_bench", topics)
    statuses = []
    bench.listen(CAPTURE_STATUS, statuses.append)
    assert bench.wait(lambda: all(bench.topic_publishers.matched(t) for t in topics), LONGEST)
    measure(bench, measured)
    assert bench.wait(lambda: statuses and statuses[-1].final, LONGEST)
    assert statuses[-1].state == CaptureState.REBOUND
    assert statuses[-1].reason.startswith("retreated 20 mm from ")
    assert node.end() == 0
