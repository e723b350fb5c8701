"""The list of faults is in step with the sources; `make faults` makes them."""

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FAULTS = tomllib.loads((Path(__file__).parent / "faults.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_made_in_one_place_and_has_its_tests(name):
    fault = FAULTS[name]
    assert (ROOT / fault["file"]).read_text(encoding="utf-8").count(fault["text"]) == 1
    assert fault["fault"] != fault["text"]
    for test in fault["tests"]:
        path, _, name = test.partition("::")
        parts = ast.parse((ROOT / path).read_text(encoding="utf-8")).body
        [function] = [each for each in parts if getattr(each, "name", "") == name]
        assert "pytest.mark.long" not in map(ast.unparse, function.decorator_list), test


def test_every_folder_of_the_package_has_a_fault():
    package = ROOT / "capture_sim"
    folders = {path.name for path in package.iterdir() if (path / "__init__.py").is_file()}
    assert folders <= {Path(fault["file"]).parts[1] for fault in FAULTS.values()}
