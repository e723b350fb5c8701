"""``capture-sim detect`` of the trials of a day: one table, and numbers for programs."""

from __future__ import annotations

import json

import dirty
import pytest

from capture_sim.cli import main
from capture_sim.errors import RecordingError
from capture_sim.recording.read import read_run
from capture_sim.scene.loading import load_scene


@pytest.fixture
def trials(tmp_path):
    """Two trials of a rig, the second with a hole over the contact, and a file that is none."""
    dirty.write(tmp_path, "plain").rename(tmp_path / "first.mcap")
    dirty.write(tmp_path, "hole_at_contact").rename(tmp_path / "second.mcap")
    (tmp_path / "third.mcap").write_text("no recording")
    return tmp_path


def test_trials_end_in_a_table_beside_them(trials, capsys):
    files = sorted(map(str, trials.glob("*.mcap")))
    command = ["detect", *files, "--scene", "tilt_p10", f"--out={trials}"]
    for _ in range(2):  # the second replaces the rows of the first
        assert main(command) == 2  # one cannot be read, the others count all the same
        shown = capsys.readouterr()
        assert "third.mcap: not an MCAP file" in shown.err
        rows = json.loads((trials / "results.json").read_text())
        assert [row["recording"] for row in rows] == ["first.mcap", "second.mcap"]
        assert [row["verdict"] for row in rows] == ["captured", "captured"]
    first, second = rows
    assert first["first_contact_time_high"] - first["first_contact_time_low"] < 0.02
    assert second["first_contact_time_high"] - second["first_contact_time_low"] > 0.9
    text = (trials / "results.txt").read_text()
    assert "second: first contact between 2.290 and 3.300 s." in text
    assert text.strip().splitlines()[0] in shown.out


def test_results_for_programs_are_those_of_the_table(trials, capsys):
    path = str(trials / "first.mcap")
    assert main(["detect", path, "--scene", "tilt_p10", "--json", f"--out={trials}"]) == 0
    (data,) = json.loads(capsys.readouterr().out)
    (row,) = json.loads((trials / "results.json").read_text())
    assert {k: data[k] for k in row if k != "recording"} == {
        k: v for k, v in row.items() if k != "recording"
    }
    assert data["same_as_recorded"] is None
    assert data["verdict_time_low"] <= 3.41 <= data["verdict_time_high"]


def test_a_trial_of_several_in_one_recording_is_chosen(tmp_path, capsys):
    """Before, the second trial of a bag was not named, and the verdict was 'undecided'."""
    path = str(dirty.write(tmp_path, "two_trials"))
    found = {}
    for number in ("1", "2"):
        command = ["detect", path, "--scene", "tilt_p10", "--json", "--trial", number]
        assert main(command) == 0
        ((found[number]),) = json.loads(capsys.readouterr().out)
    assert found["1"]["verdict"] == "undecided"
    assert found["1"]["first_contact_time"] is None
    assert found["2"]["verdict"] == "captured"
    bounds = [found["2"][f"first_contact_time_{end}"] for end in ("low", "high")]
    assert bounds[0] < dirty.TRUE.first_contact < bounds[1]
    run = read_run(path, scene=load_scene("tilt_p10"))  # the choice was that command's
    assert "several_trials" in [doubt.rule.name for doubt in run.doubts]
    assert run.replaced().verdict == "undecided"
    with pytest.raises(RecordingError, match="trial = 3: must be 1 to 2"):
        read_run(path, trial=3)
