"""An output replaces what this package wrote as that kind, and nothing else."""

import itertools

import pytest

from capture_sim.base.files import whole_file
from capture_sim.base.outputs import guarded_outputs
from capture_sim.cli import main
from capture_sim.errors import RecordingError

OURS = {
    "a.html": b'<!doctype html><meta name="generator" content="capture_sim 0.2.0">',
    "a.png": b"\x89PNG\r\n\x1a\n tEXtSoftware\x00capture_sim 0.2.0",
    "a.json": b'{"software": "capture_sim 0.2.0"}',
    "a.mcap": b"\x89MCAP0\r\n capture_sim",
    "a.csv": b"t [s],wall\n1,2\n",
    "a.yaml": b"title: a scene\n",
}
THEIRS = {
    "a.html": b"<!doctype html><p>mine",
    "a.png": b"\x89PNG\r\n\x1a\n a photograph",
    "a.json": b'{"mine": 1}',
    "a.mcap": b"\x89MCAP0\r\n a trial of another program",
    "a.csv": b"mine,yours\n1,2\n",
    "a.yaml": b"title: mine\n",
    "a.txt": b"notes",
}


def write(path, content, **guard):
    guard = guarded_outputs(guard.pop("inputs", ()), overwrites=guard.pop("overwrites", False))
    with guard, whole_file(path) as part:
        part.write_bytes(content)


@pytest.mark.parametrize("name", OURS)
def test_what_this_package_wrote_is_replaced(name, tmp_path):
    path = tmp_path / name
    (tmp_path / "results.json").write_text('{"software": "capture_sim 0.2.0"}')
    for _ in range(2):
        write(path, OURS[name])
    assert path.read_bytes() == OURS[name]


@pytest.mark.parametrize("name", THEIRS)
def test_what_another_wrote_is_not_replaced_but_on_request(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(THEIRS[name])
    new = OURS.get(name, b"text of capture_sim")
    with pytest.raises(RecordingError, match="exists, and capture-sim has not written it"):
        write(path, new)
    assert path.read_bytes() == THEIRS[name]
    write(path, new, overwrites=True)
    assert path.read_bytes() == new


def test_no_kind_is_replaced_by_another(tmp_path):
    for (name, old), (other, new) in itertools.permutations(OURS.items(), 2):
        path = tmp_path / name
        path.write_bytes(old)
        if not {name, other} <= {"a.csv", "a.yaml"}:
            with pytest.raises(RecordingError):
                write(path, new)
            assert path.read_bytes() == old


def test_an_input_is_never_replaced(tmp_path):
    path = tmp_path / "a.html"
    path.write_bytes(OURS["a.html"])
    for overwrites in (False, True):
        with pytest.raises(RecordingError, match="is an input of this command"):
            write(path, OURS["a.html"], inputs=[path], overwrites=overwrites)


def test_no_command_replaces_a_trial_by_a_page(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = ["--set", "run.t_end=0.1", "--set", "name=tilt_0"]
    assert main(["run", "tilt_0", *scene, "--out", "."]) == 0
    kept = (tmp_path / "tilt_0.mcap").read_bytes()
    (tmp_path / "other.mcap").write_bytes(kept)
    (tmp_path / "scene.yaml").write_text("extends: tilt_0\n")
    for arguments in (
        ["report", "tilt_0.mcap", "--out", "tilt_0.mcap"],
        ["report", "tilt_0.mcap", "--out", "tilt_0.mcap", "--overwrite"],
        ["report", "tilt_0.mcap", "--out", "other.mcap"],
        ["report", "scene.yaml", "--out", "scene.yaml"],
        ["sweep", "scene.yaml", "--vary", "buffer.k_A=400,500", "--out", "scene.yaml"],
    ):
        assert main(arguments) == 2, arguments
        assert capsys.readouterr().err.count("\n") == 1
    assert (tmp_path / "tilt_0.mcap").read_bytes() == kept
    assert (tmp_path / "other.mcap").read_bytes() == kept
    assert (tmp_path / "scene.yaml").read_text() == "extends: tilt_0\n"
    page = tmp_path / "page.html"
    for _ in range(2):
        assert main(["report", "tilt_0.mcap", "--out", str(page)]) == 0
