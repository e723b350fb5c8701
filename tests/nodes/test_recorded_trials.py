"""Trials of a rig one after another: each recording holds its own messages and nothing else."""

import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from bench_processes import Client, processes, wait_until
from forked import Forked
from std_srvs.srv import Trigger

from capture_sim.cli import main
from capture_sim.detection.exact import CaptureState
from capture_sim.messages.topics import CAPTURE_STATUS, CHASER_POSE
from capture_sim.nodes.recorder import OVERTAKING
from capture_sim.recording.clock import stamps_of
from capture_sim.recording.read import read_run

RIG = Path(__file__).parents[2] / "examples" / "fake_rig.py"
#: As a real rig's: the bodies of a motion capture under numbers.
NAMES = {"motion_capture/chaser": "/mocap/rb1/pose", "motion_capture/target": "/mocap/rb2/pose"}
STREAMS = "[/mocap/rb1/pose, /mocap/rb2/pose, /joint_states, /launcher/command, /capture/status, "
STREAMS += "/capture/criteria]"
#: The recorder meets 400 messages a second of this rig while no trial is on.
IDLE = 5.0


def test_trials_after_idle_time_hold_no_earlier_messages(tmp_path, capsys):
    with processes(Forked) as start, Client() as client:
        remaps = [word for pair in NAMES.items() for word in ("-r", ":=".join(pair))]
        rig = subprocess.Popen([sys.executable, str(RIG), "--ros-args", *remaps])
        try:
            stays = {"exit_when_done": "false", **NAMES}
            nodes = [
                start("launcher", scene="tilt_0", actuator="output", **NAMES),
                start("capture_detector", **stays),
                recorder := start("recorder", out=tmp_path, topics=STREAMS, **stays),
            ]
            for node in nodes:
                node.wait_for("ready")
            statuses = client.listen(CAPTURE_STATUS)
            verdicts = []
            for trial in range(1, 4):
                time.sleep(IDLE)
                statuses.clear()
                assert client.ask(Trigger, "/launcher/launch").success
                wait_until(lambda: any(status.final for status in statuses))
                verdicts.append(next(status for status in statuses if status.final))
                assert client.ask(Trigger, "/launcher/end_trial").success
                wait_until(lambda n=trial: recorder.text.count("complete") == n)
        finally:
            rig.kill()  # plain rclpy may not come to its end: see capture_sim.interrupts.end_within
            rig.wait()
    for name, live in zip(("tilt_0", "tilt_0_2", "tilt_0_3"), verdicts, strict=True):
        path = tmp_path / f"{name}.mcap"
        run = read_run(path)  # the rig's names by the recorder's note
        assert run.problems == ()
        arrivals, stamps = run.log_times(CHASER_POSE), stamps_of(run.columns(CHASER_POSE))
        announced = run.log_times("bench/run_info")[0]
        assert announced - arrivals[0] < OVERTAKING + 0.1e9
        assert np.diff(stamps).max() < 0.5e9, "a gap in the poses"
        assert np.ptp(arrivals - stamps) < 1e9, "poses logged later than they arrived"
        assert 0 < run.clock.release - stamps[0] < 2e9
        assert main(["detect", str(path)]) == 0, capsys.readouterr()
        printed = capsys.readouterr().out
        assert printed.rstrip().endswith("the same")
        (since,) = re.findall(r"verdict: (\w+) since", printed)
        assert since == run.verdict
        assert CaptureState(live.state).label == run.verdict
