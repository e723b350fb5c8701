"""Trials with the disturbances of real sensors: `detect` agrees with the live verdict.

The nodes start once in each test; between two flows only the bench starts again.
"""

import csv
import re

from bench_processes import Client, processes
from forked import Forked
from rig_session import OUTCOMES, Session, check
from std_srvs.srv import Trigger

from capture_sim.cli import main
from capture_sim.detection.exact import CaptureState

#: The topics of a driver that publishes Odometry, by the bench's names.
ODOMETRY = {"chaser/odom": "/mocap/rb1/odom", "target/odom": "/mocap/rb2/odom"}


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
            session.wait(1.3)
            assert client.ask(Trigger, "/launcher/abort").success
            session.await_verdict()  # the bench pulls its chaser back
            live, path = session.end()
            assert live is CaptureState.MISSED
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
