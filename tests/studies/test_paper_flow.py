"""The paper's design flow: its springs come back, refusals are true, energies add up."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid

from capture_sim import load_scene, simulate
from capture_sim.cli import main
from capture_sim.run.first_contact import first_cluster
from capture_sim.scene.approach import Approach, placed
from capture_sim.studies.evaluate.outcome import run_first_contact, run_to_verdict
from capture_sim.studies.search.paper_flow import (
    FirstContactTarget,
    design_first_contact,
    energy_of,
    find_springs,
    first_guess,
    with_buffer,
)


@pytest.fixture(scope="module")
def paper():
    return load_scene("paper_undamped")


@pytest.fixture(scope="module")
def design(paper):
    own = run_first_contact(paper)
    return design_first_contact(paper, FirstContactTarget(own.axial_stroke, own.torsion))


@pytest.mark.parametrize(
    "name", ["paper_clamped", "paper_undamped", "paper_designed", "paper_case_1", "tilt_p10"]
)
def test_first_contact_is_that_of_the_whole_run(name):
    scene = load_scene(name)
    contact, whole = run_first_contact(scene), simulate(scene)
    touches = first_cluster(whole.touches)
    assert contact.touches == touches.size
    assert contact.duration == pytest.approx(whole.summary["first_contact_duration"], rel=1e-9)
    assert contact.peak_force == whole.summary["first_contact_peak_force"]
    start, end = touches["start"].min(), touches["end"].max()
    fine = simulate(scene, t_end=end, t_eval=np.linspace(start, end, 20_001)).samples
    assert contact.axial_stroke == pytest.approx(np.abs(fine["axial_stroke"]).max(), rel=1e-4)
    assert contact.torsion == pytest.approx(np.abs(fine["torsion"]).max(), rel=1e-4)


def test_a_run_without_contact_has_no_strokes():
    scene = load_scene("paper_designed", ["initial.target.y=0.5", "run.t_end=0.3"])
    contact = run_first_contact(scene)
    assert (contact.touches, contact.axial_stroke, contact.peak_force) == (0, 0.0, 0.0)
    assert math.isnan(contact.duration)


def test_the_papers_springs_come_back(design):
    b = design.scene.buffer
    assert b.k_A == pytest.approx(500.0, rel=0.01)
    assert b.k_T == pytest.approx(200.0, rel=0.01)
    assert sum(candidate.verdict is None for candidate in design.history) <= 10


@pytest.mark.parametrize("name", ["paper_case_1", "paper_case_2", "paper_case_3", "tilt_0"])
def test_springs_come_back_from_the_strokes_that_they_give(name):
    """The buffers of the paper's Figures 13 and 15, within 0.1 %."""
    scene = load_scene(name)
    b = scene.buffer
    own = run_first_contact(with_buffer(scene, b.k_A, b.k_T, 0.0))
    target = FirstContactTarget(own.axial_stroke, own.torsion)
    found = find_springs(scene, target, 0.0, first_guess(scene, target))
    assert found.k_A == pytest.approx(b.k_A, rel=1e-3)
    assert found.k_T == pytest.approx(b.k_T, rel=1e-3)


def test_the_damper_captures_and_the_papers_is_among_those_that_do(design):
    assert simulate(design.scene).verdict == "captured"
    low, high = design.capturing
    assert low < 13.0 < high
    assert low <= design.scene.buffer.c_A <= high
    b = design.scene.buffer
    for c_A in (0.97 * low, 1.04 * high):
        outside = with_buffer(design.scene, b.k_A, b.k_T, c_A)
        assert simulate(outside).verdict != "captured"


def test_the_paper_has_both_ways_to_fail(design):
    """Too little damping and too much: either way the tip stays away from BE."""
    tried = sorted((t for t in design.history if t.verdict is not None), key=lambda t: t.c_A)
    assert tried[0].verdict == tried[-1].verdict == "rebound"
    assert min(t.nearest for t in tried) < 0.5 * min(tried[0].nearest, tried[-1].nearest)


