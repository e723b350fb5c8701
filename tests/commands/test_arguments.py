"""Whatever is written behind a command: a documented status, a line or three, nothing elsewhere.

The same cases every time, from each command's own options with values that fit none of them;
``CAPTURE_SIM_EXAMPLES=2000`` tries that many in place of 25 for each command.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import warnings
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from capture_sim import SceneError, load_scene
from capture_sim.base.exit_status import BAD_INPUT
from capture_sim.cli import command_parser, main
from capture_sim.commands import COMMANDS, GROUPS, OPTIONS
from capture_sim.studies.vary.inputs import FAMILIAR, read_input

EXAMPLES = int(os.environ.get("CAPTURE_SIM_EXAMPLES", "25"))
some = settings(
    max_examples=EXAMPLES,
    derandomize=True,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
#: Values that no option and no argument takes.
NO_NUMBERS = ["", " ", "nan", "-inf", "1e400", "9" * 401, "9" * 5000, "0x1", "1_0", "½", "None"]
WRONG = st.sampled_from(
    [
        *NO_NUMBERS,
        *("\x00", "\ud800", "\n", "\x1b[31m", "%s", "-", "--", "a" * 300),
        *("../../elsewhere", "/dev/full", "/nowhere/x.mcap"),
        *("5 deg:", ":::", "1,2,3,4", "[1, 2", "{a: [", "!!python/object:os.system x"),
    ]
)
#: Scenes and recordings that are not.
NOT_THERE = ["nosuch", "nosuch.mcap", "/", "/dev/null", "/dev/zero", "a" * 5000, "\x00.mcap"]
#: What is wrong behind a scene that exists, too.
UNKNOWN = [["--no-such"], ["--set", "a.b=1"], ["--set", "x"], ["--set", "buffer.c_A=-1"]]
UNKNOWN += [["--out", "/dev/null/x"]]


def options_of(command: str) -> list[argparse.Action]:
    """Return what a command takes, but for its positional arguments."""
    parser = argparse.ArgumentParser(add_help=False)
    import_module(f"capture_sim.commands.{command}").add_arguments(parser)
    return [action for action in parser._actions if action.option_strings]


def arguments_of(command: str) -> st.SearchStrategy[list[str]]:
    """Return arguments of a command of which one at least is wrong."""
    taking = [a.option_strings[0] for a in options_of(command) if a.nargs != 0] or ["--no-such"]
    unknown = st.sampled_from([*UNKNOWN, ["--out"]])
    wrong = st.tuples(st.sampled_from(taking), WRONG).map(list) | unknown
    nowhere = st.tuples(
        st.lists(st.sampled_from(NOT_THERE), min_size=1, max_size=3), st.lists(wrong, max_size=3)
    )
    there = st.tuples(st.just(["tilt_0"]), st.lists(unknown, min_size=1, max_size=2))
    return (nowhere | there).map(
        lambda parts: [*parts[0], *(word for option in parts[1] for word in option)]
    )


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "scenes"])
def test_wrong_arguments_end_in_a_line(command, tmp_path, capfd, monkeypatch):
    pytest.importorskip("rclpy" if command in ("bench", "replay") else "numpy")
    inside = tmp_path / "inside"
    inside.mkdir()
    monkeypatch.chdir(inside)

    @some
    @given(arguments_of(command))
    def try_one(arguments: list[str]) -> None:
        status = main([command, *arguments])
        said = capfd.readouterr().err
        assert status == BAD_INPUT, (arguments, said)
        assert 1 <= said.count("\n") <= 3, (arguments, said)
        assert "Traceback" not in said
        assert "\x1b" not in said
        assert len(said) < 3000

    try_one()
    assert [path.name for path in tmp_path.iterdir()] == ["inside"]
    assert [path for path in inside.rglob("*") if path.is_file()] == []


NUMBER = st.sampled_from(
    [
        *NO_NUMBERS,
        *("0", "-0", "5", "0.5", "1e-30", "1e30", "1e999", "-1e999", "1e308", "-1e308", "1e-400"),
        *("5 deg", "1e400 deg", "3 mm", "50%", "1e308%", "5 parsnips", "5,5"),
    ]
)


@settings(some, max_examples=12 * EXAMPLES)
@given(
    st.sampled_from(
        ["approach.angle", "approach.speed", "buffer.k_A", "run.max_steps", "contact.law"]
    ),
    st.one_of(
        st.tuples(NUMBER, NUMBER, NUMBER | st.just("3")).map(":".join),
        st.lists(NUMBER, min_size=1, max_size=4).map(",".join),
        st.tuples(
            st.sampled_from([*FAMILIAR, "weibull_min", "gamma", "norm", "poisson"]),
            st.lists(NUMBER, max_size=4).map(",".join),
        ).map("{0[0]}({0[1]})".format),
    ),
)
@example("approach.angle", "1e999:1:3")
@example("buffer.k_A", "-1e308:1e308:3")
@example("buffer.k_A", "uniform(-1e308, 1e308)")
def test_an_axis_has_finite_values_or_is_rejected_in_a_line(name, text):
    """Of a sweep; and nothing overflows, of which NumPy would warn."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            axis = read_input(load_scene("tilt_0"), name, text)
        except SceneError as error:
            said = str(error)
            assert said.startswith(name)
            assert "must be" in said or "must have" in said
            assert "\n" not in said
            assert len(said) < 600
        else:
            drawn = axis.quantile(np.array([0.0, 0.5, 1.0])) if axis.distribution else axis.values
            assert all(isinstance(value, str) or math.isfinite(value) for value in drawn)


