"""Trials of a real bench over DDS: nothing moves that was not asked to.

What disturbed sensors do to the verdict is in tests/trial/test_disturbed_trials.py, each limit of
a trial in tests/trial/test_trial.py, both on a simulated clock.
"""

import json
import math
import re

import pytest
from capture_sim.action import RunTrial
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rig_session import ABORTED, CANCELED, STIFFNESS, STROKE, SUCCEEDED, Goal, Session, check, rig
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from capture_sim import load_scene, simulate
from capture_sim.messages.topics import CHASER_POSE, HOLD, RUN_INFO
from capture_sim.nodes.base.endpoints import TRANSIENT_LOCAL
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import write_run
from tests.nodes.bench_client import wait_until

OUTCOMES = ("captured", "rebound", "missed")
#: The topics of a driver that publishes Odometry, by the bench's names.
ODOMETRY = {"chaser/odom": "/mocap/rb1/odom", "target/odom": "/mocap/rb2/odom"}


def test_a_session_of_trials(start, client, tmp_path, capfd):
    # on a busy machine the rig is late; what ends a late trial is tried elsewhere
    session = Session(start, client, tmp_path, launcher={"speed_tolerance": 10.0})
    waiting = session.goal(name="waiting")  # for a bench
    assert not Goal(session.actions, name="second", scene="tilt_0").accepted
    session.launcher.wait_for("goal second: rejected, waiting is on")
    waiting.refusal("no publisher")
    with session.bench(is_disturbed=False, outcomes=f"[{', '.join(OUTCOMES)}]"):
        for outcome in OUTCOMES:
            released = session.let_go
            goal = session.goal(name=f"c_{outcome}", note="a note", expected="captured")
            goal.await_phase(RunTrial.Feedback.APPROACH)
            status, result = goal.result()
            assert (status, result.verdict) == (SUCCEEDED, outcome), session.launcher.text
            assert result.as_expected is (outcome == "captured")
            phases = [feedback.phase for feedback in goal.feedback]
            assert phases == sorted(phases)
            gaps = [f.gap for f in goal.feedback if f.phase == RunTrial.Feedback.APPROACH]
            assert gaps[0] > 0.1
            wait_until(lambda: session.holds[-1][1])
            assert session.let_go == released + 1
            if outcome != "missed":
                # on a busy machine poses get lost, and the speed is then not measured
                expected_speed = pytest.approx(0.105, rel=0.1)
                assert result.impact_speed == expected_speed or math.isnan(result.impact_speed)
                # ... and the peak of the stroke may be lost: the bench keeps ten messages
                assert 0.0 < result.max_stroke < STROKE * 1.05
                assert result.max_force > 0.5 * STIFFNESS * STROKE
            assert result.complete, list(result.problems)
            assert result.recording == str(tmp_path / f"c_{outcome}.mcap")
            check(outcome, result.recording, capfd)
            run = read_bag(result.recording)
            assert run.problems == ()
            assert run.log_times(CHASER_POSE)[0] >= run.log_times(RUN_INFO)[0]
    rows = json.loads((tmp_path / "results.json").read_text())
    assert [(row["recording"], row["verdict"]) for row in rows] == [
        (f"c_{outcome}.mcap", outcome) for outcome in OUTCOMES
    ]
    assert len((tmp_path / "results.txt").read_text().splitlines()) >= len(OUTCOMES)


# S1: only a goal releases


