"""Accidents of a laboratory over DDS: each is refused, aborted or named, by a bench at fault."""

import math
import re
import shutil
import signal
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from capture_sim.action import RunTrial
from rig_session import ABORTED, SUCCEEDED, WAITS, FakeRig, Goal, Session, actions_of, rig
from std_msgs.msg import Bool

from tests.nodes.bench_client import wait_until

sys.path.append(str(Path(__file__).parents[2] / "examples"))
from fake_rig import stamped


class FaultyRig(FakeRig):
    """The example's bench with one fault, which may change while it runs."""

    fault = ""

    def send(self, publisher, message):
        camera = publisher in self.cameras
        going = self.chaser.going is not None
        offset = 0.0
        if camera:
            place = message.pose.position
            q = message.pose.orientation
            match self.fault:
                case "poses in mm":
                    place.x, place.y = 1e3 * place.x, 1e3 * place.y
                case "w first":
                    q.x, q.y, q.z, q.w = q.w, q.x, q.y, q.z
                case "zero quaternion":
                    q.x = q.y = q.z = q.w = 0.0
                case "two frames":
                    message.header.frame_id = f"camera_{self.cameras.index(publisher)}"
                case "3 s ahead":
                    offset = 3.0
                case "moves" if not going:
                    place.x += 0.01 * self.chaser.t
                case "swings" if not going and publisher is self.cameras[0]:
                    place.x += 0.008 * math.sin(2.0 * math.pi * self.chaser.t)
                case "target swings" if not going and publisher is self.cameras[1]:
                    place.y += 0.01 * math.sin(2.0 * math.pi * self.chaser.t)
                case "target pushed" if going and publisher is self.cameras[1]:
                    place.y += 0.02 * min(max(self.chaser.going - 1.0, 0.0), 0.5)
                case "names exchanged" if going and self.chaser.going > 1.0:
                    publisher = self.cameras[1 - self.cameras.index(publisher)]
                case "another origin" if going and self.chaser.going > 1.0:
                    place.x += 0.2
                case "another scene" if publisher is self.cameras[1]:
                    q.z, q.w = math.sin(math.radians(5.0)), math.cos(math.radians(5.0))
                case "stamp 0" if self.chaser.t > 1.0:
                    message.header.stamp.sec = message.header.stamp.nanosec = 0
                    publisher.publish(message)
                    return
                case "steps in flight" if going:
                    offset = -5.0
        elif publisher is self.encoders:
            hinge, slide = message.position
            match self.fault:
                case "other joints":
                    message.name = ["a", "b"]
                case "slide in mm":
                    message.position = [hinge, 1e3 * slide - 200.0]
                case "slide inverted":
                    message.position = [hinge, -slide]
                case "slide stuck":
                    message.position = [hinge, 0.0]
                case "encoders die" if going:
                    return
        if self.fault == "steady clock":
            offset = time.monotonic() - time.time()
        elif self.fault == "0.1 s late":
            offset = -0.1
        publisher.publish(stamped(message, self.epoch + self.chaser.t + offset))


#: Real time: the clocks are compared with this machine's.
LIMITS = {"waive": "[standstill, target_standstill]", "stop_timeout": 1.0, "after_verdict": 1.0}
REFUSED = {
    "poses in mm": "[rule start]",
    "w first": "refused (tilted)",
    "zero quaternion": "refused (no_pose)",
    "two frames": "refused (frames_differ)",
    "3 s ahead": "refused (clock_offset)",
    "slide in mm": "[rule buffer_rest]",
    "steady clock": "[rule machine_clock]",
}
#: ... of a laboratory that waives nothing: what a source did before tells nothing of the present.
REFUSED_AT_LAST = {
    "swings": "the chaser moves by ",
    "target swings": "the target moves by ",
    "another scene": "this is nearer to the start of tilt_p10",
    "stamp 0": "refused (stamps_unset)",
    "other joints": "joint_states: messages without a measurement: ",
}
#: The approach ends at once.
ABORTED_AT_ONCE = {
    "names exchanged": "as no body can",
    "another origin": "jumped by 2",
}
#: ... with the reason and a problem, which the file shows.
UNDECIDED = {
    "slide inverted": ("refused (buffer_against_poses)",) * 2,
    "slide stuck": ("refused (buffer_against_poses)",) * 2,
    "encoders die": ("tip never came ", "joint_states: no measurement from "),
}


@pytest.fixture
def session(start, client, tmp_path):
    return Session(start, client, tmp_path, launcher=LIMITS)


@contextmanager
def goal_at(session, fault):
    """Give a goal for a bench with a fault."""
    bench = {"pace": 1.0, "rate": 100.0, "hold_timeout": 60.0}
    with rig(FaultyRig, bench) as node:
        node.fault = fault
        wait_until(lambda: node.armed)
        session.stamps.clear()
        wait_until(lambda: len(session.stamps) > 200)  # the rules look at 2 s
        yield Goal(session.actions, name=fault)


def tried(session, fault):
    """Return status and result of a trial of a bench with a fault."""
    with goal_at(session, fault) as goal:
        return goal.result()


def refused(session, fault, words):
    """Try a bench with a fault: the launcher says so, and does not let go."""
    let_go = session.let_go
    with goal_at(session, fault) as goal:
        goal.refusal(words)
    assert session.let_go == let_go, fault


def test_what_is_wrong_before_a_release_refuses_it(session):
    for fault, words in REFUSED.items():
        refused(session, fault, words)


def test_what_moves_or_is_elsewhere_or_gives_nothing_is_not_let_go(start, client, tmp_path):
    session = Session(start, client, tmp_path, launcher=LIMITS | {"waive": "[]"})
    for fault, words in REFUSED_AT_LAST.items():
        refused(session, fault, words)


