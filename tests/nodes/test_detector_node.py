"""The capture detector's node: its parameters, and poses that no simulator sent."""

import math
import signal
import time
from dataclasses import fields, replace

import numpy as np
import pytest
import rclpy
from bench_processes import PATIENCE, Client, join_dds
from noisy_replay import Disturbance, disturbed
from rcl_interfaces.srv import DescribeParameters, GetParameters
from rclpy.parameter import parameter_value_to_python

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.detection.criteria import CaptureState
from capture_sim.detection.measurements import Source
from capture_sim.messages.topics import (
    BUFFER_STATE,
    CAPTURE_CRITERIA,
    CAPTURE_DETECTOR,
    CAPTURE_STATUS,
    CAPTURE_VERDICT,
    CHASER_POSE,
    SIMULATOR,
    TARGET_POSE,
    topics_of,
)
from capture_sim.nodes.node import BenchNode
from capture_sim.recording.bag import read_bag
from capture_sim.recording.live import LiveRecorder
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run, run_of
from capture_sim.run import detect
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
    for node in nodes:
        node.wait_for("ready")
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
            start("simulator", rtf=0.001, wait_for="[launcher, capture_detector, recorder]")
        )
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
    assert read_bag(old).criteria is None
    assert main(["detect", str(old)]) == 1
    said = capsys.readouterr().out
    assert "DIFFERENT" in said
    assert "contains no criteria" in said


def test_a_criterion_is_a_parameter(start):
    """One that is set stays; one that is not is the scene's, and reads as nan."""
    names = [field.name for field in fields(Detector)]
    with Client() as client:
        node = start("capture_detector", min_dwell=0.3)

        def shown():
            answer = client.ask(GetParameters, "/capture_detector/get_parameters", names=names)
            values = map(parameter_value_to_python, answer.values)
            known = zip(names, values, strict=True)
            return {name: value for name, value in known if not math.isnan(value)}

        assert shown() == {"min_dwell": 0.3}
        assert client.set("capture_detector", max_delay=0.1)[0]
        assert shown() == {"min_dwell": 0.3, "max_delay": 0.1}
        assert client.set("capture_detector", min_dwell=math.nan)[0]
        assert shown() == {"max_delay": 0.1}
        node.process.send_signal(signal.SIGINT)
        assert node.status() == 0


# benches without simulator


def test_judging_a_bag_without_sensors_gives_the_recorded_judgements(tmp_path):
    result = simulate(load_scene("paper_undamped"))
    again = detect(read_run(write_run(result, tmp_path / "run.mcap")), from_series=True)
    assert len(again) == len(result.statuses)
    for a, b in zip(again, result.statuses, strict=True):
        assert (a.t, a.state, a.final, a.reason) == (b.t, b.state, b.final, b.reason)
        assert a.distance == pytest.approx(b.distance, rel=1e-12)


class Bench(BenchNode):
    """Stands in for the simulator: sends what cameras and encoders of a bench would."""

    def __init__(self):
        join_dds()
        super().__init__("real_bench")
        self.open((CHASER_POSE, TARGET_POSE, BUFFER_STATE))

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
    topics = (CHASER_POSE, TARGET_POSE, BUFFER_STATE)
    assert bench.wait(lambda: all(bench.outbox.matched(t) for t in topics), PATIENCE)
    bench.measure(measured)
    assert bench.wait(lambda: statuses and statuses[-1].final, PATIENCE)
    bench.close()
    verdicts = [status for status in statuses if status.final]
    assert verdicts[-1].state == CaptureState.REBOUND
    assert verdicts[-1].reason.startswith("retreated 20 mm from ")
    node.process.send_signal(signal.SIGINT)
    assert node.status() == 0
    assert "Traceback" not in node.text
