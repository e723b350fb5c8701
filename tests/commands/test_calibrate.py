"""The command calibrate, with recordings in files: what it writes, refuses, and keeps at Ctrl-C."""

from __future__ import annotations

import hashlib
import io
import json
import signal
import sys

import pytest

import capture_sim
from capture_sim.base.exit_status import BAD_INPUT, FAILED, INTERRUPTED, OK
from capture_sim.cli import main
from capture_sim.commands import output
from capture_sim.recording.offline import write_run

SHORT = {"run.t_end": 3.2}


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    """Recordings of two trials of one bench, in place of a laboratory's."""
    folder = tmp_path_factory.mktemp("trials")
    names = ("tilt_0", "tilt_p10")
    return [write_run(capture_sim.simulate(n, SHORT), folder / f"{n}.mcap") for n in names]


def test_its_scene_runs_and_its_numbers_are_read_again(trials, tmp_path, capfd):
    out = tmp_path / "bench"
    words = ["calibrate", *trials, "--fit", "c_rr", "mu", "--profile", "c_rr", "--restarts", 1]
    words += ["--out", out]
    assert main([str(word) for word in words]) == OK
    printed = capfd.readouterr().out
    assert "found: all tests passed" in printed
    assert "c_rr: chi2 rises by " in printed
    assert "c_rr: chi2 rises by " in (out / "calibration.html").read_text(encoding="utf-8")
    text = (out / "calibration.txt").read_text(encoding="utf-8")
    for table in ("Residuals by trial, part and phase", "if one trial were left out"):
        assert table in text
        assert table in (out / "calibration.html").read_text(encoding="utf-8")
    found = json.loads((out / "calibration.json").read_text(encoding="utf-8"))
    assert found["findings"] == []
    hashes = [hashlib.sha256(trial.read_bytes()).hexdigest() for trial in trials]
    assert [trial["sha256"] for trial in found["trials"]] == hashes
    assert [profile["name"] for profile in found["profiles"]] == ["c_rr"]
    scene = capture_sim.load_scene(out / "calibrated.yaml")
    assert scene.supports.chaser.c_rr == pytest.approx(0.001, rel=1e-3)
    words = ["sweep", out / "calibrated.yaml", "--calibrated", out, "--runs", 3, "--workers", 1]
    words += ["--vary", "initial.target.y=normal(0, 0.2 mm)", "--out", tmp_path / "t.csv"]
    assert main([str(word) for word in words]) == OK


def test_a_fit_that_does_not_count_is_status_1_with_the_reason(trials, tmp_path, capfd):
    """A trial of another bench, described by the scene of the first one."""
    made = capture_sim.simulate("tilt_p10", {**SHORT, "buffer.k_A": 560.0})
    scene = capture_sim.load_scene("tilt_p10", SHORT)
    other = write_run(made.replaced(scene=scene), tmp_path / "other.mcap")
    out = tmp_path / "bench"
    words = ["calibrate", trials[0], other, "--fit", "mu", "--out", out]
    assert main([str(word) for word in words]) == FAILED
    assert "not found: " in capfd.readouterr().out
    assert json.loads((out / "calibration.json").read_text(encoding="utf-8"))["findings"]


@pytest.mark.parametrize(
    "words, said",
    [
        (["--fit", "c_rr", "c_rr"], "parameter c_rr: given twice: must be given once"),
        (["--fit", "c_rrr"], "c_rrr: no number of tilt_0; did you mean c_rr, "),
        (["--weighed", "chaser.mass=22.6"], "chaser.mass = 22.6: must be VALUE +- ERROR in kg"),
        (["--profile", "mu", "--fit", "e"], "profile mu: must be one of the fitted parameters"),
        (["--placement", "0.2 mm, 1 mrad"], "--placement: must be given with --predict"),
        (["--predict", "no_such_scene"], "scene 'no_such_scene': not found"),
        (["--until", "-1"], "argument --until: '-1': must be a number >= 0"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(words, said, trials, tmp_path, capfd):
    out = tmp_path / "bench"
    assert main(["calibrate", str(trials[0]), *words, "--out", str(out)]) == BAD_INPUT
    errors = capfd.readouterr().err
    assert said in errors
    assert len(errors.splitlines()) == 1
    assert not out.exists()


def test_trials_that_are_none_are_one_line(trials, tmp_path, capfd):
    other = write_run(
        capture_sim.simulate("tilt_p10", {**SHORT, "chaser.mass": 21.0}), tmp_path / "other.mcap"
    )
    empty = tmp_path / "empty.mcap"
    empty.touch()
    for more, said in (
        (trials[0], "given twice"),
        (other, "chaser.mass"),
        (empty, "empty.mcap"),
        (tmp_path / "none.mcap", "none.mcap: cannot read: No such file"),
    ):
        words = ["calibrate", trials[0], more, "--fit", "c_rr", "--out", tmp_path / "bench"]
        assert main([str(word) for word in words]) == BAD_INPUT
        errors = capfd.readouterr().err
        assert said in errors
        assert len(errors.splitlines()) == 1
        assert not (tmp_path / "bench").exists()


class Interrupting(io.StringIO):
    """A terminal at which somebody presses Ctrl-C as soon as the first progress is printed."""

    def write(self, text):
        count = super().write(text)
        if " simulations, " in text:
            signal.raise_signal(signal.SIGINT)
        return count


def test_ctrl_c_writes_the_state_so_far_and_says_so(trials, tmp_path, monkeypatch, capsys):
    out, errors = tmp_path / "bench", Interrupting()
    monkeypatch.setattr(output, "_PAUSE", 0.2)
    monkeypatch.setattr(sys, "stderr", errors)
    assert main(["calibrate", *map(str, trials), "--out", str(out)]) == INTERRUPTED
    shown = capsys.readouterr().out + errors.getvalue()
    assert "Traceback" not in shown
    assert "not found: unfinished" in shown
    found = json.loads((out / "calibration.json").read_text(encoding="utf-8"))
    assert [finding["kind"] for finding in found["findings"]] == ["unfinished"]
    assert capture_sim.load_scene(out / "calibrated.yaml").name
