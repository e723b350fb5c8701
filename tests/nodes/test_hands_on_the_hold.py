"""One hand on launcher/hold: a launcher that finds another publisher of it lets nothing go."""

from capture_sim.action import RunTrial
from rig_session import ABORTED, SUCCEEDED, Session
from std_msgs.msg import Bool

from capture_sim.messages.topics import HOLD
from capture_sim.nodes.base.endpoints import TRANSIENT_LOCAL
from tests.nodes.bench_client import wait_until

#: Loads a node, whose DDS begins once a file is there: a busy machine's node loads for long.
LATER = """
import time
from pathlib import Path
while not Path({!r}).exists():
    time.sleep(0.01)
"""


def test_a_second_publisher_refuses_and_aborts(start, client, tmp_path):
    session = Session(start, client, tmp_path)
    begun = tmp_path / "begun"
    other = start(
        "launcher", LATER.format(str(begun)), actuator="output", scene="tilt_0", __node="lab2"
    )
    with session.bench(is_disturbed=False, pace=1.0):
        # a launcher of another bench whose hold is remapped to this one's, in flight
        goal = session.goal(0.0)
        goal.await_phase(RunTrial.Feedback.APPROACH)
        begun.touch()
        status, result = goal.result()
        assert status == ABORTED
        assert "launcher/hold: published by /launcher and by /lab2: must be one" in result.reason
        wait_until(lambda: session.holds[-1][1])
        let_go = session.let_go
        assert let_go <= 2  # the other one's true and a false that was under way may have crossed
        # ... and before a goal
        session.goal().refusal("published by /launcher and by /lab2")
        assert other.end() == 0
        # a publisher that is no launcher
        plain = client.node.create_publisher(Bool, HOLD, TRANSIENT_LOCAL)
        session.goal(0.0).refusal("published by /launcher and by /experimenter")
        client.node.destroy_publisher(plain)
        goal = session.goal(0.0)
        goal.await_phase(RunTrial.Feedback.APPROACH)
        plain = client.node.create_publisher(Bool, HOLD, TRANSIENT_LOCAL)
        status, result = goal.result()
        assert "published by /launcher and by /experimenter" in result.reason
        assert let_go < session.let_go <= let_go + 2
        client.node.destroy_publisher(plain)
        status, result = session.goal().result()
        assert (status, result.verdict, result.complete) == (SUCCEEDED, "captured", True)
    assert session.launcher.text.count("launcher/hold: published by") >= 4


def test_two_launchers_of_one_name_let_nothing_go(start, client, tmp_path):
    session = Session(start, client, tmp_path, launchers=2)
    with session.bench(is_disturbed=False):
        session.goal(0.0).refusal("published by /launcher and by /launcher")
        session.wait(5.0)
    assert session.let_go == 0
