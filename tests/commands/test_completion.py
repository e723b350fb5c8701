"""What a shell may offer after the words that are typed."""

import os
import subprocess
import sys

import pytest

TYPED = {
    "capture-sim swe": {"sweep"},
    "capture-sim sweep --sche": {"--scheduler"},
    "capture-sim sweep tilt_": {"tilt_0", "tilt_p10", "tilt_m10"},
    "capture-sim sweep --vary buffer.k_": {f"buffer.k_{x}" for x in ("A", "T", "A3", "T3")},
    "capture-sim run runs/": {"runs/a.mcap"},
}


@pytest.mark.parametrize("line", TYPED)
def test_a_shell_is_told_what_may_follow(line, tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "a.mcap").touch()
    asked = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9", "_ARGCOMPLETE": "1"}
    out = tmp_path / "out"
    subprocess.run(
        [sys.executable, "-m", "capture_sim.cli"],
        cwd=tmp_path,
        env=os.environ | asked | {"_ARGCOMPLETE_STDOUT_FILENAME": str(out)},
        check=True,
    )
    assert set(out.read_text().replace("\v", "\n").split()) == TYPED[line]
