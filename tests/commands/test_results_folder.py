"""The tables of a folder show every recording in it, and lose nothing that was measured."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from bags import of_a_bench

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.commands import results_folder
from capture_sim.commands.results_folder import SHOWN, Recorded, ResultsFolder
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.run.summary import KEYS, NOT_NUMBERS

SHORT = {"run.t_end": 0.05}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(results_folder, "draw", lambda *_, **__: None)
    return tmp_path / "runs"


def command(folder, *arguments, status=0):
    """Run short scenes into a folder, and check its tables against its recordings."""
    short = [f"--set={name}={value}" for name, value in SHORT.items()]
    assert main(["run", *arguments, *short, f"--out={folder}"]) == status
    return checked(folder)


def made(**changes):
    return simulate(load_scene("paper_designed", {**SHORT, **changes}))


def checked(folder):
    """Return the rows of a folder, checked against the recordings in it."""
    rows = json.loads((folder / "results.json").read_text())
    recordings = {path.name for path in folder.glob("*.mcap") if path.name[0] != "."}
    listed = [row["recording"] for row in rows if row["recording"]]
    text = (folder / "results.txt").read_text()
    foreign = {name for name in recordings if f"did not record it: {name}." in text}
    assert sorted(listed) == sorted(recordings - foreign)
    for row in rows:
        assert [key for key in row if key in KEYS] == list(KEYS)
        assert [key for key in row if key in rows[0]] == [key for key in rows[0] if key in row]
        name = (row["recording"] or row["name"]).removesuffix(".mcap")
        assert f"\n{name} " in text
        if row["recording"] and not row["problems"]:
            summary = json.loads(json.dumps(read_run(folder / row["recording"]).summary))
            assert {key: row[key] for key in summary.keys() - NOT_NUMBERS} == {
                key: summary[key] for key in summary.keys() - NOT_NUMBERS
            }
    return rows


def names(rows):
    return [row["recording"] for row in rows]


def test_each_command_adds_its_runs(folder, capsys):
    """The same run again is the same row; another run of the same name has its own."""
    own = ["paper_designed", "--set=name=own"]
    assert names(command(folder, *own)) == ["own.mcap"]
    assert names(command(folder, *own)) == ["own.mcap"]
    rows = command(folder, *own, "--set=buffer.c_A=5")
    assert names(rows) == ["own.mcap", "own_2.mcap"]
    rows = command(folder, "paper_undamped", "tilt_0")
    others = ["paper_undamped_t_end_0.05.mcap", "tilt_0_t_end_0.05.mcap"]
    assert names(rows) == ["own.mcap", "own_2.mcap", *others]
    printed = capsys.readouterr().out
    assert "table of all 4 runs in" in printed
    assert "\nown_2 " in printed  # as its recording and its plot
    # the recording that is replaced takes its row with it
    rows = command(folder, *own, "--set=buffer.c_A=7", "--overwrite")
    assert names(rows) == ["own_2.mcap", *others, "own.mcap"]
    assert rows[-1]["made_by"]["overrides"][-1] == "run.t_end=0.05"


def test_a_run_without_a_recording_keeps_its_row(folder):
    rows = command(folder, "paper_designed", "--set=name=own", "--no-record")
    assert names(rows) == [None]
    command(folder, "paper_designed", "--set=name=own", "--no-record")
    command(folder, "paper_designed", "--set=name=own", "--set=buffer.c_A=5", "--no-record")
    rows = command(folder, "tilt_0", "--set=name=other")
    assert [(row["name"], row["recording"]) for row in rows] == [
        ("own", None),
        ("own", None),
        ("other", "other.mcap"),
    ]
    assert "\nown * " in (folder / "results.txt").read_text()
    # recorded at last: the row gets the recording
    rows = command(folder, "paper_designed", "--set=name=own")
    assert names(rows) == [None, "other.mcap", "own.mcap"]


def test_rows_of_deleted_recordings_stay_even_if_their_names_are_taken(folder):
    own = ["paper_designed", "--set=name=own"]
    command(folder, *own)
    (folder / "own.mcap").unlink()
    rows = command(folder, *own, "--set=buffer.c_A=5")
    assert [(row["recording"], row["made_by"]["overrides"][1]) for row in rows] == [
        (None, "run.t_end=0.05"),
        ("own.mcap", "buffer.c_A=5"),
    ]


def test_a_command_that_is_killed_before_the_tables(folder):
    """The next one lists what it has recorded."""
    compile_kernels()
    killed = (
        "import os, signal, sys\n"
        "from capture_sim.cli import main\n"
        "from capture_sim.commands.results_folder import ResultsFolder\n"
        "ResultsFolder.add = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        "main(sys.argv[1:])\n"
    )
    arguments = ["run", "paper_designed", "--set=run.t_end=0.05", f"--out={folder}"]
    process = subprocess.run([sys.executable, "-c", killed, *arguments], check=False)
    assert process.returncode == -9
    assert [path.suffix for path in folder.iterdir()] == [".mcap"]
    rows = command(folder, "paper_undamped")
    assert names(rows) == [
        "paper_designed_t_end_0.05.mcap",
        "paper_undamped_t_end_0.05.mcap",
    ]


def test_recordings_of_others_and_damaged_ones(folder):
    folder.mkdir()
    of_a_bench(write_run(made(), folder.parent / "made.mcap"), folder / "mocap.mcap")
    (folder / "notes.mcap").write_text("a text")
    (folder / ".hidden.part-1.mcap").write_text("of a kill")
    (folder / "results.csv").write_text("mine")
    cut = write_run(made(), folder / "cut.mcap")
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 3 // 4])
    # the description is whole, its scene is of another program
    odd = write_run(made(), folder / "odd.mcap")
    odd.write_bytes(odd.read_bytes().replace(b"\nbuffer:", b"\nbuffet:"))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    rows = command(folder, "tilt_0", "--set=name=own")
    assert {path.name: path.read_bytes() for path in folder.iterdir()}.items() >= before.items()
    assert names(rows)[-1] == "own.mcap"
    problems = {row["recording"]: row["problems"] for row in rows}
    assert problems["cut.mcap"][0].startswith("read up to byte")
    assert problems["odd.mcap"]
    assert rows[:-1] == command(folder, "tilt_0", "--set=name=own")[:-1]
    text = (folder / "results.txt").read_text()
    assert "Without a row, as capture_sim did not record it: mocap.mcap." in text
    assert "Without a row, as capture_sim did not record it: notes.mcap." in text


def test_tables_of_an_older_version_are_continued(folder):
    """Their rows have fewer keys and name no recording."""
    command(folder, "paper_designed", "paper_undamped", "--set=buffer.c_A=9")
    table = folder / "results.json"
    rows = json.loads(table.read_text())
    for row in rows:
        for key in ("recording", "not_used", "max_torsion_time", "made_by"):
            del row[key]
    rows.append({**rows[0], "name": "measured yesterday", "max_torsion": 1.0, "new_key": [3]})
    table.write_text(json.dumps(rows))
    again = command(folder, "tilt_0", "--set=name=own")
    listed = {row["recording"] or row["name"] for row in again}
    assert {"measured yesterday", "own.mcap"} < listed
    assert next(row for row in again if row["name"] == "measured yesterday")["new_key"] == [3]


@pytest.mark.parametrize("text", ["", "[1]", '{"a": 1}', '[{"name": "x", "verdict": 3}]', "[[["])
def test_a_foreign_table_is_kept_under_another_name(folder, capsys, text):
    folder.mkdir()
    (folder / "results.json").write_text(text)
    rows = command(folder, "paper_designed", "--set=name=own")
    assert names(rows) == ["own.mcap"]
    assert (folder / "results_2.json").read_text() == text
    assert "results.json: not a table of runs: " in capsys.readouterr().err


def test_a_file_that_changes_is_read_again(folder):
    """As one that is still being recorded while another command writes the tables."""
    whole = write_run(made(), folder.parent / "late.mcap").read_bytes()
    folder.mkdir()
    late = folder / "late.mcap"
    late.write_bytes(whole[: len(whole) // 2])
    rows = command(folder, "tilt_0", "--set=name=own")
    assert rows[0]["problems"]
    late.write_bytes(whole)
    after = (folder / "results.json").stat().st_mtime_ns + 1_000_000
    os.utime(late, ns=(after, after))
    rows = command(folder, "paper_undamped")
    assert [(row["recording"], bool(row["problems"])) for row in rows] == [
        ("own.mcap", False),
        ("late.mcap", False),
        ("paper_undamped_t_end_0.05.mcap", False),
    ]


@pytest.mark.long
def test_two_commands_at_once(tmp_path):
    """However they alternate, the tables of the folder list what both have recorded."""
    compile_kernels()
    folder = tmp_path / "runs"
    command_line = [sys.executable, "-m", "capture_sim.cli", "run", "--set=run.t_end=0.05"]
    both = [
        subprocess.Popen(
            [*command_line, scene, f"--set=name={name}", f"--out={folder}"],
            stdout=subprocess.DEVNULL,
        )
        for scene, name in (("paper_designed", "a"), ("paper_undamped", "b"))
    ]
    assert [process.wait(timeout=600) for process in both] == [0, 0]
    assert sorted(names(checked(folder))) == ["a.mcap", "b.mcap"]


def test_updates_at_once_lose_no_row(folder):
    """Two that read the table at the same time: the second waits for the first."""
    compile_kernels()
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "from capture_sim import simulate\n"
        "from capture_sim.commands.results_folder import Recorded, ResultsFolder\n"
        "folder, name = Path(sys.argv[1]), sys.argv[2]\n"
        "for c_A in range(1, 13):\n"
        "    changes = {'run.t_end': 0.01, 'buffer.c_A': c_A, 'name': name}\n"
        "    run = simulate('paper_designed', changes)\n"
        "    ResultsFolder(folder).add([Recorded(run, None)])\n"
    )
    both = [
        subprocess.Popen([sys.executable, "-c", script, folder, name], stdout=subprocess.DEVNULL)
        for name in "ab"
    ]
    assert [process.wait(timeout=600) for process in both] == [0, 0]
    rows = json.loads((folder / "results.json").read_text())
    assert sorted(row["name"] for row in rows) == ["a"] * 12 + ["b"] * 12


def test_plots_show_the_latest_runs_together(folder, monkeypatch):
    """Those of the command each for itself too; others are only drawn beside them."""
    drawn = []
    monkeypatch.setattr(
        results_folder,
        "draw",
        lambda runs, labels, folder, beside: drawn.append((labels, [name for _, name in beside])),
    )
    folder.mkdir()
    for i in range(SHOWN + 1):
        path = write_run(
            made(**{"run.t_end": 0.02 + 0.01 * i}),
            folder / f"run_{i}.mcap",
        )
        os.utime(path, ns=(i * 10**9, i * 10**9))
    (folder / "foreign.mcap").write_text("a text")
    ResultsFolder(folder).draw([Recorded(read_run(folder / "run_0.mcap"), folder / "run_0.mcap")])
    assert drawn == [(["run_0"], [f"run_{i}" for i in range(2, SHOWN + 1)])]
    again = write_run(read_run(folder / "run_6.mcap"), folder / "again.mcap")
    ResultsFolder(folder).draw([Recorded(read_run(again), again)])
    assert "run_6" not in drawn[-1][1]  # the same run, made twice


def test_a_folder_can_be_moved(folder):
    command(folder, "paper_designed", "--set=name=own")
    other = folder.parent / "other"
    shutil.copytree(folder, other)
    assert names(command(other, "tilt_0", "--set=name=next")) == ["own.mcap", "next.mcap"]
