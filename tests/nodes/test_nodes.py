"""The real nodes, in processes of their own, over real DDS."""

import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from bench_processes import Client, Simulation, Started, fresh, wait_until
from capture_sim.srv import BeginTrial
from rcl_interfaces.srv import ListParameters
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from recorded import values_of
from std_srvs.srv import Trigger

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.control.simulation import Code, State
from capture_sim.detection.exact import CaptureState
from capture_sim.launch.scenes import load_scene_text
from capture_sim.launch.watch import LauncherPhase
from capture_sim.messages.topics import (
    CAPTURE_STATUS,
    CAPTURE_VERDICT,
    LAUNCHER_PHASE,
    LAUNCHER_STATE,
    RUN_INFO,
    SIMULATOR,
    topics_of,
)
from capture_sim.nodes.node import message_class, qos_of
from capture_sim.nodes.supervisor import run_suite
from capture_sim.recording.detect import detect_again
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run

NAMES = ("tilt_0", "tilt_p10")
SENSED = "tilt_m10"
AWAITED = {"rtf": "0.0", "consumers": "[launcher, capture_detector, recorder]"}
# These carry the run's id, or what was computed from odometry instead of the state.
OF_THE_RUN = {"bench/run_info", "launcher/command", "capture/criteria", "bench/stream_counts"}
JUDGED = {"capture/status", "capture/verdict"}


@pytest.fixture(scope="module")
def scenes():
    # one with its contact at the integrator's own steps, one with sensors
    sensors = ["motion_capture={}", "motion_capture.rate=200", "load_cell={}", "seed=3"]
    return [
        load_scene("tilt_0"),
        load_scene("tilt_p10", ["run.trace=true"]),
        load_scene(SENSED, [f"sensors.{change}" for change in sensors]),
    ]


@pytest.fixture(scope="module")
def folder(scenes, tmp_path_factory):
    """The recordings of a suite; in ``beside`` those of another at the same time."""
    out = tmp_path_factory.mktemp("suite")
    with ThreadPoolExecutor() as pool:
        beside = pool.submit(run_suite, scenes[:1], out / "beside", namespace="/lab")
        status, recordings = run_suite(scenes, out)
    assert status == 0
    assert recordings == [out / f"{name}.mcap" for name in (*NAMES, SENSED)]
    assert beside.result() == (0, [out / "beside" / "tilt_0.mcap"])
    return out


@pytest.fixture(scope="module")
def suite(folder):
    """The recordings of a suite, by name."""
    return {name: read_run(folder / f"{name}.mcap") for name in (*NAMES, SENSED)}


@pytest.fixture
def start_all(start, tmp_path):
    """Start the whole bench; what is given goes to the simulator."""

    def start_all(change="", auto_release=True, recorder_change="", drain_timeout=5.0, **simulator):
        of_all = {"drain_timeout": drain_timeout}
        return {
            "simulator": start("simulator", change, **{**AWAITED, **simulator}),
            "launcher": start("launcher", auto_release=str(auto_release).lower(), **of_all),
            "capture_detector": start("capture_detector", **of_all),
            "recorder": start("recorder", recorder_change, out=tmp_path / "out", **of_all),
        }

    return start_all


