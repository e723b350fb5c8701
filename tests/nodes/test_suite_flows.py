"""Runs of the whole suite over real DDS."""

import re

import numpy as np
import pytest
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from recorded import counts_of, values_of

from capture_sim import load_scene, simulate
from capture_sim.detection.criteria import CaptureState
from capture_sim.launcher.state_machine import LauncherPhase
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.definitions import decoded
from capture_sim.messages.topics import (
    BENCH_STATE,
    CAPTURE_STATUS,
    CAPTURE_VERDICT,
    HOLD,
    LAUNCHER_PHASE,
    LAUNCHER_STATE,
    RUN_INFO,
    TARGET_ODOMETRY,
)
from capture_sim.nodes.base.endpoints import TRANSIENT_LOCAL, message_class, qos_of
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import PUBLISHERS, run_stream, write_run
from capture_sim.recording.read import run_of
from capture_sim.run.loads import loads_of
from capture_sim.run.run import detect
from capture_sim.scene.loading import load_scene_text
from tests.nodes.bench_client import Client, statuses, wait_until
from tests.nodes.bench_processes import processes
from tests.nodes.forked import Forked
from tests.nodes.own_domain import own_domain

SENSED = "tilt_m10"
WAIT_FOR = "[launcher, capture_detector, recorder]"
SHORT = "[run.t_end=1.0]"
# These carry the run's id, or values computed from odometry instead of the state.
OF_THE_RUN = {"bench/run_info", "launcher/command", "capture/criteria", "bench/stream_counts"}
DETECTED = {"capture/status", "capture/verdict"}
KEEP_ALL = QoSProfile(
    history=HistoryPolicy.KEEP_ALL, depth=1, reliability=ReliabilityPolicy.RELIABLE
)


@pytest.fixture
def start_all(start, tmp_path):
    """Start the whole suite; parameters go to the simulator."""

    def start_all(change=None, launcher=None, **simulator):
        parameters = {"rtf": 0.0, "wait_for": WAIT_FOR, **simulator}
        return {
            "launcher": start("launcher", **(launcher or {})),
            "capture_detector": start("capture_detector"),
            "recorder": start("recorder", out=tmp_path),
            "simulator": start("simulator", change, **parameters),
        }

    return start_all


@pytest.fixture(scope="module")
def scenes():
    # one with its contact at the integrator's own steps, one with sensors
    sensors = ["motion_capture={}", "motion_capture.rate=200", "load_cell={}", "seed=3"]
    return {
        "tilt_0": load_scene("tilt_0"),
        "tilt_p10": load_scene("tilt_p10", ["run.trace=true"]),
        SENSED: load_scene(SENSED, [f"sensors.{change}" for change in sensors]),
    }


@pytest.fixture(scope="module")
def folder(scenes, tmp_path_factory):
    """Recordings of a suite; in ``lab`` those of another one in a namespace, at the same time."""
    out = tmp_path_factory.mktemp("suite")
    for name, scene in scenes.items():
        (out / f"{name}.yaml").write_text(scene.to_yaml(), encoding="utf-8")
    paths = ", ".join(str(out / f"{name}.yaml") for name in scenes)
    with own_domain(), processes(Forked) as start:

        def start_suite(where, launcher, **simulator):
            common = {"__ns": f"/{where}"} if where else {}
            return {
                "launcher": start("launcher", **common, **launcher),
                "recorder": start("recorder", out=out / where, **common),
                "simulator": start("simulator", rtf=0.0, wait_for=WAIT_FOR, **simulator, **common),
                "capture_detector": start("capture_detector", **common),
            }

        lab = start_suite("lab", {"__node": "my_launcher"}, overrides=SHORT)
        suite = start_suite("", {}, scenes=f"[{paths}]")
        assert statuses(lab) == dict.fromkeys(lab, 0)
        assert statuses(suite) == dict.fromkeys(suite, 0)
    return out


@pytest.fixture(scope="module")
def suite(folder, scenes):
    return {name: read_bag(folder / f"{name}.mcap") for name in scenes}


