"""What is printed under the figures of the pages can be typed in, and every figure is there."""

import re
import shlex
from pathlib import Path

import pytest

from capture_sim.cli import command_parser

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGES = [
    DOCS / name
    for name in ("reproduction.md", "design.md", "envelope.md", "sensitivity/sensitivity.md")
]
COMMAND = re.compile(r"^    \.venv/bin/capture-sim (.*)$|`\.venv/bin/capture-sim ([^`]*)`", re.M)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_under_figures_are_understood(page):
    found = COMMAND.findall(page.read_text())
    assert found
    for one, other in found:
        command, *arguments = shlex.split(one or other)
        command_parser(command).parse_args(arguments)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_figure_is_there(page):
    figures = re.findall(r"!\[[^]]*\]\(([^)]*)\)", page.read_text())
    assert figures
    for figure in figures:
        assert (page.parent / figure).stat().st_size > 10_000


def test_every_figure_of_the_reproduction_has_its_command():
    text = (DOCS / "reproduction.md").read_text()
    for figure in re.findall(r"\(reproduction/(\w+)\.png\)", text):
        assert f"capture-sim reproduce --only {figure} --out runs" in text