def same_bits(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


# what the suite gives


@pytest.mark.parametrize("name", NAMES)
def test_suite_and_offline_run_agree_bit_for_bit(name, suite, scenes):
    recorded = suite[name]
    offline = simulate(scenes[NAMES.index(name)])
    assert recorded.problems == ()
    assert same_bits(recorded.samples, offline.samples)
    for field in set(recorded.touches.dtype.names) - {"rate_ratio"}:  # no message has that
        assert same_bits(recorded.touches[field], offline.touches[field])
    assert len(recorded.events) == len(offline.events)
    for live, other in zip(recorded.events, offline.events, strict=True):
        assert (live.kind, live.t, live.wall, live.detail) == (
            (other.kind, other.t, other.wall, other.detail)
        )
        assert same_bits(np.asarray(live.q), np.asarray(other.q))
        assert same_bits(np.asarray(live.v), np.asarray(other.v))


@pytest.mark.parametrize("name", NAMES)
def test_suite_and_offline_run_record_the_same_messages(name, suite, scenes, tmp_path):
    live = suite[name]
    offline = read_run(write_run(simulate(scenes[NAMES.index(name)]), tmp_path / "offline.mcap"))
    assert live.topics == offline.topics
    for topic in {key.lstrip("/") for key in live.topics} - OF_THE_RUN - JUDGED:
        assert values_of(live, topic) == values_of(offline, topic), topic


def test_trace_of_the_contact_is_sent_where_it_is_asked_for_and_changes_nothing(suite):
    assert suite["tilt_0"].topics["/bench/contact_trace"] == 0
    live = suite["tilt_p10"]
    assert live.topics["/bench/contact_trace"] > 100
    # the offline run has it as well, see above; this one has not
    assert same_bits(live.samples, simulate(load_scene("tilt_p10")).samples)
    offline = simulate(load_scene("tilt_p10"), trace=True)
    assert same_bits(live.trace["normal_force"], offline.trace["normal_force"])


@pytest.mark.parametrize("name", NAMES)
def test_detector_judges_the_messages_as_it_judges_the_state(name, suite, scenes):
    live, offline = suite[name].statuses, simulate(scenes[NAMES.index(name)]).statuses
    assert len(live) == len(offline)
    for a, b in zip(live, offline, strict=True):
        # times are the stamps' own; numbers differ by the rounding of a quaternion
        assert (a.t, a.state, a.final, a.time_in_state) == (b.t, b.state, b.final, b.time_in_state)
        for key in ("distance", "axial_offset", "lateral_offset", "relative_speed"):
            assert getattr(a, key) == pytest.approx(getattr(b, key), rel=1e-12, abs=1e-14)
    assert live[-1].final
    assert live[-1].reason == offline[-1].reason


def test_two_suites_in_one_domain_do_not_mix_and_give_the_same(suite, folder):
    alone, run = suite[NAMES[0]], read_run(folder / "beside" / f"{NAMES[0]}.mcap")
    assert run.complete
    assert run.run_id != alone.run_id
    assert run.topics == alone.topics
    for topic in {key.lstrip("/") for key in run.topics} - OF_THE_RUN:
        assert values_of(run, topic) == values_of(alone, topic), topic


def test_live_offline_and_the_bag_agree_on_sensed_poses(suite, scenes, folder, tmp_path, capsys):
    live = suite[SENSED]
    offline = simulate(scenes[-1])
    assert live.problems == ()
    assert agree(live.statuses, offline.statuses)
    assert detect_again(live) == list(live.statuses)
    written = read_run(write_run(offline, tmp_path / "offline.mcap"))
    assert written.topics == live.topics
    for topic in ("motion_capture/chaser", "motion_capture/target", "load_cell/wrench"):
        assert values_of(written, topic) == values_of(live, topic)
        assert len(live.raw(topic)) > 1000
    assert agree(written.statuses, live.statuses)
    path = str(folder / f"{SENSED}.mcap")
    assert main(["detect", path]) == 0
    said = capsys.readouterr().out
    # times of judgement, whenever they were told
    since = offline.statuses[-1].t - offline.statuses[-1].time_in_state
    told = next(s.t for s in offline.statuses if s.state is CaptureState.CAPTURED)
    assert told > since + 0.05
    assert (
        f"{since:10.3f} s  captured  within 5 mm of BE for 0.2 s, reported at {told:.3f} s" in said
    )
    assert f"verdict: captured since {since:.3f} s" in said
    assert f"recorded: captured since {since:.3f} s" in said
    assert main(["detect", path, "--set", "detector.capture_radius=1e-4"]) == 0
    assert "verdict: captured" not in capsys.readouterr().out


def agree(one, other):
    """Whether statuses are the same; a heading goes through a quaternion's rounding."""
    for a, b in zip(one, other, strict=True):
        assert (a.t, a.state, a.final, a.reason) == (b.t, b.state, b.final, b.reason)
        assert a == pytest.approx(b, abs=1e-12)
    return True


def test_second_simulator_on_the_same_topics_ends_with_a_line(start):
    first = start("simulator", rtf="0.1")
    first.wait_for("released")
    impatient = "node.SECOND_SIMULATOR_TIMEOUT = 1.0"  # the first will not leave
    not_found_at_the_start = "node.SimulatorNode._check_only_simulator = lambda self: None"
    for change in (impatient, not_found_at_the_start):
        second = start("simulator", change, rtf="0.1", exit_when_done="false")
        assert second.status() == 1
        assert "another simulator publishes /bench/state: use another" in second.text
        assert "Traceback" not in second.text
    first.process.send_signal(signal.SIGINT)
    assert first.status() == 0
    assert "another simulator" not in first.text


def test_younger_simulator_ends_when_the_older_one_begins_a_run_later(start):
    """As both were stopped, nothing told them of each other before."""
    unchecked = "node.SimulatorNode._check_only_simulator = lambda self: None"
    with Client() as client:
        older = start("simulator", initial_state="stopped", exit_when_done="false", __node="older")
        simulation = Simulation(client, "older")
        assert simulation.state is State.STOPPED
        younger = start("simulator", unchecked, rtf="0.1", __node="younger")
        younger.wait_for("released")
        assert older.process.poll() is None
        simulation.set(State.PLAYING)
        assert younger.status() == 1
        assert "another simulator publishes /bench/state: use another" in younger.text
        older.wait_for("all runs finished")
        simulation.set(State.QUITTING)
        assert older.status() == 0, older.text


def test_of_two_simulators_that_start_together_the_older_one_runs(start):
    impatient = "node.SECOND_SIMULATOR_TIMEOUT = 1.0"
    both = [start("simulator", impatient, rtf="0.1", exit_when_done="false") for _ in range(2)]
    wait_until(lambda: any(node.process.poll() is not None for node in both))
    younger, older = sorted(both, key=lambda node: node.process.poll() is None)
    assert younger.status() == 1
    assert "another simulator publishes /bench/state: use another" in younger.text
    older.wait_for("released")
    older.process.send_signal(signal.SIGINT)
    assert older.status() == 0, older.text


# each node alone


def test_simulator_alone_launches_by_its_own_plan(start):
    with Client() as client:
        simulation = Simulation(client)
        node = start("simulator", overrides="[run.t_end=1.0]")
        assert node.status() == 0, node.text
        assert simulation.settle() > 900  # of 1001: those before the two had found each other
        assert simulation.states[-1].t == 1.0
        assert simulation.clock


def test_names_and_namespaces_are_the_users(start, tmp_path):
    """Who a node is to the others does not depend on what it is called."""
    nodes = {
        "launcher": start("launcher", __node="my_launcher", __ns="/lab"),
        "capture_detector": start("capture_detector", __node="judge", __ns="/lab"),
        "recorder": start("recorder", __node="tape", __ns="/lab", out=tmp_path),
        "simulator": start("simulator", __node="bench", __ns="/lab", **AWAITED),
    }
    # two benches of one domain share nothing unless asked to
    with Client() as client:
        own = {"/lab/clock", "/lab/diagnostics", "/lab/capture/verdict"}

        def names():
            return {name for name, _ in client.node.get_topic_names_and_types()}

        wait_until(lambda: own <= names())
        shared = {name for name in names() if not name.startswith("/lab/")}
        assert not shared & {"/clock", "/diagnostics", "/tf", "/bench/state"}
    assert {name: node.status() for name, node in nodes.items()} == dict.fromkeys(nodes, 0)
    run = read_run(tmp_path / "tilt_0.mcap")
    assert run.problems == ()
    assert run.topics["/launcher/state"] == run.topics["/bench/buffer"] + 2


def test_run_waits_for_its_release_and_a_latecomer_gets_how_it_ended(start_all):
    nodes = start_all(auto_release=False, exit_when_done="false")
    nodes["simulator"].wait_for("waiting for the release")
    with Client() as client:
        assert client.set("launcher", auto_release=True) == (True, "")
        nodes["simulator"].wait_for("all runs finished")
        topics = CAPTURE_VERDICT, LAUNCHER_PHASE, RUN_INFO
        verdicts, phases, infos = (client.listen(topic) for topic in topics)
        wait_until(lambda: verdicts and phases and infos)
        time.sleep(0.5)
        assert [(m.state, m.final) for m in verdicts] == [(CaptureState.CAPTURED, True)]
        assert [m.state for m in phases] == [LauncherPhase.DELIVERED]
        # no run is on any more, and its scene is still there
        assert [(m.run_id, m.name) for m in infos] == [("", "tilt_0")]
        assert load_scene_text(infos[0].scene) == load_scene("tilt_0")
    nodes["simulator"].process.send_signal(signal.SIGINT)
    assert {name: node.status() for name, node in nodes.items()} == dict.fromkeys(nodes, 0)


def echo_once(client, topic):
    """Subscribe as `ros2 topic echo` does; return its messages and the warnings about QoS."""
    name = topic.absolute_name
    wait_until(lambda: client.node.count_publishers(name))
    offered = [p.qos_profile for p in client.node.get_publishers_info_by_topic(name)]
    assert len(offered) == 1, name
    kept = offered[0].durability is DurabilityPolicy.TRANSIENT_LOCAL
    durability = DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE
    messages, warnings = [], []
    client.node.create_subscription(
        message_class(topic.type_name),
        name,
        messages.append,
        QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=durability),
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=warnings.append),
    )
    return messages, warnings


