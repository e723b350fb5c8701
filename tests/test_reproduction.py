"""The paper reproduced: its statements, the second engine, the assumptions, and the page."""

import math
import re
import sys

import numpy as np
import pytest

from benchmarks import paper, reproduction
from benchmarks.paper import (
    ASSUMPTIONS,
    CASES,
    DOCKING,
    Agreement,
    Assumption,
    Evidence,
    JointVariation,
    run_case,
    scan_assumptions,
    second_engine,
    vary_together,
)
from benchmarks.paper_figures import FIGURES
from benchmarks.reproduction import page, terminal_table
from capture_sim import load_scene, simulate
from capture_sim.scene.approach import Approach, placed
from capture_sim.studies.evaluate.executors import InProcess

RADIUS = Assumption("radius", "detector.capture_radius", "mm", 1e3, (3e-3, 5e-3, 8e-3), "", 5e-3)


@pytest.fixture(scope="module")
def evidence():
    """All that the statements need, the assumptions on small grids."""
    found = Evidence(InProcess())
    found.__dict__["scans"] = scan_assumptions(InProcess(), [RADIUS])
    found.__dict__["joint_variation"] = vary_together(InProcess(), 3, seed=4)
    return found


def test_first_impact_from_one_metre_comes_after_ten_seconds(evidence):
    far, near = evidence.run(DOCKING), evidence.run("paper_designed")
    touch = far.summary["first_contact_time"]
    assert touch == pytest.approx(10.0, abs=1e-9)
    k = int(np.searchsorted(far.t, touch))
    assert abs(far.samples["tip_axial"][[0, k]] @ [1, -1]) == pytest.approx(1.0, abs=1e-3)
    assert far.verdict == "captured"
    for key in ("first_contact_duration", "first_contact_peak_force"):
        assert far.summary[key] == pytest.approx(near.summary[key], rel=1e-6)


@pytest.fixture(scope="module")
def claims(evidence):
    return list(paper.claims(evidence))


def test_statements_that_differ_agree_in_numbers_or_cannot_be_compared(claims):
    by_kind = {
        kind: [claim.paper for claim in claims if claim.agreement is kind] for kind in Agreement
    }
    assert [text.split(":")[0] for text in by_kind[Agreement.DIFFERS]] == [
        "paper_designed",  # drifts out again
        "paper_case_2",
        "paper_case_3",
    ]
    assert by_kind[Agreement.NUMBERS] == ["first contact lasts 0.2734 s"]
    assert len(by_kind[Agreement.NOT_COMPARABLE]) == 3
    assert len(claims) == 18


def test_a_statement_that_does_not_hold_differs(evidence):
    clamped, undamped = evidence.run("paper_clamped"), evidence.run("paper_undamped")
    kinds = [claim.agreement for claim in paper.impact(clamped=undamped, undamped=clamped)]
    assert kinds[:4] == [Agreement.NOT_COMPARABLE, *[Agreement.DIFFERS] * 3]


def test_second_engine_agrees_on_velocities():
    engine = second_engine()
    assert engine.source.startswith("Exudyn ")
    assert engine.difference.max() < 1e-5
    # a difference of the law alone is seen
    assert engine.law_effect.max() > 1e-5
    kinds = [claim.agreement for claim in paper.velocities(engine)]
    assert kinds == [Agreement.NOT_COMPARABLE] * 2  # the paper compares with another program


def test_a_radius_of_capture_decides_cases_2_and_3(evidence):
    (scan,) = evidence.scans
    assert scan.agrees("paper_case_2") == [True, False, False]
    assert scan.agrees("paper_case_3") == [False, False, True]
    assert scan.agrees("paper_designed") == [False, True, True]
    assert scan.where("paper_case_2") == "3 mm"
    assert scan.where("paper_designed") == "5 to 8 mm"
    assert scan.where("paper_undamped") == "all"


@pytest.mark.parametrize("case", CASES)
def test_assumptions_as_in_the_scenes_give_the_cases_verdict(evidence, case):
    point = run_case((case, tuple((a.field, a.assumed) for a in ASSUMPTIONS)))
    whole = evidence.run(case)
    assert point.verdict == whole.verdict
    final = next((s for s in whole.statuses if s.final), whole.statuses[-1])
    # The run to a verdict goes on for up to 0.2 s. It starts farther away, so its steps are others:
    # the two integrations agree within 1e-8 m (2e-9 m seen).

    def nearest(end):
        t = whole.samples["t"]
        return whole.samples["tip_distance"][t <= end].min()

    assert nearest(final.t + 0.2) - 1e-5 < point.loads["nearest_distance"] < nearest(final.t) + 1e-8


def test_the_first_touch_is_at_b():
    scene = load_scene("paper_designed", ["initial.target.x=2.0"])
    cone = scene.cone
    offset = -(cone.R_c + (0.045 - scene.probe.tip_radius) * math.sin(cone.half_angle))
    near = placed(scene, Approach(0.0, offset, 0.1), 1e-4)
    given = load_scene("paper_designed").initial
    assert near.initial.chaser.y - near.initial.target.y == pytest.approx(
        given.chaser.y - given.target.y, abs=1e-12
    )
    assert simulate(near, t_end=0.002).touches["start"][0] == pytest.approx(1e-3, abs=1e-9)


def test_shares_of_samples():
    agrees = {case: np.array([True, True, False, False]) for case in CASES}
    agrees["paper_case_2"] = np.array([False, True, True, False])
    together = JointVariation(agrees)
    assert together.share("paper_case_2") == 0.5
    assert together.share("paper_case_2", "paper_designed") == 0.25
    assert together.share(*CASES) == 0.25


def test_the_page_has_every_figure_with_its_command(claims, evidence):
    text = page(claims, evidence, {name: figure.title for name, figure in FIGURES.items()})
    commands = re.findall(r"!\[.*\]\(reproduction/(\w+)\.png\)\n\n`(.*)`\n", text)
    assert commands == [
        (name, f"python -m benchmarks.reproduction --only {name} --out runs") for name in FIGURES
    ]
    assert "1: agrees in numbers; 11: agrees in shape; 3: cannot be compared; 3: differs." in text
    assert re.search(r"---\|\n\| radius \|.* \|\n\nAll open assumptions varied together", text)
    assert "agrees" in terminal_table(claims)


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_shows_curves_of_finite_numbers(evidence, name):
    figure = FIGURES[name].draw(evidence)
    drawn = [line.get_xydata() for axes in figure.axes for line in axes.get_lines()]
    shown = [*drawn, *(c for axes in figure.axes for c in [*axes.collections, *axes.patches])]
    assert shown
    assert all(np.isfinite(data).any() for data in drawn if len(data))


def test_one_figure_by_the_command(tmp_path, monkeypatch, drawn):
    arguments = ["reproduction", "--only", "figure_12", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    reproduction.main()
    assert (tmp_path / "reproduction" / "figure_12.png").stat().st_size > 10_000


def test_the_second_engine_is_drawn_as_points_of_its_curves(evidence):
    engine = evidence.engine
    figure = FIGURES["figure_10"].draw(evidence)
    assert "Exudyn" in [text.get_text() for text in figure.legends[0].get_texts()]
    for axes, index in zip(figure.axes, (0, 5, 1, 6, 2, 7), strict=True):
        [points] = [line.get_xydata() for line in axes.get_lines() if line.get_label() == "Exudyn"]
        assert 20 <= len(points) <= 30
        expected = np.interp(points[:, 0], engine.t, engine.v[:, index] * 1e3)
        assert points[:, 1] == pytest.approx(expected, abs=1e-9)
