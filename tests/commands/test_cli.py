"""The command line as a user calls it."""

import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec

import dirty
import pytest
from bags import of_a_bench

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.commands import results_folder
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import write_run
from capture_sim.run.loads import LOADS
from capture_sim.run.summary import NOT_NUMBERS


def test_run_prints_a_table_and_writes_numbers(tmp_path, capsys):
    status = main(["run", "tilt_0", "paper_undamped", "--no-record", "--out", str(tmp_path)])
    out = capsys.readouterr().out
    assert status == 0
    assert "tilt_0" in out
    rows = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert [row["name"] for row in rows] == ["tilt_0", "paper_undamped"]
    assert [row["verdict"] for row in rows] == ["captured", "rebound"]
    assert rows[0].keys() == {
        *("name", "verdict", "left_again", "not_used", "problems", "doubts", "waived"),
        "impact_speed",
        *("impact_speed_missing", "nearest_distance_error", "impact_speed_error"),
        *("verdict_time", "verdict_time_low", "verdict_time_high"),
        *("first_contact_time_low", "first_contact_time_high"),
        *("first_contact_time", "first_contact_duration", "first_contact_touches"),
        *("first_contact_peak_force", "normal_impulse", "loads_from", "energy_residual"),
        *("wall_time", "real_time_factor", "made_by", "recording"),
        *simulate("paper_designed", t_end=0.1).loads,
        *(f"{load.key}_{end}" for load in LOADS if load.is_measured for end in ("low", "high")),
    }
    assert (tmp_path / "results.txt").read_text(encoding="utf-8").strip() in out


def test_run_records_and_the_recording_gives_the_same_run_again(drawn, tmp_path, capsys):
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["run", "tilt_p10", "--set", "buffer.c_A=14", "--out", str(first)]) == 0
    recording = first / "tilt_p10_c_A_14.mcap"
    assert recording.is_file()
    assert (first / "tilt_p10_c_A_14.png").stat().st_size > 20_000
    if find_spec("rerun"):
        assert (first / "runs.rrd").stat().st_size > 10_000
    assert main(["run", str(recording), "--no-record", "--out", str(second)]) == 0

    def numbers(folder):
        row = json.loads((folder / "results.json").read_text(encoding="utf-8"))[0]
        assert row["made_by"]["overrides"] == ["buffer.c_A=14"]
        return {k: v for k, v in row.items() if k not in NOT_NUMBERS}

    assert numbers(first) == numbers(second)
    capsys.readouterr()


def test_no_run_is_lost_unless_overwriting_is_asked_for(tmp_path, capsys, monkeypatch):
    """Runs of other scenes in one folder; the same run made again is one file."""
    monkeypatch.setattr(results_folder, "draw", lambda *_, **__: None)  # a second each
    command = ["run", "paper_designed", "--out", str(tmp_path), "--set", "run.t_end=0.02"]

    def recordings():
        return sorted(path.name for path in tmp_path.glob("*.mcap"))

    for damping in ("20", "5", "20"):
        assert main([*command, "--set", f"buffer.c_A={damping}"]) == 0
    names = [f"paper_designed_t_end_0.02_c_A_{c_A}.mcap" for c_A in (20, 5)]
    assert recordings() == names
    named = [*command, "--set", "name=mine", "--set"]
    for rest, files in (
        (["buffer.c_A=20"], ["mine.mcap"]),
        (["buffer.c_A=5"], ["mine.mcap", "mine_2.mcap"]),
        (["buffer.c_A=7", "--overwrite"], ["mine.mcap", "mine_2.mcap"]),
        (["buffer.c_A=8", "--no-record"], ["mine.mcap", "mine_2.mcap"]),
    ):
        assert main([*named, *rest]) == 0
        assert recordings() == sorted([*files, *names])
    assert read_bag(tmp_path / "mine.mcap").scene.buffer.c_A == 7.0
    text = (tmp_path / "results.txt").read_text()
    assert "with run.t_end=0.02, name=mine, buffer.c_A=8; capture_sim " in text


def test_run_beside_a_bench_recording_leaves_it_and_its_picture(tmp_path, capsys):
    recording, picture = tmp_path / "tilt_p10.mcap", tmp_path / "tilt_p10.png"
    made = write_run(simulate(load_scene("tilt_p10")), tmp_path / "made" / "tilt_p10.mcap")
    of_a_bench(made, recording)
    picture.write_text("of the bench")
    before = recording.read_bytes(), picture.read_bytes()
    assert main(["run", "tilt_p10", "--out", str(tmp_path)]) == 0
    assert (recording.read_bytes(), picture.read_bytes()) == before
    assert (tmp_path / "tilt_p10_2.mcap").is_file()
    assert (tmp_path / "tilt_p10_2.png").is_file()
    assert f"plot in {tmp_path / 'tilt_p10_2.png'}" in capsys.readouterr().out


