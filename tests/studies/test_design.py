"""Design: a front that grids do not beat, whose rows run to their figures, within limits."""

import csv
import itertools
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture_sim import SceneError, load_scene, simulate
from capture_sim.base.exit_status import INTERRUPTED
from capture_sim.cli import main
from capture_sim.scene import paths
from capture_sim.scene.loading import change_scene
from capture_sim.studies.evaluate.executors import InProcess, open_executor
from capture_sim.studies.evaluate.limits import make_limits, make_objectives
from capture_sim.studies.evaluate.outcome import run_to_end
from capture_sim.studies.search import evaluator
from capture_sim.studies.search.coverage import undecided
from capture_sim.studies.search.design import beaten_by, costs_of_limits, design_buffer
from capture_sim.studies.search.evaluator import (
    Candidate,
    Dispersions,
    Evaluator,
    Requirements,
    costs_of,
)
from capture_sim.studies.search.search import Window
from capture_sim.studies.search.variables import FREE, make_variables, with_values

SERVICER = Path(__file__).parents[2] / "examples" / "servicer.yaml"
LIMITS = make_limits(
    {"max_axial_stroke_in": 0.015, "max_axial_stroke_out": 0.015, "max_torsion": 0.015}
)
FORCE = make_objectives(["max_buffer_force"])
TRADED = make_objectives(["max_axial_stroke_in", "max_buffer_force"])
DAMPER = ["buffer.c_A=100:2000"]


@pytest.fixture(scope="module")
def servicer():
    """The scene to 1 s: a third of the touches, and every capture."""
    return load_scene(SERVICER, ["run.rtol=1e-6", "run.t_end=1"])


@pytest.fixture(scope="module")
def design(servicer):
    return design_buffer(servicer, Requirements(TRADED, LIMITS), candidates=400)


def within(scene, limits):
    """Return whether a run captures within limits, and the tip does not leave again."""
    outcome = run_to_end(scene)
    return (
        outcome.captured
        and not outcome.left_again
        and all(outcome.loads[each.key] <= each.value for each in limits)
    )


def test_rows_of_the_front_run_to_their_figures_within_the_limits(servicer, design):
    assert design.met
    assert 3 <= len(design.rows) <= 12
    assert len({row.candidate.values["buffer.k_A"] for row in design.rows}) == len(design.rows)
    for row in design.rows[:3]:
        run = simulate(design.scene_of(row.candidate))
        assert run.verdict == "captured"
        assert all(run.loads[limit.key] <= limit.value for limit in LIMITS)
        for objective in TRADED:
            assert run.loads[objective.key] == row.candidate.loads[objective.key]


def test_no_buffer_of_the_front_or_of_the_search_beats_a_row(design):
    """But by a share below what the budget of 400 can refine."""
    costs = costs_of(design.front, TRADED)
    tried = costs_of([each for each in design.history if each.feasible], TRADED)
    assert len(tried) > len(design.front)
    for cost in costs:
        dominates = (costs <= cost).all(axis=1) & (costs < cost).any(axis=1)
        assert not dominates.any()
        assert not (tried < cost - 0.03).all(axis=1).any()
    assert all(row.convergence for row in design.rows)


def test_the_own_buffer_is_beaten_by_what_is_said(servicer, design):
    own = simulate(servicer).loads
    for objective, best in beaten_by(design):
        (other,) = (each for each in TRADED if each != objective)
        better = [
            each
            for each in design.front
            if each.loads[other.key] <= own[other.key] and each.loads[objective.key] == best
        ]
        assert better
        assert best < own[objective.key]


def test_a_single_objective_gives_one_buffer_that_no_grid_around_beats(servicer):
    """A grid of 9 dampers within 20 %; benchmarks/design.py has grids of 20^3."""
    limits = make_limits({"max_axial_stroke_in": 0.015})
    found = design_buffer(servicer, Requirements(FORCE, limits), DAMPER, candidates=150)
    assert len(found.rows) == len(found.front) == 1
    assert "buffer.c_A" in found._repr_html_()
    assert len(found.plot().axes) > 1
    best = found.rows[0].candidate
    for factor in np.linspace(0.8, 1.2, 9):
        scene = with_values(servicer, {"buffer.c_A": factor * best.values["buffer.c_A"]})
        if within(scene, limits):
            force = run_to_end(scene).loads["max_buffer_force"]
            assert force >= best.loads["max_buffer_force"] * (1.0 - 1e-3)


