"""The real nodes, in processes of their own, over real DDS."""

import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest
from bench_processes import Client, Simulation, Started, processes, wait_until
from observations import observation
from rclpy.qos import DurabilityPolicy, QoSProfile
from recorded import values_of

from capture_sim import load_scene, simulate
from capture_sim.bench import compile_kernels
from capture_sim.control.simulation import Code, State
from capture_sim.nodes.flow_control import Followers, samples_between_acks
from capture_sim.nodes.receiving import StampMatcher, observation_of
from capture_sim.nodes.running import message_class
from capture_sim.nodes.suite import run_suite
from capture_sim.recording.judging import judge_recording
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run

NAMES = ("tilt_0", "tilt_p10")
# These carry the run's id, or what was computed from odometry instead of the state.
OF_THE_RUN = {"bench/run_info", "launcher/command", "capture/criteria", "bench/stream_counts"}
JUDGED = {"capture/status"}
# s; what the issue allows the others when a node is killed
NOTICED = 5.0


@pytest.fixture(scope="module", autouse=True)
def kernels():
    compile_kernels()


@pytest.fixture(scope="module")
def scenes():
    # one of them with its contact at the integrator's own steps
    return [load_scene("tilt_0"), load_scene("tilt_p10", ["run.trace=true"])]


@pytest.fixture(scope="module")
def suites(scenes, tmp_path_factory):
    """Two suites of the same scenes: the recordings of each, by name."""
    runs = []
    for _ in range(2):
        out = tmp_path_factory.mktemp("suite")
        assert run_suite(scenes, out) == 0
        runs.append({name: read_run(out / f"{name}.mcap") for name in NAMES})
    return runs


@pytest.fixture
def start(tmp_path):
    """Start a node: its name, Python code that changes it before, and parameters."""
    with processes(tmp_path) as start:
        yield start


@pytest.fixture
def start_all(start, tmp_path):
    """Start the whole bench; what is given goes to the simulator."""

    def start_all(change="", auto_release=True, recorder_change="", **simulator):
        return {
            "simulator": start("simulator", change, **simulator),
            "launcher": start("launcher", auto_release=str(auto_release).lower()),
            "capture_detector": start("capture_detector"),
            "recorder": start("recorder", recorder_change, out=tmp_path / "out", drain_timeout=1.0),
        }

    return start_all