def test_energy_is_what_the_curves_of_force_enclose(design):
    """Step 6 of the paper's flow, by trapezoids over samples dense in every touch."""
    end, energy = run_to_verdict(design.scene).t, design.energy
    touches = simulate(design.scene, t_end=end).touches
    share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 60))
    dense = touches["start"][:, None] + share * (touches["end"] - touches["start"])[:, None]
    t = np.unique(np.concatenate([np.arange(0.0, end, 5e-4), dense.ravel(), [end]]))
    s = simulate(design.scene, t_end=end, t_eval=t[t <= end]).samples
    damper = -trapezoid(s["axial_force"], s["axial_stroke"]) - np.ptp(s["elastic_axial"][[0, -1]])
    contact = sum(
        trapezoid(s["normal_force"][:, wall], s["penetration"][:, wall]) for wall in (0, 1)
    )
    assert energy.damper == pytest.approx(damper, rel=2e-3)
    assert energy.contact == pytest.approx(contact, rel=1e-2)
    chaser, target = 21.9706 + 1.0 + 0.178185, 23.5731
    m = chaser * target / (chaser + target)
    assert energy.approach == pytest.approx(0.5 * m * 0.1**2, rel=1e-4)
    assert energy.damper + energy.contact < energy.approach
    assert energy_of(with_buffer(design.scene, 500.0, 200.0, 0.0), 0.25).damper == 0.0


def test_target_strokes_of_the_first_contact_are_met(paper):
    found = design_first_contact(paper, FirstContactTarget(5e-3, 3e-3))
    assert found.met
    b = found.scene.buffer
    scene = with_buffer(found.scene, b.k_A, b.k_T, 0.0)
    contact = run_first_contact(replace(scene, run=replace(scene.run, rtol=1e-10)))
    assert contact.axial_stroke == pytest.approx(5e-3, rel=0.02)
    assert contact.torsion == pytest.approx(3e-3, rel=0.02)
    assert simulate(found.scene).verdict == "captured"


def test_what_later_contacts_exceed_is_reported(paper):
    target = FirstContactTarget(7.5e-3, 2e-3)
    found = design_first_contact(load_scene("paper_designed"), target)
    assert found.met
    assert [limit.text for limit in found.exceeded] == ["torsion <= 2 mrad"]
    assert found.outcome.loads["max_torsion"] == pytest.approx(9.17e-3, rel=1e-3)


def test_energy_is_counted_from_the_launch():
    """The vehicles are held at t = 0: the string brings in what the buffer absorbs."""
    scene = load_scene("tilt_p10")
    energy = energy_of(scene, 5.0)
    speed = simulate(scene, t_end=5.0).summary["impact_speed"]
    chaser, target = scene.chaser_total_mass, scene.target.mass
    assert energy.approach == pytest.approx(
        0.5 * chaser * target / (chaser + target) * speed**2, rel=1e-3
    )
    assert 0.0 < energy.damper + energy.contact < energy.approach


def test_a_stroke_longer_than_the_approach_has_energy_for_is_refused(paper):
    found = design_first_contact(paper, FirstContactTarget(0.2, 2e-3))
    assert not found.met
    assert found.refusal.startswith("no springs give")
    strokes = [
        run_first_contact(with_buffer(paper, k_A, k_T, 0.0)).axial_stroke
        for k_A in (20.0, 300.0, 5000.0)
        for k_T in (5.0, 300.0, 2e4)
    ]
    assert max(strokes) < 0.2


def test_too_short_a_stroke_is_refused_as_no_damper_captures(paper):
    found = design_first_contact(paper, FirstContactTarget(2.3e-3, 2e-3))
    assert "no damper captures" in found.refusal
    assert "too much energy is left" in found.refusal
    assert "too little is left" in found.refusal
    b = found.scene.buffer
    for c_A in [0.0, *np.geomspace(0.3, 1500.0, 12)]:
        scene = with_buffer(paper, b.k_A, b.k_T, c_A)
        assert simulate(scene).verdict != "captured"


