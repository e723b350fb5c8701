"""What README and docs show works: their code runs, their site builds, the examples too."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# A fence, what stands behind its language, and its content
BLOCK = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
PAGES = ("README.md", "docs/tutorial.md")


def environment():
    binaries = str(Path(sys.executable).parent)
    return {**os.environ, "PATH": binaries + os.pathsep + os.environ["PATH"], "MPLBACKEND": "agg"}


def run(command, folder):
    done = subprocess.run(
        command, cwd=folder, env=environment(), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, f"{command}: {done.stderr[-2000:]}"
    return done.stdout


@pytest.mark.parametrize("page", PAGES)
def test_the_blocks_of_a_page_run(page, tmp_path):
    python = []
    for language, head, content in BLOCK.findall((ROOT / page).read_text()):
        if language == "yaml" and (title := re.search(r'title="([^"]+)"', head)):
            (tmp_path / title[1]).write_text(content)
        elif language == "console":
            for line in content.splitlines():
                if line.startswith("$ capture-sim"):  # others need a ROS installation
                    run(shlex.split(line[2:]), tmp_path)
        elif language == "python":
            python.append(content)
            (tmp_path / "page.py").write_text("\n".join(python))
            run([sys.executable, "page.py"], tmp_path)
    assert python, f"{page} shows no Python"


def test_sweep_finds_what_captures(tmp_path):
    out = run([sys.executable, str(ROOT / "examples/sweep_damping.py")], tmp_path)
    captured, of = map(int, re.fullmatch(r"captured (\d+) of (\d+)\n", out).groups())
    assert 0 < captured < of
    assert (tmp_path / "sweep_damping.png").stat().st_size > 5000


def test_the_notebook_runs_from_top_to_bottom(tmp_path):
    notebook = json.loads((ROOT / "examples/capture.ipynb").read_text())
    cells = ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]
    (tmp_path / "notebook.py").write_text("\n".join(cells))
    run([sys.executable, "notebook.py"], tmp_path)


def test_a_recording_is_read_by_others(tmp_path):
    run(["capture-sim", "run", "tilt_0", "--out", "runs"], tmp_path)
    out = run(
        [sys.executable, str(ROOT / "examples/bag_to_pandas.py"), "runs/tilt_0.mcap"], tmp_path
    )
    assert "mean" in out


def test_site_builds_without_a_warning(tmp_path):
    run([sys.executable, "-m", "mkdocs", "build", "-q", "-d", str(tmp_path / "site")], ROOT)
    reference = (tmp_path / "site" / "scene_reference" / "index.html").read_text()
    assert "buffer.k_A" in reference
