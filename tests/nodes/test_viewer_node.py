"""The live viewer's node: what someone sees who connects while a bench runs."""

from __future__ import annotations

import signal
import time
from contextlib import closing

import numpy as np
import pytest
from rcl_interfaces.srv import ListParameters
from rclpy.duration import Duration
from rclpy.serialization import deserialize_message

import capture_sim
from capture_sim.messages.convert import Messages, RunDescription
from capture_sim.messages.topics import (
    BENCH_EVENT,
    CHASER_ODOMETRY,
    JOINT_STATES,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    TARGET_ODOMETRY,
)
from capture_sim.nodes.base.endpoints import message_class, qos_of
from capture_sim.nodes.base.node import BenchNode
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import write_run
from capture_sim.viewing.shapes import tip_in_cone
from tests.nodes.bench_processes import Client, statuses, wait_until
from tests.nodes.own_domain import participant

pytest.importorskip("rerun", reason="needs rerun")

from ports import free_port
from rrd import column, seen

# what is saved while it comes has no table of contents at its end
pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")


@pytest.fixture(scope="module")
def run():
    return capture_sim.simulate(capture_sim.load_scene("tilt_p10"))


@pytest.fixture
def viewer(start):
    """Start the viewer; return its process and its address."""

    def viewer(**parameters):
        port = free_port()
        node = start("viewer", port=port, **parameters)
        node.wait_for("waiting for a run")
        return node, f"rerun+http://127.0.0.1:{port}/proxy"

    return viewer


def ended(node):
    node.process.send_signal(signal.SIGINT)
    return node.status() == 0 and "Traceback" not in node.text


def test_server_that_does_not_start_is_reported(start):
    dead = """
        from pathlib import Path
        from capture_sim.viewing import rerun_server
        rerun_server.program = lambda: Path("/bin/false")
    """
    node = start("viewer", dead, port=free_port())
    assert node.status() == 2
    assert "the server of rerun on port" in node.text
    assert "has not started: exit status 1" in node.text
    assert "look at the runs with" not in node.text


def test_node_shows_the_suites_run_and_disturbs_nothing(viewer, start, run, tmp_path):
    node, address = viewer()
    wait_for = "[launcher, capture_detector, recorder]"
    nodes = {
        "simulator": start("simulator", scenes="[tilt_p10]", rtf=0.0, wait_for=wait_for),
        "launcher": start("launcher"),
        "capture_detector": start("capture_detector"),
        "recorder": start("recorder", out=tmp_path),
    }
    assert statuses(nodes) == dict.fromkeys(nodes, 0)
    recorded = read_bag(tmp_path / "tilt_p10.mcap")
    assert recorded.complete, recorded.problems
    node.wait_for("tilt_p10: shown\n")

    def check(found):
        times, tip = column(found, "/tilt_p10/close_up/tip", "positions")
        k = np.round(times * 1e-6).astype(int)
        assert np.all(np.diff(k) >= 20), "at most 50 a second"
        assert len(k) > 10  # on a busy machine
        _, energy = column(found, "/plots/energy/tilt_p10", "scalars")
        assert energy[:, 0] == pytest.approx(run.samples["kinetic"][k] * 1e3)
        assert tip == pytest.approx(tip_in_cone(run.samples[k]) * 1e3, abs=1e-4)
        _, peaks = column(found, "/plots/contact_force/tilt_p10/touches", "scalars")
        assert sorted(peaks) == sorted(run.touches["peak_force"])
        _, verdicts = column(found, "/states/tilt_p10/verdict", "state")
        assert verdicts.tolist() == ["approach", "contact", "captured"]

    seen(address, tmp_path / "late.rrd", check)
    assert ended(node)


def test_touches_that_come_after_the_end_of_their_run_are_shown(viewer, run, tmp_path):
    """A viewer that has found the topic of events late: on a busy machine, of a quick run."""
    node, address = viewer()
    events = read_bag(write_run(run, tmp_path / "run.mcap")).raw(BENCH_EVENT.name)
    described = RunDescription.of(run.scene, "a run", [SIMULATOR])
    make, topics = Messages(), (RUN_INFO, STREAM_COUNTS, BENCH_EVENT)
    counts = make.stream_counts(SIMULATOR, described.run_id, {BENCH_EVENT.name: len(events)})
    with closing(BenchNode("bench", context=participant())) as bench:
        bench.open(topics)
        wait_until(lambda: all(bench.topic_publishers.matched(topic) for topic in topics))
        bench.send(RUN_INFO, make.serialise(make.run_info(described)))
        bench.send(STREAM_COUNTS, make.serialise(counts))
        time.sleep(1.0)
        for event in events:
            bench.send(BENCH_EVENT, event)
        node.wait_for("tilt_p10: shown")
    assert "missing" not in node.text

    def check(found):
        _, peaks = column(found, "/plots/contact_force/tilt_p10/touches", "scalars")
        assert sorted(peaks) == sorted(run.touches["peak_force"])

    seen(address, tmp_path / "late.rrd", check)
    assert ended(node)


@pytest.mark.long
def test_node_shows_a_bench_that_announces_no_run(viewer, run, tmp_path):
    path = write_run(run, tmp_path / "bench.mcap")
    node, address = viewer(scene="tilt_0")
    recorded = read_bag(path)
    topics = (JOINT_STATES, CHASER_ODOMETRY, TARGET_ODOMETRY)
    kinds = [message_class(topic.type_name) for topic in topics]
    with Client() as client:
        senders = [
            client.node.create_publisher(kind, topic.name, qos_of(topic))
            for kind, topic in zip(kinds, topics, strict=True)
        ]
        wait_until(lambda: all(sender.get_subscription_count() for sender in senders))
        # nodes tell of their publishers in turn: one that answers a later client knows the others
        client.ask(ListParameters, "/viewer/list_parameters")
        for row in zip(*(recorded.raw(topic.name) for topic in topics), strict=True):
            for sender, kind, data in zip(senders, kinds, row, strict=True):
                sender.publish(deserialize_message(data, kind))
            time.sleep(0.002)
        assert all(sender.wait_for_all_acked(Duration(seconds=30)) for sender in senders)

    def check(found):
        times, tip = column(found, "/bench/close_up/tip", "positions")
        k = np.round(times * 1e-6).astype(int)
        assert len(k) > 100
        assert tip == pytest.approx(tip_in_cone(run.samples[k]) * 1e3, abs=1e-4)

    seen(address, tmp_path / "x.rrd", check)
    assert ended(node)
