"""The refinement finds minima that are known exactly: on kinks, on ceilings, among catalogues."""

import math

import numpy as np
import pytest

from capture_sim.studies.evaluate.limits import make_objectives
from capture_sim.studies.search.evaluator import Candidate
from capture_sim.studies.search.refinement import CandidatePoints, Goal, NelderMead, refine
from capture_sim.studies.vary.inputs import Input

FORCE = make_objectives(["max_buffer_force"])
TRADED = make_objectives(["max_axial_stroke_in", "max_buffer_force"])


def minimum(function, start, runs, size=0.1, rng=None):
    """Return the best value and the number of calls."""
    search, values = NelderMead(np.array(start), size, runs, rng), []
    while len(asked := search.ask()):
        assert ((asked >= 0.0) & (asked <= 1.0)).all()
        values += [function(x) for x in asked]
        search.tell(np.array(values[-len(asked) :]))
    return min(values), len(values)


@pytest.mark.parametrize("rng", [None, 3])
@pytest.mark.parametrize("at", [(0.3, 0.6), (0.0, 0.5), (1.0, 1.0)])
def test_a_kinked_minimum_is_found_inside_and_at_the_bounds(at, rng):
    def kinked(x):
        return float(np.abs(x - at).max() + 0.5 * np.abs(x - at).sum())

    found, runs = minimum(kinked, [0.5, 0.4], 250, rng=rng and np.random.default_rng(rng))
    assert found < 1e-3
    assert runs == 250


def test_what_a_search_asks_next_is_among_what_it_looked_ahead_to():
    def bent(x):
        return float(np.abs(x - 0.3).max() + np.abs(x - 0.3).sum())

    search, seen, among = NelderMead(np.array([0.8, 0.9, 0.1]), 0.2, 200), 0, 0
    while len(asked := search.ask()):
        later = [one.ask() for _, one in search.ahead()]
        search.tell(np.array([bent(x) for x in asked]))
        if later and len(search.ask()):
            seen += 1
            among += any(np.array_equal(one, search.ask()) for one in later)
    assert seen > 100
    assert among > 0.9 * seen  # all but shrinking and new simplices


def test_looking_ahead_changes_no_search():
    """Beyond a simplex that has converged neither: the next one is drawn by the search itself."""
    plain, looks = (
        NelderMead(np.array([0.8, 0.9]), 0.2, 300, np.random.default_rng(4)) for _ in range(2)
    )
    while len(asked := plain.ask()):
        assert np.array_equal(asked, looks.ask())
        values = ((asked - 0.3) ** 2).sum(axis=1)
        looks.ahead()
        looks.after(values)
        for search in (plain, looks):
            search.tell(values)
    assert not len(looks.ask())


def candidates_of(force):
    """Return the evaluation of force(values), with the stroke x, m."""

    def evaluate(values, _=None):
        return [
            Candidate(
                dict(each),
                {"max_buffer_force": force(each), "max_axial_stroke_in": each["x"]},
                *("captured", 0.0),
            )
            for each in values
        ]

    return evaluate


def test_a_row_is_the_least_force_at_its_stroke():
    """Two basins; force 3 / x in the better one, which is on a kink."""
    variables = (Input("x").between(0.001, 0.1), Input("y").between(1.0, 100.0))

    def force(values):
        x, y = values["x"], values["y"]
        return min(3.0 * math.exp(abs(math.log(y / 8.0))), 3.3 * abs(math.log(y / 70.0)) + 3.2) / x

    points = CandidatePoints(variables, TRADED)
    rng = np.random.default_rng(1)
    evaluate = candidates_of(force)
    points.add(evaluate([points.values_of(x) for x in rng.random((60, 2)).tolist()]))
    goals = [Goal((1e-3, 1.0), (TRADED[0].cost(x), math.inf)) for x in (0.003, 0.02)]
    assert refine(goals, points, evaluate, 150)
    for goal, stroke in zip(goals, (0.003, 0.02), strict=True):
        best = points.best(goal, 1)[0]
        assert best.loads["max_axial_stroke_in"] == pytest.approx(stroke, rel=1e-3)
        assert best.loads["max_buffer_force"] == pytest.approx(3.0 / stroke, rel=2e-3)


def test_a_catalogue_is_searched_by_its_items_alone():
    items = (1.0, 3.0, 4.0, 9.0, 20.0)
    variables = (Input("x").between(0.001, 0.1), Input("y", values=items, low=1.0, high=20.0))
    tried = []

    def force(values):
        tried.append(values["y"])
        return 1.0 + abs(math.log(values["x"] / 0.01)) + abs(values["y"] - 8.0)

    points, evaluate = CandidatePoints(variables, FORCE), candidates_of(force)
    points.add(evaluate([points.values_of([0.1, 0.1])]))
    goal = Goal((1.0,), (math.inf,))
    for _ in range(4):  # from one item to the next
        refine([goal], points, evaluate, 120)
    best = points.best(goal, 1)[0]
    assert set(tried) <= set(items)
    assert best.values["y"] == 9.0
    assert best.values["x"] == pytest.approx(0.01, rel=1e-3)


def test_a_budget_that_ends_is_said_and_kept():
    points = CandidatePoints((Input("x").between(0.1, 10.0),), FORCE)
    evaluate = candidates_of(lambda values: values["x"])
    points.add(evaluate([{"x": 5.0}]))
    left = [30]

    def limited(values, _=None):
        found = evaluate(values[: left[0]])
        left[0] -= len(found)
        return found

    assert not refine([Goal((1.0,), (math.inf,))], points, limited, 100)
    assert len(points.candidates) == 31
