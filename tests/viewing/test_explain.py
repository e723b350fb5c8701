"""Pictures for newcomers: every symbol is named, and the moving picture is small and moves."""

from __future__ import annotations

import itertools

import numpy as np
from PIL import Image

from capture_sim.launch.scenes import load_scene
from tools.explain import draw_geometry, save_capture_gif


def test_every_symbol_of_the_geometry_is_named():
    figure = draw_geometry(load_scene("tilt_0"))
    named = "\n".join(text.get_text() for axes in figure.axes for text in axes.texts)
    symbols = ("$L_T$", "$R_c$", "$L_c$", "$h_0$", r"$\beta$", "$R_t$", "BE", "+y wall", "-y wall")
    parts = ("chaser", "target", "rail", "string", "pulley", "mass", "probe", "cone")
    for name in ("a", *symbols, *parts):
        assert name in named, name
    assert "stroke < 0: compression" in named
    assert "torsion > 0" in named


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
    assert all(np.abs(one - other).max() > 100 for one, other in itertools.pairwise(shown))
