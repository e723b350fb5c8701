"""Files are whole once they have their name, and no name leads out of its folder."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture_sim.base.files import NAME_BYTES, file_name, file_problem, free_path, whole_file


@given(st.text())
def test_any_text_makes_the_name_of_a_file_in_its_folder(tmp_path_factory, text):
    folder = tmp_path_factory.getbasetemp()
    name = file_name(text)
    assert (folder / name).parent == folder
    assert name.isprintable()
    assert name[0] not in ".-"
    assert 0 < len(name.encode()) <= NAME_BYTES
    assert file_name(name) == name


@pytest.mark.parametrize(
    "text, name",
    [
        ("tilt_0", "tilt_0"),
        ("../../x", "_.._x"),
        ("/elsewhere/x", "_elsewhere_x"),
        ("a\nb\x1b[31m", "a_b_31m"),
        ("", "unnamed"),
        ("...", "unnamed"),
        (".hidden", "hidden"),
        ("--out", "out"),
        ("x" * 5000, "x" * NAME_BYTES),
    ],
)
def test_names_from_outside(text, name):
    assert file_name(text) == name


def test_a_file_has_its_name_only_when_it_is_whole(tmp_path):
    path = tmp_path / "deep" / "a.txt"
    with whole_file(path) as part:
        part.write_text("whole")
        assert not path.exists()
        assert part.suffix == ".txt"
    assert [file.name for file in path.parent.iterdir()] == ["a.txt"]
    with pytest.raises(RuntimeError), whole_file(path) as part:
        part.write_text("half")
        raise RuntimeError
    with pytest.raises(FileExistsError), whole_file(path, replace=False) as part:
        part.write_text("second")
    assert path.read_text() == "whole"
    assert [file.name for file in path.parent.iterdir()] == ["a.txt"]


def test_of_many_writers_one_has_the_name_and_all_are_whole(tmp_path):
    path, refused = tmp_path / "a.txt", []
    barrier = threading.Barrier(8)

    def write(text):
        try:
            with whole_file(path, replace=False) as part:
                part.write_text(text)
                barrier.wait()
        except FileExistsError:
            refused.append(text)

    threads = [threading.Thread(target=write, args=(str(i) * 1000,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refused) == 7
    assert len(set(path.read_text())) == 1
    assert free_path(path).name == "a_2.txt"


def test_why_a_file_cannot_be_written(tmp_path):
    path = tmp_path / "report.json"
    assert not file_problem(path)
    assert not path.exists()
    path.write_text("kept")
    assert not file_problem(path)
    assert path.read_text() == "kept"
    assert file_problem(tmp_path) == "it is a folder"
    assert file_problem(tmp_path / "no" / "a.json") == f"{tmp_path / 'no'} is not a folder"
    assert file_problem(path / "a.json") == f"{path} is not a folder"
