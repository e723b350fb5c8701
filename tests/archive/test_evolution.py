"""The rule of evolution (CONTRIBUTING.md): messages, scenes and results only gain fields."""

import dataclasses
import json
from pathlib import Path

import pytest
import yaml
from rosbags.typesys import get_types_from_msg

import capture_sim
from capture_sim import load_scene, simulate
from capture_sim.base.resources import message_dir
from capture_sim.base.software import newer_line, newer_version, own_version
from capture_sim.messages.evolution import defaults
from capture_sim.run.summary import FIRST_NAMES, row_from
from capture_sim.scene.loading import load_scene_text
from capture_sim.scene.parts import Scene, as_mapping
from tests.archive.test_archive import ARCHIVE, FIRST_KEYS, OF_THE_CALL, VERSIONS

#: Fields and types that are gone: a replay and a reader of that time's files need neither.
GONE = {("RunInfo", "consumers"), ("SimulatorFeatures", None)}
ADVICE = "keep its name, type and unit; for another meaning add a field with its default"


def fields(path):
    found = get_types_from_msg(path.read_text(), f"capture_sim/msg/{path.stem}")
    return dict(found[f"capture_sim/msg/{path.stem}"][1])


def unit(path, name):
    """Return the beginning of a field's comment, which is its unit where it has one."""
    for line in path.read_text().splitlines():
        declared, _, comment = line.partition("#")
        if declared.split()[1:2] == [name]:
            return comment.strip().partition(",")[0]
    return ""


@pytest.mark.parametrize("version", VERSIONS)
def test_messages_only_gain_fields_with_defaults(version):
    for old in sorted((ARCHIVE / version / "msg").glob("*.msg")):
        new = message_dir() / old.name
        if (old.stem, None) in GONE:
            continue
        assert new.is_file(), f"msg/{old.name} is gone since {version}: keep it"
        then, now = fields(old), fields(new)
        for name, kind in then.items():
            if (old.stem, name) not in GONE:
                where = f"msg/{old.name}: {name} differs from {version}: {ADVICE}"
                assert now.get(name) == kind, where
                if unit(old, name) in ("m", "rad", "s", "N", "N m", "N s", "J", "m/s", "rad/s"):
                    assert unit(new, name) == unit(old, name), where
        declared = defaults(f"capture_sim/msg/{old.stem}")
        for name in now.keys() - then.keys():
            assert name in declared, (
                f"msg/{old.name}: {name} came since {version}: give it a default in its line"
            )


@pytest.mark.parametrize("version", VERSIONS)
def test_scenes_only_gain_fields(version):
    text = (ARCHIVE / version / "scene.yaml").read_text()
    scene, then = load_scene_text(text), yaml.safe_load(text)

    def compare(old, new, where):
        for name, value in old.items():
            assert name in new, f"scene: {where}{name} is gone since {version}: {ADVICE}"
            if isinstance(value, dict):
                compare(value, new[name], f"{where}{name}.")
            else:
                changed = f"scene: {where}{name} differs from {version}: {ADVICE}"
                assert new[name] == value, changed

    compare(then, as_mapping(scene), "")


@pytest.mark.parametrize("version", VERSIONS)
def test_results_only_gain_keys(version):
    (then,) = json.loads((ARCHIVE / version / "offline_results.json").read_text())
    now = simulate(load_scene("tilt_0")).summary
    for key in then.keys() - set(OF_THE_CALL):
        key = FIRST_KEYS.get(key, key) if version == "8613e21" else key
        assert key in now, f"results.json: {key} is gone since {version}: keep it, or name it"


def test_the_version_is_declared_once():
    root = Path(capture_sim.__file__).parents[1]
    citation = yaml.safe_load((root / "CITATION.cff").read_text())
    assert str(citation["version"]) == capture_sim.__version__
    assert f"## {capture_sim.__version__}" in (root / "CHANGELOG.md").read_text()
    assert own_version().partition("+")[0] == capture_sim.__version__


def test_a_newer_version_is_named():
    assert newer_version(["numpy 99.0", "capture_sim 99.1.0+abc"]) == "99.1.0+abc"
    assert newer_version([f"capture_sim {capture_sim.__version__}+abc"]) == ""
    assert newer_version(["capture_sim 0.1.0"]) == ""
    assert "99.1.0" in newer_line("99.1.0")
    assert capture_sim.__version__ in newer_line("99.1.0")


def test_a_scene_of_a_newer_version_is_read_as_far_as_it_is_known():
    data = as_mapping(load_scene("tilt_0"))
    data["buffer"]["new_field"] = 1.0
    scene = load_scene_text(yaml.safe_dump(data), only_known=True)
    assert dataclasses.replace(scene) == load_scene("tilt_0")
    assert isinstance(scene, Scene)


def test_a_row_of_the_first_results_has_the_keys_of_today():
    (then,) = json.loads((ARCHIVE / "8613e21" / "offline_results.json").read_text())
    row = row_from(then, "run 1")
    for old, new in FIRST_NAMES.items():
        assert row[new] == then[old]
    assert row["max_axial_stroke_in"] == max(
        then["max_axial_stroke"], then["max_axial_stroke_latched"]
    )
    assert row["max_torsion"] == max(then["max_torsion"], then["max_torsion_latched"])
    without_latch = row_from({**then, "max_torsion_latched": None}, "run 1")
    assert without_latch["max_torsion"] == then["max_torsion"]
