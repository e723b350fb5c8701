"""Where commands read and write: nothing into a bag, nothing left by a rejected command."""

import csv
from pathlib import Path

import numpy as np
import pytest
from bags import in_two_files

import capture_sim
from capture_sim.base.files import whole_file, writing_problem
from capture_sim.cli import main
from capture_sim.errors import RecordingError
from capture_sim.recording.offline import write_run


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    result = capture_sim.simulate(capture_sim.load_scene("tilt_0"), t_end=0.8)
    return write_run(result, tmp_path_factory.mktemp("runs") / "tilt_0.mcap")


def test_tables_of_a_bag_are_written_beside_it(path, tmp_path, monkeypatch):
    folder = in_two_files(path, tmp_path / "bag", 1.4)
    before = sorted(folder.iterdir())
    assert main(["export", str(folder)]) == 0
    monkeypatch.chdir(folder)
    assert main(["export", "."]) == 0
    assert sorted(folder.iterdir()) == before
    assert (tmp_path / "bag_tables" / "bench_state.csv").is_file()
    # nor of a file beside a bag of its name
    path = tmp_path / "bag.mcap"
    (folder / "bag_0.mcap").rename(path)
    assert main(["export", str(path)]) == 0
    assert len(list(folder.iterdir())) == len(before) - 1


def test_touches_are_a_table(tmp_path):
    result = capture_sim.simulate(capture_sim.load_scene("tilt_0"))
    path = write_run(result, tmp_path / "tilt_0.mcap")
    assert main(["export", str(path), "--columns", "impulse", "wall", "--out", str(tmp_path)]) == 0
    with (tmp_path / "touches.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["impulse [N s]"]) for row in rows] == result.touches["impulse"].tolist()
    assert [int(row["wall"]) for row in rows] == result.touches["wall"].tolist()
    assert main(["export", str(path), "--to", "npz", "--out", str(tmp_path)]) == 0
    with np.load(tmp_path / "tilt_0.npz") as arrays:
        assert arrays["touches/peak_force"].tolist() == result.touches["peak_force"].tolist()


def test_missing_input_is_named_where_an_output_is_written(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"), whole_file(tmp_path / "out.txt"):
        (tmp_path / "nowhere").read_text()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "out.txt"
    with pytest.raises(RecordingError, match=r"out.txt: cannot write"), whole_file(out) as part:
        part.write_text("")


@pytest.mark.parametrize("command", ["view", "compare", "export", "report"])
def test_rejected_command_leaves_no_folder(command, tmp_path, capsys):
    files = [str(tmp_path / "no.mcap")] * (2 if command == "compare" else 1)
    out = tmp_path / "deep" / "out"
    assert main([command, *files, "--out", str(out)]) == 2
    assert "no.mcap" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_why_a_folder_cannot_be_written(tmp_path):
    assert writing_problem(tmp_path / "a" / "b") == ""
    (tmp_path / "file").write_text("")
    assert writing_problem(tmp_path / "file") == "it is a file"
    assert "is a file" in writing_problem(tmp_path / "file" / "b")
    assert writing_problem(Path("/proc/x")) == "/proc takes no new files"
    assert writing_problem(tmp_path / ("n" * 300))
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_scene_that_is_none_is_rejected_though_the_recording_contains_one(path, tmp_path, capsys):
    for command in (["view"], ["report"], ["detect"]):
        out = [] if command == ["detect"] else ["--out", str(tmp_path / "out.html")]
        assert main([*command, str(path), "--scene", "nonsense", *out]) == 2
        assert "nonsense" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
