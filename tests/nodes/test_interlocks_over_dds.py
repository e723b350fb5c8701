"""Interlocks of a trial over DDS: the client that listens, and launcher/hold without gaps."""

import re
import subprocess
import sys
from contextlib import ExitStack

from capture_sim.action import RunTrial
from rig_session import SUCCEEDED, Goal, Session, asked

from tests.nodes.bench_client import wait_until

#: Makes the launcher count what it does between two looks at launcher/hold, and what no approach
#: has room for: scenes that are loaded and kernels that are compiled.
WATCHED = """
from numba.core import event
from capture_sim.trial import hold
from capture_sim.nodes.trials import bench as trial_bench, server as trial_server

compiled, loaded, between = event.RecordingListener(), [], []
count = [0, True]  # callbacks since launcher/hold was looked at; whether it holds
event.register("numba:compile", compiled)

class Watched(hold.HoldOutput):
    def update(self, is_held, now):
        if not (is_held and count[1]):
            between.append(count[0])
        count[:] = 0, is_held
        super().update(is_held, now)

serve, load, work = node.LauncherNode.serve, trial_server.load_requested, node.LauncherNode.work

def counted(self, limit=0.0):
    count[0] += 1
    serve(self, limit)

def noted(*arguments, **options):
    loaded.append(count[1])
    return load(*arguments, **options)

def watch(self):
    compiled.buffer.clear()
    try:
        return work(self)
    finally:
        print("\\nlooks", len(between), "most callbacks", max(between), "scenes", len(loaded),
            "let go", loaded.count(False), "kernels", len(compiled.buffer), flush=True)

node.LauncherNode.serve, node.LauncherNode.work = counted, watch
trial_bench.HoldOutput, trial_server.load_requested = Watched, noted
"""


def test_no_release_before_the_client_asks_for_the_result(start, client, tmp_path):
    """A client that has not got the response to its goal could neither watch nor cancel it."""
    session = Session(start, client, tmp_path, launcher={"start_timeout": 600.0})
    with session.bench():
        feedback = []
        sent = asked(
            session.actions,
            session.actions.send_goal_async,
            RunTrial.Goal(scene="tilt_0"),
            feedback_callback=lambda message: feedback.append(message.feedback),
        )
        wait_until(sent.done, "no response to a goal")
        wait_until(lambda: feedback and feedback[-1].waiting_for.startswith("client: has not"))
        session.wait(3.0)
        assert session.let_go == 0
        assert {each.phase for each in feedback} == {RunTrial.Feedback.PREPARING}
        result = asked(session.actions, sent.result().get_result_async)
        wait_until(result.done, "no result of a goal")
        assert (result.result().status, session.let_go) == (SUCCEEDED, 1)


def test_a_client_that_never_asks_for_the_result(start, client, tmp_path):
    session = Session(start, client, tmp_path, launcher={"require_client": "false"})
    with session.bench():
        asked(session.actions, session.actions.send_goal_async, RunTrial.Goal(scene="tilt_0"))
        wait_until(lambda: session.let_go == 1)


def test_hold_is_looked_at_in_every_callback_on_a_busy_machine(start, client, tmp_path):
    """How late a message can be for it is in tests/trial/test_hold.py, on a simulated clock."""
    session = Session(start, client, tmp_path, change=WATCHED)
    with session.bench(), ExitStack() as stack:
        for _ in range(4):
            burner = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(burner.wait)
            stack.callback(burner.kill)
        goal = Goal(session.actions, name="watched", scene="tilt_0")
        goal.result()
        # while it holds: scenes that are loaded, parameters that are read
        for scene in ("tilt_p10", "nothing", "paper_designed"):
            client.set("launcher", speed_tolerance=0.3)
            session.goal(0.0, scene=scene).cancel()
    assert session.launcher.end() == 0
    pattern = r"looks (\d+) most callbacks (\d+) scenes (\d+) let go (\d+) kernels (\d+)"
    found = re.search(pattern, session.launcher.text)
    assert found, session.launcher.text
    looks, most, scenes, let_go, compiled = map(int, found.groups())
    assert looks > 10
    assert most < 20  # a timer looks at it as well: a few of other topics may come before its turn
    assert scenes > 1  # a goal is rejected until the one before is over
    assert (let_go, compiled) == (0, 0)
