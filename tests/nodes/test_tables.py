"""config/nodes.yaml and the tables of topics and frames are those of running nodes."""

import subprocess
import sys

import pytest

from tests.nodes.own_domain import own_domain
from tools.reference import ROOT
from tools.tables_of_nodes import FILE, PAGE, part_of


@pytest.mark.long
def test_the_file_and_the_page_say_what_running_nodes_declare_and_send():
    """The tool itself compares type and quality of service with the code's table of topics."""
    page = (ROOT / PAGE).read_text(encoding="utf-8")
    with own_domain():
        command = [sys.executable, "-m", "tools.tables_of_nodes"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    file = (ROOT / FILE).read_text(encoding="utf-8")
    assert part_of(done.stdout, FILE.name)[1].strip() == file.strip()
    for name in ("topics", "frames"):
        found, written = part_of(done.stdout, name)[1], part_of(page, name)[1]
        assert found.splitlines() == written.splitlines(), "python -m tools.tables_of_nodes ."