DESIGN, PAPER, SWEEP = ["design"], ["paper"], ["sweep"]
BENCH, REPLAY = ["bench", "tilt_0"], ["replay", "x.mcap"]
NO_FACTOR = "must be a number >= 0 and <= 1000"


@pytest.mark.parametrize(
    "command, arguments, said",
    [
        (["run", "tilt_0", "--set"], ["chaser.mass=-1"], "chaser.mass = -1"),
        (["run"], ["tilt_0", "tilt_0"], "given twice"),
        (BENCH, ["--rtf", "1000.1"], NO_FACTOR),
        (REPLAY, ["--rtf", "inf"], NO_FACTOR),
        (BENCH, ["--namespace", "a b"], "must be a ROS name, e.g. lab"),
        (BENCH, ["--namespace", "lab//two"], "must be a ROS name, e.g. lab"),
        (["view"], ["tilt_0", "--window", "nan", "1"], "a number"),
        (["compare"], ["x.mcap", "--tolerance", "nan"], "a number >= 0"),
        (["calibrate"], ["x.mcap", "--restarts", "0x10"], "whole number"),
        (
            DESIGN,
            ["--stroke=5"],
            "unrecognized arguments: --stroke=5; did you mean --stroke-limit?",
        ),
        (PAPER, ["--stroke=5"], "--stroke (mm), --torsion (mrad): must be given both or neither"),
        (PAPER, ["--stroke=0", "--torsion=1"], "'0': must be a number > 0, in mm"),
        (PAPER, ["--stroke=1", "--torsion=2000"], "torsion = 2.0 rad: must be >= 1e-06"),
        (DESIGN, ["--minimize=max_force"], "minimize max_force: is no load; did you mean"),
        (DESIGN, ["--minimize=max_torsion,max_torsion"], "max_torsion: must be given once"),
        (DESIGN, ["--maximize=max_torsion"], "maximize max_torsion: must be capture_range"),
        (DESIGN, ["--minimize=max_force"], "did you mean max_"),
        (DESIGN, ["--free=buffer.k_A=500"], "free buffer.k_A=500: nothing to search"),
        (DESIGN, ["--maximize=capture_range"], "capture_range: must have an area of approach"),
        (DESIGN, ["--approach=offset=5:-5:3"], "must be LOW:HIGH:COUNT with LOW < HIGH"),
        (DESIGN, ["--pick=13"], "--pick: '13': must be knee, or the number of a row, 1 to 12"),
        (DESIGN, ["--candidates=5"], "--candidates: '5': must be a whole number"),
        (DESIGN, ["--confidence=0.9"], "--confidence: must be given with --under or --calibrated"),
        (DESIGN, ["--under=missing.yaml"], "missing.yaml: cannot be read"),
        (DESIGN, ["--limit=max_torsion"], "must be LOAD=VALUE"),
        (DESIGN, ["--limit=max_torsion=5 N"], "limit max_torsion = '5 N': must be a number in rad"),
        (DESIGN, ["--peak-force=5", "--limit=max_normal_force=5"], "must be given once"),
        (SWEEP, ["--vary=gravity=8,9", "--correlate=a=1"], "must be NAME,NAME=R"),
        (SWEEP, [], "--vary: must be given at least once, or --under, or --calibrated, or --from"),
        (SWEEP, ["--vary=buffer.c_A"], "--vary buffer.c_A: must be NAME=VALUES"),
        (SWEEP, ["--vary=gravity=9", "--vary=gravity=8"], "each name once"),
        (SWEEP, ["--vary=gravity=normal(9,1)", "--runs=0"], "runs = 0: must be >= 1"),
        (SWEEP, ["--vary=gravity=8,9", "--runs=5"], "must be 0 where no axis is a distribution"),
        (SWEEP, ["--vary=gravity=8,9", "--from=x.csv"], "--from: must be given without --vary"),
        (SWEEP, ["--from=x.csv"], "x.csv: cannot be read"),
        (SWEEP, ["--vary=gravity=8,9", "--out=x.txt"], "--out = x.txt: must end in .csv or .parq"),
        (SWEEP, ["--vary=gravity=8,9", "--worst=force"], "--worst"),
        (SWEEP, ["--vary=gravity=8,9", "--workers=-1"], "--workers: '-1': must be"),
        (SWEEP, ["--vary=gravity=8,9", "--seed=-1"], "whole number"),
    ],
)
def test_bad_input_is_said_in_a_line_before_anything_runs(
    command, arguments, said, capsys, tmp_path, monkeypatch
):
    pytest.importorskip("rclpy" if command[0] in ("bench", "replay") else "numpy")
    monkeypatch.chdir(tmp_path)
    assert main([*command, *arguments]) == 2
    seen = capsys.readouterr()
    assert said in seen.err
    assert seen.err.startswith("capture-sim")
    assert seen.err.count("\n") == 1
    assert seen.out == ""
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_mistyped_word_gets_the_nearest_one_and_help_is_a_word(capsys):
    for arguments, meant in (
        (["rum", "tilt_0"], "run"),
        (["--verison"], "--version"),
        (["run", "tilt_0", "--no-recrod"], "--no-record"),
    ):
        assert main(arguments) == BAD_INPUT
        assert f"did you mean {meant}?" in capsys.readouterr().err
    for words, usage in ((["help", "run"], "capture-sim run"), (["help"], "capture-sim [-h]")):
        assert main(words) == 0
        assert capsys.readouterr().out.startswith(f"usage: {usage}")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize(
    "arguments, buffered",
    [
        (["--help"], True),
        (["run", "paper_designed", "--no-record", "--set", "run.t_end=0.01"], False),
    ],
)
def test_a_full_device_is_a_line(arguments, buffered, tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    if not buffered:
        environment["PYTHONUNBUFFERED"] = "1"
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "capture_sim.cli", *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=tmp_path,
        )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("capture-sim: ")
    assert done.stderr.count("\n") == 1