def test_streams_and_their_last_state_are_echoed_without_a_warning(start_all):
    nodes = start_all(rtf=1.0, exit_when_done="false")
    with Client() as client:
        nodes["simulator"].wait_for("released")
        echoed = [echo_once(client, topic) for topic in (CAPTURE_STATUS, LAUNCHER_STATE)]
        wait_until(lambda: all(messages for messages, _ in echoed))
        nodes["simulator"].wait_for("all runs finished")
        echoed += [echo_once(client, topic) for topic in (CAPTURE_VERDICT, LAUNCHER_PHASE)]
        wait_until(lambda: all(messages for messages, _ in echoed))
        assert not any(warnings for _, warnings in echoed)
    for node in nodes.values():
        node.process.send_signal(signal.SIGINT)
    assert {name: node.status() for name, node in nodes.items()} == dict.fromkeys(nodes, 0)
    assert not any("incompatible" in node.text for node in nodes.values())


@pytest.mark.parametrize("when", [{"initial_state": "stopped"}, {"consumers": "[recorder]"}])
def test_services_are_the_simulators_own_and_quitting_ends_it(when, start):
    with Client() as client:
        node = start("simulator", exit_when_done="false", **when)
        simulation = Simulation(client)
        assert simulation.features().features
        graph = client.node

        def is_the_nodes_own(service):  # nodes tell of themselves later than DDS of their services
            if ("simulator", "/") not in graph.get_node_names_and_namespaces():
                return False
            return service in dict(graph.get_service_names_and_types_by_node("simulator", "/"))

        wait_until(lambda: is_the_nodes_own("/simulator/step_simulation"))
        assert simulation.set(State.QUITTING) == (Code.OK, "")
        assert node.status() == 0
        assert "Traceback" not in node.text