def test_what_says_converged_is_not_beaten_by_another_seed(servicer):
    """Two designs of one buffer, each with a second seed: apart by less than is promised."""
    limits = make_limits({"max_axial_stroke_in": 0.015, "max_torsion": 0.02})
    asked, free = Requirements(FORCE, limits), ["buffer.k_A", "buffer.c_A"]
    rows = [
        design_buffer(servicer, asked, free, candidates=1200, seed=seed).rows[0] for seed in (1, 3)
    ]
    least = min(row.candidate.loads["max_buffer_force"] for row in rows)
    for row in rows:
        apart = row.candidate.loads["max_buffer_force"] / least - 1.0
        said = re.fullmatch(r"converged|within (\S+) % of a second seed", row.convergence)
        assert apart <= (0.005 if said[1] is None else 0.01 * float(said[1]))
    # a pass too short to tell has no second seed, and says so
    few = design_buffer(servicer, asked, free, candidates=500)
    assert few.rows[0].convergence == "budget ended"


@pytest.mark.parametrize("budget", [150, 500])
@pytest.mark.parametrize("keys", [("max_buffer_force",), ("max_axial_stroke_in", "max_torsion")])
def test_a_budget_has_ended_only_when_it_is_used_up(keys, budget):
    check_budget(keys, budget)


@pytest.mark.long
def test_a_budget_for_three_objectives_is_used_up_too():
    """Passes were planned for fewer rows than there are: 1 385 of 8000 were run."""
    check_budget(("max_buffer_force", "max_axial_stroke_in", "max_torsion"), 700)


def check_budget(keys, budget):
    objectives = make_objectives(keys)
    found = design_buffer(load_scene("tilt_p10"), Requirements(objectives), candidates=budget)
    if any(row.convergence == "budget ended" for row in found.rows):
        # a share of 0.12 is kept for what limits cost; each row needs 4, and none is run twice
        assert len(found.history) >= 0.95 * 0.88 * budget


@pytest.mark.long
def test_what_free_workers_run_ahead_changes_no_result(servicer, design):
    one, many = Counting(1), Counting(40)
    for executor in (one, many):
        found = design_buffer(
            servicer, Requirements(TRADED, LIMITS), candidates=400, executor=executor
        )
        assert [x.values for x in found.history] == [x.values for x in design.history]
        assert [*map(repr, found.front)] == [*map(repr, design.front)]
    assert many.runs > 1.2 * one.runs
    assert many.batches < 0.7 * one.batches


def test_a_design_from_an_earlier_one_is_the_same_whatever_its_workers(tmp_path, capsys):
    """Two workers also run what one search may ask for next; that is no buffer of the design."""
    asked = ["design", str(SERVICER), "--free=buffer.c_A=100:2000", "--stroke-limit=15"]
    asked += ["--set=run.rtol=1e-6", "--set=run.t_end=1", "--candidates=120"]
    found = []
    for workers in (1, 2):
        first, then = tmp_path / f"first_{workers}", tmp_path / f"then_{workers}"
        asked_now = [*asked, "--minimize=max_buffer_force", f"--workers={workers}"]
        assert main([*asked_now, f"--out={first}"]) == 0
        after = [*asked, "--minimize=max_axial_stroke_in", "--workers=1", f"--from={first}"]
        assert main([*after, f"--out={then}"]) == 0
        capsys.readouterr()
        texts = [(folder / "design.json").read_text() for folder in (first, then)]
        found.append([(data["rows"], data["history"]) for data in map(json.loads, texts)])
    assert found[0] == found[1]


def test_a_seed_gives_one_front_wherever_it_is_computed(servicer):
    requirements = Requirements(TRADED, make_limits({"max_axial_stroke_in": 0.015}))
    here = design_buffer(servicer, requirements, DAMPER, candidates=100)
    with open_executor(2) as executor:
        there = design_buffer(servicer, requirements, DAMPER, candidates=100, executor=executor)
    assert [x.values for x in here.history] == [x.values for x in there.history]
    # as text: since Python 3.13, a dataclass with a NaN equals no other
    assert [*map(repr, here.front)] == [*map(repr, there.front)]
    assert len(here.history) <= 100