def test_a_reader_that_goes_away_is_no_error(tmp_path):
    command = f"{sys.executable} -m capture_sim.cli scenes | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=tmp_path)
    assert done.stderr == ""


@pytest.mark.parametrize("arguments, status", [("scenes", 0), ("run --nonsense", BAD_INPUT)])
def test_closed_streams_change_neither_status_nor_the_other_stream(arguments, status, tmp_path):
    def called(closed=""):
        command = f"{sys.executable} -m capture_sim.cli {arguments} {closed}"
        done = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == status
        return done.stdout, done.stderr

    out, err = called()
    assert called(">&-") == ("", err)
    assert called("2>&-") == (out, "")
    assert called("<&- >&- 2>&-") == ("", "")


@pytest.mark.parametrize("option", ["--set", "--out"])
def test_two_dashes_are_no_value(option, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "tilt_0", f"{option}=--"]) == BAD_INPUT
    assert f"argument {option}: expected one argument" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_help_lists_every_command_in_its_group_with_an_example(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for group, commands in GROUPS.items():
        assert f"\n{group}:\n" in text
        for name, line in commands.items():
            assert f"  {name}" in text
            assert line in text
    for name in COMMANDS:
        assert import_module(f"capture_sim.commands.{name}").EXAMPLE.startswith(
            f"  capture-sim {name}"
        )


def test_help_loads_no_library():
    script = (
        "import sys\nfrom capture_sim.cli import main\nmain(['--help'])\n"
        "print([m for m in ('numpy', 'numba', 'rich', 'yaml') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.endswith("[]\n"), done.stdout[-200:]


def test_titles_in_help_are_of_options_that_exist():
    known = {
        option
        for name in COMMANDS
        for action in command_parser(name)._actions
        for option in action.option_strings
    }
    assert not {option for options in OPTIONS.values() for option in options} - known


def test_a_former_command_is_led_to_what_does_its_work(capsys):
    assert main(["identify", "run.mcap", "c_rr"]) == BAD_INPUT
    line = capsys.readouterr().err
    assert "run capture-sim calibrate RUN.mcap --fit NAME" in line
    assert line.count("\n") == 1
