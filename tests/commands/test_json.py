"""``--json`` prints the results of a command as JSON, and nothing else."""

import json

import pytest

from capture_sim import simulate
from capture_sim.cli import main
from capture_sim.commands.output import give
from capture_sim.recording.offline import write_run

SHORT = ("--set", "run.t_end=0.6")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    run = simulate("paper_designed", "sensors.motion_capture={}")
    return str(write_run(run, tmp_path_factory.mktemp("recorded") / "run.mcap"))


def printed(capsys, *arguments):
    """Return the exit status of a command, and what it prints with and without ``--json``."""
    status = main([*arguments])
    text = capsys.readouterr().out
    assert main([*arguments, "--json"]) == status
    return status, text, json.loads(capsys.readouterr().out)


def test_run(tmp_path, capsys):
    arguments = ("run", "paper_designed", "paper_undamped", *SHORT, "--no-record")
    _, text, rows = printed(capsys, *arguments, f"--out={tmp_path}")
    assert "experiment" in text
    assert rows[0]["verdict"] in ("captured", "undecided")
    written = json.loads((tmp_path / "results.json").read_text())
    assert [row["max_torsion"] for row in rows] == [row["max_torsion"] for row in written]


def test_sweep(tmp_path, capsys):
    arguments = ("sweep", "paper_designed", "--vary", "c_A=9,13", *SHORT)
    _, _, rows = printed(capsys, *arguments, f"--out={tmp_path / 'table.csv'}")
    assert [row["c_A"] for row in rows] == [9.0, 13.0]
    assert rows[0]["max_axial_stroke_in"] > rows[1]["max_axial_stroke_in"]


def test_calibrate(recording, tmp_path, capsys):
    arguments = ("calibrate", recording, "--fit", "c_A", "--restarts=0", f"--out={tmp_path}")
    _, text, found = printed(capsys, *arguments)
    assert "c_A" in text
    assert found == json.loads((tmp_path / "calibration.json").read_text())


def test_results_are_printed_even_if_a_recording_is_refused(recording, tmp_path, capsys):
    missing = str(tmp_path / "missing.mcap")
    assert main(["detect", recording, missing, "--json"]) == 2
    captured = capsys.readouterr()
    [row] = json.loads(captured.out)
    assert row["recording"] == recording
    assert "missing.mcap" in captured.err


def test_an_error_prints_no_json(tmp_path, capsys):
    assert main(["detect", str(tmp_path / "missing.mcap"), "--json"]) == 2
    assert capsys.readouterr().out == ""


def test_results_are_not_made_unless_they_are_asked_for():
    give(lambda: pytest.fail("made for nobody"))