class Counting(InProcess):
    """Runs in this process, but gets as many runs as if it had some workers."""

    def __init__(self, workers):
        self.workers, self.runs, self.batches = workers, 0, 0

    def map(self, fn, tasks):
        """Count the runs and the batches."""
        self.runs += sum(map(len, tasks))
        self.batches += bool(tasks)
        return super().map(fn, tasks)


def candidates_with(forces, strokes):
    """Return feasible candidates with these loads, and no others."""
    return [
        Candidate({}, {"max_normal_force": f, "max_axial_stroke_in": s}, "captured", 0.0)
        for f, s in zip(forces, strokes, strict=True)
    ]


def test_an_objective_that_the_buffer_does_not_decide_is_said():
    """Of 100 buffers 12 share the least force: a first touch that no buffer softens."""
    forces = np.append(np.linspace(131.5, 131.9, 12), np.linspace(140.0, 300.0, 88))
    tried = candidates_with(forces, np.geomspace(0.001, 0.02, 100))
    said = undecided(tried, make_objectives(["max_normal_force"]))
    assert "peak normal force is not decided by the buffer: 12 of 100 feasible buffers" in said
    assert "131.5 to 131.9 N; loads that it decides: max_axial_stroke_in 1 to 20 mm" in said
    assert not undecided(tried, make_objectives(["max_axial_stroke_in"]))
    constant = candidates_with(np.linspace(100.0, 100.9, 30), np.geomspace(0.001, 0.02, 30))
    assert "30 of 30" in undecided(constant, make_objectives(["max_normal_force"]))


def test_the_search_ends_where_the_buffer_decides_nothing():
    """On this bench, the first touch has the peak normal force of a third of all buffers."""
    scene = load_scene("tilt_0", ["run.t_end=4", "run.rtol=1e-6"])
    objectives = make_objectives(["max_normal_force"])
    found = design_buffer(scene, Requirements(objectives), candidates=300)
    assert not found.met
    assert "peak normal force is not decided by the buffer" in found.refusal
    assert "loads that it decides: max_axial_stroke_in " in found.refusal
    assert len(found.history) == 50  # the first ones alone


def test_what_is_free_is_searched_and_a_rebound_damper_keeps_its_ratio(servicer):
    scene = paths.with_values(servicer, {"buffer.c_A": 10.0, "buffer.c_A_rebound": 30.0})
    free = ["buffer.c_A", "buffer.k_A3=0 N/m^3:1e5 N/m^3"]
    limits = make_limits({"max_axial_stroke_in": "20 mm"})
    found = design_buffer(scene, Requirements(FORCE, limits), free, candidates=100)
    b = found.scene_of(found.front[0]).buffer
    assert b.c_A_rebound == pytest.approx(3.0 * b.c_A)
    assert (b.k_A, b.k_T) == (scene.buffer.k_A, scene.buffer.k_T)
    tried = [candidate.values["buffer.k_A3"] for candidate in found.history]
    assert min(tried) < 1e3 < 9e4 < max(tried) <= 1e5
    freed = make_variables(scene, limits, ["buffer.c_A", "buffer.c_A_rebound"])
    values = {variable.name: variable.low for variable in freed}
    assert with_values(scene, values).buffer.c_A_rebound == freed[1].low


def test_a_refusal_names_what_was_searched_and_the_nearest(servicer):
    limits = make_limits({"max_axial_stroke_in": 0.015, "max_normal_force": 20.0})
    free = ["buffer.c_A=100:1000"]
    found = design_buffer(servicer, Requirements(FORCE, limits), free, candidates=100)
    assert not found.met
    assert not found.rows
    assert "buffers tried (buffer.c_A 100 to 1000)" in found.refusal
    assert "none captures within the limits; the nearest, buffer.c_A = " in found.refusal
    assert "has peak normal force" in found.refusal
    nothing = design_buffer(
        replace(servicer, run=replace(servicer.run, t_end=0.2)),
        Requirements(FORCE, LIMITS),
        FREE[2:],
        candidates=100,
    )
    assert "none captures; the nearest" in nothing.refusal


