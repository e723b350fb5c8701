"""The tables of parameters, topics and frames on the reference page are those of running nodes."""

import subprocess
import sys

import pytest

from tests.nodes.own_domain import own_domain
from tools.reference import ROOT
from tools.tables_of_nodes import PAGE, part_of


@pytest.mark.long
def test_the_reference_page_says_what_running_nodes_declare_and_send():
    """The tool itself compares type and quality of service with the code's table of topics."""
    page = (ROOT / "docs" / PAGE).read_text(encoding="utf-8")
    with own_domain():
        command = [sys.executable, "-m", "tools.tables_of_nodes"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    for name in ("parameters", "topics", "frames"):
        found, written = part_of(done.stdout, name)[1], part_of(page, name)[1]
        assert found.splitlines() == written.splitlines(), "python -m tools.tables_of_nodes docs"
