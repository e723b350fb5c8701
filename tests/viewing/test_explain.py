"""Pictures for newcomers: every symbol is named, and the moving picture is small and moves."""

from __future__ import annotations

import itertools

import numpy as np
from matplotlib.text import Annotation
from PIL import Image

from capture_sim.launch.scenes import load_scene
from capture_sim.messages.urdf import chaser_box
from tools.explain import draw_geometry, save_capture_gif


def test_every_symbol_of_the_geometry_is_named():
    figure = draw_geometry(load_scene("tilt_0"))
    texts = [text for axes in figure.axes for text in axes.texts]
    texts += figure.axes[1].get_legend().get_texts()
    named = "\n".join(text.get_text() for text in texts)
    symbols = ("$L_T$", "$R_c$", "$L_c$", "$h_0$", r"$\beta$", "$R_t$", "BE", "+y wall", "-y wall")
    parts = ("chaser", "target", "rail", "string", "pulley", "mass", "probe", "cone", "ball wheel")
    for name in ("a", *symbols, *parts):
        assert name in named, name
    assert "stroke < 0: compression" in named
    assert "torsion > 0" in named


def test_no_line_of_the_geometry_crosses_another():
    """Neither names' lines nor measures; and the hinge lies in the chaser's body."""
    scene = load_scene("tilt_0")
    for axes in draw_geometry(scene).axes:
        lines = [
            np.array([note.xy, note.xyann])
            for note in axes.texts
            if isinstance(note, Annotation) and note.arrow_patch is not None
        ]
        assert len(lines) >= 4
        for (a, b), (c, d) in itertools.combinations(lines, 2):
            if not {tuple(a), tuple(b)} & {tuple(c), tuple(d)}:
                assert not crossing(a, b, c, d)
    assert chaser_box(scene).front > scene.buffer.hinge_offset


def crossing(a, b, c, d):
    """Return whether two segments cross."""
    side = np.linalg.det(np.array([[b - a, c - a], [b - a, d - a], [d - c, a - c], [d - c, b - c]]))
    return side[0] * side[1] < 0 and side[2] * side[3] < 0


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