@pytest.mark.parametrize(
    "free, message",
    [
        (["buffer.k_B"], "buffer.k_B: no number of servicer; did you mean buffer"),
        (["buffer.k_A=5 mm"], "buffer.k_A = '5 mm': must be a number in N/m"),
        (["buffer.k_A=5 mm:6"], "must be LOW:HIGH, LOW:HIGH:COUNT or .A,B,C. in N/m"),
        (["buffer.k_A=normal(5, 1)"], "must be LOW:HIGH, LOW:HIGH:COUNT or .A,B,C. in N/m"),
        (["buffer.k_A=5 +- 1"], "must be LOW:HIGH, LOW:HIGH:COUNT or .A,B,C. in N/m"),
        (["buffer.k_A=5:-1"], "buffer.k_A = -1.0 N/m: must be >= 0"),
        (["buffer.k_A=5:1"], "must be LOW < HIGH"),
        (["probe.length"], "free probe.length: must have a range, probe.length=LOW:HIGH"),
        (["contact.law"], "must be a number of the scene"),
        (["buffer.k_A", "buffer.k_A=1:2"], "must be given once"),
        (["drag=0.1:0.2", "chaser.drag=0:1"], "free chaser.drag: must be given once"),
        (["buffer.k_A=[]"], "buffer.k_A = '': must be a number in N/m"),
        (["buffer.k_A=[ , ]"], "must be a number in N/m"),
        (["buffer.k_A=[500,-1]"], "buffer.k_A = -1.0 N/m: must be >= 0"),
        (["buffer.k_A=[500,5 mm]"], "buffer.k_A = '5 mm': must be a number in N/m"),
    ],
)
def test_what_cannot_be_free_is_rejected_in_a_line(servicer, free, message):
    with pytest.raises(SceneError, match=message):
        make_variables(servicer, LIMITS, free)


def test_a_capture_range_is_required_and_measured(servicer):
    """By hand: of 5 offsets, those between the edges of the capture."""
    from capture_sim.studies.evaluate.capture_range import make_area

    area = make_area(servicer, ["offset=-40 mm:40 mm:5"])
    limits = make_limits({"max_axial_stroke_in": 0.03})
    most = make_objectives([], ["capture_range"])
    required = Requirements(most, limits, area=area, least_range=0.05)
    runs = Evaluator(servicer, required, 1, InProcess())
    (found,) = runs.alone([{"buffer.c_A": 300.0}])
    scene = with_values(servicer, {"buffer.c_A": 300.0})
    offsets = np.linspace(-0.04, 0.04, 41)
    captured = [within(change_scene(scene, {"approach.offset": x}), limits) for x in offsets]
    assert found.verdict == "captured"
    assert 0.0 < found.loads["capture_range"] < 1.0
    assert found.loads["capture_range"] == pytest.approx(
        np.mean(captured), abs=found.range_error + 1 / 40
    )
    with pytest.raises(SceneError, match="capture_range: must have an area of approach"):
        Requirements(most)


@pytest.mark.long
def test_a_robust_design_holds_for_draws_that_the_search_never_saw(servicer, monkeypatch):
    """Drawn here with other seeds, by hand; the design for the nominal case does not hold.

    A smaller check and search than those of the command, to save time.
    """
    monkeypatch.setattr(evaluator, "CHECK_DRAWS", 60)
    vary = {"approach.speed": "normal(0.1, 5%)", "approach.offset": "normal(-20 mm, 2 mm)"}
    limits = make_limits({"max_axial_stroke_in": 0.010, "max_normal_force": 260.0})
    requirements = Requirements(FORCE, limits, Dispersions(vary), confidence=0.8, draws=15)
    found = design_buffer(servicer, requirements, DAMPER, candidates=100)
    without_draws = [each for each in found.history if each.share is None and each.feasible]
    least = min(without_draws, key=lambda each: each.loads["max_buffer_force"])
    nominal = with_values(servicer, least.values)
    assert found.met
    row = found.rows[0]
    assert row.check.estimate >= 0.8

    def share(scene):
        generator, n_met = np.random.default_rng(99), 0
        for _ in range(60):
            speed, offset = generator.normal(0.1, 0.005), generator.normal(-0.02, 0.002)
            changes = {"approach.speed": speed, "approach.offset": offset}
            n_met += within(change_scene(scene, changes), limits)
        return n_met / 60

    assert share(found.scene_of(row.candidate)) >= 0.8 - 3.0 * np.sqrt(0.8 * 0.2 / 60)
    assert share(nominal) < share(found.scene_of(row.candidate))