def same_bits(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


# a suite compared with a call


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", SENSED])
def test_suite_and_call_agree_bit_for_bit(name, suite, scenes, tmp_path):
    live, offline = suite[name], simulate(scenes[name])
    assert live.problems == ()
    assert same_bits(live.samples, offline.samples)
    for field in set(live.touches.dtype.names) - {"rate_ratio"}:  # no message has that
        assert same_bits(live.touches[field], offline.touches[field])
    assert loads_of(live.extremes, live.touches) == loads_of(offline.extremes, offline.touches)
    for a, b in zip(live.events, offline.events, strict=True):
        assert (a.kind, a.t, a.wall, a.detail) == (b.kind, b.t, b.wall, b.detail)
        assert same_bits(np.asarray(a.q), np.asarray(b.q))
    written = read_bag(write_run(offline, tmp_path / "offline.mcap"))
    assert counts_of(live) == counts_of(written)
    for topic in {key.lstrip("/") for key in live.topics} - OF_THE_RUN - DETECTED:
        assert values_of(live, topic) == values_of(written, topic), topic
    for a, b in zip(live.statuses, offline.statuses, strict=True):
        # times are the stamps' own; numbers differ by the round-off of a quaternion
        assert (a.t, a.state, a.final, a.reason) == (b.t, b.state, b.final, b.reason)
        assert a._replace(not_used="") == pytest.approx(b._replace(not_used=""), abs=1e-12)
        assert b.not_used.startswith(a.not_used)  # no message has the number of all
    if name == SENSED:
        again = detect(run_of(live), from_series=True)
        assert [s._replace(not_used="") for s in again] == [
            s._replace(not_used="") for s in live.statuses
        ]
    # the contact's trace is sent only where it is asked for
    assert (live.topics["/bench/contact_trace"] > 100) is (name == "tilt_p10")
    states = live.columns("launcher/state")
    assert states["state"][:2].tolist() == [LauncherPhase.ARMED, LauncherPhase.RELEASED]
    assert states["state"][-1] == LauncherPhase.DELIVERED
    assert states["measured_speed"][-1] == pytest.approx(0.1, rel=0.01)


def test_two_suites_in_one_domain_do_not_mix(suite, folder, tmp_path):
    run = read_bag(folder / "lab" / "tilt_0.mcap")
    assert run.problems == ()
    assert run.run_id != suite["tilt_0"].run_id
    alone = simulate(load_scene("tilt_0", [SHORT[1:-1]]))
    written = read_bag(write_run(alone, tmp_path / "alone.mcap"))
    assert counts_of(run) == counts_of(written)
    for topic in {key.lstrip("/") for key in run.topics} - OF_THE_RUN - DETECTED:
        assert values_of(run, topic) == values_of(written, topic), topic


def test_nodes_and_offline_run_launch_alike(start):
    """S6: a target that moves away: `bench` aborted at 1.83 s what `run` let rebound."""
    changes = ["initial.target.x=0.6", "initial.target.vx=0.05", "run.t_end=4"]
    scene = load_scene("paper_designed", changes)
    description = RunDescription.of(scene, "x", PUBLISHERS)
    offline = [
        decoded(LAUNCHER_PHASE, sent.data)
        for sent in run_stream(simulate(scene), description)
        if sent.topic is LAUNCHER_PHASE
    ]
    with Client() as client:
        phases = client.listen(LAUNCHER_PHASE, qos=qos_of(LAUNCHER_PHASE, transient_local=False))
        launcher = start("launcher")
        client.await_answers_of("/launcher")
        overrides = f"[{', '.join(changes)}]"
        options = {"scenes": "[paper_designed]", "overrides": overrides}
        simulator = start("simulator", rtf=0.0, wait_for="[launcher]", **options)
        assert simulator.status() == 0, simulator.text
        wait_until(lambda: phases and phases[-1].seq == len(offline) - 1)
        assert launcher.end() == 0
    assert LauncherPhase(phases[-1].state) is LauncherPhase.DELIVERED
    for live in phases:
        expected = offline[live.seq]  # one may have been replaced by the next on its way
        assert (live.state, live.reason) == (expected.state, expected.reason)
        assert live.measured_speed == expected.measured_speed
        assert live.header.stamp.nanosec == expected.header.stamp.nanosec


# who takes part


def test_two_recorders_of_one_name_record_the_same(start_all, start, tmp_path):
    second = start("recorder", out=tmp_path / "second")
    nodes = start_all(overrides=SHORT, wait_for=WAIT_FOR.replace("recorder", "recorder, recorder"))
    assert statuses(nodes) == dict.fromkeys(nodes, 0)
    assert second.end() == 0
    one, other = (read_bag(f / "tilt_0.mcap") for f in (tmp_path, tmp_path / "second"))
    assert one.problems == other.problems == ()
    assert counts_of(one) == counts_of(other)


@pytest.mark.parametrize("name", ["my_detector", "/lab/my_detector"])
def test_nothing_of_an_unpaced_run_passes_a_plain_node_that_is_waited_for(name, start):
    """It has the name that the simulator waits for, and starts after it."""
    soon = "from capture_sim.nodes.protocol import announcer; announcer._REPORT_PERIOD = 0.1"
    simulator = start("simulator", soon, rtf=0.0, wait_for=f"[{name}]", overrides=SHORT)
    simulator.wait_for(f"waiting for {name} to start")
    with Client("my_detector", namespace="/lab") as client:
        received = {}
        for topic in (BENCH_STATE, TARGET_ODOMETRY):
            received[topic] = messages = []
            client.subscribe(topic.type_name, topic.absolute_name, messages.append, KEEP_ALL)
        assert simulator.status() == 0, simulator.text
        wait_until(lambda: len(received[BENCH_STATE]) == 1001)
        wait_until(lambda: len(received[TARGET_ODOMETRY]) == 101)
    assert [m.seq for m in received[BENCH_STATE]] == list(range(1001))


def test_node_that_does_not_come_is_named(start):
    simulator = start("simulator", wait_for="[nobody]", start_timeout=1.0)
    assert simulator.status() == 1
    assert "waiting for nobody to start: timed out after 1 s" in simulator.text


def test_of_two_simulators_on_the_same_topics_the_older_one_runs(start):
    both = [start("simulator", rtf=0.1) for _ in range(2)]  # at the same time, of the same name
    wait_until(lambda: not all(simulator.is_alive for simulator in both))
    older, younger = sorted(both, key=lambda simulator: not simulator.is_alive)
    assert younger.status() == 1
    older.wait_for("released")
    later = start("simulator", rtf=0.1, __node="later")
    assert later.status() == 1
    assert "another simulator, /simulator, publishes /bench/state: use another" in later.text
    assert older.end() == 0
    assert "another simulator" not in older.text


def test_another_announcer_is_named_once_and_takes_nothing_away(start, tmp_path):
    """A run elsewhere in the domain is announced a dozen times while one is on."""
    recorder = start("recorder", out=tmp_path)
    kind = message_class(RUN_INFO.type_name)
    with Client() as client:
        announced = client.listen(RUN_INFO, lambda info: info.run_id)
        simulator = start("simulator", rtf=0.01, wait_for="[recorder]", overrides=SHORT)
        simulator.wait_for("released")
        wait_until(lambda: announced, "the run was not announced")
        publisher = client.node.create_publisher(kind, RUN_INFO.name, qos_of(RUN_INFO))
        wait_until(lambda: publisher.get_subscription_count() >= 2, "the recorder was not found")
        info = announced[0]
        info.announcer = "/elsewhere/player#1"
        for k in range(12):
            info.run_id, info.source = f"{k:032x}", ("simulation", "replay")[k % 2]
            publisher.publish(info)
            recorder.wait_for("/elsewhere/player announces tilt_0 (simulation): ignored")
        assert client.set("simulator", rtf=0.0)[0]
    assert simulator.status() == 0
    assert recorder.end() == 0
    assert recorder.text.count("/elsewhere/player") == 1
    assert read_bag(tmp_path / "tilt_0.mcap").problems == ()
    assert [path.name for path in tmp_path.glob("*.mcap")] == ["tilt_0.mcap"]


def test_run_waits_for_its_release_and_a_latecomer_gets_how_it_ended(start_all):
    nodes = start_all(
        launcher={"auto_release": "false"},
        exit_when_done="false",
        overrides="[string.impact_speed=0.3, run.t_end=3]",
    )
    nodes["simulator"].wait_for("waiting for the release")
    with Client() as client:
        assert client.set("launcher", auto_release=True) == (True, "")
        nodes["simulator"].wait_for("all runs finished")
        topics = CAPTURE_VERDICT, LAUNCHER_PHASE, RUN_INFO
        verdicts, phases, infos = (client.listen(topic) for topic in topics)
        wait_until(lambda: verdicts and phases and infos)
        client.await_answers_of("/simulator")  # nothing else was on its way
        assert [(m.state, m.final) for m in verdicts] == [(CaptureState.CAPTURED, True)]
        assert [m.state for m in phases] == [LauncherPhase.DELIVERED]
        # no run is on any more, and its scene is still there
        assert [(m.run_id, m.name) for m in infos] == [("", "tilt_0")]
        assert load_scene_text(infos[0].scene).name == "tilt_0"
    assert {name: node.end() for name, node in nodes.items()} == dict.fromkeys(nodes, 0)


def test_streams_are_echoed_without_a_warning(start_all):
    """As `ros2 topic echo` does: by the QoS that is offered."""
    nodes = start_all(rtf=0.2, exit_when_done="false")
    with Client() as client:
        nodes["simulator"].wait_for("released")
        warnings, echoed = [], []
        for topic in (CAPTURE_STATUS, LAUNCHER_STATE, LAUNCHER_PHASE):
            name = topic.absolute_name
            wait_until(lambda name=name: client.node.count_publishers(name))
            (offered,) = client.node.get_publishers_info_by_topic(name)
            qos = QoSProfile(
                depth=10,
                reliability=ReliabilityPolicy.RELIABLE,
                durability=offered.qos_profile.durability,
            )
            echoed.append(messages := [])
            watch = SubscriptionEventCallbacks(incompatible_qos=warnings.append)
            client.subscribe(topic.type_name, name, messages.append, qos, event_callbacks=watch)
        wait_until(lambda: all(echoed))
        assert not warnings


# losses

LEAKY = """
left = {"bench/state": 234, "target/odom": 56}
send = node.SimulatorNode.send
def leak(self, topic, message):
    if topic.name in left:
        left[topic.name] -= 1
        if left[topic.name] == -1:
            return True
    return send(self, topic, message)
node.SimulatorNode.send = leak
"""


def test_dropped_messages_are_named(start_all):
    """The simulator counts a message and does not send it: all that need it must notice."""
    nodes = start_all(LEAKY, overrides=SHORT)
    found = statuses(nodes)
    assert found == {"simulator": 0, "launcher": 0, "capture_detector": 1, "recorder": 1}
    text = nodes["recorder"].text
    assert re.search(r"bench/state: 1 messages? missing \(seq 234\)", text), text
    assert re.search(r"target/odom: 1 messages? missing", text), text
    text = nodes["capture_detector"].text
    assert "ended with messages missing: target/odom: 1 messages missing" in text


SLOW = """
import time
from capture_sim.launcher.state_machine import Launcher
observe = Launcher.observe
Launcher.observe = lambda *arguments: (time.sleep(5e-4), observe(*arguments))[1]
"""


@pytest.mark.long
def test_every_topic_with_every_sample_loses_nothing_with_a_slow_reader(start_all, tmp_path):
    nodes = start_all(launcher={"change": SLOW}, overrides="[run.rate=1000, run.t_end=1.2]")
    assert statuses(nodes) == dict.fromkeys(nodes, 0)
    run = read_bag(tmp_path / "tilt_0.mcap")
    assert run.complete
    assert run.topics["/joint_states"] == run.topics["/bench/state"] == 1201


@pytest.mark.long
def test_reader_that_stalls_is_dropped_by_name_and_costs_the_others_nothing(start_all, tmp_path):
    """A plain node subscribes with KEEP_ALL and never reads: the run has more than DDS keeps."""
    with Client("asleep") as client:
        client.stop()
        kind = message_class(BENCH_STATE.type_name)
        client.node.create_subscription(kind, "bench/state", print, KEEP_ALL)
        nodes = start_all(
            reader_timeout=5.0, overrides="[run.state_rate=20000, run.t_end=0.6, run.rate=100]"
        )
        assert statuses(nodes) == dict.fromkeys(nodes, 0)
    assert "/asleep: no message read from bench/state for 5 s" in nodes["simulator"].text
    assert read_bag(tmp_path / "tilt_0.mcap").complete


# the launch


#: The bench differs from its plan: the mass that was fitted is heavier by half.
HEAVIER = """
from capture_sim.nodes.simulation import simulated_runs
plan_of = simulated_runs._plan
def plan(scene, armed):
    planned = plan_of(scene, armed)
    return planned._replace(hanging_mass=1.5 * planned.hanging_mass)
simulated_runs._plan = plan
"""
GOES_ON = """
from capture_sim.nodes.simulation.control import SimulationControl
SimulationControl.abort = lambda *arguments: None
"""


def test_launcher_aborts_a_launch_that_goes_wrong(start):
    launcher = start("launcher")
    simulator = start("simulator", HEAVIER, wait_for="[launcher]", rtf=1.0)
    assert simulator.status() == 1
    assert "aborted by the launcher" in simulator.text
    assert launcher.end() == 1
    assert re.search(r"aborted: speed 0\.\d+ m/s after 0\.\d+ m: must be", launcher.text)


def test_an_abort_is_reported_once(start):
    """S12: also where the bench goes on, and each further sample differs from the plan."""
    launcher = start("launcher", speed_tolerance=0.01)
    changes = "[string.impact_speed=0.3, run.t_end=3]"
    change = HEAVIER + GOES_ON
    simulator = start("simulator", change, wait_for="[launcher]", rtf=0.0, overrides=changes)
    assert simulator.status() == 0, simulator.text
    launcher.end()
    assert launcher.text.count("aborted: speed") == 1


def test_launcher_with_an_actuator_follows_no_simulator(start):
    """S1: only a trial moves hardware; what a simulator or player announces releases nothing."""
    with Client() as client:
        launcher = start("launcher", actuator="output", scene="tilt_0")
        holds = []
        client.subscribe("std_msgs/msg/Bool", HOLD, holds.append, TRANSIENT_LOCAL)
        wait_until(lambda: holds)
        assert start("simulator", rtf=0.0, overrides=SHORT).status() == 0
        launcher.wait_for("announces tilt_0 (simulation): ignored")
        assert launcher.end() == 0
        assert {message.data for message in holds} == {True}


# errors in a node


def test_node_whose_callback_fails_ends_with_a_line(start):
    fails = """
    freeze = node.LauncherNode.freeze_objects
    def begin(self):
        freeze(self)
        self.every(0.01, lambda: 1 / 0)
    node.LauncherNode.freeze_objects = begin
    """
    node = start("launcher", fails)
    assert node.status() == 1
    assert "stopped by ZeroDivisionError: division by zero" in node.text


def test_unknown_parameter_is_named(start):
    node = start("launcher", auto_relase="true")
    node.wait_for("auto_relase is unknown here and has no effect; did you mean auto_release?")
    assert node.end() == 0


def test_unusable_messages_of_a_publisher_give_one_line(start):
    with Client() as client:
        node = start("launcher")
        kind = message_class(RUN_INFO.type_name)
        publisher = client.node.create_publisher(kind, RUN_INFO.name, qos_of(RUN_INFO))
        wait_until(lambda: publisher.get_subscription_count() > 0)
        client.await_answers_of("/launcher")  # it knows the publisher, too
        for number in range(3):  # one after another, as the reader keeps only the last message
            publisher.publish(kind(run_id=f"{number}", scene="no scene"))
            client.await_answers_of("/launcher")
        node.wait_for("bench/run_info: rejected")
        assert node.end() == 0
    assert any("bench/run_info: 3 messages rejected" in line for line in node.lines)
    assert len([line for line in node.lines if "bench/run_info: rejected" in line]) == 1


def test_a_second_detector_is_named_by_both_and_refuses_the_run(start):
    """A run with two was INCOMPLETE, 'repeated or disordered', and no line named the second."""
    first = start("capture_detector")
    second = start("capture_detector", __node="second")
    first.wait_for("/second is a capture_detector, as this node is")
    second.wait_for("/capture_detector is a capture_detector, as this node is")
    simulator = start("simulator", rtf=0.0, exit_when_done=True, overrides=SHORT)
    assert simulator.status() == 1
    assert "/capture_detector and /second are capture_detector both" in simulator.text
    assert not any("tilt_0" in line for line in second.lines)  # no run was announced
