"""Sensitivities: scaling laws of the physics, and models whose indices are known."""

import json
import math

import numpy as np
import pytest

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.commands import sensitivity as command
from capture_sim.errors import SceneError
from capture_sim.studies import sensitivity
from capture_sim.studies.approach import approach_of
from capture_sim.studies.executors import InProcess
from capture_sim.studies.sensitivity import (
    QUANTITIES,
    STEPS,
    Parameter,
    changed,
    default_parameters,
    global_sensitivity,
    local_sensitivity,
    value_of,
)

NAMES = [quantity.name for quantity in QUANTITIES]


@pytest.fixture(scope="module")
def near():
    parameters = (
        Parameter("approach.speed", "m/s", 0.02),
        Parameter("buffer.k_A", "N/m", 0.02),
        Parameter("buffer.k_T", "N m/rad", 0.02),
    )
    return local_sensitivity(load_scene("paper_undamped"), parameters, InProcess())


def elasticity(found, parameter, quantity):
    """Percent of the quantity for a percent of the parameter."""
    p = [one.name for one in found.parameters].index(parameter)
    q = NAMES.index(quantity)
    derivative = found.derivatives[p][q]
    assert derivative.converged
    return derivative.value / found.base[q] / found.parameters[p].spread


def test_peak_force_goes_with_the_six_fifths_of_the_speed(near):
    """Hertz: delta_max ~ v^(4/5), F ~ delta^1.5; the first touch is too short for the buffer."""
    assert elasticity(near, "approach.speed", "peak_force") == pytest.approx(1.2, abs=0.01)
    assert elasticity(near, "buffer.k_A", "peak_force") == pytest.approx(0.0, abs=1e-3)


def test_strokes_go_with_speed_and_springs(near):
    """A linear spring's stroke: with the speed, and with k^-1/2 along."""
    assert elasticity(near, "approach.speed", "axial_stroke") == pytest.approx(1.0, abs=0.05)
    assert elasticity(near, "buffer.k_A", "axial_stroke") == pytest.approx(-0.5, abs=0.06)
    assert elasticity(near, "buffer.k_A", "duration") == pytest.approx(-0.45, abs=0.1)
    assert elasticity(near, "buffer.k_T", "axial_stroke") == pytest.approx(0.0, abs=0.05)


def test_the_tornado_agrees_with_the_derivative_over_a_small_spread(near):
    for p in range(3):
        for q in range(3):
            d = near.derivatives[p][q]
            middle = 0.5 * (near.high[p, q] - near.low[p, q])
            assert middle == pytest.approx(d.value, rel=0.1, abs=2e-3 * near.base[q])


def test_a_corner_is_flagged_and_a_smooth_curve_is_not():
    steps = np.array(STEPS)[:, None] * [-1.0, 1.0]
    touches = np.full(steps.shape, 5)
    smooth = sensitivity._converge(np.exp(steps), touches, 1.0)
    assert smooth.converged
    assert smooth.value == pytest.approx(1.0, abs=1e-4)
    jump = sensitivity._converge(np.where(steps > 0.0, 2.0, 1.0), touches, 1.0)
    assert not jump.converged
    touches[:, 1] = 6
    assert not sensitivity._converge(np.exp(steps), touches, 1.0).converged


def linear(task):
    """An invented bench: force 3 a + 4 b of the parameters' shares, captured for a > 0."""
    scene, parameters, values = task
    share = [
        (value - value_of(scene, p)) / (p.spread * value_of(scene, p))
        for p, value in zip(parameters, values, strict=True)
    ]
    answer = np.zeros(len(QUANTITIES))
    answer[0], answer[-1] = 3.0 * share[0] + 4.0 * share[1], share[0] > 0.0
    return answer, 1


@pytest.fixture
def invented(monkeypatch):
    monkeypatch.setattr(sensitivity, "respond", linear)
    return (
        Parameter("buffer.k_A", "N/m", 0.1),
        Parameter("buffer.k_T", "N m/rad", 0.1),
        Parameter("buffer.c_A", "N s/m", 0.1),
    )


def test_sobol_of_a_linear_model(invented):
    """Shares of the variance 9/25 and 16/25, none for what does not count."""
    reported = []
    found = global_sensitivity(
        load_scene("paper_designed"),
        invented,
        InProcess(),
        "sobol",
        128,
        report=lambda done, count: reported.append((done, count)),
    )
    assert found.runs == 128 * 5
    assert reported[-1] == (found.runs, found.runs)
    assert found.first[:, 0] == pytest.approx([0.36, 0.64, 0.0], abs=0.05)
    assert found.total[:, 0] == pytest.approx([0.36, 0.64, 0.0], abs=0.05)
    assert np.isnan(found.total[:, 1:-1]).all()
    assert found.captured == pytest.approx(0.5, abs=0.05)


def test_morris_of_a_linear_model(invented):
    """Elementary effects over the whole range: 2 x 3, 2 x 4 and 0, without scatter."""
    found = global_sensitivity(load_scene("paper_designed"), invented, InProcess(), "morris", 8)
    assert found.runs == 8 * 4
    assert found.total[:, 0] == pytest.approx([6.0, 8.0, 0.0], abs=1e-9)
    assert found.first[:, 0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_the_same_seed_gives_the_same_indices(invented):
    scene = load_scene("tilt_0")
    one, two, other = (
        global_sensitivity(scene, invented, InProcess(), "sobol", 8, seed) for seed in (3, 3, 4)
    )
    assert np.array_equal(one.total, two.total, equal_nan=True)
    assert not np.array_equal(one.total, other.total, equal_nan=True)


@pytest.mark.parametrize("name", ["paper_designed", "tilt_p10"])
def test_nothing_changed_is_the_scene_itself(name):
    scene = load_scene(name)
    same = changed(scene, [], [])
    assert approach_of(same) == pytest.approx(approach_of(scene), abs=1e-9)
    one, two = simulate(scene).summary, simulate(same, t_end=4.0).summary
    for key in ("first_contact_peak_force", "first_contact_duration"):
        assert one[key] == pytest.approx(two[key], rel=2e-3)


def test_a_changed_cone_is_still_met_just_so():
    scene = load_scene("paper_designed")
    beta = Parameter("cone.half_angle", "rad", 0.02, relative=False)
    steeper = changed(scene, [beta], [scene.cone.half_angle + 0.02])
    assert steeper.cone.half_angle == scene.cone.half_angle + 0.02
    first = simulate(steeper, t_end=0.1).summary
    assert first["first_contact_time"] == pytest.approx(0.01, rel=1e-6)
    assert first["impact_speed"] == pytest.approx(0.1, rel=1e-9)


def test_unknown_parameters_are_refused():
    with pytest.raises(SceneError, match=r"supports\.c_rr: must be a number"):
        value_of(load_scene("tilt_0"), Parameter("supports.c_rr", "1", 0.1))


def test_the_command_leaves_numbers_and_pictures(tmp_path, capsys, monkeypatch):
    few = default_parameters()[3:6]
    monkeypatch.setattr(command, "default_parameters", lambda part: few)
    arguments = ["sensitivity", "--samples=4", "--workers=1", "--out", str(tmp_path)]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "buffer.k_A" in text
    assert "axial_stroke mm" in text
    kept = json.loads((tmp_path / "sensitivity.json").read_text())
    assert len(kept["derivatives"]) == len(kept["parameters"]) == 3
    assert kept["morris"]["runs"] == 4 * 4
    assert math.isfinite(kept["base"][0])
    for name in ("tornado.png", "morris.png"):
        assert (tmp_path / name).stat().st_size > 20_000
