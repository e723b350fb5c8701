"""The version that runs and files name."""

import subprocess
from pathlib import Path

import pytest

import capture_sim
from capture_sim.base import software
from capture_sim.base.software import own_version, software_versions

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A clone of a package like this one, and how to run git in it."""
    module = tmp_path / "capture_sim" / "base" / "software.py"
    module.parent.mkdir(parents=True)
    for path in (module, tmp_path / "package.xml", tmp_path / "notes.txt"):
        path.write_text("first")
    monkeypatch.setattr(software, "__file__", str(module))
    own_version.cache_clear()
    identity = ["-c", "user.name=n", "-c", "user.email=n@example.org"]

    def git(*arguments):
        command = ["git", "-C", tmp_path, *identity, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    yield tmp_path, git
    own_version.cache_clear()


def test_a_clone_names_its_commit_and_whether_its_code_differs(clone):
    folder, git = clone
    assert own_version() == capture_sim.__version__  # without git
    for make, ending in (
        (lambda: git("init", "-q"), None),  # no commit yet
        (lambda: (git("add", "."), git("commit", "-qm", "first")), ""),
        (lambda: (folder / "notes.txt").write_text("second"), ""),  # decides about no numbers
        (lambda: (folder / "capture_sim" / "base" / "software.py").write_text("x"), ".changed"),
        (lambda: git("commit", "-qam", "second"), ""),
        (lambda: (folder / "capture_sim" / "new.py").write_text(""), ".changed"),
    ):
        make()
        own_version.cache_clear()
        commit = "" if ending is None else "+" + git("rev-parse", "HEAD")[:7] + ending
        assert own_version() == capture_sim.__version__ + commit


def test_simulate_starts_no_program_until_the_software_is_asked_for(monkeypatch):
    started = []
    monkeypatch.setattr(subprocess, "check_output", lambda *a, **_: started.append(a) or "")
    own_version.cache_clear()
    software_versions.cache_clear()
    run = capture_sim.simulate("tilt_0", t_end=0.1)
    assert not started
    assert any(line.startswith("capture_sim ") for line in run.origin.software)
    assert len(started) == (ROOT / ".git").exists()
    own_version.cache_clear()
    software_versions.cache_clear()
