"""Draws the plan of the package: its rooms, layer by layer, and which room imports which.

python -m tools.plan docs

An arrow that follows from others is left out: of A to B, B to C and A to C, A to C is.
"""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from capture_sim.viewing import style
from capture_sim.viewing.canvas import new_figure, save

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "capture_sim"
_WIDTH, _ROW = 9.6, 0.86
_BOX = 1.5, 0.44
_FONT = 11.5
#: Where a room stands in its row, as a share of the width, so that few arrows cross; else evenly.
_SHARES = {"cli": 0.36, "commands": 0.36, "viewing": 0.13, "recording": 0.58, "studies": 0.1}
_SHARES |= {"fmu": 0.28, "hardware": 0.73, "trial": 0.9, "messages": 0.53, "run": 0.42}
_SHARES |= {"detection": 0.26, "launcher": 0.74}


def layers() -> list[list[str]]:
    """Return the rooms of each layer, the highest first, as the contract of imports has them."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    rooms = next(c["layers"] for c in settings["contracts"] if c["type"] == "layers")
    return [[name.strip() for name in layer.split("|")] for layer in rooms]


def imports() -> dict[str, set[str]]:
    """Return the rooms that each room imports from, also for types and inside functions."""
    found: dict[str, set[str]] = {room: set() for layer in layers() for room in layer}
    for path in (ROOT / PACKAGE).rglob("*.py"):
        room = path.relative_to(ROOT / PACKAGE).with_suffix("").parts[0]
        if room != "__init__":
            found[room] |= _rooms_in(path) - {room}
    return found


def _rooms_in(path: Path) -> set[str]:
    """Return the rooms that a file imports from."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    inside = (name.split(".") for name in names)
    rooms = {parts[1] for parts in inside if parts[0] == PACKAGE and len(parts) > 1}
    return rooms & {room for layer in layers() for room in layer}


def arrows(found: Mapping[str, set[str]]) -> set[tuple[str, str]]:
    """Return the pairs (importing, imported) that do not follow from others."""

    def reached(room: str) -> set[str]:
        return found[room].union(*(reached(below) for below in found[room]))

    return {
        (room, below)
        for room, rooms in found.items()
        for below in rooms
        if not any(below in reached(other) for other in rooms - {below})
    }


def draw_plan() -> Figure:
    """Draw rooms and arrows; in an SVG they have the ids ``room-NAME`` and ``arrow-FROM-TO``."""
    rows = layers()
    height = _ROW * len(rows)
    figure = new_figure(_WIDTH, height, arranged=False)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, _WIDTH), ylim=(0.0, height))
    axes.set_axis_off()
    places = {
        room: (
            _WIDTH * _SHARES.get(room, (k + 0.5) / len(row)),
            height - _ROW * (n + 0.5),
        )
        for n, row in enumerate(rows)
        for k, room in enumerate(row)
    }
    for room, (x, y) in places.items():
        corner = x - _BOX[0] / 2, y - _BOX[1] / 2
        look = {"facecolor": style.PALE, "edgecolor": style.DARK, "lw": 1.2, "zorder": 5}
        box = FancyBboxPatch(corner, *_BOX, boxstyle="round,pad=0.03", **look)
        box.set_gid(f"room-{room}")
        axes.add_patch(box)
        text = room if room in ("cli", "errors") else f"{room}/"
        axes.text(x, y, text, ha="center", va="center", fontsize=_FONT, zorder=6)
    for room, below in sorted(arrows(imports())):
        (x, y), (x_below, y_below) = places[room], places[below]
        start, end = (x, y - _BOX[1] / 2 - 0.03), (x_below, y_below + _BOX[1] / 2 + 0.03)
        arrow = FancyArrowPatch(start, end, shrinkA=0, shrinkB=0)
        arrow.set(arrowstyle="-|>", mutation_scale=13.0, color=style.DARK, lw=1.2, zorder=3)
        arrow.set_gid(f"arrow-{room}-{below}")
        axes.add_patch(arrow)
    return figure


def main(folder: Path) -> None:
    """Write the plan."""
    print(save(draw_plan(), folder / "plan.svg"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
