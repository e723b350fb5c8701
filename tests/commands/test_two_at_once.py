"""Two commands into one folder at once: every file that is left is whole."""

import subprocess
import sys

import pytest

from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.recording.bag import read_bag


@pytest.mark.long
def test_two_runs_into_one_folder(tmp_path):
    compile_kernels()
    short = ["paper_designed", "--set", "run.t_end=0.3"]
    command = [sys.executable, "-m", "capture_sim.cli", "run", *short, "--out", "two"]
    both = [
        subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        for _ in range(2)
    ]
    for one in both:
        said = one.communicate(timeout=600)[1].decode()
        assert one.returncode in (0, 2), said
        assert "Traceback" not in said
    assert 0 in [one.returncode for one in both]
    left = {path.name: path for path in (tmp_path / "two").iterdir()}
    assert not [name for name in left if name.startswith(".")]
    recordings = [path for name, path in left.items() if name.endswith(".mcap")]
    assert recordings
    for path in recordings:
        run = read_bag(path)
        assert run.problems == ()
        assert run.statuses[-1].final