def test_ctrl_c_keeps_what_was_found(servicer, tmp_path, capsys, monkeypatch):
    count = itertools.count()
    real = Evaluator.alone

    def interrupted(self, values, ahead=None):
        if next(count) == 3:
            raise KeyboardInterrupt
        return real(self, values, ahead)

    monkeypatch.setattr(Evaluator, "alone", interrupted)
    arguments = ["--minimize=max_axial_stroke_in,max_buffer_force", "--stroke-limit=15"]
    arguments += ["--free=buffer.c_A=100:2000", "--set=run.rtol=1e-6", "--set=run.t_end=1"]
    arguments += ["--candidates=150", "--workers=1", f"--out={tmp_path}"]
    assert main(["design", str(SERVICER), *arguments]) == INTERRUPTED
    written = capsys.readouterr()
    assert "interrupted: " in written.err
    assert "front in" in written.out
    assert simulate(load_scene(tmp_path / "design_01.yaml")).verdict == "captured"
    assert len(json.loads((tmp_path / "design.json").read_text())["history"]) < 100


def test_the_command_leaves_scenes_that_run_to_the_figures_of_its_table(tmp_path, capsys, drawn):
    limits = ["--stroke-limit=15", "--limit=max_torsion=30 mrad", "--peak-force=345"]
    free = ["--free=buffer.c_A=100:2000", "--set=run.rtol=1e-6", "--set=run.t_end=1"]
    free += ["--minimize=max_axial_stroke_in,max_buffer_force", "--candidates=120"]
    free += ["--workers=1", f"--out={tmp_path}"]
    assert main(["design", str(SERVICER), *limits, *free, "--pick=2"]) == 0
    printed = capsys.readouterr().out
    assert "limits: stroke inwards <= 15 mm" in printed
    with (tmp_path / "front.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["row"]]
    assert [int(row["row"]) for row in rows] == list(range(1, len(rows) + 1))
    assert sum(row["knee"] == "knee" for row in rows) == 1
    run = simulate(load_scene(tmp_path / "design_02.yaml"))
    assert run.scene.name == "servicer_design_02"
    assert run.verdict == "captured"
    force = run.loads["max_buffer_force"]
    assert float(rows[1]["max_buffer_force [N]"]) == force
    line = next(line for line in printed.splitlines() if line.startswith("2"))
    assert f"{force:.4g}" in line.split()
    picked = load_scene(tmp_path / "design.yaml")
    assert picked.name == "servicer_design"
    assert picked.buffer == run.scene.buffer
    kept = json.loads((tmp_path / "design.json").read_text())
    assert kept["limits"]["max_normal_force"] == 345.0
    assert kept["picked"] == 2
    assert (tmp_path / "design.png").stat().st_size > 10_000
    page = (tmp_path / "design.html").read_text()
    for text in ("<h2>Front</h2>", "<h2>Chosen buffer</h2>", f"<td>{force:.4g}</td>", "own"):
        assert text in page
    assert "http" not in page.replace("http-equiv", "")  # whole in one file
    assert main(["design", str(SERVICER), "--peak-force=20", *free]) == 1
    assert "no buffer found: among" in capsys.readouterr().out
    assert not (tmp_path / "design_01.yaml").exists()


@pytest.mark.long
def test_an_active_limit_has_a_cost_by_runs(servicer):
    """A stroke that limits the force: 1 % more of it, and a design for that."""
    limits = make_limits({"max_axial_stroke_in": 0.010})
    found = design_buffer(servicer, Requirements(FORCE, limits), DAMPER, candidates=1500)
    (cost,) = costs_of_limits(found, found.rows[0])
    assert cost.use == pytest.approx(1.0, abs=1e-3)
    ((change,), (more,)) = cost.changes
    wider = Requirements(FORCE, make_limits({"max_axial_stroke_in": 0.0101}))
    again = design_buffer(servicer, wider, DAMPER, candidates=1500)
    least = [each.front[0].loads["max_buffer_force"] for each in (found, again)]
    assert more.value < change.value < 0.0
    assert change.value == pytest.approx(least[1] / least[0] - 1.0, abs=3.0 * change.error + 1e-3)
    assert 0.0 < change.error < 0.01


def test_a_buffer_that_lets_go_again_is_no_design():
    """Without a latch the tip lingers at BE: what is allowed to leave says until when it stays."""
    scene = load_scene(SERVICER, ["run.rtol=1e-6", "run.t_end=3", "latch=null"])
    limits = make_limits({"max_axial_stroke_in": 0.015})
    found = design_buffer(scene, Requirements(FORCE, limits), DAMPER, candidates=100)
    left = [x for x in found.history if x.left_again]
    assert left
    assert not any(x.feasible for x in left)
    assert any(x.feasible for x in found.history)  # at 3 s, but not at 30 s
    assert not found.rows
    assert "none is held until 10 times 3 s" in found.refusal
    again = Requirements(FORCE, limits, allow_leaving=True)
    allowed = design_buffer(scene, again, DAMPER, candidates=100)
    assert any(x.feasible for x in allowed.history if x.left_again)
    stays = []
    soft = design_buffer(scene, again, ["buffer.c_A=250:350"], candidates=100)
    for design in (allowed, soft):
        for row in design.rows:
            by_hand = 0.0
            for until in (3.0, 9.0, 30.0):
                scene_then = paths.changed(design.scene_of(row.candidate), "run.t_end", until)
                run = run_to_end(scene_then)
                if not run.captured or run.left_again or run.behind:
                    break
                by_hand = until
            assert row.stays == by_hand
            stays.append(by_hand)
    assert min(stays) < 30.0


def test_a_row_that_ends_inside_of_the_target_says_so(tmp_path, capsys):
    """Through an opening twice as wide as the tip nothing holds it: by hand, where it is."""
    wide = [*COMMAND, "--set=cone.R_c=30 mm", "--set=latch=null", f"--out={tmp_path}"]
    assert main([*wide, "--allow-passing"]) == 0
    kept = json.loads((tmp_path / "design.json").read_text())["rows"][0]
    scene = load_scene(tmp_path / "design.yaml")
    last = simulate(scene).samples[-1]
    assert -last["tip_axial"] > 0.02
    assert kept["stays_until"] == 0.0
    assert kept["behind_at"] == 1.0
    assert kept["behind"] == pytest.approx(-last["tip_axial"], rel=1e-3)
    said = f"at 1 s the tip is {-last['tip_axial'] * 1e3:.0f} mm behind BE, inside of the target"
    assert said in " ".join(capsys.readouterr().out.split())
    assert main(wide) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert "none is still captured at 1 s" in shown
    assert "has left again or is behind BE (a latch would hold it" in shown


def test_what_happened_is_stored_and_what_is_wanted_is_asked_of_it(tmp_path, capsys):
    """A design that accepts a tip behind BE, and from its runs one that does not: and back."""
    wide = [*COMMAND, "--set=cone.R_c=30 mm"]
    loose, strict, again = (str(tmp_path / name) for name in ("loose", "strict", "again"))
    assert main([*wide, "--allow-passing", "--out", loose]) == 0
    assert main([*wide, "--from", loose, "--out", strict]) == 1
    assert main([*wide, "--from", strict, "--allow-passing", "--out", again]) == 0
    rows = [
        json.loads((tmp_path / n / "design.json").read_text())["rows"] for n in ("loose", "again")
    ]
    assert rows[1][0]["loads"]["max_buffer_force"] <= rows[0][0]["loads"]["max_buffer_force"] * 1.01


def test_rows_keep_to_a_window_a_catalogue_and_a_damping_ratio(servicer):
    free = ["damping_ratio=0.1:2", "buffer.k_A=[800, 1 N/mm, 2000]"]
    window = Window("max_axial_stroke_in", 0.006, 0.012)
    found = design_buffer(servicer, Requirements(TRADED), free, window=window, candidates=200)
    assert found.rows
    assert {row.convergence for row in found.rows} == {"budget ended"}  # no second seed had a turn
    for row in found.rows:
        values = row.candidate.values
        assert values["buffer.k_A"] in (800.0, 1000.0, 2000.0)
        buffer = found.scene_of(row.candidate).buffer
        reduced = servicer.chaser_total_mass * 95.0 / (servicer.chaser_total_mass + 95.0)
        critical = 2.0 * math.sqrt(buffer.k_A * reduced)
        assert buffer.c_A == pytest.approx(values["damping_ratio"] * critical)
        assert row.candidate.loads["max_axial_stroke_in"] <= 0.012
    assert found.rows[-1].candidate.loads["max_axial_stroke_in"] == pytest.approx(0.012, rel=0.05)


@pytest.mark.parametrize(
    "window, shown",
    [((1e-6, 2e-6), "0.001 to 0.002 mm"), ((0.5, 0.6), "500 to 600 mm")],
)
def test_a_window_beyond_what_buffers_reach_is_refused_with_what_they_do(servicer, window, shown):
    asked = Window("max_axial_stroke_in", *window)
    refused = design_buffer(servicer, Requirements(TRADED), DAMPER, window=asked, candidates=100)
    assert not refused.rows
    assert f"--window max_axial_stroke_in: {shown} is not reached" in refused.refusal
    strokes = [x.loads["max_axial_stroke_in"] * 1e3 for x in refused.history if x.feasible]
    said = re.search(r"have (\S+) to (\S+) mm", refused.refusal)
    assert float(said[1]) == pytest.approx(min(strokes), rel=1e-3)
    assert float(said[2]) == pytest.approx(max(strokes), rel=1e-3)


def test_three_objectives_give_a_front_of_three(servicer):
    """All three are traded, and no run of the search beats a row in all of them."""
    keys = ["max_axial_stroke_in", "max_buffer_force", "max_buffer_torque"]
    three = make_objectives(keys)
    found = design_buffer(servicer, Requirements(three, LIMITS), candidates=300)
    costs = costs_of(found.front, three)
    assert len(costs) >= 3
    tried = costs_of([x for x in found.history if x.feasible], three)
    for row in costs:
        assert not (tried < row - 1e-4).all(axis=1).any()
        assert not ((costs <= row).all(axis=1) & (costs < row).any(axis=1)).any()
    assert np.ptp(costs, axis=0).min() > 0.05
    for row in found.rows:
        run = run_to_end(found.scene_of(row.candidate))
        assert [run.loads[key] for key in keys] == [row.candidate.loads[key] for key in keys]
        assert within(found.scene_of(row.candidate), LIMITS)


def test_narrow_ranges_are_searched_though_the_buffer_decides_little():
    """Where the whole range is refused, a narrow one is not."""
    scene = load_scene("tilt_0", ["run.t_end=4", "run.rtol=1e-6"])
    requirements = Requirements(make_objectives(["max_normal_force"]))
    free = ["buffer.k_A=400:600", "buffer.c_A=5:15"]
    assert design_buffer(scene, requirements, free, candidates=100).met


COMMAND = ["design", str(SERVICER), "--minimize=max_buffer_force", "--stroke-limit=10"]
COMMAND += ["--free=buffer.c_A=100:2000", "--set=run.rtol=1e-6", "--set=run.t_end=1"]
COMMAND += ["--candidates=100", "--workers=1"]


def runs_in(lines):
    """Return the runs of a journal, each once, however many are in a line."""
    found = []
    for kind, names, rows, results, *_ in (json.loads(line) for line in lines[1:]):
        pairs = zip(rows, results, strict=True)
        found += [repr((kind, names, row, result)) for row, result in pairs]
    assert len(found) == len(set(found))
    return sorted(found)


def test_a_killed_design_continues_to_the_same_table(tmp_path, capsys):
    """Cut anywhere, the last line torn, the runs of before are not made again."""
    assert main([*COMMAND, f"--out={tmp_path / 'a'}"]) == 0
    table = capsys.readouterr().out.replace(str(tmp_path / "a"), "OUT")
    lines = (tmp_path / "a" / "design.journal").read_bytes().splitlines(keepends=True)
    for kept in (2, len(lines) // 2):
        journal = tmp_path / "b" / "design.journal"
        journal.parent.mkdir(exist_ok=True)
        journal.write_bytes(b"".join(lines[:kept]) + lines[kept][:20])
        assert main([*COMMAND, f"--out={tmp_path / 'b'}", "--resume"]) == 0
        shown = capsys.readouterr().out.replace(str(tmp_path / "b"), "OUT")
        assert shown.partition("runs were made before\n")[2] == table
        for name in ("design.json", "design.yaml"):
            assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "a" / name).read_bytes()
        assert runs_in(journal.read_bytes().splitlines()) == runs_in(lines)
    assert main([*COMMAND, "--seed=2", f"--out={tmp_path / 'b'}", "--resume"]) == 2
    assert "is of another study: seed must be the same" in capsys.readouterr().err


def test_a_design_begins_with_the_runs_of_another(tmp_path, capsys):
    assert main([*COMMAND, f"--out={tmp_path / 'a'}"]) == 0
    first = json.loads((tmp_path / "a" / "design.json").read_text())["rows"][0]["loads"]
    narrower = [*COMMAND, "--free=buffer.k_A=450:550", f"--from={tmp_path / 'a'}"]
    capsys.readouterr()
    assert main([*narrower, f"--out={tmp_path / 'b'}"]) == 0
    second = json.loads((tmp_path / "b" / "design.json").read_text())["rows"][0]["loads"]
    assert second["max_buffer_force"] <= first["max_buffer_force"] * (1.0 + 1e-6)
    other = [item for item in COMMAND if "t_end" not in item]
    assert main([*other, f"--from={tmp_path / 'a'}", f"--out={tmp_path / 'c'}"]) == 2
    assert "must be a design of the same scene" in capsys.readouterr().err


def test_the_scene_of_the_examples_is_that_of_the_page():
    page = (SERVICER.parents[1] / "docs" / "design.md").read_text()
    assert f'```yaml title="servicer.yaml"\n{SERVICER.read_text()}```' in page


def test_each_row_is_held_by_the_latch_at_ten_times_the_end(design):
    """By hand: latched, in the zone and not behind BE, at the end and at ten times it."""
    assert design.rows
    for row in design.rows:
        for factor in (1.0, 10.0):
            scene = design.scene_of(row.candidate)
            run = run_to_end(paths.changed(scene, "run.t_end", factor * scene.run.t_end))
            assert run.captured
            assert not run.left_again
            assert not run.behind
            assert run.loads["max_latch_force"] > 0.0


def test_a_latch_that_is_missed_holds_nothing(servicer):
    """The tip passes 1 um beside the latch: 'captured' was said of it, 679 mm inside the target."""
    missed = paths.changed(servicer, "latch.radius", 1e-5)
    found = design_buffer(missed, Requirements(FORCE, LIMITS), DAMPER, candidates=100)
    assert not found.met
    assert any(each.verdict == "captured" for each in found.history)


def test_the_whole_front_is_in_the_table(design, tmp_path):
    """Each buffer that was run and that none beats, and the rows with their numbers."""
    whole = design.whole_front
    costs = costs_of([each for each, _ in whole], TRADED)
    tried = costs_of([each for each in design.history if each.feasible], TRADED)
    for (_, number), cost in zip(whole, costs, strict=True):
        # rows were run again at a smaller tolerance
        assert number is not None or not (tried < cost - 1e-5).all(axis=1).any()
    rows = [number for _, number in whole if number is not None]
    assert rows == list(range(1, len(design.rows) + 1))
    assert len(whole) > len(rows)
    for cost in tried:  # the line of the picture is below every buffer that was run
        assert (costs <= cost + 1e-5).all(axis=1).any()


def test_costs_are_computed_where_they_are_asked_for(tmp_path, capsys):
    """The same folder twice: what a design has written, the next one may replace."""
    assert main([*COMMAND, f"--out={tmp_path}"]) == 0
    assert json.loads((tmp_path / "design.json").read_text())["costs"] == []
    assert "active limits" not in capsys.readouterr().out
    assert main([*COMMAND, f"--out={tmp_path}", "--costs", "--seed=3"]) == 0
    shown = capsys.readouterr()
    assert "active limits" in shown.out or "--costs: not computed" in shown.err
    page = (tmp_path / "design.html").read_text()
    for text in ("What was asked", "seed 3", "force of the buffer", "What is not shown", "extends"):
        assert (text in page) != (text == "extends")


def test_a_refusal_under_dispersions_says_what_is_required_and_reached(servicer):
    limits = make_limits({"max_buffer_force": 30.0})
    under = Dispersions({"approach.speed": "normal(0.2, 20%)"})
    found = design_buffer(
        servicer,
        Requirements(FORCE, limits, under, confidence=0.9, draws=20),
        DAMPER,
        candidates=100,
    )
    assert not found.met
    assert re.search(
        r"captured within the limits in 90% of the draws is required, shown if \d+ of \d+ are",
        found.refusal,
    )
    assert re.search(r"is in [\d.]+% of \d+ \(\d+% to \d+%\)", found.refusal)
