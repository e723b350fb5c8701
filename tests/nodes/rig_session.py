"""Trials of the example's bench: nodes that serve them, an operator, and the bench itself."""

import itertools
import re
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

from action_msgs.msg import GoalStatus
from capture_sim.action import RunTrial
from geometry_msgs.msg import WrenchStamped
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import Bool
from threads import wait_until

from capture_sim.cli import main
from capture_sim.hardware.messages import stamp_of

EXAMPLES = Path(__file__).parents[2] / "examples"
STREAMS = ["/joint_states", "/load_cell/wrench", "/launcher/command", "/launcher/hold"]
STREAMS += ["/capture/status", "/capture/criteria"]
POSES = ["/motion_capture/chaser", "/motion_capture/target"]
#: Speed of the bench's clock compared with ours, except in tests of the clocks.
PACE = 3.0
#: After the chaser was held, the bench has pulled it back by then, s of the bench.
BACK = 2.0
SUCCEEDED, CANCELED, ABORTED = (
    *(GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_ABORTED),
)


def asked(actions, send, *arguments, **options):
    """Return the answer to a request that is sent in the thread of the client's callbacks.

    From another one, rclpy may have the answer before it has noted the request, and drops it.
    """
    task = actions._node.executor.create_task(lambda: send(*arguments, **options))
    wait_until(task.done, "a request was not sent")
    return task.result()


class Goal:
    """A goal of launcher/run_trial, as an rclpy client sends it."""

    def __init__(self, actions, **fields):
        self.feedback = []
        self._actions = actions
        sent = asked(
            actions,
            actions.send_goal_async,
            RunTrial.Goal(**fields),
            feedback_callback=lambda message: self.feedback.append(message.feedback),
        )
        wait_until(sent.done, "no response to a goal")
        self._handle = sent.result()
        self.accepted = self._handle.accepted
        if self.accepted:
            self._result = asked(actions, self._handle.get_result_async)

    @property
    def is_over(self):
        return self._result.done()

    def await_phase(self, phase):
        wait_until(
            lambda: self.is_over or any(f.phase >= phase for f in self.feedback),
            f"never in phase {phase}",
        )

    def cancel(self):
        answer = asked(self._actions, self._handle.cancel_goal_async)
        wait_until(answer.done, "no response to a cancel")

    def result(self):
        """Wait for the end; return the goal's status and the result."""
        wait_until(self._result.done, "no result of a goal")
        answer = self._result.result()
        return answer.status, answer.result


def actions_of(client):
    """Return an action client of launcher/run_trial."""
    actions = ActionClient(client.node, RunTrial, "/launcher/run_trial")
    assert actions.wait_for_server(60.0)
    client.await_answers_of("/launcher")
    return actions


class Session:
    """Nodes that serve one trial after the other."""

    def __init__(
        self,
        start,
        client,
        folder,
        *,
        actuator="output",
        poses=POSES,
        launcher=None,
        launcher_change="",
        **options,
    ):
        self.client, self.folder = client, folder
        streams = f"[{', '.join([*poses, *STREAMS])}]"
        self.detector = start("capture_detector", **options)
        self.recorder = start("recorder", out=folder, topics=streams, **options)
        # a busy machine is no dead camera: 0.3 s is for the tests of this limit
        settings = {"scene": "tilt_0", "start_timeout": 5.0, "after_verdict": 0.3}
        settings |= {"max_pose_age": 1.0, "max_hold_silence": 5.0}
        settings |= launcher or {}
        self.launcher = start("launcher", launcher_change, actuator=actuator, **settings | options)
        self.launcher.wait_for("ready for trials")
        self.detector.wait_for("ready")
        self.recorder.wait_for("ready")
        self.holds = []  # s (wall) and value of launcher/hold
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        client.node.create_subscription(
            Bool,
            "launcher/hold",
            lambda message: self.holds.append((time.monotonic(), message.data)),
            latched,
        )
        self.stamps = []  # s by the bench's clock, of the load cell, which never falls silent
        client.node.create_subscription(
            WrenchStamped,
            "load_cell/wrench",
            lambda sample: self.stamps.append(stamp_of(sample)),
            qos_profile_sensor_data,
        )
        self.actions = actions_of(client)

    @contextmanager
    def bench(self, *remaps, script="disturbed_rig.py", pace=PACE, **disturbances):
        """Run the bench, disturbed."""
        disturbances = {"pace": pace, "hold_timeout": 5.0, **disturbances}
        values = [w for key, value in disturbances.items() for w in ("-p", f"{key}:={value}")]
        command = [sys.executable, str(EXAMPLES / script), "--ros-args", *values, *remaps]
        rig = subprocess.Popen(command)
        try:
            self.stamps.clear()
            wait_until(lambda: self.stamps or rig.poll() is not None)
            assert rig.poll() is None, "the bench has ended"
            yield
        finally:
            rig.kill()  # plain rclpy may not come to its end: see capture_sim.interrupts.end_within
            rig.wait()

    def wait(self, seconds):
        """Wait by the bench's clock (s), which is slower than its pace on a busy machine."""
        end = self.stamps[-1] + seconds
        wait_until(lambda: self.stamps[-1] >= end)

    def goal(self, after=BACK, **fields):
        """Send a goal once the chaser is back."""
        if self.stamps:
            self.wait(after)
        return Goal(self.actions, **fields)

    @property
    def let_go(self):
        """How often the chaser was let go."""
        values = [True, *(value for _, value in self.holds)]
        return sum(a and not b for a, b in itertools.pairwise(values))

    def try_outcomes(self, capfd, *outcomes):
        """Run a trial for each outcome; live and by `detect` it is that one."""
        for outcome in outcomes:
            status, result = self.goal(expected=outcome).result()
            assert (status, result.verdict) == (SUCCEEDED, outcome), self.launcher.text
            assert result.as_expected
            assert result.complete, list(result.problems)
            check(result.verdict, result.recording, capfd)
        return Path(result.recording)


def check(verdict, path, capfd, *options):
    """Return what `detect` prints, which must be the live verdict, at the same time."""
    assert main(["detect", str(path), *options]) == 0, capfd.readouterr()
    printed = capfd.readouterr().out
    (found,) = re.findall(r"verdict: (\w+) since", printed)
    assert found == verdict
    assert printed.rstrip().endswith("the same")  # within 0.1 s
    return printed
