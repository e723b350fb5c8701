"""Nodes in processes of their own: kills, Ctrl-C, full disks, exit statuses."""

import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
from rig_session import FakeRig, Goal, actions_of, rig

import capture_sim
from capture_sim import load_scene, simulate
from capture_sim.commands.suite import run_suite
from capture_sim.messages.topics import CHASER_POSE
from capture_sim.recording.bag import read_bag
from capture_sim.recording.read import run_of
from capture_sim.run.run import detect
from tests.nodes.bench_processes import (
    Client,
    Started,
    fresh,
    leave,
    processes,
    statuses,
    wait_until,
)
from tests.nodes.forked import Forked, _tracing
from tests.nodes.own_domain import own_domain


def start_suite(start, out, recorder_change="", **simulator):
    """Start the whole suite; further parameters go to the simulator."""
    parameters = {"rtf": 0.0, "wait_for": "[launcher, capture_detector, recorder]", **simulator}
    return {
        "simulator": start("simulator", **parameters),
        "launcher": start("launcher"),
        "capture_detector": start("capture_detector"),
        "recorder": start("recorder", recorder_change, out=out),
    }


@pytest.fixture
def start_all(start, tmp_path):
    def start_all(recorder_change="", **simulator):
        return start_suite(start, tmp_path / "out", recorder_change, **simulator)

    return start_all


# nodes that die or stop in a run: DDS notices that after 12 s


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory):
    """Suites at the same time, each without one of its nodes since the middle of its run."""
    out = tmp_path_factory.mktemp("disturbed")
    options = {
        "simulator": {},
        "capture_detector": {"reader_timeout": 60.0},
        "recorder": {"reader_timeout": 60.0},
        "stopped": {"reader_timeout": 8.0},  # on a busy machine nodes need a while to join
    }
    suites = {}
    with ExitStack() as domains, processes(Forked) as start:
        for name, changes in options.items():
            domains.enter_context(own_domain())
            suites[name] = start_suite(start, out / name, rtf=2.0, **changes)
        for name, nodes in suites.items():
            path = out / name / "tilt_0.mcap"
            # about 1000 samples
            wait_until(lambda path=path: path.is_file() and path.stat().st_size > 300_000)
            if name == "stopped":
                nodes["capture_detector"].process.send_signal(signal.SIGSTOP)
            else:
                nodes.pop(name).process.kill()
        yield {name: (nodes, out / name / "tilt_0.mcap") for name, nodes in suites.items()}


@pytest.fixture
def suite_without(disturbed):
    """Give the suite without a node: its other nodes, which end with the test, and its file."""
    with ExitStack() as stack:

        def take(name):
            stack.callback(leave, disturbed[name][0].values())
            return disturbed[name]

        yield take


def test_killed_simulator_leaves_a_readable_file_and_the_others_go_on(suite_without):
    nodes, path = suite_without("simulator")
    for node in nodes.values():
        node.wait_for("the simulator has gone")
        assert node.end() == 1
    run = read_bag(path)
    assert not run.complete
    assert not run.damage
    whole = simulate(load_scene("tilt_0")).samples
    assert 500 < run.samples.size < whole.size
    assert run.samples.tobytes() == whole[: run.samples.size].tobytes()
    assert run.scene == load_scene("tilt_0")


@pytest.mark.parametrize("victim", ["capture_detector", "recorder"])
def test_run_goes_on_without_a_killed_participant(victim, suite_without):
    nodes, path = suite_without(victim)
    nodes["simulator"].wait_for("done, 5936 samples")
    found = statuses(nodes)
    assert found.pop("recorder", 1) == 1
    assert not any(found.values())
    if victim != "recorder":
        assert victim in nodes["recorder"].text
    run = read_bag(path)
    assert not run.complete
    assert run.samples.size > 500


def test_stopped_process_is_named_and_the_others_record_the_run(suite_without):
    nodes, path = suite_without("stopped")
    assert nodes["simulator"].status() in (0, 1), nodes["simulator"].text
    nodes["recorder"].wait_for("capture_detector: never reported")
    nodes["capture_detector"].process.kill()  # the others have lost it already
    run = read_bag(path)
    assert run.samples.size == 5936
    assert run.problems == (
        "capture_detector: never reported how many messages it sent; it may have been killed",
    )


# Ctrl-C, disks


SUITE = """
import sys
from pathlib import Path
from capture_sim import load_scene
from capture_sim.commands.suite import run_suite
try:
    run_suite([load_scene("tilt_0")], Path(sys.argv[1]), rtf=1.0)
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv of util-linux")
def test_nodes_of_a_killed_suite_end(tmp_path):
    suite = Started(fresh(SUITE, [str(tmp_path)]))
    try:
        suite.wait_for("released")
        with Client() as client:

            def nodes():
                return client.node.get_publishers_info_by_topic("/bench/roll")

            wait_until(lambda: len(nodes()) == 4)  # found one after another
            suite.process.kill()
            wait_until(lambda: not nodes(), "nodes go on")
    finally:
        leave([suite])
    assert not read_bag(tmp_path / "tilt_0.mcap").damage


def test_one_ctrl_c_ends_all_without_traceback(tmp_path):
    suite = Started(fresh(SUITE, [str(tmp_path)]))
    try:
        suite.wait_for("released")
        path = tmp_path / "tilt_0.mcap"
        wait_until(lambda: path.is_file() and path.stat().st_size > 200_000)
        assert suite.end() == 130, suite.text
    finally:
        leave([suite])
    text = suite.text
    assert "Traceback" not in text
    assert "killed" not in text  # no node had to be
    assert "interrupted" in text
    assert "undecided, run ended before any contact" in text
    run = read_bag(tmp_path / "tilt_0.mcap")
    assert not run.damage
    assert run.samples.size > 100
    # all that was sent is there, and no verdict is claimed that the run has not come to
    assert all("ended the run early" in line for line in run.problems), run.problems
    assert len(run.problems) == 3  # simulator, launcher, detector
    last = run.statuses[-1]
    assert (last.state.label, last.final) == ("undecided", False)
    assert detect(run_of(run), from_series=True)[-1] == last


_FAILS = """
def fail(self):
    raise ZeroDivisionError("of the test")