def test_launcher_delivers(suite):
    states = suite["tilt_0"].columns("launcher/state")
    assert states["state"][:2].tolist() == [1, 2]  # armed, released
    assert states["state"][-1] == 4  # delivered
    assert np.all(np.diff(states["state"].astype(int)) >= 0)
    assert states["measured_speed"][-1] == pytest.approx(0.1, rel=0.01)


# losses


def test_dropped_messages_are_named(start_all):
    """The simulator counts a message and does not send it: all who need it must notice."""
    drop = """
        from capture_sim.messages.topics import BENCH_STATE, TARGET_ODOMETRY
        left = {BENCH_STATE: 1234, TARGET_ODOMETRY: 56}
        send = node.SimulatorNode.send
        def leaky(self, topic, message):
            if topic in left:
                left[topic] -= 1
                if left[topic] == -1:
                    return True
            return send(self, topic, message)
        node.SimulatorNode.send = leaky
    """
    nodes = start_all(drop, drain_timeout=2.0)
    assert nodes["recorder"].status() == 1
    said = nodes["recorder"].text
    assert re.search(r"bench/state: 1 messages? missing \(seq 1234\)", said), said
    assert re.search(r"target/odom: 1 messages? missing", said), said
    assert nodes["capture_detector"].status() == 1
    assert re.search(r"target/odom: \d+ of \d+ messages received", nodes["capture_detector"].text)
    assert nodes["launcher"].status() == 0  # it needs neither
    assert nodes["simulator"].status() == 0


