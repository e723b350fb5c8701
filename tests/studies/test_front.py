"""Fronts of known shape: layers, knee, rows; limits with known cost."""

import math

import numpy as np
import pytest

from capture_sim import SceneError
from capture_sim.studies.evaluate.limits import make_limits, make_objectives
from capture_sim.studies.search.evaluator import Candidate, Requirements
from capture_sim.studies.search.front import knee, layers, spread_points
from capture_sim.studies.search.limit_costs import limit_costs
from capture_sim.studies.vary.inputs import Input


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
    rows = spread_points(front, 7, [at])
    assert len(rows) == 7
    assert {0, 100, at} <= set(rows)
    assert rows == sorted(rows)
    assert np.diff(front[rows, 0]).max() < 0.45
    assert spread_points(front[:1], 12) == [0]


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


VARIABLES = (Input("x").between(0.1, 10.0), Input("y").between(1.0, 2.0))


def evaluations(force):
    """Return the evaluation of force(x, y) and stroke x, m, under requirements, and its count."""
    count = [0]

    def of(requirements):
        def evaluate(values, _=None):
            count[0] += len(values)
            found = []
            for each in values:
                x, y = each["x"], each["y"]
                loads = {"max_buffer_force": force(x, y), "max_axial_stroke_in": x}
                loads["max_torsion"] = 0.05
                uses = [limit.use(loads[limit.key]) for limit in requirements.limits]
                excess = max(0.0, math.log(max(uses))) if max(uses) > 1.0 + 1e-6 else 0.0
                found.append(Candidate(each, loads, "captured", excess))
            return found

        return evaluate

    return of, count


@pytest.mark.parametrize("kink", [0.0, 1.0])
def test_the_cost_of_a_limit_is_what_the_optimum_gains(kink):
    """Force 1/x, more off y = 1.5, there with a kink; stroke x: -1/1.01 and -1/1.05."""

    def force(x, y):
        return 4.0 / x * math.exp(kink * abs(y - 1.5) + (y - 1.5) ** 2)

    requirements = Requirements(
        make_objectives(["max_buffer_force"]),
        make_limits({"max_axial_stroke_in": 1.0, "max_torsion": 0.1}),
    )
    of, count = evaluations(force)
    (chosen,) = of(requirements)([{"x": 1.0, "y": 1.5}])
    (cost,) = limit_costs(chosen, [], VARIABLES, requirements, of, 600)
    assert cost.limit.key == "max_axial_stroke_in"
    assert cost.use == pytest.approx(1.0)
    for (change,), exact in zip(cost.changes, (1 / 1.01 - 1, 1 / 1.05 - 1), strict=True):
        assert change.value == pytest.approx(exact, abs=1e-4)
        assert abs(change.value - exact) <= 5.0 * change.error + 1e-6
        assert 0.0 < change.error < 1e-3
    assert count[0] < 1000
    (inside,) = of(requirements)([{"x": 0.5, "y": 1.5}])
    assert limit_costs(inside, [], VARIABLES, requirements, of, 600) == ()