def test_simulator_and_replay_let_nothing_go(start, client, tmp_path):
    """Idle or in a trial; the recorded run contains the release of a simulated chaser."""
    scene = load_scene("tilt_0", ["run.t_end=1.0"])
    recording = write_run(simulate(scene), tmp_path / "simulated" / "tilt_0.mcap")
    session = Session(start, client, tmp_path, launcher={"after_verdict": 600.0})
    wait_until(lambda: session.holds)

    def play_both(*, beside_a_trial=False):
        # beside a trial they end once they discover it: on a busy machine during the run
        rtf = 0.5 if beside_a_trial else 0.0
        kept = {"exit_when_done": "false"} if beside_a_trial else {}  # it ends all the same
        simulator = start("simulator", overrides="[run.t_end=1.0]", rtf=rtf, **kept)
        assert simulator.status() == int(beside_a_trial), simulator.text
        player = start("player", bag=recording, rtf=rtf)
        assert player.status() == int(beside_a_trial), player.text
        for node in (simulator, player):
            line = "in a trial of a real bench: nothing else may publish"
            assert (line in node.text) is beside_a_trial

    play_both()
    assert session.let_go == 0  # idle
    with session.bench(is_disturbed=False, pace=1.0):
        goal = session.goal(0.0, name="live")
        goal.await_phase(RunTrial.Feedback.APPROACH)
        play_both(beside_a_trial=True)
        goal.await_phase(RunTrial.Feedback.DECIDED)
        goal.cancel()
        status, result = goal.result()
        assert (status, result.verdict) == (CANCELED, "captured"), session.launcher.text
        assert result.problems == ["launcher ended the run early: cancelled"]
    wait_until(lambda: session.holds[-1][1])
    assert session.let_go == 1
    for source in ("simulation", "replay"):
        session.launcher.wait_for(f"announces tilt_0 ({source}): ignored")
    # once for each announcer; beside a trial one announces only before it has discovered the trial
    assert 2 <= session.launcher.text.count("ignored, only a goal of ~/run_trial") <= 4


def test_a_replay_of_a_trial_plays_no_hold(start, client, tmp_path):
    """The recording of a trial contains launcher/hold, by which a driver would let go."""
    session = Session(start, client, tmp_path)
    with session.bench(is_disturbed=False):
        _, result = session.goal(0.0).result()
    assert "/launcher/hold" in read_bag(result.recording).types
    session.launcher.end()
    player = start("player", bag=result.recording, rtf=0.0, paused="true")

    def publishers(topic):
        ends = client.node.get_publishers_info_by_topic(topic)
        return {end.node_name for end in ends}

    # the roll's publisher is the last one that a node makes
    wait_until(lambda: "player" in publishers("/bench/roll"), "the player was not found")
    assert "player" in publishers("/load_cell/wrench")
    assert "player" not in publishers(f"/{HOLD}")
    assert client.ask(Trigger, "/player/resume").success
    assert player.status() == 0
    assert "/launcher/hold: not played" in player.text


# S2: interlocks


def test_no_release_without_fresh_measurements(start, client, tmp_path):
    session = Session(start, client, tmp_path, launcher={"start_timeout": 1.0})
    goal = session.goal(name="blind")
    status, result = goal.result()
    assert (status, result.verdict) == (ABORTED, "")
    assert result.reason.startswith(
        "not released after 1 s: motion_capture/chaser or chaser/odom: "
    )
    assert result.reason.count("no measurement, no publisher") == 3
    assert any("no publisher" in feedback.waiting_for for feedback in goal.feedback)
    assert math.isnan(result.impact_speed)
    # of another type than it must be
    client.node.create_publisher(Bool, "motion_capture/chaser", 10)
    client.await_answers_of("/launcher")
    _, result = session.goal().result()
    assert "experimenter publishes std_msgs/msg/Bool, not geometry_msgs/msg/Pose" in result.reason
    assert session.let_go == 0
    assert list(tmp_path.glob("*.mcap")) == []  # nothing was announced


class Driver(Node):
    qos = TRANSIENT_LOCAL

    def __init__(self, **options):
        super().__init__("driver", **options)
        self.create_subscription(Bool, HOLD, lambda message: None, self.qos)


class DriverWithDeadline(Driver):
    """No publisher without a deadline of its own serves it."""

    qos = QoSProfile(depth=1, deadline=Duration(seconds=0.5))


def test_no_release_without_the_driver(start, client, tmp_path):
    """The recorder and the experimenter read launcher/hold, and are not the driver."""
    session = Session(start, client, tmp_path, launcher={"driver": "driver"})
    with session.bench(pace=1.0):
        goal = session.goal(0.0)
        reason = "launcher/hold: not read by driver"
        wait_until(
            lambda: goal.is_over or (goal.feedback and goal.feedback[-1].waiting_for == reason)
        )
        session.wait(1.0)
        with rig(DriverWithDeadline, {}):
            wait_until(
                lambda: (
                    goal.is_over
                    or f"{reason} (/driver requests another" in goal.feedback[-1].waiting_for
                )
            )
        assert (goal.is_over, session.let_go) == (False, 0)
        with rig(Driver, {}):
            goal.await_phase(RunTrial.Feedback.APPROACH)
        status, result = goal.result()  # it has left in the approach
        assert (status, result.reason) == (ABORTED, reason)
        wait_until(lambda: session.holds[-1][1])
        assert session.let_go == 1