def test_who_looks_on_is_not_taken_for_who_is_awaited(start, tmp_path):
    """Somebody else reads the topics while the recorder, known by its counts, does not yet."""
    late = """
        import time
        listen = node.RecorderNode.listen
        def late(self, topic, *args, **options):
            if topic.name == "bench/state":
                time.sleep(2.0)
            listen(self, topic, *args, **options)
        node.RecorderNode.listen = late
    """
    with Client() as client:
        for topic in topics_of(SIMULATOR):
            client.listen(topic)
        simulator = start(
            "simulator", rtf="0.0", consumers="[recorder]", overrides="[run.t_end=1.0]"
        )
        recorder = start("recorder", late, out=tmp_path)
        assert [simulator.status(), recorder.status()] == [0, 0], recorder.text
    assert read_run(tmp_path / "tilt_0.mcap").complete


# nodes that die


def begun(tmp_path):
    """Wait until the recorder has written about 1000 samples; return its file."""
    path = tmp_path / "out" / "tilt_0.mcap"
    wait_until(lambda: path.is_file() and path.stat().st_size > 300_000)
    return path


def test_killed_simulator_leaves_a_readable_file_and_ends_the_others(start_all, tmp_path):
    nodes = start_all(rtf=2.0)
    path = begun(tmp_path)
    nodes["simulator"].process.kill()
    for name in ("recorder", "launcher", "capture_detector"):
        assert nodes[name].status() == 1
        assert "the simulator has gone" in nodes[name].text
    run = read_run(path)
    assert not run.complete
    assert not run.damage
    whole = simulate(load_scene("tilt_0")).samples
    assert 500 < run.samples.size < whole.size
    assert same_bits(run.samples, whole[: run.samples.size])
    assert run.scene == load_scene("tilt_0")


@pytest.mark.parametrize("victim", ["capture_detector", "recorder"])
def test_run_goes_on_without_a_killed_participant(victim, start_all, tmp_path):
    nodes = start_all(rtf=2.0, consumer_timeout=60.0)
    path = begun(tmp_path)
    nodes[victim].process.kill()
    nodes["simulator"].wait_for("done, 5936 samples")
    assert nodes["simulator"].status() == 0
    assert nodes["launcher"].status() == 0
    if victim != "recorder":
        assert nodes["recorder"].status() == 1
        assert victim in nodes["recorder"].text
    run = read_run(path)
    assert not run.complete
    assert run.samples.size > 500


