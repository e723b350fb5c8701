"""Fronts of known shape: layers, knee, rows, hypervolume; limits with known cost."""

import numpy as np
import pytest

from capture_sim import SceneError
from capture_sim.studies.front import hypervolume, knee, layers, rows_of
from capture_sim.studies.limit_costs import limit_costs
from capture_sim.studies.limits import make_limits, make_objectives


def test_layers_are_fronts_one_behind_the_other():
    points = np.array([[0, 2], [1, 1], [2, 0], [1, 2], [2, 1], [2, 2], [1, 1]], dtype=float)
    first, second, third = layers(points)
    assert sorted(first.tolist()) == [0, 1, 2]  # the double of 1 is left out
    assert sorted(second.tolist()) == [3, 4]
    assert third.tolist() == [5]
    assert layers(np.empty((0, 2))) == []


def test_the_knee_is_the_corner_and_rows_are_spread_with_the_ends():
    x = np.linspace(0.0, 1.0, 101)
    front = np.column_stack([x, np.maximum(1.0 - 4.0 * x, 0.25 * (1.0 - x) / 0.9375 * 0.8)])
    at = knee(front)
    assert front[at, 0] == pytest.approx(0.21, abs=0.03)
    rows = rows_of(front, 7, [at])
    assert len(rows) == 7
    assert {0, 100, at} <= set(rows)
    assert rows == sorted(rows)
    assert np.diff(front[rows, 0]).max() < 0.45
    assert rows_of(front[:1], 12) == [0]


def test_the_hypervolume_of_a_corner_is_its_area():
    assert hypervolume(np.array([[0.25, 0.5]]), np.zeros(2), np.ones(2)) == pytest.approx(0.375)
    assert hypervolume(np.empty((0, 2)), np.zeros(2), np.ones(2)) == 0.0


@pytest.mark.parametrize(
    "minimize, maximize, message",
    [
        (["max_bufer_force"], [], "minimize max_bufer_force: is no load; did you mean max_buffer"),
        (["max_torsion", "max_torsion"], [], "minimize max_torsion: must be given once"),
        (["max_torsion"], ["max_torsion"], "maximize max_torsion: must be capture_range"),
        ([], [], r"objectives = 0 \(\): must be 1 to 3"),
        (
            ["max_torsion", "max_buffer_force", "max_buffer_torque"],
            ["capture_range"],
            "objectives = 4 .*: must be 1 to 3",
        ),
    ],
)
def test_what_is_no_objective_is_rejected_in_a_line(minimize, maximize, message):
    with pytest.raises(SceneError, match=message):
        make_objectives(minimize, maximize)


def test_the_cost_of_a_limit_is_its_multiplier():
    """Force 1/x and stroke x: 1 % more stroke is 1 % less force; y changes neither."""
    objectives = make_objectives(["max_buffer_force"])
    limits = make_limits({"max_axial_stroke_in": 0.01, "max_torsion": 0.1})

    def loads(shares, noise=0.0):
        x = np.exp(np.asarray(shares)[:, 0] - 0.5)
        rng = np.random.default_rng(3)
        force = 4.0 / x * (1.0 + noise * rng.normal(size=x.size))
        return [
            {"max_buffer_force": f, "max_axial_stroke_in": 0.01 * s, "max_torsion": 0.05}
            for f, s in zip(force, x, strict=True)
        ]

    (chosen,) = loads([[0.5, 0.5]])
    (cost,) = limit_costs(chosen, [0.5, 0.5], limits, objectives, loads)
    assert cost.limit.key == "max_axial_stroke_in"
    assert cost.use == pytest.approx(1.0)
    # the buffers lie within 0.5 % to either side
    assert cost.changes[0].value == pytest.approx(-0.005, rel=0.02)
    assert cost.changes[0].deviation < 1e-4
    (noisy,) = limit_costs(
        chosen, [0.5, 0.5], limits, objectives, lambda shares: loads(shares, 0.002)
    )
    assert noisy.changes[0].deviation > 1e-4
    assert (
        limit_costs({**chosen, "max_axial_stroke_in": 0.005}, [0.5, 0.5], limits, objectives, loads)
        == ()
    )
