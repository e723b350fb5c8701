"""Pictures for newcomers: every symbol is named, and the moving picture is small and moves."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from PIL import Image

from capture_sim.launch.scenes import load_scene
from capture_sim.messages.topics import TOPICS
from tools.diagrams import draw_nodes, draw_touch
from tools.explain import draw_geometry, save_capture_gif


def test_every_symbol_of_the_geometry_is_named():
    figure = draw_geometry(load_scene("tilt_0"))
    texts = [text for axes in figure.axes for text in axes.texts]
    texts += figure.axes[1].get_legend().get_texts()
    named = "\n".join(text.get_text() for text in texts)
    symbols = ("$L_T$", "$R_c$", "$L_c$", "$L_C$", "$h_0$", r"$\beta$", "$R_t$", "BE", "offset")
    symbols += ("theta > 0", "torsion > 0", "stroke < 0", "+y wall", "-y wall")
    parts = ("chaser", "target", "rail", "string", "pulley", "mass", "probe", "cone", "ball wheel")
    for name in (*symbols, *parts):
        assert name in named, name
    assert {"a", "b"} <= set(named.splitlines())


def test_moving_picture_ends_with_the_verdict(runs, tmp_path):
    path = save_capture_gif(runs[1], tmp_path / "capture.gif", pictures=6)
    assert path.stat().st_size < 2_000_000
    with Image.open(path) as image:
        assert image.n_frames == 6
        shown = []
        for i in range(6):
            image.seek(i)
            shown.append(np.asarray(image.convert("L"), float))
        assert image.info["duration"] == 2500
    assert all(np.abs(a - b).max() > 100 for a, b in itertools.pairwise(shown))


def test_the_diagram_of_nodes_has_every_topic():
    texts = "\n".join(text.get_text() for text in draw_nodes().axes[0].texts).splitlines()
    for topic in TOPICS:
        assert texts.count(f"/{topic.name}") >= len(topic.publishers)


def test_the_close_up_of_a_touch_ends_where_the_touch_ends(runs):
    force, _ = draw_touch(runs[1]).axes
    touch = runs[1].touches[0]
    t, values = force.get_lines()[0].get_data()
    assert values.max() == pytest.approx(touch["peak_force"], rel=1e-3)
    contact = t[values > 0.0] * 1e-3
    lasted = touch["end"] - touch["start"]
    assert (contact.min(), contact.max()) == pytest.approx((0.0, lasted), abs=1e-6)