def test_reader_that_stalls_is_dropped_by_name(start_all, tmp_path):
    stuck = """
        import time
        take = node.RecorderNode._record
        def wait(self, topic, data):
            if topic.name == "bench/state" and self.run is not None:
                print("stalled", flush=True)
                time.sleep(20.0)
            take(self, topic, data)
        node.RecorderNode._record = wait
    """
    nodes = start_all(
        recorder_change=stuck,
        consumer_timeout="2.0",
        overrides="[run.state_rate=10000, run.t_end=1.5]",
    )
    nodes["simulator"].wait_for("/recorder: no message read from", 120.0)
    assert "/capture_detector" not in nodes["simulator"].text
    nodes["simulator"].wait_for("done, ")
    assert nodes["capture_detector"].status() == 0
    assert nodes["simulator"].status() == 1


ASLEEP = """
import sys, time
import rclpy
from capture_sim.messages.topics import BENCH_STATE
from capture_sim.nodes.node import message_class, qos_of
rclpy.init()
node = rclpy.create_node("asleep")
kind, qos = message_class(BENCH_STATE.type_name), qos_of(BENCH_STATE)
node.create_subscription(kind, "bench/state", print, qos)
print("subscribed", flush=True)
time.sleep(300.0)
"""


def test_foreign_reader_that_does_not_read_is_named_and_fails_nothing(start_all, tmp_path):
    asleep = Started(fresh(ASLEEP, []))
    try:
        asleep.wait_for("subscribed")
        nodes = start_all(consumer_timeout="2.0")  # tilt_0 has more samples than DDS keeps for it
        assert {name: node.status() for name, node in nodes.items()} == dict.fromkeys(nodes, 0)
    finally:
        asleep.process.kill()
        asleep.process.wait()
    assert "/asleep: no message read from bench/state for 2 s" in nodes["simulator"].text
    assert read_run(tmp_path / "out" / "tilt_0.mcap").complete


def test_slow_reader_loses_nothing(start):
    slow = """
        import time
        follow = node.LauncherNode._receive_measurement
        def late(self, name, message):
            time.sleep(5e-4)
            follow(self, name, message)
        node.LauncherNode._receive_measurement = late
    """
    launcher = start("launcher", slow)
    simulator = start(
        "simulator",
        rtf="0.0",
        consumers="[launcher]",
        overrides="[run.rate=1000, run.t_end=1.2]",
    )
    assert [launcher.status(), simulator.status()] == [0, 0], launcher.text


def test_launcher_aborts_a_launch_that_goes_wrong(start):
    """The real bench is not as planned: here the mass that was fitted is heavier by half."""
    heavier = """
        from dataclasses import replace
        fitted = node._plan
        def wrong(scene, armed):
            plan = fitted(scene, armed)
            return replace(plan, hanging_mass=1.5 * plan.hanging_mass)
        node._plan = wrong
    """
    with Client() as client:
        simulator = start("simulator", heavier, consumers="[launcher]", rtf="2.0")
        launcher = start("launcher", actuator="output", auto_release="false")
        holds = []
        kind = message_class("std_msgs/msg/Bool")
        qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        client.node.create_subscription(kind, "launcher/hold", holds.append, qos)
        simulator.wait_for("waiting for the release")
        wait_until(lambda: holds)
        client.set("launcher", auto_release=True)
        assert launcher.status() == 1
        assert re.search(r"aborted: speed 0\.\d+ m/s after 0\.\d+ m: must be", launcher.text)
        assert simulator.status() == 1
        assert "aborted by the launcher" in simulator.text
        # held, let go at the release, held again
        wait_until(lambda: len(holds) >= 3)
        assert [m.data for m in holds][-3:] == [True, False, True]


