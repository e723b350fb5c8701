"""What an operator does with the recording of a trial of his rig, from the goal to the tables."""

import csv
import re
import sys
from pathlib import Path

import pytest
from rig_session import POSES, STREAMS, SUCCEEDED, Session, check

from capture_sim.cli import main
from capture_sim.recording.bag import read_bag
from tests.nodes.bench_client import Client

sys.path.append(str(Path(__file__).parents[2] / "examples"))
from fake_chaser import STIFFNESS, STOP, STROKE

#: Plots of a run, of a quantity each.
FIGURES = {"axial_performance", "distance", "impact_force", "snapshots", "torsional_performance"}
FIGURES |= {"trajectory", "velocities"}


def number(text, row):
    """Return the first number in a row of a table."""
    return float(re.search(rf"{re.escape(row)} +(-?[\d.]+)", text)[1])


def printed(capfd, *words):
    """Run a command; return its status and what it prints."""
    capfd.readouterr()
    status = main([str(word) for word in words])
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err
    return status, out + err


def test_a_recorded_trial_through_every_command(start, tmp_path, capfd):
    with Client() as client:
        session = Session(start, client, tmp_path / "trials")
        with session.bench(is_disturbed=False, outcomes="[captured]"):
            status, result = session.goal(name="c3", note="walk").result()
        assert (status, result.verdict, result.complete) == (SUCCEEDED, "captured", True)
        path = result.recording
        session.launcher.end()
        session.recorder.end()
        # replayed, with a detector that gives the verdict anew and a second recorder
        topics = ", ".join(name for name in (*POSES, *STREAMS) if name != "/launcher/hold")
        again = start("recorder", out=tmp_path / "again", topics=f"[{topics}]")
        again.wait_for("ready")
        player = start("player", bag=path, wait_for="[capture_detector, recorder]", rtf=1.0)
        assert player.status() == 0, player.text
        again.wait_for("c3.mcap: ")
        assert again.end() == 0, again.text
    replayed, recorded = read_bag(tmp_path / "again" / "c3.mcap"), read_bag(path)
    verdicts = replayed.statuses[-1], recorded.statuses[-1]
    assert verdicts[0].state is verdicts[1].state
    # it comes to rest on the edge of the capture zone: how it ends depends on the last pose
    first, again = (verdict.reason.partition(",")[0] for verdict in verdicts)
    assert first == again
    check("captured", path, capfd)

    status, text = printed(capfd, "view", path, "--figures", "--out", tmp_path / "view")
    assert status == 0, text
    drawn = {file.stem for file in (tmp_path / "view" / "figures").glob("*.png")}
    assert drawn == FIGURES
    status, text = printed(capfd, "report", path, "--out", tmp_path / "report")
    assert status == 0, text
    report = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "captured" in report

    # the bench moves as it is told, which no rolling resistance explains
    fit = ("--fit=c_rr", "--restarts=0", "--touches=0", f"--out={tmp_path / 'fit'}")
    status, text = printed(capfd, "calibrate", path, *fit)
    assert status == 1
    assert "not found: " in text

    status, text = printed(capfd, "compare", path, "tilt_0", "--out", tmp_path / "compare")
    assert status == 0
    force = STIFFNESS * STROKE  # N, peak of the bench's half sine
    assert number(text, "largest sampled force, N") == pytest.approx(force, rel=0.02)
    assert number(text, "stroke inwards, mm") == pytest.approx(1e3 * STROKE, rel=0.02)
    assert "too slow for touches of" in text

    status, text = printed(capfd, "export", path, "--out", tmp_path / "export")
    assert status == 0
    for name in (*POSES, *STREAMS):
        table = tmp_path / "export" / f"{name.strip('/').replace('/', '_')}.csv"
        with table.open(encoding="utf-8", newline="") as file:
            head, *rows = list(csv.reader(file))
        assert len(rows) == len(recorded.raw(name)), name
        if name == "/motion_capture/chaser":
            x = [float(row[head.index("pose.position.x [m]")]) for row in rows]
            assert x[0] == pytest.approx(0.0, abs=1e-4)
            assert max(x) == pytest.approx(STOP + STROKE, abs=1e-4)  # m