node.RecorderNode.is_complete = fail
"""


def test_a_recorder_that_fails_leaves_a_file_up_to_there(start_all, tmp_path):
    nodes = start_all(_FAILS, overrides="[run.t_end=0.5]")
    assert nodes["recorder"].status() == 1
    assert "stopped by ZeroDivisionError: of the test" in nodes["recorder"].text
    run = read_bag(tmp_path / "out" / "tilt_0.mcap")
    assert not run.damage
    assert run.samples.size == 501


_SMALL_DISK = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
"""


def test_disk_that_is_full_ends_the_recording_with_one_line_and_no_run(start_all):
    nodes = start_all(_SMALL_DISK)
    found = statuses(nodes)
    assert found == {"simulator": 0, "launcher": 0, "capture_detector": 0, "recorder": 1}
    assert "Traceback" not in nodes["recorder"].text
    assert "Error occurred at" not in nodes["recorder"].text
    (line,) = [line for line in nodes["recorder"].lines if "[ERROR]" in line]
    assert "tilt_0.mcap: cannot write: File too large" in line
    assert "done, 5936 samples" in nodes["simulator"].text  # as without a full disk


_STALLED_DISK = """
import time
from capture_sim.recording import live
from capture_sim.recording.write import RunWriter
live.STALL_LIMIT = 2.0
write = RunWriter.write
def stall(self, *message):
    if self.bag.span and self.bag.span[1] > 1_500_000_000:
        time.sleep(600.0)
    write(self, *message)
RunWriter.write = stall
"""


@pytest.mark.long
def test_stalled_disk_ends_the_recording_and_no_run(start_all):
    nodes = start_all(_STALLED_DISK)
    found = statuses(nodes)
    assert found == {"simulator": 0, "launcher": 0, "capture_detector": 0, "recorder": 1}
    assert "the disk wrote nothing for 2 s" in nodes["recorder"].text


def test_own_detector_of_the_page_misses_no_sample(start):
    example = Path(__file__).parents[2] / "examples" / "own_detector.py"
    assert len(example.read_text().splitlines()) <= 45
    detector = subprocess.Popen(
        [sys.executable, example], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        simulator = start("simulator", wait_for="[own_detector]", rtf=0.0)
        assert simulator.status() == 0, simulator.text
        text = detector.communicate(timeout=300.0)[0]
    finally:
        detector.kill()
    samples = simulate(load_scene("tilt_0")).samples
    inside = samples["tip_distance"] < 0.005
    since, count = re.search(r"captured since ([\d.]+) s; sample (\d+)", text).groups()
    start_of_dwell = samples["t"][int(count) - 1] - 0.2
    assert float(since) == pytest.approx(start_of_dwell, abs=2e-3)
    assert inside[round(float(since) * 1000) : int(count)].all()


def test_a_driver_holds_when_the_launcher_is_killed(start):
    """launcher/hold is repeated; without it, the bench stops its chaser by itself."""
    with Client() as client:
        poses = client.listen(CHASER_POSE)
        options = {"start_timeout": 120.0, "max_pose_age": 10.0, "max_hold_silence": 10.0}
        options |= {"require_recorder": False, "require_detector": False}
        launcher = start("launcher", actuator="output", scene="tilt_0", **options)
        launcher.wait_for("ready for trials")
        with rig(FakeRig, {"hold_timeout": 1.0}) as node:
            wait_until(lambda: node.armed)  # else it lets nothing go
            Goal(actions_of(client))
            wait_until(lambda: node.chaser.released is not None)
            launcher.process.kill()
            wait_until(lambda: node.chaser.released is None and node.chaser.trial == 1)
            began = node.chaser.t
            wait_until(lambda: node.chaser.t > began + 2.0)  # pulled back by then
            assert poses[-1].pose.position.x < 0.01
            assert max(pose.pose.position.x for pose in poses) < 0.2


# the command line


def test_help_shows_the_parameters_and_starts_nothing():
    command = [sys.executable, "-m", "capture_sim.nodes.simulator", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0
    for word in ("usage: simulator", 'initial_state: "playing"', "ros2 param describe /simulator"):
        assert word in done.stdout
    assert "launcher:" not in done.stdout  # another node's
    assert not re.search(r"``|:\w+:`", done.stdout)  # markup of docstrings


def test_help_into_a_closed_pipe_ends_quietly():
    command = [sys.executable, "-m", "capture_sim.nodes.capture_detector", "--help"]
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert done.returncode == 0
    assert not done.stderr


def test_suite_ends_when_a_node_refuses(tmp_path, capfd):
    (tmp_path / "out").write_text("not a folder")
    assert run_suite([capture_sim.load_scene("tilt_0")], tmp_path / "out") == (2, [])
    assert "must be a folder" in capfd.readouterr().out


# the helper of these tests


def test_a_fork_has_the_threads_that_its_exit_cancels():
    """Those of LTTng-UST, which rclpy loads: a fork without them ends with SIGSEGV now and then."""
    program = "import os\nprint(len(os.listdir('/proc/self/task')), 'threads')"
    fork = Started(Forked(program, []))
    assert fork.status() == 0, fork.text
    if _tracing() is not None:  # a system's ROS may be built without it
        assert "3 threads" in fork.text
