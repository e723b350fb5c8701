"""Pictures for newcomers: every symbol is named, and the moving picture is small and moves."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from capture_sim.base.compiled.kernels import plain
from capture_sim.detection.criteria import (
    CaptureState,
    Criteria,
    Place,
    decide,
    decide_at_end,
    new_memory,
)
from capture_sim.launcher.state_machine import Launcher, LauncherPhase, LaunchObservation
from capture_sim.messages.topics import TOPICS
from capture_sim.scene.loading import load_scene
from tools.diagrams import DETECTOR, LAUNCHER, draw_nodes, draw_touch
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


def test_the_diagram_has_every_transition_of_the_launcher():
    """All sequences of four inputs, from a launch that begins."""
    scene = load_scene("tilt_0")

    def observe(launcher, *, is_slack=False, has_touched=False, speed=0.0):
        launcher.observe(LaunchObservation(0.1, speed, 0.0, is_slack, has_touched))

    inputs = (
        lambda launcher: launcher.release(),
        lambda launcher: launcher.abort("cancelled"),
        lambda launcher: observe(launcher, is_slack=True),
        lambda launcher: observe(launcher, has_touched=True),
        lambda launcher: observe(launcher, speed=1.0),
    )
    seen = {(LauncherPhase.IDLE, Launcher(scene).status.state)}
    for sequence in itertools.product(inputs, repeat=4):
        launcher = Launcher(scene)
        for each in sequence:
            before = launcher.status.state
            each(launcher)
            seen.add((before, launcher.status.state))
    assert {(a, b) for a, b in seen if a is not b} == set(LAUNCHER)


def test_the_diagram_has_every_transition_of_the_detector():
    """Paths of straight pieces through the cone, each with rests, and each ended everywhere."""
    scene = load_scene("tilt_0")
    criteria, step = Criteria.of(scene), 0.01
    evaluate, evaluate_end = plain(decide), plain(decide_at_end)
    corners = [(x, y) for x in (0.12, 0.06, 0.016, 0.003, -0.03) for y in (0.0, 0.013, 0.1)]
    seen = set()
    for path in itertools.product(corners, repeat=2):
        places = np.concatenate(
            [np.linspace(a, b, 12) for a, b in itertools.pairwise(((0.15, 0.0), *path))]
            + [np.repeat([path[-1]], 150, axis=0)]
        )
        rates = np.gradient(places, step, axis=0)
        fields = new_memory(has_approached=True)
        memory = SimpleNamespace(**dict(zip(fields.dtype.names, *fields.tolist(), strict=True)))
        for k, (place, rate) in enumerate(zip(places.tolist(), rates.tolist(), strict=True)):
            before = CaptureState(memory.state)
            evaluate(criteria, memory, Place(k * step, *place, *rate), False, 0.0, 0.0)
            seen.add((before, CaptureState(memory.state)))
            if memory.state <= CaptureState.CONTACT:
                ended = SimpleNamespace(**vars(memory))
                evaluate_end(criteria, ended, 0.0, False)
                seen.add((CaptureState(memory.state), CaptureState(ended.state)))
    assert {(a, b) for a, b in seen if a is not b} == set(DETECTOR)
