"""The plan in CONTRIBUTING is that of the code: layers, rooms, arrows, and the places it names."""

import ast
import re
import tomllib
from collections import defaultdict

import pytest

from tools.plan import PACKAGE, ROOT, arrows, imports, layers

ROOMS = sorted(path.parent for path in (ROOT / PACKAGE).rglob("__init__.py"))
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_there_are_twelve_layers_and_few_loose_modules():
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    assert contract["exclude_type_checking_imports"] is False
    assert len(layers()) <= 12
    loose = [path.stem for path in (ROOT / PACKAGE).glob("*.py")]
    assert len(loose) <= 5, loose


def test_every_import_points_to_a_lower_layer():
    height = {room: -n for n, layer in enumerate(layers()) for room in layer}
    upwards = {(a, b) for a, below in imports().items() for b in below if height[a] <= height[b]}
    assert upwards == set()


def test_the_picture_shows_the_rooms_and_arrows_of_the_code():
    picture = (ROOT / "docs" / "plan.svg").read_text(encoding="utf-8")
    drawn = re.findall(r'id="arrow-(\w+)-(\w+)"', picture)
    assert set(drawn) == arrows(imports()), "python -m tools.plan docs"
    rooms = re.findall(r'id="room-(\w+)"', picture)
    assert sorted(rooms) == sorted(imports())


@pytest.mark.parametrize("folder", ROOMS[1:], ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_room_says_what_it_is_for(folder):
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8")))
    if folder.parent.name == "dynamics":  # one contract, in dynamics/__init__.py
        text = (folder.parent / "__init__.py").read_text(encoding="utf-8")
        assert f"``{folder.name}``" in text
        return
    for label in ("Takes: ", "Gives: ", "Must not know: "):
        assert f"\n{label}" in text, label
    [begin] = re.findall(r"\nBegin with: ``([\w/]+\.py)``", text)
    assert (folder / begin).is_file()


def test_the_places_that_the_plan_names_exist():
    plan = CONTRIBUTING[CONTRIBUTING.index("## The plan of the house") :]
    named = re.findall(r"`([\w./]+/[\w.]+\.(?:py|msg|md|toml))`", plan)
    assert len(named) > 60
    places = (ROOT, ROOT / PACKAGE)
    missing = {name for name in named if not any((place / name).is_file() for place in places)}
    assert missing == set()


@pytest.mark.parametrize(
    "change",
    [
        *("a term in the buffer", "a criterion of capture", "a topic", "number in `results.json`"),
        *("a plot", "a sensor", "a limit of the loop", "a command", "an interlock"),
        *("a message's field", "when a launch may begin", "message type of a measured source"),
        *("string goes slack", "how long a step is", "quality of service", "an output of the FMU"),
        "objective of a design",
    ],
)
def test_the_table_says_where_to_begin(change):
    rows = [line for line in CONTRIBUTING.splitlines() if line.startswith("| ")]
    [row] = [row for row in rows if change in row.split("|")[1]]
    assert re.search(r"`[\w./]+`", row.split("|")[2])


def test_each_noun_names_one_class():
    """As CONTRIBUTING promises; private classes are known in their file alone."""
    files = defaultdict(list)
    for path in (ROOT / PACKAGE).rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                files[node.name].append(path.relative_to(ROOT).as_posix())
    assert {name: paths for name, paths in files.items() if len(paths) > 1} == {}