def test_launch_pressed_twice_begins_one_trial(start):
    with Client() as client:
        launcher = start("launcher", scene="tilt_0", actuator="output")
        launcher.wait_for("ready")
        runs = client.listen(RUN_INFO, lambda info: info.run_id)
        client.ask(ListParameters, "/launcher/list_parameters")
        presses = [client.begin(Trigger, "/launcher/launch") for _ in range(3)]
        assert sorted(press().success for press in presses) == [False, False, True]
        wait_until(lambda: runs)
        launcher.wait_for("armed")
        time.sleep(0.5)
        assert len(runs) == 1
        assert client.ask(Trigger, "/launcher/end_trial").success
        launcher.process.send_signal(signal.SIGINT)
        assert launcher.status() == 0, launcher.text
        assert launcher.text.count("armed") == 1


def test_end_trial_of_a_recorder_names_its_file(start, tmp_path):
    with Client() as client:
        recorder = start("recorder", out=tmp_path, exit_when_done="false")
        recorder.wait_for("ready")
        assert client.ask(BeginTrial, "/recorder/begin_trial", scene="tilt_0").success
        recorder.wait_for("recording in")
        ended = client.ask(Trigger, "/recorder/end_trial")
        assert ended.message == f"tilt_0: ended, file {tmp_path / 'tilt_0.mcap'}"
        recorder.wait_for("tilt_0.mcap: ")


def test_missing_reader_is_named_and_delays_no_callback(start):
    """The run waits for a recorder that is not there: its detector answers meanwhile."""
    with Client() as client:
        detector = start("capture_detector", exit_when_done="false")
        detector.wait_for("ready")
        kind = message_class(RUN_INFO.type_name)
        publisher = client.node.create_publisher(kind, RUN_INFO.name, qos_of(RUN_INFO))
        wait_until(lambda: publisher.get_subscription_count() > 0)
        client.ask(ListParameters, "/capture_detector/list_parameters")
        scene = load_scene("tilt_0").to_yaml()
        run = kind(run_id="x", name="tilt_0", scene=scene, state_rate=1000.0, rate=100.0)
        run.publishers, run.consumers = ["simulator"], ["recorder"]
        publisher.publish(run)
        answers = 0
        while "begun without them" not in detector.text:
            began = time.monotonic()
            client.ask(ListParameters, "/capture_detector/list_parameters")
            answers += time.monotonic() - began < 1.0
        assert answers > 20
        named = "not all nodes that the run waits for read capture/criteria, capture/status"
        assert named in detector.text
        detector.process.send_signal(signal.SIGINT)
        assert detector.status() == 0


COUNTED = """
    import gc, os, sys
    collect = gc.collect
    def sweep_and_count():
        collect()
        files = len(os.listdir("/proc/self/fd"))
        print("left", sys.getallocatedblocks(), files, flush=True)
    gc.collect = sweep_and_count
"""


def test_resets_leave_nothing_in_memory_and_no_open_files(start):
    """A run makes thousands of objects; without a sweep 20 to 40 of them stay, in free lists."""
    nodes = [
        start(
            "simulator",
            COUNTED,
            initial_state="stopped",
            consumers="[launcher]",
            overrides="[run.t_end=0.4]",
            exit_when_done="false",
        ),
        start("launcher", COUNTED, exit_when_done="false"),
    ]
    nodes[1].wait_for("ready")  # a step waits 5 s for the release
    with Client() as client:
        simulation = Simulation(client)
        assert simulation.set(State.PAUSED)[0] == Code.OK
        for _ in range(150):
            assert simulation.step(3) == (Code.OK, "")
            assert simulation.reset() == (Code.OK, "")
        for node in nodes:  # the launcher may be behind
            wait_until(lambda node=node: node.text.count("left") >= 150)
        simulation.set(State.QUITTING)
    for node in nodes:
        left = [line.split()[1:] for line in node.lines if line.startswith("left")]
        blocks, files = zip(*((int(a), int(b)) for a, b in left), strict=True)
        assert blocks[-1] - blocks[70] < 10 * (len(blocks) - 71)
        assert files[-1] <= files[70] + 2


