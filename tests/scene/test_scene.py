"""Scenes: reading, extending, overriding, and what is refused."""

import dataclasses
import re
import shutil
from dataclasses import replace

import pytest
import yaml
from random_scenes import wide_scenes

from capture_sim import Bench, SceneError, load_scene, scene_names
from capture_sim.base.resources import config_dir
from capture_sim.cli import main
from capture_sim.scene.loading import change_scene, load_scene_text, overrides_of
from capture_sim.scene.parts import PlanarState, Vehicle, as_mapping
from capture_sim.scene.paths import field_names

# What does not fit together, and what the one line must say. Single values out of their range or of
# another kind are drawn in test_bad_scenes.py.
BAD = [
    ("contact={law: flores, restitution: 0}", ["contact.restitution = 0.0", "> 0", "law flores"]),
    ("friction.mu_s=0.01", ["friction.mu_s = 0.01: must be >= 0", "friction.mu, or null"]),
    ("buffer.rest_length=0.001", ["buffer.rest_length = 0.001 m: must be > 0.015", "the tip"]),
    ("cone.R_c=0.01", ["cone.R_c = 0.01 m", ">= 0.015", "tip"]),
    ("bufer.k_A=500", ["bufer: unknown field", "did you mean buffer?"]),
    ("buffer=12", ["buffer = 12", "its fields"]),
    ("rail.length=0.5", ["rail.length = 0.5 m", "< 0.20", "before the contact"]),
    ("rail=null", ["string", "rail"]),
    ("string.drop_height=0.2", ["string.drop_height = 0.2 m", "<= 0.15"]),
    ("string.hanging_mass=0.2", ["string", "exactly two of"]),
    ("string.impact_speed=1.5", ["string.drop_height = 0.1 m", "1.5 m/s in free fall"]),
    (
        "supports.target.balls=[[0.1,0],[0.2,0.1],[0.2,-0.1]]",
        ["supports.target.balls", "m: must be", "would lift off"],
    ),
    ("supports.chaser.balls=[[0,0],[0.1,0],[0.2,0]]", ["supports.chaser.balls", "in one line"]),
    ("latch.radius=0.2", ["latch.radius = 0.2 m", "< 0.05"]),
    ("initial.target.x=0.45", ["initial: the tip starts", "m inside", "initial.target.x"]),
    ("initial.target.vx=-0.1", ["initial.target.vx = -0.1 m/s", "0 while the scene has a rail"]),
    ("initial.target.y=0.5", ["misses the cone"]),
    ("initial.chaser.omega=0.1", ["initial.chaser.omega = 0.1 rad/s", "0 on the rail"]),
    ("run.rate=300", ["run.rate = 300", "Hz", "whole number"]),
    ("chaser.mass", ["override 'chaser.mass'", "part.field=value"]),
    ("chaser.mass=[", ["override", "not valid YAML"]),
    ("sensors.motion_capture.rate=300", ["sensors.motion_capture.rate = 300.0 Hz", "whole number"]),
    ("sensors.load_cell.rate=2000", ["sensors.load_cell.rate = 2000.0 Hz", "whole number"]),
    ("name=../../evil", ["name = '../../evil'", "1 to 64 letters", "digits and _ . -"]),
    ("name=..", ["name = '..'", "beginning with neither . nor -"]),
    ("name=''", ["name = ''", "beginning with neither . nor -"]),
    ("name=" + 65 * "x", ["name = 'xxx", "1 to 64 letters"]),
]


@pytest.mark.parametrize("override, says", BAD, ids=[b[0] for b in BAD])
def test_bad_value_is_refused_in_one_clear_line(override, says):
    with pytest.raises(SceneError) as caught:
        load_scene("tilt_0", [override])
    message = str(caught.value)
    assert "\n" not in message
    for part in says:
        assert part in message


@pytest.mark.parametrize(
    "text, says",
    [
        ("extends: tilt_0\nbuffer: {k_A: 1, k_A: 2}", ["k_A", "given twice", "line 2"]),
        ("extends: nowhere", ["'nowhere'", "not found", "tilt_0"]),
        ("extends: tilt_0\nchaser: {mass: [}", ["not valid YAML", "line 2"]),
        ("- a\n- b", ["holds ['a', 'b']", "must be fields of a scene"]),
        ("extends: 3", ["extends = 3"]),
        ("chaser: {mass: 1, inertia: 1}", ["missing"]),
        ("extends: _table_2", ["initial: missing"]),
        ("extends: self", ["extends itself"]),
    ],
)
def test_bad_file_is_refused_in_one_clear_line(tmp_path, text, says):
    path = tmp_path / "self.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path.name) in message or "missing" in message or "not found" in message
    for part in says:
        assert part in message


