"""The figure of docs/your_rig.md has the lengths of the scene that it names."""

import itertools

import pytest

from capture_sim import load_scene
from tools.diagrams import draw_rig


def test_lengths_of_the_figure_are_those_of_the_scene():
    scene = load_scene("tilt_0")
    [axes] = draw_rig(scene).axes
    hinge = scene.buffer.hinge_offset
    target = scene.initial.target.x - scene.initial.chaser.x
    places = [0.0, hinge, hinge + scene.rest_length, target - scene.cone.L_T, target]
    lengths = [1e3 * (end - begin) for begin, end in itertools.pairwise(places)]
    texts = [text.get_text() for text in axes.texts]
    printed = [float(text) for text in texts if text.replace(".", "").isdigit()]
    assert printed == pytest.approx([*lengths, 1e3 * target])