def test_a_node_of_the_suite_is_no_driver(start, client, tmp_path):
    session = Session(start, client, tmp_path, launcher={"driver": "recorder"})
    with session.bench():
        session.goal(0.0).refusal("launcher/hold: not read by recorder")
    assert session.let_go == 0


def test_cameras_that_die_under_way_hold_the_chaser(start, client, tmp_path):
    settings = {"start_timeout": 120.0, "max_pose_age": 0.5}
    session = Session(start, client, tmp_path, launcher=settings)
    with session.bench(camera_end=1.0, pace=1.0):
        status, result = session.goal(0.0).result()
        assert (status, session.let_go) == (ABORTED, 1)
        silent = r"motion_capture/(?:chaser|target): last measurement ([\d.]+) s old"
        assert float(re.match(silent, result.reason)[1]) >= 0.5  # a busy launcher looks later
        assert session.holds[-1][1]
        session.launcher.wait_for("aborted: motion_capture")
        assert session.launcher.text.count("aborted: motion_capture") == 1


def test_two_sources_of_one_sensor_refuse(start, client, tmp_path):
    session = Session(start, client, tmp_path)
    with session.bench():
        client.node.create_publisher(PoseStamped, "motion_capture/chaser", 10)
        session.goal(0.0).refusal("published by /experimenter and /fake_rig: must be one node")
    assert session.let_go == 0


# S3: by hand


def test_by_hand_with_poses_that_begin_late(start, client, tmp_path):
    """Let go by hand; the poses begin when the vehicle is captured already."""
    session = Session(start, client, tmp_path, actuator="none")
    hold = client.node.create_publisher(Bool, HOLD, TRANSIENT_LOCAL)
    assert session.holds == []
    with session.bench(camera_begin=5.0, outcomes="[captured]") as rig:
        goal = session.goal(0.0, name="by hand")
        goal.await_phase(RunTrial.Feedback.APPROACH)
        while not rig.armed:  # before it has heard a true no bench lets go
            hold.publish(Bool(data=True))
            session.wait(0.1)
        while not goal.is_over:  # as an operator with a button does
            hold.publish(Bool(data=False))
            session.wait(0.3)
        status, result = goal.result()
    assert (status, result.verdict) == (SUCCEEDED, "captured"), session.launcher.text
    assert "aborted" not in session.launcher.text
    assert math.isnan(result.impact_speed)
    assert result.recording == str(tmp_path / "by_hand.mcap")
    assert read_bag(result.recording).announced.waived == ("machine_clock", "start")


# goals


def test_cancel_and_bad_goals(start, client, tmp_path):
    session = Session(start, client, tmp_path)
    with session.bench(pace=1.0):
        for fields, words in (
            ({"scene": "/etc/passwd"}, "scene = '/etc/passwd': must be"),
            ({"scene": "a: [\n"}, "not valid YAML"),
            ({"expected": "good"}, "expected = 'good': must be empty or one of captured"),
            ({"name": "a\x1b[31m"}, "name: must be at most 200 printable characters"),
        ):
            status, result = session.goal(0.0, **fields).result()
            assert status == ABORTED
            assert words in result.reason
            assert "root" not in result.reason
        goal = session.goal(0.0, scene=load_scene("tilt_p10").to_yaml(), name="own scene")
        goal.await_phase(RunTrial.Feedback.APPROACH)
        goal.cancel()
        wait_until(lambda: session.holds[-1][1])
        status, result = goal.result()
        assert (status, result.reason) == (CANCELED, "cancelled")
        assert session.let_go == 1
        assert result.recording == str(tmp_path / "own_scene.mcap")
        assert read_bag(result.recording).scene.name == "tilt_p10"
        # Ctrl-C is a cancel too: it holds, and closes the file
        goal = session.goal(name="last")
        goal.await_phase(RunTrial.Feedback.APPROACH)
        assert session.launcher.end() == 0
        status, result = goal.result()
        assert (status, result.reason) == (ABORTED, "launcher interrupted")
        assert result.recording == str(tmp_path / "last.mcap")
        wait_until(lambda: session.holds[-1][1])
        session.recorder.wait_for("last.mcap: ")


