"""Numbers with units in scenes and overrides: read into SI, wrong dimensions rejected."""

import dataclasses
import inspect
import math
import subprocess
import sys

import pytest

from capture_sim import Scene, SceneError, load_scene
from capture_sim.scene.quantities import declared
from capture_sim.scene.units import in_si

GOOD = [
    ("0.5 N/mm", "N/m", 500.0),
    ("45deg", "rad", math.pi / 4),
    ("5 °", "rad", math.radians(5.0)),
    ("2 mrad", "rad", 0.002),
    ("10 rpm", "rad/s", math.pi / 3),
    ("7.85 g/cm^3", "kg/m^3", 7850.0),
    ("210 GPa", "N/m^2", 2.1e11),
    ("30 kg cm^2", "kg m^2", 0.003),
    ("3 N s²/m²", "N s^2/m^2", 3.0),
    ("1 kHz", "Hz", 1000.0),
    ("5 %", "1", 0.05),
    ("-1.5e1 mm", "m", -0.015),
    ("250", "N/m", 250.0),
]
BAD = [
    ("5 mm", "N/m"),
    ("5 N m", "N m/rad"),  # an angle is a dimension here
    ("5 deg", "1"),
    ("1 Hz", "rad/s"),
    ("5 parsnips", "m"),
    ("m", "m"),
    ("5 m^99999999", "m"),
    ("5 m; import os", "m"),
    ("5 " + "m" * 200, "m"),
    ("½ m", "m"),
]


@pytest.mark.parametrize("text, unit, value", GOOD)
def test_text_with_a_unit_is_converted_to_si(text, unit, value):
    assert in_si(text, unit) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize("text, unit", BAD)
def test_wrong_dimension_or_unknown_unit_is_rejected(text, unit):
    with pytest.raises(ValueError, match=r"not a unit|not a number|another dimension"):
        in_si(text, unit)


def test_units_stand_in_files_and_overrides_and_python(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "extends: tilt_0\ncone: {half_angle: 40 deg}\nprobe: {length: 20 cm}\n"
        "supports: {chaser: {balls: [[10 cm, 0], [-0.1, 100 mm], [-0.1, -0.1]]}}\n"
    )
    scene = load_scene(path, {"buffer.k_A": "0.5 N/mm", "initial.target.theta": "5 deg"})
    assert scene.cone.half_angle == math.radians(40.0)
    assert scene.probe.length == 0.2
    assert scene.supports.chaser.balls[0] == (0.1, 0.0)
    assert scene.supports.chaser.balls[1] == (-0.1, 0.1)
    assert scene.buffer.k_A == 500.0
    assert scene.initial.target.theta == math.radians(5.0)
    assert "buffer.k_A=0.5 N/mm" in scene.title
    assert load_scene("tilt_0", ["buffer.k_A=0.5 N/mm"]).buffer.k_A == 500.0


@pytest.mark.parametrize(
    "override, message",
    [
        ("buffer.k_A=5 mm", "buffer.k_A = '5 mm': must be a number in N/m, >= 0"),
        ("buffer.k_A=-1 N/mm", "buffer.k_A = -1000.0 N/m: must be >= 0"),
        ("buffer.k_A=1e400 N/m", "must be finite and >= 0"),
        ("buffer.k_A=0,5 N/mm", "decimals need a point, not a comma"),
        ("run.max_steps=1 km", "run.max_steps = '1 km'"),
        ("run.method=5 m", "run.method = '5 m': must be one of dop853"),
    ],
)
def test_wrong_unit_is_rejected_with_the_unit_of_the_field(override, message):
    with pytest.raises(SceneError) as caught:
        load_scene("tilt_0", [override])
    assert message in str(caught.value)


@pytest.mark.parametrize("value", ["45", "44.5"])
def test_angle_in_degrees_gets_a_hint(value):
    with pytest.raises(SceneError, match=rf"half_angle = {value}.* did you mean {value} deg\?"):
        load_scene("tilt_0", [f"cone.half_angle={value}"])
    assert load_scene("tilt_0", [f"cone.half_angle={value} deg"])


def test_an_angle_with_a_unit_is_not_taken_for_degrees():
    with pytest.raises(SceneError, match=r"must be > 0 and < 1\.5708$"):
        load_scene("tilt_0", ["cone.half_angle='100 deg'"])


def test_three_mistakes_are_named_together(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "extends: tilt_0\nchaser: {mass: -1}\nbuffer: {k_A: 5 mm}\ncone: {half_angle: 45}\n"
    )
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert message.startswith("mine.yaml: ")
    assert "\n" not in message
    for mistake in ("chaser.mass = -1 kg: must be > 0", "buffer.k_A = '5 mm'", "45 deg?"):
        assert mistake in message


def test_pint_is_loaded_only_for_a_text_with_a_unit():
    code = (
        "import sys\nfrom capture_sim import load_scene\nload_scene('tilt_0', ['buffer.k_A=500'])\n"
        "assert 'pint' not in sys.modules\nload_scene('tilt_0', ['buffer.k_A=500 N/m'])\n"
        "assert 'pint' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def fields_of(part):
    for what in declared(part).values():
        yield what
        if dataclasses.is_dataclass(what.kind):
            yield from fields_of(what.kind)


def test_every_field_has_a_meaning_and_help_shows_it_with_its_unit():
    text = inspect.getdoc(Scene)
    for what in fields_of(Scene):
        if not dataclasses.is_dataclass(what.kind):
            assert len(what.doc) > 8, what.name
            assert what.doc in text
            assert what.unit or what.kind not in (float, int), what.name
            assert what.unit in ("", "1") or f"({what.unit})" in text
    assert "- chaser.theta : float (rad): heading" in text
