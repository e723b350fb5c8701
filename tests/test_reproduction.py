"""The paper reproduced: its statements, the second engine, the readings, and the page."""

import re

import numpy as np
import pytest

from capture_sim.cli import main
from capture_sim.reproduction import claims, second_engine
from capture_sim.reproduction.cases import DOCKING, run_cases
from capture_sim.reproduction.everything import FIGURES, reproduce_figure
from capture_sim.reproduction.page import Reproduction, page, terminal_table
from capture_sim.reproduction.readings import (
    CASES,
    READINGS,
    Reading,
    Together,
    judge,
    scan_readings,
    vary_together,
)
from capture_sim.studies.executors import InProcess


@pytest.fixture(scope="module")
def runs():
    return run_cases()


def test_first_impact_from_one_metre_comes_after_ten_seconds(runs):
    run = runs[DOCKING]
    tip = run.samples[0]["tip_axial"], run.samples[0]["tip_lateral"]
    touch = run.summary["first_contact_time"]
    assert touch == pytest.approx(10.0, abs=1e-9)
    k = int(np.searchsorted(run.t, touch))
    assert abs(tip[0] - run.samples[k]["tip_axial"]) == pytest.approx(1.0, abs=1e-3)
    assert run.verdict.label == "captured"


def test_the_docking_ends_as_the_same_case_from_near(runs):
    far, near = runs[DOCKING].summary, runs["paper_designed"].summary
    for key in ("first_contact_duration", "first_contact_peak_force"):
        assert far[key] == pytest.approx(near[key], rel=1e-6)


def test_what_must_be_shown(runs):
    durations = {0.5: runs["paper_undamped"].summary["first_contact_duration"]}
    told = [*claims.buffer_against_clamped(runs), *claims.undamped(runs, durations)]
    told += [*claims.docking(runs), *claims.experiments(runs)]
    assert [claim.agrees for claim in told].count(False) == 0
    assert [claim.agrees for claim in told].count(True) == 10
    assert "2.49 times less" in told[1].here


def test_a_statement_that_does_not_hold_is_said_to_differ(runs):
    swapped = {"paper_clamped": runs["paper_undamped"], "paper_undamped": runs["paper_clamped"]}
    assert [claim.agrees for claim in claims.buffer_against_clamped(swapped)][1:] == [False, False]
    assert claims.undamped(swapped, {0.5: 0.0125})[0].agrees is False


def test_second_engine_agrees_on_velocities():
    if second_engine.missing():
        pytest.skip(second_engine.missing())
    both = second_engine.compare(0.3)
    until = both.t <= both.contact_end
    assert until.sum() > 240
    assert both.largest_difference().max() < 1e-5
    # a difference of the law alone is seen
    assert both.law_effect.max() > 1e-5
    told = claims.velocities(both, "")
    assert [claim.agrees for claim in told] == [True, True]


def test_without_second_engine_nothing_is_claimed():
    [told] = claims.velocities(None, "Exudyn is not installed")
    assert told.agrees is None
    assert told.why == "Exudyn is not installed"


def test_cases_2_and_3_as_found():
    """Neither verdict is the paper's at the readings taken; a radius of capture decides both."""
    radius = Reading("radius", "detector.radius", "mm", 1e3, (3e-3, 5e-3, 8e-3), "", 5e-3)
    [scan] = scan_readings(InProcess(), [radius])
    assert scan.agrees("paper_case_2") == [True, False, False]
    assert scan.agrees("paper_case_3") == [False, False, True]
    assert scan.agrees("paper_designed") == [False, True, True]
    assert scan.where("paper_case_2") == "3 mm"
    assert scan.where("paper_designed") == "5 to 8 mm"
    assert scan.where("paper_undamped") == "all"


@pytest.mark.parametrize("case", CASES)
def test_readings_as_taken_give_the_cases_verdict(runs, case):
    values = tuple((r.field, r.taken) for r in READINGS)
    point = judge((case, values))
    assert point.verdict == runs[case].verdict.label
    final = next((s for s in runs[case].statuses if s.final), runs[case].statuses[-1])
    assert point.nearest == pytest.approx(final.nearest_distance, abs=1e-5)


def test_the_first_touch_is_where_b_says():
    import math

    from capture_sim.scene.files import load_scene
    from capture_sim.simulation import simulate
    from capture_sim.studies.approach import placed

    scene = load_scene("paper_designed", ["initial.target.x=2.0"])
    cone = scene.cone
    offset = -(cone.R_c + (0.045 - scene.probe.tip_radius) * math.sin(cone.beta))
    near = placed(scene, 0.0, offset, 0.1, 1e-4)
    paper = load_scene("paper_designed")
    assert near.initial.chaser.y - near.initial.target.y == pytest.approx(
        paper.initial.chaser.y - paper.initial.target.y, abs=1e-12
    )
    run = simulate(near, t_end=0.002)
    assert run.touches["start"][0] == pytest.approx(1e-3, abs=1e-9)


def test_varied_together_the_same_seed_gives_the_same():
    one, two = (vary_together(InProcess(), 3, seed=4) for _ in range(2))
    assert one.count == 3
    assert all(np.array_equal(one.agrees[case], two.agrees[case]) for case in CASES)


def test_shares_of_samples():
    agrees = {case: np.array([True, True, False, False]) for case in CASES}
    agrees["paper_case_2"] = np.array([False, True, True, False])
    together = Together(agrees)
    assert together.share("paper_case_2") == 0.5
    assert together.share("paper_case_2", "paper_designed") == 0.25
    assert together.share(*CASES) == 0.25


def test_the_page_prints_the_command_under_each_figure(runs):
    found = Reproduction(claims.docking(runs), pictures={"figure_12": "Figure 12"})
    found.left_out["Figure 10"] = "Exudyn is not installed"
    text = page(found)
    shown = re.findall(r"!\[.*\]\(reproduction/(\w+)\.png\)\n\n    (.*)\n", text)
    assert shown == [("figure_12", ".venv/bin/capture-sim reproduce --only figure_12 --out runs")]
    assert "Not drawn: Exudyn is not installed." in text
    assert "agrees" in terminal_table(found.claims)


def test_one_figure_on_its_own(tmp_path, capsys):
    assert main(["reproduce", "--only", "figure_12", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "reproduction" / "figure_12.png").stat().st_size > 10_000
    assert main(["reproduce", "--only", "figure_99", "--out", str(tmp_path)]) == 2
    assert "allowed are figure_5" in capsys.readouterr().err


@pytest.mark.parametrize("name", [n for n in FIGURES if n not in ("readings", "figure_12")])
def test_every_figure_is_drawn(name, tmp_path):
    if name in ("figure_10", "figure_11") and second_engine.missing():
        pytest.skip(second_engine.missing())
    assert reproduce_figure(name, InProcess(), tmp_path).stat().st_size > 10_000