# Ctrl-C


def test_one_ctrl_c_ends_all_without_traceback(tmp_path):
    program = """
        import sys
        from pathlib import Path
        from capture_sim import load_scene
        from capture_sim.nodes.supervisor import run_suite
        try:
            run_suite([load_scene("tilt_0")], Path(sys.argv[1]), rtf=1.0)
        except KeyboardInterrupt:
            sys.exit(130)
    """
    process = fresh(textwrap.dedent(program), [str(tmp_path)])
    suite = Started(process)
    try:
        suite.wait_for("released")
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        assert suite.status() == 130, suite.text
    finally:
        process.kill()
    said = suite.text
    assert "Traceback" not in said
    assert "killed" not in said  # none had to be, and none is suspected of it
    assert "interrupted" in said
    assert "undecided, run ended before any contact" in said
    run = read_run(tmp_path / "tilt_0.mcap")
    assert not run.damage
    assert run.samples.size > 100
    # all that was sent is there, and nothing is claimed that the run has not come to
    assert all("ended the run early" in line for line in run.problems), run.problems
    assert len(run.problems) == 3  # simulator, launcher, detector
    last = run.statuses[-1]
    assert (last.state.label, last.final) == ("undecided", False)
    assert detect_again(run)[-1] == last


_SMALL_DISK = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
"""


def test_disk_that_is_full_ends_the_recording_with_one_line_and_no_run(start_all):
    nodes = start_all(recorder_change=_SMALL_DISK, drain_timeout=2.0)
    assert nodes["recorder"].status() == 1
    assert "Traceback" not in nodes["recorder"].text
    assert "Error occurred at" not in nodes["recorder"].text
    (line,) = [line for line in nodes["recorder"].lines if "[ERROR]" in line]
    assert "tilt_0.mcap: cannot write: File too large" in line
    assert nodes["simulator"].status() == 0
    assert "done, 5936 samples" in nodes["simulator"].text  # as without a full disk


def test_node_whose_callback_fails_says_so_and_ends(start):
    node = start("launcher", "node.LauncherNode._look_at_clock = lambda self: 1 / 0")
    assert node.status() == 1
    assert "stopped by ZeroDivisionError: division by zero" in node.text


# parameters


def test_unknown_parameter_is_named(start):
    node = start("launcher", auto_relase="true")
    node.wait_for("auto_relase is unknown here and has no effect; did you mean auto_release?")
    node.process.send_signal(signal.SIGINT)
    assert node.status() == 0


def test_help_into_a_closed_pipe_ends_quietly():
    command = [sys.executable, "-m", "capture_sim.nodes.capture_detector", "--help"]
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert done.returncode == 0
    assert not done.stderr


def test_help_shows_the_parameters_and_starts_nothing():
    command = [sys.executable, "-m", "capture_sim.nodes.simulator", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    for word in ("usage: simulator", "initial_state: playing", "ros2 param describe /simulator"):
        assert word in done.stdout
    assert "launcher:" not in done.stdout  # another node's


def test_suite_ends_when_a_node_refuses(scenes, tmp_path, capfd):
    (tmp_path / "out").write_text("not a folder")
    assert run_suite(scenes[:1], tmp_path / "out") == (2, [])
    assert "must be a folder" in capfd.readouterr().out


def test_every_topic_with_every_sample_loses_nothing(start_all, tmp_path):
    nodes = start_all(overrides="[run.rate=1000, run.t_end=1.2]")
    ended = {name: node.status() for name, node in nodes.items()}
    assert ended == dict.fromkeys(nodes, 0), [node.text for node in nodes.values()]
    run = read_run(tmp_path / "out" / "tilt_0.mcap")
    assert run.complete
    assert run.topics["/joint_states"] == run.topics["/bench/state"] == 1201