INTERRUPTED = """
from capture_sim.nodes.protocol.roll import Roll
def interrupt(self):
    raise KeyboardInterrupt
Roll.await_heard = interrupt
"""


def test_a_goal_that_comes_with_ctrl_c_gets_a_result(start, client, tmp_path):
    session = Session(start, client, tmp_path, change=INTERRUPTED)  # before the trial begins
    status, result = session.goal().result()
    assert (status, result.reason) == (ABORTED, "launcher interrupted")
    assert session.launcher.status() == 0


# sensors of other kinds, and a full disk


def test_best_effort_odometry_under_other_names(start, client, tmp_path, capfd):
    poses = [f"/{name}" for name in ODOMETRY]
    session = Session(start, client, tmp_path, poses=poses, **ODOMETRY)
    with session.bench(ODOMETRY, preset="hard", odometry=True, hidden=0.1, outcomes="[captured]"):
        path = session.try_outcomes(capfd, "captured")
    session.launcher.wait_for("best effort")
    named = [word for pair in ODOMETRY.items() for word in ("--remap", ":=".join(pair))]
    check("captured", path, capfd, *named)


def test_diagnostics_of_the_sources(start, client, tmp_path):
    session = Session(start, client, tmp_path)
    found = {}

    def take(array):
        for status in array.status:
            found[status.name] = status

    client.subscribe("diagnostic_msgs/msg/DiagnosticArray", "diagnostics", take)
    name = "capture_detector: /motion_capture/chaser"
    wait_until(lambda: name in found)
    assert found[name].message == "no publisher"

    def values_of(name):
        return {value.key: value.value for value in found[name].values}

    def offset():
        clocks = [
            float(values_of(source).get("clock offset [s]", math.nan))
            for source in ("capture_detector: /joint_states", name)
        ]
        return clocks[0] - clocks[1]

    with session.bench(pace=1.0, rate=100.0, encoder_offset=0.1, preset="standard"):
        wait_until(lambda: name in found and found[name].level == b"\0")
        wait_until(lambda: offset() == pytest.approx(0.1, abs=0.05))
        values = values_of(name)
        assert float(values["rate [Hz]"]) > 0.0
        assert values["published by /fake_rig"] == "reliable, volatile"
        own = "launcher: release"  # its encoders' clock is within the bound
        wait_until(lambda: own in found and found[own].level == b"\0", lambda: str(found[own]))
        assert values_of(own)["waived rules"] == "machine_clock, start"
    found.clear()
    wait_until(lambda: name in found and found[name].message == "no publisher")
    wait_until(lambda: own in found and found[own].level == b"\1")
    with session.bench(pace=1.0, rate=100.0, encoder_offset=0.4):
        wait_until(lambda: "clock_offset" in found[own].message, lambda: str(found[own]))
        source = "capture_detector: /joint_states"
        wait_until(lambda: found[source].message.startswith("clock +0.4"))
        assert found[source].level == b"\1"


FILLED_UP = """
import errno
from pathlib import Path
from capture_sim.recording.bag_file import BagFile
add = BagFile.add
def fill_up(self, topic, time, *message):
    if self.span and time - self.span[0] > 3 * 10**8 and Path("{full}").exists():
        raise OSError(errno.EFBIG, "File too large")
    return add(self, topic, time, *message)
BagFile.add = fill_up
"""


def test_a_full_disk_is_in_the_result(start, client, tmp_path):
    full = tmp_path / "full"
    full.touch()
    session = Session(start, client, tmp_path, recorder_change=FILLED_UP.format(full=full))
    with session.bench(outcomes="[captured, rebound]"):
        status, result = session.goal(0.0).result()
        assert (status, result.verdict, result.complete) == (SUCCEEDED, "captured", False)
        assert any("cannot write: File too large" in problem for problem in result.problems)
        full.unlink()
        _, result = session.goal().result()
        assert (result.verdict, result.complete) == ("rebound", True)
