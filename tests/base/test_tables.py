"""Printed tables: whole on any terminal."""

from rich.console import Console

from capture_sim.base import tables
from capture_sim.base.tables import print_table

HEAD = ["row", "force of the buffer\nN", *(f"value {k}" for k in range(9))]
ROWS = [[str(n), "3.4680", *(f"{n}.{k}491" for k in range(9))] for n in range(3)]


def printed(capsys, monkeypatch, width):
    """Return what is printed on a terminal of a width."""

    def console(**options):
        return Console(**options, force_terminal=True, width=width, color_system=None)

    monkeypatch.setattr(tables, "Console", console)
    print_table(HEAD, ROWS)
    return capsys.readouterr().out


def test_a_narrow_terminal_gets_every_value_whole(capsys, monkeypatch):
    text = printed(capsys, monkeypatch, 60)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 60
    for cell in [cell for row in ROWS for cell in row]:
        assert cell in text.split()
    assert "\u2026" not in text
    blocks = sum(line.lstrip().startswith("row") for line in text.splitlines())
    assert blocks > 1
    # each block has the first column again
    assert sum(line.startswith("2 ") for line in text.splitlines()) == blocks


def test_a_wide_terminal_gets_one_table(capsys, monkeypatch):
    text = printed(capsys, monkeypatch, 300)
    assert sum(line.startswith("2 ") for line in text.splitlines()) == 1