def test_a_jump_in_flight_ends_the_approach_and_a_moved_target_is_named(session):
    for fault, words in ABORTED_AT_ONCE.items():
        status, result = tried(session, fault)
        assert (status, result.verdict, result.complete) == (ABORTED, "undecided", False), fault
        assert words in result.reason, (fault, result.reason)
        assert session.verdicts[-1] == ("undecided", True)
    _, result = tried(session, "target pushed")
    assert math.isnan(result.impact_speed)
    assert any("target: moved by " in problem for problem in result.problems)


def test_the_emergency_stop_holds_and_decides_nothing(start, client, tmp_path):
    limits = LIMITS | {"waive": "[]", "require_emergency_stop": True}
    session = Session(start, client, tmp_path, launcher=limits)
    refused(session, "", "emergency_stop: unknown, no message")
    button = client.node.create_publisher(Bool, "emergency_stop", 10)
    is_pressed, over = [True], threading.Event()

    def publish():
        while not over.wait(0.1):
            button.publish(Bool(data=is_pressed[0]))

    sender = threading.Thread(target=publish, daemon=True)
    sender.start()
    try:
        refused(session, "", "emergency_stop: pressed")
        is_pressed[0] = False
        with rig(FaultyRig, {"hold_timeout": 60.0}) as node:
            wait_until(lambda: node.armed)
            goal = Goal(session.actions)
            goal.await_phase(RunTrial.Feedback.APPROACH)
            wait_until(lambda: node.chaser.x > 0.05)
            is_pressed[0] = True
            status, result = goal.result()
        assert (status, result.verdict) == (ABORTED, "undecided")
        assert "emergency_stop: pressed" in result.reason
        assert session.verdicts[-1] == ("undecided", True)
        assert session.let_go == 1
    finally:
        over.set()
        sender.join()


def test_a_file_that_is_gone_or_has_holes_is_not_complete(session):
    def tried_while(meddle):
        with rig(FaultyRig, {"hold_timeout": 60.0}) as node:
            wait_until(lambda: node.armed)
            goal = Goal(session.actions)
            goal.await_phase(RunTrial.Feedback.APPROACH)
            meddle()
            return goal.result()[1]

    def stand_still():
        session.recorder.process.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        session.recorder.process.send_signal(signal.SIGCONT)

    result = tried_while(lambda: shutil.rmtree(session.folder))
    assert not result.complete
    assert any("is gone" in problem or "No such file" in problem for problem in result.problems)
    result = tried_while(stand_still)
    assert not result.complete
    assert any("no measurement from " in problem for problem in result.problems)


def test_a_chaser_that_moves_is_not_let_go_and_late_stamps_are_no_fault(start, client, tmp_path):
    session = Session(start, client, tmp_path, launcher=LIMITS | {"waive": "[]"})
    refused(session, "moves", "the chaser moves by ")
    status, result = tried(session, "0.1 s late")
    assert (status, result.complete) == (SUCCEEDED, True), (result.reason, result.problems)
    for node in (session.launcher, session.detector):
        assert "behind" not in node.text


def test_who_must_take_part_is_named_when_absent(start, client):
    options = {"scene": "tilt_0", "actuator": "output", **LIMITS, **WAITS}
    launcher = start("launcher", **options)
    launcher.wait_for("ready for trials")
    with rig(FakeRig, {"pace": 1.0, "hold_timeout": 60.0}) as node:
        wait_until(lambda: node.armed)
        Goal(actions_of(client)).refusal("no recorder ", "no capture_detector ")
        assert node.chaser.released is None


@pytest.mark.parametrize(
    "fault",
    [pytest.param(each, marks=[pytest.mark.long] * (n > 0)) for n, each in enumerate(UNDECIDED)],
)
def test_what_goes_wrong_in_flight_is_named(fault, start, client, tmp_path):
    reason, problem = UNDECIDED[fault]
    session = Session(start, client, tmp_path, launcher=LIMITS | {"time_limit": 8.0})
    _, result = tried(session, fault)
    assert result.verdict == "undecided", result.reason
    assert reason in result.reason, result.reason
    assert any(problem in each for each in result.problems), list(result.problems)
    assert session.verdicts[-1] == ("undecided", True)
    assert not result.complete
    assert result.recording


@pytest.mark.long
def test_a_clock_that_steps_in_flight_ends_the_trial(session):
    status, result = tried(session, "steps in flight")
    assert status == ABORTED
    step = float(re.search(r"clock stepped by (-[\d.]+) s", result.reason)[1])
    assert abs(step + 5.0) < 1.0  # with the delay of a busy machine
    assert session.holds[-1][1]


class DeafRig(FaultyRig):
    """Its driver ignores a hold that comes while the chaser moves."""

    def on_hold(self, message):
        if self.fault == "deaf" and self.chaser.going is not None:
            return
        super().on_hold(message)


def test_a_driver_that_ignores_the_hold_is_an_alarm(session, client):
    with rig(DeafRig, {"hold_timeout": 60.0}) as node:
        node.fault = "deaf"
        wait_until(lambda: node.armed)
        session.stamps.clear()
        wait_until(lambda: len(session.stamps) > 100)
        goal = Goal(session.actions)
        goal.await_phase(RunTrial.Feedback.APPROACH)
        wait_until(lambda: node.chaser.x > 0.05)
        goal.cancel()
        goal.result()
        session.launcher.wait_for("its driver does not hold it")
        assert math.isfinite(node.chaser.x)
        Goal(session.actions).refusal("its driver does not hold it")
        node.fault = ""  # mended; it hears the hold, and is pulled back
        session.launcher.wait_for("the chaser is at rest at its start again")
        assert session.let_go == 1