def same_bits(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


# what the suite gives


@pytest.mark.parametrize("name", NAMES)
def test_suite_and_offline_run_agree_bit_for_bit(name, suites, scenes):
    recorded = suites[0][name]
    offline = simulate(scenes[NAMES.index(name)])
    assert recorded.problems == ()
    assert same_bits(recorded.samples, offline.samples)
    assert same_bits(recorded.touches, offline.touches)
    assert len(recorded.events) == len(offline.events)
    for live, other in zip(recorded.events, offline.events, strict=True):
        assert (live.kind, live.t, live.wall, live.detail) == (
            (other.kind, other.t, other.wall, other.detail)
        )
        assert same_bits(np.asarray(live.q), np.asarray(other.q))
        assert same_bits(np.asarray(live.v), np.asarray(other.v))


@pytest.mark.parametrize("name", NAMES)
def test_suite_and_offline_run_record_the_same_messages(name, suites, scenes, tmp_path):
    live = suites[0][name]
    offline = read_run(write_run(simulate(scenes[NAMES.index(name)]), tmp_path / "offline.mcap"))
    assert live.topics == offline.topics
    for topic in {key.lstrip("/") for key in live.topics} - OF_THE_RUN - JUDGED:
        assert values_of(live, topic) == values_of(offline, topic), topic


def test_trace_of_the_contact_is_sent_where_it_is_asked_for_and_changes_nothing(suites):
    assert suites[0]["tilt_0"].topics["/bench/contact_trace"] == 0
    live = suites[0]["tilt_p10"]
    assert live.topics["/bench/contact_trace"] > 100
    # the offline run has it as well, see above; this one has not
    assert same_bits(live.samples, simulate(load_scene("tilt_p10")).samples)
    offline = simulate(load_scene("tilt_p10"), trace=True)
    assert same_bits(live.trace["normal_force"], offline.trace["normal_force"])


@pytest.mark.parametrize("name", NAMES)
def test_detector_judges_the_messages_as_it_judges_the_state(name, suites, scenes):
    live, offline = suites[0][name].statuses, simulate(scenes[NAMES.index(name)]).statuses
    assert len(live) == len(offline)
    for a, b in zip(live, offline, strict=True):
        # times are the stamps' own; numbers differ by the rounding of a quaternion
        assert (a.t, a.state, a.final, a.time_in_state) == (b.t, b.state, b.final, b.time_in_state)
        for key in ("distance", "axial_offset", "lateral_offset", "relative_speed"):
            assert getattr(a, key) == pytest.approx(getattr(b, key), rel=1e-12, abs=1e-14)
    assert live[-1].final
    assert live[-1].reason == offline[-1].reason


@pytest.mark.parametrize("name", NAMES)
def test_two_suites_are_identical(name, suites):
    first, second = (suite[name] for suite in suites)
    assert first.run_id != second.run_id
    assert first.topics == second.topics
    for topic in {key.lstrip("/") for key in first.topics} - OF_THE_RUN:
        assert values_of(first, topic) == values_of(second, topic), topic


def test_two_suites_in_one_domain_do_not_mix(suites, scenes, tmp_path):
    status = {}

    def suite(name):
        status[name] = run_suite(scenes[:1], tmp_path / name)

    threads = [threading.Thread(target=suite, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert status == {"a": 0, "b": 0}
    alone = suites[0][NAMES[0]]
    for name in "ab":
        run = read_run(tmp_path / name / f"{NAMES[0]}.mcap")
        assert run.complete
        assert run.topics == alone.topics
        for topic in {key.lstrip("/") for key in run.topics} - OF_THE_RUN:
            assert values_of(run, topic) == values_of(alone, topic), topic


def test_second_simulator_on_the_same_topics_ends_with_a_line(start):
    # still on when the second has started, on a busy machine too
    first = start("simulator", consumers="[launcher]", pace="0.25")
    start("launcher")
    first.wait_for("released")
    second = start("simulator", consumers="[launcher]")
    assert second.status(60.0) == 1
    assert re.search("another simulator, with tilt_0, publishes /bench/run_info", second.text)
    assert "Traceback" not in second.text
    assert first.status(60.0) == 0


def test_launcher_is_heard_and_delivers(suites):
    states = suites[0]["tilt_0"].columns("launcher/state")
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
                    return
            send(self, topic, message)
        node.SimulatorNode.send = leaky
    """
    nodes = start_all(drop)
    assert nodes["recorder"].status() == 1
    said = nodes["recorder"].text
    assert re.search(r"bench/state: 1 messages? missing \(seq 1234\)", said), said
    assert re.search(r"target/odom: 1 messages? missing", said), said
    assert nodes["capture_detector"].status() == 1
    assert re.search(r"target/odom: \d+ of \d+ messages came", nodes["capture_detector"].text)
    assert nodes["launcher"].status() == 0  # it needs neither
    assert nodes["simulator"].status() == 0


# nodes that die


def test_killed_simulator_leaves_a_readable_file_and_ends_the_others(start_all, tmp_path):
    nodes = start_all(pace=2.0)
    nodes["simulator"].wait_for("released")
    time.sleep(1.5)
    nodes["simulator"].process.kill()
    for name in ("recorder", "launcher", "capture_detector"):
        assert nodes[name].status(NOTICED) == 1
        assert "the simulator has gone" in nodes[name].text
    run = read_run(tmp_path / "out" / "tilt_0.mcap")
    assert not run.complete
    assert not run.damage
    whole = simulate(load_scene("tilt_0")).samples
    assert 500 < run.samples.size < whole.size
    assert same_bits(run.samples, whole[: run.samples.size])
    assert run.scene == load_scene("tilt_0")


@pytest.mark.parametrize("victim", ["capture_detector", "recorder"])
def test_killed_follower_is_named_and_the_run_goes_on(victim, start_all, tmp_path):
    nodes = start_all(pace=1.5)
    nodes["simulator"].wait_for("released")
    time.sleep(0.5)
    nodes[victim].process.kill()
    nodes["simulator"].wait_for(f"{victim}: no sign of life", NOTICED)
    assert nodes["simulator"].status() == 1
    assert "done, 5936 samples" in nodes["simulator"].text
    assert nodes["launcher"].status() == 0
    if victim != "recorder":
        assert nodes["recorder"].status() == 1
        assert victim in nodes["recorder"].text
    run = read_run(tmp_path / "out" / "tilt_0.mcap")
    assert not run.complete
    assert run.samples.size > 100


def test_launcher_that_dies_before_the_release_ends_the_run(start_all):
    nodes = start_all(auto_release=False)
    nodes["simulator"].wait_for("waiting for the release")
    nodes["launcher"].process.kill()
    for name, status in (("simulator", 1), ("capture_detector", 1), ("recorder", 1)):
        assert nodes[name].status(2 * NOTICED) == status
    assert "launcher: no sign of life" in nodes["simulator"].text


def test_chaser_is_held_until_the_release_is_given(start, tmp_path):
    nodes = [
        start("simulator", consumers="[launcher, capture_detector]"),
        start("launcher", auto_release="false"),
        start("capture_detector"),
    ]
    nodes[0].wait_for("waiting for the release")
    with Client() as client:
        assert client.set("launcher", auto_release=True) == (True, "")
    assert [node.status() for node in nodes] == [0, 0, 0]


def test_launcher_aborts_a_launch_that_goes_wrong(start):
    """The real bench is not as planned: here the mass that was fitted is heavier by half."""
    heavier = """
        from dataclasses import replace
        fitted = node.SimulatorNode._commanded_plan
        def wrong(self):
            plan = fitted(self)
            return replace(plan, hanging_mass=1.5 * plan.hanging_mass)
        node.SimulatorNode._commanded_plan = wrong
    """
    with Client() as client:
        simulator = start("simulator", heavier, consumers="[launcher]", pace="2.0")
        launcher = start("launcher", actuator="output", auto_release="false")
        holds = []
        kind = message_class("std_msgs/msg/Bool")
        qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        client.node.create_subscription(kind, "launcher/hold", holds.append, qos)
        simulator.wait_for("waiting for the release")
        wait_until(lambda: holds)
        client.set("launcher", auto_release=True)
        assert launcher.status() == 1
        assert re.search(r"aborted: speed 0\.\d+ m/s after 0\.\d+ m: allowed is", launcher.text)
        assert simulator.status() == 1
        assert "aborted by the launcher" in simulator.text
        # held, let go at the release, held again
        wait_until(lambda: len(holds) >= 3)
        assert [m.data for m in holds][-3:] == [True, False, True]


COUNTED = """
    import sys
    def counted(module):
        sweep = module.sweep_memory
        def sweep_and_count():
            sweep()
            print("blocks", sys.getallocatedblocks(), flush=True)
        module.sweep_memory = sweep_and_count
"""


def test_resets_leave_nothing_in_the_memory_of_python(start):
    """A run makes thousands of objects; without a sweep 20 to 40 of them stay, in free lists."""
    of_follower = "\n    from capture_sim.nodes import following\n    counted(following)"
    nodes = [
        start(
            "simulator",
            COUNTED + "\n    counted(node)",
            initial_state="stopped",
            consumers="[launcher]",
            overrides="[run.t_end=0.4]",
            exit_when_done="false",
        ),
        start("launcher", COUNTED + of_follower, exit_when_done="false"),
    ]
    nodes[1].wait_for("ready")  # a step waits 5 s for the release
    with Client() as client:
        simulation = Simulation(client)
        assert simulation.set(State.PAUSED)[0] == Code.OK
        for _ in range(150):
            assert simulation.step(3) == (Code.OK, "")
            assert simulation.reset() == (Code.OK, "")
        simulation.set(State.QUITTING)
    for node in nodes:
        blocks = [int(line.split()[1]) for line in node.lines if line.startswith("blocks")]
        assert len(blocks) >= 150
        assert blocks[-1] - blocks[70] < 10 * (len(blocks) - 71)


def test_quitting_ends_the_process(start):
    with Client() as client:
        node = start("simulator", consumers="[nobody]", exit_when_done="false")
        simulation = Simulation(client)
        assert simulation.set(State.QUITTING) == (Code.OK, "")
        assert node.status(20.0) == 0
        assert "Traceback" not in node.text


# Ctrl-C


def interrupted_suite(tmp_path, wait):
    """Start a suite, wait for what ``wait`` asks, press Ctrl-C; return what it said."""
    program = """
        import sys
        from pathlib import Path
        from capture_sim import load_scene
        from capture_sim.nodes.suite import run_suite
        try:
            run_suite([load_scene("tilt_0")], Path(sys.argv[1]), pace=1.0)
        except KeyboardInterrupt:
            sys.exit(130)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program), str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    suite = Started(process)
    try:
        wait(suite)
        process.send_signal(signal.SIGINT)
        assert suite.status(20.0) == 130, suite.text
    finally:
        process.kill()
    assert "Traceback" not in suite.text
    assert "killed" not in suite.text  # none had to be, and none is suspected of it
    return suite.text


def test_one_ctrl_c_ends_all_without_traceback(tmp_path):
    def wait(suite):
        suite.wait_for("released")
        time.sleep(1.0)

    said = interrupted_suite(tmp_path, wait)
    assert "interrupted" in said
    assert "no verdict, approach" in said
    run = read_run(tmp_path / "tilt_0.mcap")
    assert not run.damage
    assert run.samples.size > 100
    # all that was sent is there, and nothing is claimed that the run has not come to
    assert all("ended the run early" in line for line in run.problems), run.problems
    assert len(run.problems) == 3  # simulator, launcher, detector
    last = run.statuses[-1]
    assert (last.state.label, last.final) == ("approach", False)
    assert judge_recording(run)[-1] == last


def test_ctrl_c_while_the_nodes_start_ends_them_too(tmp_path):
    interrupted_suite(tmp_path, lambda suite: suite.wait_for("starting"))


def test_ctrl_c_on_nodes_without_a_run(start):
    node = start("launcher")
    node.wait_for("ready")
    node.process.send_signal(signal.SIGINT)
    assert node.status(10.0) == 0
    assert "Traceback" not in node.text


_SMALL_DISK = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
"""


def test_disk_that_fails_ends_the_recorder_with_one_line(start_all):
    nodes = start_all(recorder_change=_SMALL_DISK)
    assert nodes["recorder"].status() == 1
    assert "Traceback" not in nodes["recorder"].text
    assert "Error occurred at" not in nodes["recorder"].text
    assert "tilt_0.mcap" in nodes["recorder"].lines[-1]
    assert nodes["simulator"].status() == 1
    assert "recorder: no sign of life" in nodes["simulator"].text


def test_node_whose_callback_fails_says_so_and_ends(start):
    node = start("launcher", "node.LauncherNode._look_at_clock = lambda self: 1 / 0")
    assert node.status(20.0) == 1
    assert "stopped by ZeroDivisionError: division by zero" in node.text


# parameters

WRONG = {
    "pace out of range": ("simulator", {"pace": "-1.0"}, ["pace = -1.0", "0 to 1000"]),
    "pace without point": ("simulator", {"pace": "1"}, ["pace = 1", "decimal point"]),
    "window out of range": ("simulator", {"window": "5000"}, ["window = 5000", "200 to 900"]),
    "unknown scene": ("simulator", {"scenes": "[tilt_1]"}, ["tilt_1", "did you mean"]),
    "bad override": (
        "simulator",
        {"overrides": '["buffer.c_A=-1"]'},
        ["buffer.c_A = -1", "N s/m", ">= 0"],
    ),
    "same scene twice": ("simulator", {"scenes": "[tilt_0, tilt_0]"}, ["different names"]),
    "no scene": ("simulator", {"scenes": "[]"}, ["scenes = []", "names of scenes"]),
    "same consumer twice": ("simulator", {"consumers": "[a, a]"}, ["consumers", "once"]),
    "out is no folder": ("recorder", {"out": os.devnull}, [os.devnull, "folder"]),
    "no syntax": ("launcher", {"auto_release": "["}, ["auto_release"]),
    "no bool": ("launcher", {"auto_release": "3"}, ["auto_release = 3", "true or false"]),
}


def test_wrong_parameters_are_refused_with_one_line(start):
    nodes = {case: start(name, **parameters) for case, (name, parameters, _) in WRONG.items()}
    for case, node in nodes.items():
        assert node.status() == 2, case
        assert "Traceback" not in node.text, case
        lines = [line for line in node.lines if line.startswith("error:")]
        assert len(lines) == 1, (case, node.text)
        for words in WRONG[case][2]:
            assert words in lines[0], case


def test_unknown_parameter_is_named(start):
    node = start("launcher", auto_relase="true")
    node.wait_for("auto_relase is unknown here and has no effect; did you mean auto_release?")
    node.process.send_signal(signal.SIGINT)
    assert node.status(10.0) == 0


def test_help_shows_the_parameters_and_starts_nothing():
    command = [sys.executable, "-m", "capture_sim.nodes.simulator", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert done.returncode == 0
    for word in ("usage: simulator", "initial_state: playing", "ros2 param describe /simulator"):
        assert word in done.stdout
    assert "launcher:" not in done.stdout  # another node's


def test_suite_ends_when_a_node_refuses(scenes, tmp_path, capfd):
    (tmp_path / "out").write_text("not a folder")
    assert run_suite(scenes[:1], tmp_path / "out") == 2
    assert "allowed is a folder" in capfd.readouterr().out


# the parts without DDS


@pytest.mark.parametrize("rate", [1.0, 100.0, 250.0, 1000.0])
def test_what_is_under_way_fits_into_the_shared_memory(rate):
    """Fast DDS: a port holds 512 messages (port_queue_capacity), a segment 512 kB."""
    samples = 2 * samples_between_acks(1000.0, rate)
    # a state each, and with a periodic sample eight of the simulator and one of each other
    messages = samples * (1.0 + 10.0 * rate / 1000.0)
    assert samples >= 2
    assert messages <= 512 * 0.8
    assert samples * 800 + (messages - samples) * 400 < 0.8 * 512 * 1024


def test_every_topic_with_every_sample_loses_nothing(start_all, tmp_path):
    nodes = start_all(overrides="[run.rate=1000, run.t_end=3.0]")
    assert {name: node.status() for name, node in nodes.items()} == dict.fromkeys(nodes, 0)
    run = read_run(tmp_path / "out" / "tilt_0.mcap")
    assert run.complete
    assert run.topics["/joint_states"] == run.topics["/bench/state"] == 3001


def test_slowest_follower_is_waited_for():
    followers = Followers(["fast", "slow"], timeout=10.0)
    followers.heard("fast", "run", 300)
    followers.heard("slow", "run", 100)
    followers.start("run")
    timer = threading.Timer(0.1, followers.heard, ("slow", "run", 200))
    timer.start()
    assert followers.wait_for(200, "run") == []
    assert not timer.is_alive()
    timer.join()


def test_follower_that_stands_still_is_left_behind_and_one_that_comes_on_is_not():
    followers = Followers(["dead", "slow"], timeout=0.3)
    followers.heard("dead", "run", 50)
    followers.heard("slow", "run", 0)
    followers.start("run")
    stop = threading.Event()

    def live():
        received = 0
        while not stop.wait(0.05):
            received += 10
            followers.heard("dead", "run", 50)  # breathes, but does not come on
            followers.heard("slow", "run", received)

    thread = threading.Thread(target=live)
    thread.start()
    assert followers.wait_for(100, "run") == ["dead"]
    stop.set()
    thread.join()
    assert followers.names == ["slow"]
    assert "stood still" in followers.lost["dead"]


def test_follower_that_falls_silent_is_left_behind_even_if_it_is_not_late():
    followers = Followers(["dead"], timeout=0.1)
    followers.heard("dead", "run", 1000)
    time.sleep(0.2)
    assert followers.wait_for(10, "run") == ["dead"]
    assert "no sign of life" in followers.lost["dead"]


def test_follower_that_comes_back_counts_from_the_next_run_on():
    followers = Followers(["a"], timeout=0.1)
    followers.heard("a", "run", 1000)
    followers.start("run")
    time.sleep(0.2)
    assert followers.drop_silent() == ["a"]
    assert followers.unheard() == ["a"]
    followers.heard("a", "", 0)  # started again
    followers.heard("a", "run", 10)  # and finds the run under way
    assert followers.lost == {}
    assert followers.wait_for(2000, "run") == []  # is not waited for
    assert followers.not_in("") == ["a"]  # before the next run begins it must be free
    followers.heard("a", "next", 0)
    followers.start("next")
    time.sleep(0.2)
    assert followers.wait_for(2000, "next") == ["a"]


def test_acknowledgement_of_another_run_does_not_count():
    followers = Followers(["a"], timeout=10.0)
    followers.heard("a", "old", 900)
    assert followers.not_in("new") == ["a"]
    followers.heard("a", "new", 0)
    followers.heard("b", "new", 5)  # not asked for
    assert followers.not_in("new") == []
    assert followers.names == ["a"]


class Stamped:
    def __init__(self, stamp):
        time_type = message_class("builtin_interfaces/msg/Time")
        self.header = message_class("std_msgs/msg/Header")(
            stamp=time_type(sec=stamp // 10**9, nanosec=stamp % 10**9)
        )


def test_messages_of_one_stamp_come_together_and_a_gap_is_skipped():
    matcher = StampMatcher(["a", "b"])
    first, second = Stamped(1_000_000_000), Stamped(1_010_000_000)
    assert matcher.add("a", first) is None
    assert matcher.add("a", second) is None  # b of the first is lost
    other = Stamped(1_010_000_000)
    assert matcher.add("b", other) == {"a": second, "b": other}
    assert matcher.skipped == 1
    assert matcher.add("b", Stamped(1_020_000_000)) is None


def test_observation_of_messages_is_that_of_the_sample(suites):
    from rclpy.serialization import deserialize_message

    run = suites[0]["tilt_p10"]

    def messages(topic, type_name):
        return [deserialize_message(data, message_class(type_name)) for data in run.raw(topic)]

    seen = [
        observation_of(*parts)
        for parts in zip(
            messages("chaser/odom", "nav_msgs/msg/Odometry"),
            messages("target/odom", "nav_msgs/msg/Odometry"),
            messages("bench/buffer", "capture_sim/msg/BufferState"),
            strict=True,
        )
    ]
    for got, sample in zip(seen, run.samples[::10], strict=True):
        wanted = observation(sample)
        assert got.t == wanted.t
        assert got.stroke == wanted.stroke
        assert got.torsion_rate == wanted.torsion_rate
        for key in ("chaser", "chaser_rate", "target", "target_rate"):
            assert getattr(got, key) == pytest.approx(getattr(wanted, key), rel=1e-13, abs=1e-15)
