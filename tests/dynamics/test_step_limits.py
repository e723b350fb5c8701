"""The limits of a step that docs/accuracy.md, model.md and forces.md name."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from capture_sim import load_scene, simulate
from capture_sim.base.compiled.kernels import plain
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.engine.step_length import path_to_events

STOPS = {"stops.compression": 0.02, "stops.extension": 0.02}
STOPS |= {"stops.stiffness": 1e4, "stops.damping": 0.0}


@pytest.mark.parametrize("scene", ["paper_designed", "tilt_p10", "paper_clamped"])
@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
def test_no_step_in_contact_spans_more_than_five_radians(scene, rtol):
    """With the slope of F = k d^1.5 at the start of the step, which is that of its limit."""
    changes = {"run.trace": True, "run.rtol": rtol, "run.t_end": 4.0}
    run = simulate(load_scene(scene, changes))
    par = Bench(run.scene)._system["par"]
    longest = 0.0
    for touch in run.touches:
        wall = 0 if touch["wall"] > 0 else 1
        inside = (run.trace["t"] >= touch["start"]) & (run.trace["t"] <= touch["end"])
        points = run.trace[inside]
        depth = np.maximum(points["penetration"][:-1, wall], 0.0)
        slope = 1.5 * run.scene.contact_stiffness * np.sqrt(depth)
        angles = np.sqrt(slope / float(par["m_P"])) * np.diff(points["t"])
        longest = max(longest, angles.max(initial=0.0))
    assert 0.1 < longest <= 5.0 * (1.0 + 1e-9)


@pytest.mark.parametrize(
    "changes, steepest",
    [
        (STOPS, 500.0),
        ({"buffer.preload": 0.5}, 500.0),
        ({"buffer.force_table": [[0, 0], ["4 mm", 2], ["8 mm", 12], ["20 mm", 40]]}, 2500.0),
    ],
)
def test_steps_of_a_limited_stroke_span_two_radians_of_the_probe(changes, steepest):
    """In free flight at a loose tolerance nothing else shortens a step."""
    loose = {"run.rtol": 1e-3, "approach.speed": 2e-3, "run.t_end": 6.0}
    if "buffer.force_table" in changes:
        changes = {**changes, "buffer.k_A": 0.0}
    run = simulate(load_scene("tilt_0", {**loose, **changes}))
    first = run.touches["start"].min(initial=6.0)
    m_P = float(Bench(run.scene)._system["par"]["m_P"])
    least = first * math.sqrt(steepest / m_P) / 2.0
    assert least > 10.0
    assert run.statistics.steps >= least


@pytest.mark.parametrize("gap", [0.0, 0.1, 0.3, 0.5])
def test_near_walls_the_path_of_a_step_is_a_quarter_of_the_radius(gap):
    """Gaps of the tip to a wall and to the latch, as shares of their radii."""
    par = SimpleNamespace(R_t=0.015, latch_radius=0.004, has_latch=True)
    mode = SimpleNamespace(latched=False)
    for near, radius in ((0, par.R_t), (1, par.R_t), (2, par.latch_radius)):
        gaps = [1.0, 1.0, 1.0]
        gaps[near] = gap * radius
        start = SimpleNamespace(gap=gaps)
        system = SimpleNamespace(par=par, mode=mode)
        path = plain(path_to_events)(
            SimpleNamespace(system=system, step=SimpleNamespace(start=start))
        )
        assert path == pytest.approx(0.25 * radius)
