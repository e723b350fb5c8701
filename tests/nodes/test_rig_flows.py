"""Trials of a bench with the disturbances of real sensors: `detect` agrees with the live verdict.

The nodes start once in each test; between two flows only the bench starts again.
"""

import csv
import re
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from bench_processes import Client, processes, wait_until
from capture_sim.srv import BeginTrial
from forked import Forked
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from capture_sim.cli import main
from capture_sim.detection.exact import CaptureState
from capture_sim.messages.topics import CAPTURE_STATUS, CHASER_POSE
from capture_sim.nodes.node import LATCHED
from capture_sim.nodes.recorder import OVERTAKING
from capture_sim.recording.clock import stamps_of
from capture_sim.recording.read import read_run

RIG = Path(__file__).parents[2] / "examples" / "fake_rig.py"
STREAMS = ["/joint_states", "/load_cell/wrench", "/launcher/command", "/launcher/hold"]
STREAMS += ["/capture/status", "/capture/criteria"]
POSES = ["/motion_capture/chaser", "/motion_capture/target"]
OUTCOMES = ("captured", "rebound", "missed")
#: The bench's clock runs so many times as fast as ours, unless the clocks are what is tested.
PACE = 3.0
#: After the chaser was held, the bench has pulled it back by then, s of the bench.
BACK = 2.0
#: Time between two trials of a session, s of the bench.
IDLE = 10.0
#: The launcher has found a bench that begins to publish within this long, s (wall).
DISCOVERY = 3.0
#: The topics of a driver that publishes Odometry, by the bench's names.
ODOMETRY = {"chaser/odom": "/mocap/rb1/odom", "target/odom": "/mocap/rb2/odom"}


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
        self.joints = []
        client.node.create_subscription(
            JointState, "joint_states", self.joints.append, qos_profile_sensor_data
        )

    @contextmanager
    def bench(self, *remaps, pace=PACE, **disturbances):
        """Run the bench, disturbed."""
        self.pace, disturbances["pace"] = pace, pace
        values = [w for key, value in disturbances.items() for w in ("-p", f"{key}:={value}")]
        rig = subprocess.Popen([sys.executable, str(RIG), "--ros-args", *values, *remaps])
        try:
            self.joints.clear()
            wait_until(lambda: self.joints or rig.poll() is not None)
            assert rig.poll() is None, "the bench has ended"
            time.sleep(DISCOVERY)
            yield
        finally:
            rig.kill()  # plain rclpy may not come to its end: see capture_sim.interrupts.end_within
            rig.wait()

    def wait(self, seconds):
        """Wait so many seconds of the bench."""
        time.sleep(seconds / self.pace)

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


def check_messages(path, *, release):
    """Check that a recording holds its own messages and nothing else: none of the idle time."""
    run = read_run(path)
    assert run.problems == ()
    arrivals, stamps = run.log_times(CHASER_POSE), stamps_of(run.columns(CHASER_POSE))
    announced = run.log_times("bench/run_info")[0]
    assert announced - arrivals[0] < OVERTAKING + 0.1e9
    assert np.diff(stamps).max() < 0.5e9, "a gap in the poses"
    assert 0 < run.clock.release - stamps[0] - release * 1e9 < 2e9 * PACE


def test_six_trials_in_a_session_with_the_launcher(tmp_path, capsys):
    assert len(RIG.read_text().splitlines()) <= 140
    assert "capture_sim." not in RIG.read_text()
    with processes(Forked) as start, Client() as client:
        session = Session(start, client, tmp_path)
        with session.bench(outcomes=f"[{', '.join(OUTCOMES)}]"):
            for outcome in OUTCOMES * 2:
                session.launch(IDLE)
                assert not client.ask(Trigger, "/launcher/launch").success  # pressed twice
                session.await_verdict()
                live, path = session.end()
                assert live.label == outcome
                check(live, path, capsys)
                check_messages(path, release=0.0)
    names = {path.name for path in tmp_path.glob("*.mcap")}
    assert names == {"tilt_0.mcap", *(f"tilt_0_{k}.mcap" for k in range(2, 7))}


def test_six_trials_in_a_session_without_launcher(tmp_path, capsys):
    with processes(Forked) as start, Client() as client:
        session = Session(start, client, tmp_path, has_launcher=False)
        hold = client.node.create_publisher(Bool, "launcher/hold", LATCHED)
        with session.bench(outcomes=f"[{', '.join(OUTCOMES)}]"):
            for trial, outcome in enumerate(OUTCOMES * 2):
                if trial == 1:
                    session.recorder.process.kill()
                    session.recorder.process.wait()
                session.wait(IDLE)
                session.statuses.clear()
                begin = client.ask(BeginTrial, "/capture_detector/begin_trial", scene="tilt_0")
                assert begin.success, begin.message
                if trial == 1:  # the recorder starts late, in the trial
                    session.recorder, session.recorded = session.start_recorder(), 0
                    session.recorder.wait_for("recording in")
                else:
                    session.wait(4.0)
                hold.publish(Bool(data=False))
                session.await_verdict()
                live, path = session.end("capture_detector")
                assert live.label == outcome
                check(live, path, capsys)
                hold.publish(Bool(data=True))


