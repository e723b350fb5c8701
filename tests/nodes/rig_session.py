"""Trials of the example's bench: nodes that serve them, an operator, and the bench itself."""

import itertools
import re
import sys
import threading
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from action_msgs.msg import GoalStatus
from capture_sim.action import RunTrial
from rclpy.action import ActionClient
from rclpy.experimental import EventsExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data

from capture_sim.cli import main
from capture_sim.detection.criteria import CaptureState
from capture_sim.hardware.messages import stamp_of
from tests.nodes.bench_client import ros_arguments, wait_until
from tests.nodes.own_domain import participant

sys.path.append(str(Path(__file__).parents[2] / "examples"))
from disturbed_rig import DisturbedRig
from fake_chaser import STIFFNESS, STROKE
from fake_rig import FakeRig

__all__ = ["STIFFNESS", "STROKE"]

STREAMS = ["/joint_states", "/load_cell/wrench", "/launcher/command", "/launcher/hold"]
STREAMS += ["/capture/status", "/capture/criteria"]
POSES = ["/motion_capture/chaser", "/motion_capture/target"]
#: The bench's clock compared with ours, and its measurements in a second of it.
PACE, RATE = 5.0, 50.0
#: After the chaser was held, the bench has pulled it back by then, s of the bench.
BACK = 2.0
SUCCEEDED, CANCELED, ABORTED = (
    *(GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_ABORTED),
)
#: A busy machine is no dead camera, and no absent node.
PATIENT = {"max_pose_age": 10.0, "max_buffer_age": 10.0, "max_hold_silence": 10.0}
#: A trial waits this long, s; after all three it has a result, which names what it has waited for.
#: A refusal is read in the feedback (:meth:`Goal.refusal`), however long a busy machine takes.
WAITS = {"start_timeout": 600.0, "time_limit": 120.0, "closing_timeout": 60.0}
PATIENT |= WAITS


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
            lambda: len(self.feedback),
        )

    def refusal(self, *words):
        """Wait until the launcher says all of these words, for it does not let go; then cancel."""

        def is_said():
            said = self.feedback[-1].waiting_for if self.feedback else ""
            return self.is_over or all(each in said for each in words)

        def what():
            return f"{words} not in {[f.waiting_for for f in self.feedback[-1:]]}"

        wait_until(is_said, what, lambda: len(self.feedback))
        assert not self.is_over, self.result()
        self.cancel()
        status, result = self.result()
        assert (status, result.verdict) == (CANCELED, ""), result.reason

    def cancel(self):
        answer = asked(self._actions, self._handle.cancel_goal_async)
        wait_until(answer.done, "no response to a cancel")

    def result(self):
        """Wait for the end; return the goal's status and the result."""
        wait_until(
            self._result.done,
            lambda: f"no result of a goal: {self.feedback[-1:]}",
            lambda: len(self.feedback),
        )
        answer = self._result.result()
        return answer.status, answer.result


def actions_of(client, launcher="/launcher"):
    """Return an action client of a launcher's run_trial."""
    actions = ActionClient(client.node, RunTrial, f"{launcher}/run_trial")
    wait_until(actions.server_is_ready, "no launcher/run_trial")
    client.await_answers_of(launcher)
    return actions


@contextmanager
def rig(kind, parameters):
    """Run a bench of the examples in a thread; give its node."""
    context, over = participant(), threading.Event()
    node = kind(context=context, cli_args=ros_arguments(parameters), use_global_arguments=False)
    executor = EventsExecutor(context=context)
    executor.add_node(node)

    def spin():
        while not over.is_set():
            executor.spin_once(0.05)
        executor.remove_node(node)
        executor.shutdown()
        node.destroy_node()

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield node
    finally:
        over.set()
        thread.join()


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
        change=None,
        recorder_change=None,
        launchers=1,
        **options,
    ):
        self.client, self.folder = client, folder
        self.has_actuator = actuator == "output"
        streams = f"[{', '.join([*poses, *STREAMS])}]"
        self.detector = start("capture_detector", **options)
        self.recorder = start("recorder", recorder_change, out=folder, topics=streams, **options)
        self._restart = {
            "capture_detector": partial(start, "capture_detector", **options),
            "recorder": partial(start, "recorder", out=folder, topics=streams, **options),
        }
        settings = {**PATIENT, "scene": "tilt_0", "after_verdict": 0.1}
        # a bench that is faster than real time; a start 120 mm aside is one that misses
        settings["waive"] = "[machine_clock, start]"
        settings |= (launcher or {}) | options
        started = [
            start("launcher", change, actuator=actuator, **settings) for _ in range(launchers)
        ]
        self.launcher = started[0]
        self._restart["launcher"] = partial(start, "launcher", actuator=actuator, **settings)
        for launcher in started:
            launcher.wait_for("ready for trials")
        self.detector.wait_for("ready")
        self.recorder.wait_for("ready")
        self.holds = []  # s (wall) and value of launcher/hold
        client.subscribe(
            "std_msgs/msg/Bool",
            "launcher/hold",
            lambda message: self.holds.append((time.monotonic(), message.data)),
            QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL),
        )
        self.verdicts = []  # label and final, as the detector's topic has them
        client.subscribe(
            "capture_sim/msg/CaptureStatus",
            "capture/verdict",
            lambda status: self.verdicts.append((CaptureState(status.state).label, status.final)),
            QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL),
        )
        self.stamps = []  # s by the bench's clock, of the load cell, which never falls silent
        client.subscribe(
            "geometry_msgs/msg/WrenchStamped",
            "load_cell/wrench",
            lambda sample: self.stamps.append(stamp_of(sample)),
            qos_profile_sensor_data,
        )
        self.actions = actions_of(client)
        if self.has_actuator:  # a topic that is not ours: the recorder looks for it
            wait_until(lambda: self._is_read_by("recorder", "/launcher/hold"))

    def kill(self, role):
        """Kill a node (kill -9)."""
        self._nodes[role].process.kill()
        self._nodes[role].process.wait()

    def send_signal(self, role, number):
        """Send a signal to a node."""
        self._nodes[role].process.send_signal(number)

    def restart(self, role):
        """Start a node again with the same parameters."""
        node = self._restart[role]()
        node.wait_for("ready")
        setattr(self, {"capture_detector": "detector"}.get(role, role), node)
        if role == "launcher":
            self.actions = actions_of(self.client)

    @property
    def _nodes(self):
        return {
            "capture_detector": self.detector,
            "recorder": self.recorder,
            "launcher": self.launcher,
        }

    def _is_read_by(self, node, topic):
        readers = self.client.node.get_subscriptions_info_by_topic(topic)
        return node in {reader.node_name for reader in readers}

    @contextmanager
    def bench(self, remaps=(), *, is_disturbed=True, **disturbances):
        """Run the bench, disturbed; give its node, to look at."""
        parameters = {
            "pace": PACE,
            "rate": RATE,
            "hold_timeout": 60.0,
            **disturbances,
            **dict(remaps),
        }
        kind = DisturbedRig if is_disturbed else FakeRig
        self.stamps.clear()
        with rig(kind, parameters) as node:
            wait_until(lambda: self.stamps)
            if self.has_actuator:  # it lets go only at a false that follows a true
                wait_until(lambda: node.armed, "the bench has no launcher/hold")
            yield node

    def wait(self, seconds):
        """Wait by the bench's clock (s), which is slower than its pace on a busy machine."""
        end = self.stamps[-1] + seconds
        wait_until(lambda: self.stamps[-1] >= end, progress=lambda: self.stamps[-1])

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
