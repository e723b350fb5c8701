"""Trials of the example's bench, one after the other, with the nodes that serve them."""

import re
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

from bench_processes import wait_until
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import qos_profile_sensor_data
from std_srvs.srv import Trigger

from capture_sim.cli import main
from capture_sim.detection.exact import CaptureState
from capture_sim.hardware.messages import stamp_of
from capture_sim.messages.topics import CAPTURE_STATUS

RIG = Path(__file__).parents[2] / "examples" / "fake_rig.py"
STREAMS = ["/joint_states", "/load_cell/wrench", "/launcher/command", "/launcher/hold"]
STREAMS += ["/capture/status", "/capture/criteria"]
POSES = ["/motion_capture/chaser", "/motion_capture/target"]
OUTCOMES = ("captured", "rebound", "missed")
#: Speed of the bench's clock compared with ours, except in tests of the clocks.
PACE = 3.0
#: After the chaser was held, the bench has pulled it back by then, s of the bench.
BACK = 2.0
#: The launcher has found a bench that begins to publish within this long, s (wall).
DISCOVERY = 3.0


class Session:
    """Nodes that serve one trial after the other."""

    def __init__(
        self, start, client, folder, *, has_launcher=True, poses=POSES, change="", **options
    ):
        self.client, self.folder, self.recorded = client, folder, 0
        options = {"exit_when_done": "false", **options}
        streams = f"[{', '.join([*poses, *STREAMS])}]"
        self.start_recorder = lambda: start(
            "recorder", change, out=folder, topics=streams, **options
        )
        self.detector = start("capture_detector", **options)
        self.recorder = self.start_recorder()
        self.launcher = None
        if has_launcher:
            self.launcher = start("launcher", scene="tilt_0", actuator="output", **options)
            self.launcher.wait_for("ready")
        self.detector.wait_for("ready")
        self.recorder.wait_for("ready")
        self.statuses = client.listen(CAPTURE_STATUS)
        self.stamps = []  # s by the bench's clock, of the load cell, which never falls silent
        client.node.create_subscription(
            WrenchStamped,
            "load_cell/wrench",
            lambda sample: self.stamps.append(stamp_of(sample)),
            qos_profile_sensor_data,
        )

    @contextmanager
    def bench(self, *remaps, pace=PACE, **disturbances):
        """Run the bench, disturbed."""
        disturbances["pace"] = pace
        values = [w for key, value in disturbances.items() for w in ("-p", f"{key}:={value}")]
        rig = subprocess.Popen([sys.executable, str(RIG), "--ros-args", *values, *remaps])
        try:
            self.stamps.clear()
            wait_until(lambda: self.stamps or rig.poll() is not None)
            assert rig.poll() is None, "the bench has ended"
            time.sleep(DISCOVERY)
            yield
        finally:
            rig.kill()  # plain rclpy may not come to its end: see capture_sim.interrupts.end_within
            rig.wait()

    def wait(self, seconds):
        """Wait by the bench's clock (s), which is slower than its pace on a busy machine."""
        end = self.stamps[-1] + seconds
        wait_until(lambda: self.stamps[-1] >= end)

    def launch(self, after=BACK):
        self.wait(after)
        self.statuses.clear()
        self.launched = len(self.launcher.lines)
        assert self.client.ask(Trigger, "/launcher/launch").success

    def await_verdict(self):
        """Wait until the verdict is known here and to the launcher."""
        wait_until(lambda: any(status.final for status in self.statuses))
        if self.launcher is not None:
            state = next(status.state for status in self.statuses if status.final)
            self.launcher.wait_for(f"verdict {CaptureState(state).label}", since=self.launched)

    def end(self, node="launcher"):
        """End the trial; return the live verdict and the recording."""
        is_known = any(status.final for status in self.statuses)
        ended = self.client.ask(Trigger, f"/{node}/end_trial")
        assert ended.success
        self.recorded += 1
        wait_until(lambda: self.recorder.text.count(".mcap: ") >= self.recorded)
        states = self.statuses
        wait_until(lambda: any(s.final or s.state == CaptureState.UNDECIDED for s in states))
        live = CaptureState(next((s for s in states if s.final), states[-1]).state)
        path = max(self.folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime)
        verdict = f"verdict {live.label}" if live.is_verdict else "no verdict"
        if node == "recorder":
            assert ended.message.endswith(str(path))
        else:
            # the end itself may bring the verdict
            assert ended.message.endswith((verdict,) if is_known else (verdict, "no verdict"))
        return live, path

    def try_outcomes(self, capsys, *outcomes):
        """Launch once for each outcome; live and by `detect` it is that one."""
        for outcome in outcomes:
            self.launch()
            self.await_verdict()
            live, path = self.end()
            assert live.label == outcome, self.launcher.text
            check(live, path, capsys)
        return path


def check(live, path, capsys, *options):
    """Return what `detect` prints, which must be the live verdict, at the same time."""
    assert main(["detect", str(path), *options]) == 0, capsys.readouterr()
    printed = capsys.readouterr().out
    (verdict,) = re.findall(r"verdict: (\w+) since", printed)
    assert verdict == live.label
    assert printed.rstrip().endswith("the same")  # within 0.1 s
    return printed