def test_disturbed_sensors(tmp_path, capsys):
    with processes(Forked) as start, Client() as client:
        session = Session(start, client, tmp_path)
        with session.bench(preset="standard", outcomes="[captured, rebound]"):
            disturbed = session.try_outcomes(capsys, "captured", "rebound")
        with session.bench(burst_loss=0.02, repeated=0.05, step_back=0.02):
            session.try_outcomes(capsys, "captured")
        for lost_as in ("void", "frozen"):
            with session.bench(
                hidden=0.3, lost_as=lost_as, noise=1e-4, outcomes="[captured, rebound]"
            ):
                session.try_outcomes(capsys, "captured", "rebound")
        with session.bench(encoder_end=1.0):
            session.launch()
            session.detector.wait_for("no measurement of the")
            live, path = session.end()
            assert live is CaptureState.UNDECIDED
            check(live, path, capsys)
        with session.bench(pace=1.0, encoder_offset=0.4):
            session.launch()
            session.detector.wait_for("buffer: clock 0.")  # s ahead of the other sources'
            live, path = session.end()
            assert live is CaptureState.UNDECIDED
            offsets = re.findall(r"sources differ by (\d+) ms", check(live, path, capsys))
            assert offsets  # printed by `detect`, and recorded
            assert all(350 < int(offset) < 450 for offset in offsets)
        with session.bench():
            session.launch()
            session.wait(1.0)
            assert client.ask(Trigger, "/launcher/abort").success
            live, path = session.end()
            # the bench pulls its chaser back: seen by then, or not
            assert live in (CaptureState.UNDECIDED, CaptureState.MISSED)
            check(live, path, capsys)
        assert len(list(tmp_path.glob("*.mcap"))) == session.recorded  # one trial each
    check_commands(disturbed, capsys)


def check_commands(path, capsys):
    """A recording of the standard disturbance goes through every command."""
    out, printed = str(path.parent), {}
    for command, *options, status in (
        ("detect", 0),
        ("view", "--out", out, 0),
        ("report", "--out", out, 0),
        ("identify", "c_rr", "--starts", "1", "--touches", "0", 1),
        ("compare", str(path), "--out", out, 0),
        ("export", "--to", "csv", "--out", out, 0),
        ("replay", "--rtf", "0", 0),
    ):
        assert main([command, str(path), *options]) == status, (command, capsys.readouterr())
        printed[command] = capsys.readouterr().out
    assert "the model does not explain the measurements" in printed["identify"]  # it is no physics
    (since,) = re.findall(r"verdict: rebound since (\d\.\d+) s", printed["detect"])
    assert 2.0 < float(since) < 5.0  # let go, the chaser is at the cone after 3.0 s and 0.2 m
    with (path.parent / "motion_capture_chaser.csv").open() as table:
        t = [float(row["t [s]"]) for row in csv.DictReader(table)]
    assert -5.0 < t[0] < 1.0
    assert float(since) < t[-1] < 10.0


def test_best_effort_odometry_under_other_names(tmp_path, capsys):
    remaps = [word for pair in ODOMETRY.items() for word in ("-r", ":=".join(pair))]
    best_effort = {
        f"qos_overrides.{topic}.subscription.reliability": "best_effort"
        for topic in (*ODOMETRY.values(), "/joint_states", "/load_cell/wrench")
    }
    with processes(Forked) as start, Client() as client:
        session = Session(
            start,
            client,
            tmp_path,
            poses=[f"/{name}" for name in ODOMETRY],
            **best_effort,
            **ODOMETRY,
        )
        with session.bench(*remaps, pace=1.0, odometry=True, rate=250.0, best_effort=True):
            path = session.try_outcomes(capsys, "captured")  # by the names that the recorder noted
            named = [word for pair in ODOMETRY.items() for word in ("--remap", ":=".join(pair))]
            check(CaptureState.CAPTURED, path, capsys, *named)
        outcomes = f"[{', '.join(OUTCOMES)}]"
        with session.bench(*remaps, preset="hard", odometry=True, outcomes=outcomes):
            session.try_outcomes(capsys, *OUTCOMES)


def test_disk_that_is_full_in_the_second_trial_and_stalls_in_the_fourth(tmp_path, capsys):
    """A limit of the file's size is the full disk, a writing thread that waits the stalled one."""
    stalled = tmp_path / "stalled"
    stall = f"""
        import os, time
        from capture_sim.recording import live
        from capture_sim.recording.write import RunWriter
        write = RunWriter.write
        def write_or_wait(self, *message):
            while os.path.exists({str(stalled)!r}):
                time.sleep(0.05)
            write(self, *message)
        RunWriter.write = write_or_wait
        live.CLOSE_LIMIT = 1.0
    """
    with processes(Forked) as start, Client() as client:
        session = Session(start, client, tmp_path, change=stall)
        recorder = session.recorder
        with session.bench(outcomes="[captured, rebound, missed]"):
            first = session.try_outcomes(capsys, "captured")
            whole = first.read_bytes()
            limits = resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE)
            full = (len(whole) // 3, limits[1])
            resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, full)
            session.launch()
            session.await_verdict()
            assert client.ask(Trigger, "/launcher/end_trial").success
            recorder.wait_for("tilt_0_2.mcap: cannot write: File too large")
            session.recorded += 1
            resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, limits)
            session.try_outcomes(capsys, "missed")
            assert first.read_bytes() == whole
            assert recorder.text.count("cannot write") == 1
            assert "Traceback" not in recorder.text
            session.launch()
            session.wait(1.0)
            stalled.touch()
            session.wait(1.0)
            began = time.monotonic()
            recorder.process.send_signal(signal.SIGTERM)
            assert recorder.status() == 0
            assert time.monotonic() - began < 10.0
            assert "the disk has written nothing for 1 s" in recorder.text
            assert "Traceback" not in recorder.text