def test_missing_file_and_unknown_name(tmp_path, monkeypatch):
    with pytest.raises(SceneError, match=r"no such file"):
        load_scene("somewhere/else.yaml")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep.csv").touch()
    with pytest.raises(SceneError, match=r"'sweep.csv': no scene: must end in .yaml"):
        load_scene("sweep.csv")
    with pytest.raises(SceneError, match=r"did you mean tilt_p10\?"):
        load_scene("tilt_p1")


@pytest.mark.parametrize("name", scene_names())
def test_scene_survives_being_written_and_read(name):
    for changes in ([], ["sensors.motion_capture={}", "sensors.load_cell={}"]):
        scene = load_scene(name, changes)
        assert load_scene_text(scene.to_yaml()) == scene
        assert scene.name == name


TITLES = [
    *("yes", "Null", "12", "1e3", "y", "it's", "a: b", "a #b", "- a", "a ", "é, ü", "a\tb", "q?"),
    *("a, b; with buffer.k_A=501.0, run.rtol=1e-06", "stops={compression: 0.1, extension: 0.1}"),
    *(
        "word " * 40 + "end",
        "x" * 200,
        "x" * 79 + " y z",
        "x" * 81 + " y",
        "two  blanks",
        "&a *b ~",
    ),
]


def test_text_of_a_scene_is_that_of_pyyaml():
    """Recordings of all versions have the hash of this text, as PyYAML wrote it."""
    scenes = [load_scene(name) for name in scene_names()]
    scenes += [load_scene("tilt_0", ["sensors={load_cell: {}}", "string=null", "rail=null"])]
    scenes += [replace(scenes[0], title=title) for title in TITLES]
    scenes += [replace(scenes[0], name=name) for name in ("1e3", "yes", "_a", "1.5", "0x1f")]
    scenes += [replace(scenes[0], gravity=g) for g in (1e-5, 1.5e-7, 1e16, 123456789.125)]
    scenes += wide_scenes(10)
    for scene in scenes:
        expected = yaml.safe_dump(as_mapping(scene), sort_keys=False, default_flow_style=None)
        assert scene.to_yaml() == expected
        assert replace(scene).to_yaml() == expected


def test_changes_of_a_scene_can_be_made_again():
    changed = change_scene(load_scene("tilt_0"), {"latch": None, "buffer.c_A": 13.0})
    assert overrides_of(changed) == ["latch=null", "buffer.c_A=13.0"]
    again = change_scene(load_scene("tilt_0"), overrides_of(changed))
    assert again == changed

    points = [[1e-4 * k, 1.5 * k] for k in range(60)]
    changed = load_scene("tilt_0", {"contact.force_table": points, "contact.stiffness": None})
    assert len(changed.title) < 200
    again = load_scene("tilt_0", overrides_of(changed))
    assert again.contact == changed.contact