def test_a_limit_of_force_is_kept_or_refused(paper, design):
    own = run_first_contact(paper)
    strokes = own.axial_stroke, own.torsion
    kept = design_first_contact(paper, FirstContactTarget(*strokes, peak_force=250.0))
    assert kept.met
    force = run_to_verdict(kept.scene).loads["max_normal_force"]
    assert force <= 250.0 < design.history[-1].peak_force + 100.0
    refused = design_first_contact(paper, FirstContactTarget(*strokes, peak_force=100.0))
    assert "pushes too hard" in refused.refusal
    # the first touch alone is harder than that, whatever the buffer
    assert own.peak_force > 100.0


def test_the_search_for_springs_ends_where_nothing_can_be_met(paper):
    tried = []
    target = FirstContactTarget(0.2, 2e-3)
    found = find_springs(paper, target, 0.0, (500.0, 200.0), thorough=False, report=tried.append)
    assert not found.met
    assert len(tried) <= 26


def test_the_command_leaves_a_scene_that_captures(tmp_path, capsys, drawn):
    how = ["paper", "paper_designed", "--out", str(tmp_path)]
    assert main(how) == 0
    printed = capsys.readouterr().out
    assert "k_A = 499.99 N/m" in printed or "k_A = 500" in printed
    assert len(printed.splitlines()) < 40
    # what is printed last are the loads of the design itself
    loads = simulate(load_scene(tmp_path / "design.yaml")).loads
    torsion = next(
        line.split() for line in printed.splitlines() if line.startswith("torsion, mrad")
    )
    assert float(torsion[2]) == pytest.approx(loads["max_torsion"] * 1e3, rel=1e-3)
    assert f"torsion {loads['max_torsion'] * 1e3:.4g} mrad, must be at most" in printed
    scene = load_scene(tmp_path / "design.yaml")
    assert scene.name == "paper_designed_design"
    assert simulate(scene).verdict == "captured"
    kept = json.loads((tmp_path / "design.json").read_text())
    assert kept["refusal"] == ""
    assert len(kept["history"]) > 30
    assert (tmp_path / "design.png").stat().st_size > 10_000
    assert main([*how, "-v", "--peak-force=50"]) == 1
    printed = capsys.readouterr().out
    assert "pushes too hard" in printed
    assert len(printed.splitlines()) > 50


@pytest.mark.parametrize("stroke, torsion, leaves", [(5, 3, True), (10, 2, False)])
def test_a_winner_whose_tip_leaves_again_says_so(stroke, torsion, leaves, tmp_path, capsys):
    target = [f"--stroke={stroke}", f"--torsion={torsion}"]
    assert main(["paper", "paper_designed", *target, f"--out={tmp_path}"]) == 0
    printed = capsys.readouterr().out
    run = simulate(load_scene(tmp_path / "design.yaml"))
    kept = json.loads((tmp_path / "design.json").read_text())
    assert run.verdict == kept["verdict"] == "captured"
    assert run.summary["left_again"] == kept["left_again"] == leaves
    assert ("the tip leaves the capture zone again" in printed) == leaves
    closing = next(line for line in printed.splitlines() if line.startswith("verdict "))
    assert ("captured, left" in closing) == leaves


def test_a_tip_that_meets_the_outer_lip_is_said_to(paper):
    lip = placed(paper, Approach(0.0, 0.07, 0.1))
    own = run_first_contact(lip)
    found = design_first_contact(lip, FirstContactTarget(own.axial_stroke, own.torsion))
    assert "outer lip" in found.refusal
    # the lip lies further from BE than the generatrix is long
    assert simulate(lip).samples["tip_distance"].min() > lip.cone.L_c
