"""/tf: its message is there after `make run`, and the frames are those of the run."""

import pytest
from std_msgs.msg import String

from capture_sim import load_scene, simulate
from capture_sim.messages.topics import BENCH_STATE
from capture_sim.messages.urdf import urdf
from capture_sim.nodes.base.endpoints import TRANSIENT_LOCAL
from capture_sim.recording.offline import write_run
from tests.nodes.bench_client import wait_until
from tf2_msgs.msg import TFMessage


def test_frames_of_a_run(start, client):
    moving, static = [], []
    client.node.create_subscription(TFMessage, "tf", moving.append, 1000)
    client.node.create_subscription(TFMessage, "tf_static", static.append, TRANSIENT_LOCAL)
    client.listen(BENCH_STATE)  # frames are waited for by no run
    options = {"overrides": "[run.t_end=1]", "wait_for": "[experimenter]"}
    simulator = start("simulator", rtf=1.0, **options)
    assert simulator.status() == 0
    final = simulate(load_scene("tilt_0", ["run.t_end=1"])).samples[-1]
    wait_until(lambda: moving and moving[-1].transforms[0].header.stamp.sec == 2)
    stamps = [message.transforms[0].header.stamp for message in moving]
    assert static
    parts = {t.child_frame_id: t for t in moving[-1].transforms}
    assert parts["chaser/base_link"].header.frame_id == "world"
    where = parts["chaser/base_link"].transform.translation
    assert (where.x, where.y) == pytest.approx(tuple(final["q"][:2]), abs=1e-12)
    assert [(s.sec, s.nanosec) for s in stamps] == sorted((s.sec, s.nanosec) for s in stamps)


def test_frames_of_a_recording(start, client, tmp_path):
    """Who comes late gets the shape and the constant frames; the others move as recorded."""
    scene = load_scene("tilt_0", ["run.t_end=2"])
    path = write_run(simulate(scene), tmp_path / "run.mcap")
    moving, static, shapes = [], [], []
    client.node.create_subscription(TFMessage, "tf", moving.append, 1000)
    start("player", bag=str(path), rtf=1.0)
    wait_until(lambda: moving)
    client.node.create_subscription(TFMessage, "tf_static", static.append, TRANSIENT_LOCAL)
    client.node.create_subscription(String, "robot_description", shapes.append, TRANSIENT_LOCAL)
    wait_until(lambda: static and shapes)
    assert {t.child_frame_id for t in static[0].transforms} == {"chaser/tip", "target/cone"}
    assert shapes[0].data == urdf(scene)
    frames = {"chaser/base_link", "chaser/cylinder", "chaser/probe", "target/base_link"}
    wait_until(lambda: {m.transforms[0].child_frame_id for m in moving} == frames)
