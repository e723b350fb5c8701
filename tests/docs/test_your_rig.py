"""The figure of docs/your_rig.md has the lengths of the scene that it names."""

import itertools
import re
from pathlib import Path

import pytest

from capture_sim import load_scene

FIGURE = Path(__file__).parents[2] / "docs" / "your_rig.svg"
SCALE, ORIGIN = 1200.0, 90.0  # px/m, and the chaser's base frame in px


def test_lengths_of_the_figure_are_those_of_the_scene():
    scene, text = load_scene("tilt_0"), FIGURE.read_text()
    hinge = scene.buffer.hinge_offset
    tip = hinge + scene.rest_length
    target = scene.initial.target.x - scene.initial.chaser.x
    places = [0.0, hinge, tip, target - scene.cone.L_T, target]
    lengths = [end - begin for begin, end in itertools.pairwise(places)]
    printed = [float(number) / 1e3 for number in re.findall(r">([\d.]+)</text>", text)]
    assert printed == pytest.approx([*lengths, target])
    drawn = re.findall(r'<line x1="(\d+)" y1="2\d\d" x2="\1" y2="(?:446|512)"/>', text)
    assert [(float(x) - ORIGIN) / SCALE for x in drawn] == pytest.approx(places, abs=1e-3)