def test_command_that_made_no_run_leaves_earlier_results(tmp_path, capsys, monkeypatch):
    """The nodes find no middleware, so that each dies at its start."""
    assert main(["run", "tilt_0", "--no-record", "--out", str(tmp_path)]) == 0
    for name in ("tilt_0.mcap", "tilt_0.png", "overview.png"):
        (tmp_path / name).write_text("an earlier one")
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()}
    assert {"results.txt", "results.json"} < set(before)
    capsys.readouterr()
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_of_nobody")
    assert main(["bench", "tilt_0", "--out", str(tmp_path)]) != 0
    seen = capsys.readouterr()
    assert "no result for tilt_0" in seen.err
    assert "verdict" not in seen.out
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()} == before


def test_a_failed_run_says_why_and_keeps_what_was_computed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(results_folder, "draw", lambda *_, **__: None)
    status = main(["run", "paper_designed", "--set", "run.max_steps=300", "--out", str(tmp_path)])
    seen = capsys.readouterr()
    assert status == 1
    assert "paper_designed_max_steps_300: stopped at t = 0." in seen.err
    assert "phase contact" in seen.err or "phase free" in seen.err
    assert "run.max_steps" in seen.err
    kept = read_bag(tmp_path / "paper_designed_max_steps_300.mcap")
    assert kept.samples.size > 5
    assert not kept.complete


def test_scenes_and_show(capsys):
    assert main(["scenes"]) == 0
    assert "tilt_p10" in capsys.readouterr().out
    assert main(["show", "tilt_0", "--set", "buffer.c_A=20"]) == 0
    assert "c_A: 20.0" in capsys.readouterr().out


@pytest.mark.parametrize(
    "command, step, message",
    [
        (["run", "tilt_0", "paper_undamped"], "run.simulate", "only the recordings named above"),
        (["run", "paper_undamped"], "results_folder.draw", "named above are complete, other plots"),
        (["report", "tilt_0", "--out", "x.html"], "report.save_report", "x.html is not written"),
        (["view", "tilt_0"], "view.plotted_runs", "nothing is written"),
        (["view", "paper_undamped"], "view.draw", "named above are complete, other plots"),
    ],
)
def test_ctrl_c_says_what_is_written(command, step, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    module, name = step.split(".")
    owner = import_module(
        f"capture_sim.{'viewing' if name == 'save_report' else 'commands'}.{module}"
    )
    original, calls = getattr(owner, name), []

    def interrupted(*arguments, **options):
        calls.append(name)
        # the second run is interrupted, or what is done once
        if name == "simulate" and len(calls) == 1:
            return original(*arguments, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(owner, name, interrupted)
    assert main(command) == 130
    out, errors = capsys.readouterr()
    assert errors.splitlines()[-1].startswith("capture-sim: interrupted: ")
    assert message in errors
    written = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert written == {
        "run.simulate": {"tilt_0.mcap"},
        "results_folder.draw": {"paper_undamped.mcap", "results.txt", "results.json"},
    }.get(step, set())
    assert all(name in out for name in written)


def on_terminal(width, *arguments):
    """Return what a command prints on a terminal of this width, without its colours."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 40, width, 0, 0))
    environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "NO_COLOR")}
    command = [sys.executable, "-m", "capture_sim.cli", *map(str, arguments)]
    with subprocess.Popen(
        command, stdin=slave, stdout=slave, stderr=subprocess.DEVNULL, env=environment
    ) as process:
        os.close(slave)
        text = b""
        with suppress(OSError):  # at its end
            while part := os.read(master, 65536):
                text += part
        os.close(master)
        assert process.wait() == 0
    return re.sub(r"\x1b\[[0-9;]*m", "", text.decode()).replace("\r", "").splitlines()


@pytest.mark.parametrize("width", [80, 120])
def test_tables_never_break_on_a_terminal(width, tmp_path):
    path = dirty.write(tmp_path, "plain")
    two = ["run", "tilt_p10", "paper_designed", "--no-record", "--out", tmp_path]
    for command in (two, ["inspect", path, "--scene", "tilt_p10"]):
        lines = on_terminal(width, *command)
        rules = [k for k, line in enumerate(lines) if line.startswith("──")]
        assert len(rules) >= (2 if width == 80 else 1)
        for k in rules:
            for line in lines[max(k - 3, 0) : k + 5]:
                if line and not line.endswith("."):
                    assert len(line) <= width, line