def test_file_extends_and_overrides_reach_every_value(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("extends: tilt_p10\nbuffer: {c_A: 20}\nlatch: null\n", encoding="utf-8")
    scene = load_scene(path, ["buffer.k_A=600", "contact.tip.E=2.1e11", "run.rtol=1e-9"])
    base = load_scene("tilt_p10")
    assert (scene.buffer.c_A, scene.buffer.k_A, scene.buffer.k_T) == (20.0, 600.0, 200.0)
    assert scene.contact.tip.E == 2.1e11
    assert scene.run.rtol == 1e-9
    assert scene.latch is None
    assert scene.initial == base.initial
    assert scene.name == "mine"


def test_scene_is_frozen_and_checked_when_made_in_python():
    scene = load_scene("tilt_0")
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.chaser.mass = 3.0
    with pytest.raises(SceneError, match=r"c_A = inf N s/m: must be finite and >= 0"):
        load_scene("tilt_0", ["buffer.c_A=.inf"])
    with pytest.raises(SceneError, match=r"Vehicle.mass = -3 kg: must be > 0"):
        Vehicle(mass=-3, inertia=1.0)
    with pytest.raises(SceneError, match=r"PlanarState.theta"):
        PlanarState(theta=float("inf"))
    with pytest.raises(SceneError, match=r"rail must end before"):
        Bench(dataclasses.replace(scene, rail=dataclasses.replace(scene.rail, length=1.0)))


def test_inertia_of_probe_and_cylinder_are_those_of_the_shared_figures():
    scene = load_scene("paper_designed")
    assert scene.probe.mass == pytest.approx(0.178185, abs=5e-7)
    assert scene.probe.com_offset == pytest.approx(0.0900, abs=5e-5)
    assert scene.probe.inertia == pytest.approx(8.7206e-4, abs=5e-9)
    assert scene.cylinder.inertia == pytest.approx(1.5527e-3, abs=5e-8)
    assert scene.rest_length == pytest.approx(0.215)
    assert as_mapping(scene)["cone"]["half_angle"] == pytest.approx(0.7853981633974483)


@pytest.mark.parametrize(
    "name, nearest",
    [
        ("cone.half_angel", "cone.half_angle"),
        ("detector.radius", "detector.capture_radius"),
        ("contact.v_0_floor", None),
        ("k_A", "buffer.k_A"),
        ("kA", "buffer.k_A"),
        ("mass", "chaser.mass, target.mass or cylinder.mass"),
        ("supports.c_rr", "supports.chaser.c_rr or supports.target.c_rr"),
    ],
)
def test_an_unknown_field_is_rejected_with_the_nearest_name(name, nearest):
    with pytest.raises(SceneError) as caught:
        load_scene("tilt_0", [f"{name}=0.1"])
    message = str(caught.value)
    assert message.startswith(f"{name}: unknown field")
    assert ("did you mean" in message) == (nearest is not None)
    assert nearest is None or f"did you mean {nearest}?" in message


def test_the_template_has_every_field_and_loads(tmp_path, capsys):
    """Absent parts too: as comments, which load once they are values."""
    assert main(["scenes", "--template"]) == 0
    text = capsys.readouterr().out
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    scene, original = load_scene(path), load_scene("tilt_0")
    assert scene == replace(original, name="mine", title="Made from tilt_0")
    for name in field_names(scene):
        assert re.search(rf"^ *{name.rpartition('.')[2]}: .+ # .+", text, re.MULTILINE), name
    stops = re.search(r"^stops: null .*\n((?:#   .*\n)+)", text, re.MULTILINE)
    given = yaml.safe_load("".join(line[2:] for line in stops[1].splitlines(keepends=True)))
    assert set(given) == {"compression", "extension", "stiffness", "damping"}


def test_a_missing_detector_is_offered_with_its_defaults(tmp_path):
    data = yaml.safe_load(load_scene("tilt_0").to_yaml())
    del data["detector"]
    path = tmp_path / "a.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(SceneError, match=r"missing; detector: \{\} has all default values"):
        load_scene(path)
    path.write_text(yaml.safe_dump({**data, "detector": {}}))
    assert load_scene(path).detector.min_dwell == 0.2


def outcome(load, *arguments):
    try:
        return load(*arguments)
    except SceneError as error:
        return str(error)


@pytest.mark.parametrize("name", ["tilt_0", "paper_designed"])
def test_change_of_a_scene_is_that_of_its_text(name):
    """Values that change alone are not read again with all others; what comes out is the same."""
    scene = load_scene(name)
    values = [{field: value} for field in field_names(scene) for value in (1, -1.0, "1 mm", None)]
    values += [["latch=null"], ["latch.radius=0.001"], ["stops={compression: 0.1}"], {"bufer": 1}]
    values += [["buffer.k_A=5", "buffer.k_A=6", "title=mine"], ["buffer.k_A=-5", "run.rtol=2"]]
    for overrides in values:
        expected = outcome(load_scene_text, scene.to_yaml(), overrides)
        assert outcome(change_scene, scene, overrides) == expected, overrides


def test_packaged_scene_is_read_again_after_a_change_of_a_file(tmp_path, monkeypatch):
    folder = tmp_path / "scenes"
    shutil.copytree(config_dir() / "scenes", folder)
    for module in ("files", "loading"):
        monkeypatch.setattr(f"capture_sim.scene.{module}.config_dir", lambda: tmp_path)
    kept = {}
    monkeypatch.setattr("capture_sim.scene.loading._packaged", kept)
    assert load_scene("tilt_0").buffer.k_A == 500.0
    assert not kept  # a file that is just written may change within a tick of its clock
    monkeypatch.setattr("capture_sim.scene.loading._SETTLED", -1000.0)
    load_scene("tilt_0")
    assert load_scene("tilt_0") is load_scene("tilt_0")
    base = folder / "_table_2.yaml"
    base.write_text(base.read_text().replace("k_A: 500.0", "k_A: 77.0"))
    assert load_scene("tilt_0").buffer.k_A == 77.0
