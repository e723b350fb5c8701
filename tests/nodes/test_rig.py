"""A bench without simulator: plain rclpy with a clock, jitter and losses of its own."""

import csv
import re
import subprocess
import sys
from pathlib import Path

from bench_processes import Client, processes, wait_until
from forked import Forked
from std_srvs.srv import Trigger

from capture_sim.cli import main
from capture_sim.detection.exact import CaptureState
from capture_sim.messages.topics import CAPTURE_STATUS
from capture_sim.recording.playback import Playback

RIG = Path(__file__).parents[2] / "examples" / "fake_rig.py"
STREAMS = "[/motion_capture/chaser, /motion_capture/target, /joint_states, /load_cell/wrench, "
STREAMS += "/launcher/hold, /launcher/state, /launcher/command, /capture/status, /capture/criteria]"


def test_three_trials_in_a_row_are_judged_and_recorded(tmp_path, capsys):
    assert len(RIG.read_text().splitlines()) <= 140
    assert "capture_sim." not in RIG.read_text()
    with processes(Forked) as start, Client() as client:
        rig = subprocess.Popen([sys.executable, str(RIG)])
        try:
            nodes = {
                "launcher": start("launcher", scene="tilt_0", actuator="output"),
                "detector": start("capture_detector", exit_when_done="false"),
                "recorder": start("recorder", exit_when_done="false", out=tmp_path, topics=STREAMS),
            }
            for node in nodes.values():
                node.wait_for("ready")
            verdicts = client.listen(CAPTURE_STATUS)
            for trial in range(1, 4):
                verdicts.clear()
                assert client.ask(Trigger, "/launcher/launch").success
                wait_until(lambda: any(status.final for status in verdicts))
                assert verdicts[-1].state == CaptureState.CAPTURED
                assert client.ask(Trigger, "/launcher/end_trial").success
                wait_until(lambda n=trial: nodes["recorder"].text.count("complete") == n)
        finally:
            rig.kill()  # plain rclpy may not come to its end: see capture_sim.interrupts.end_within
            rig.wait()
    for name in ("tilt_0", "tilt_0_2", "tilt_0_3"):
        path = tmp_path / f"{name}.mcap"
        assert path.is_file()
        assert len(list(Playback(path).messages())) > 1000
    told = {}
    for command, *options, status in (
        ("detect", 0),
        ("view", "--out", str(tmp_path), 0),
        ("export", "--to", "csv", "--out", str(tmp_path), 0),
        ("identify", "c_rr", "--starts", "1", "--touches", "0", 1),
        ("replay", "--rtf", "0", 0),
    ):
        assert main([command, str(path), *options]) == status, capsys.readouterr().err
        told[command] = capsys.readouterr().out
    assert "the model does not explain the measurements" in told["identify"]  # it is no physics
    # let go, the chaser is at the cone after a way of 0.2 m
    (since,) = re.findall(r"verdict: captured since (\d\.\d+) s", told["detect"])
    assert 2.0 < float(since) < 4.0  # 3.0, and what messages are late by
    assert "the same" in told["detect"]
    with (tmp_path / "motion_capture_chaser.csv").open() as table:
        t = [float(row["t"]) for row in csv.DictReader(table)]
    assert -5.0 < t[0] < 1.0
    assert float(since) < t[-1] < 10.0
