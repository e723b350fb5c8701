"""The paper's numerical cases and the three experiments, against its figures."""

import numpy as np
import pytest

from capture_sim import load_scene, simulate
from capture_sim.results import first_cluster, table


@pytest.fixture(scope="module")
def runs():
    names = [
        f"paper_{n}" for n in ("undamped", "designed", "case_1", "case_2", "case_3", "clamped")
    ]
    return {name: simulate(load_scene(name)) for name in names}


def test_undamped_first_contact_rebound_and_second_wall(runs):
    run = runs["paper_undamped"]
    assert run.summary["first_contact_duration"] == pytest.approx(0.2734, rel=0.01)
    first = first_cluster(run.touches)
    assert {int(w) for w in first["wall"]} == {-1}
    later = run.touches[run.touches["start"] > first["end"].max()]
    assert 1 in later["wall"], "the second hit is on the other wall"
    assert run.verdict.label == "rebound"


def test_designed_buffer_brings_the_tip_to_be(runs):
    run = runs["paper_designed"]
    assert run.summary["nearest_distance"] < 0.005
    assert run.verdict.label == "captured"


def test_case_1_rebounds(runs):
    assert runs["paper_case_1"].verdict.label == "rebound"


@pytest.mark.parametrize(
    "name, nearest, at",
    [
        ("paper_undamped", 9.6e-3, 0.75),
        ("paper_designed", 3.9e-3, 1.25),
        ("paper_case_1", 13.6e-3, 0.69),
        ("paper_case_2", 2.9e-3, 1.23),
        ("paper_case_3", 5.6e-3, 0.78),
    ],
)
def test_nearest_approach_is_that_of_the_independent_model(runs, name, nearest, at):
    """Figures of an implementation of the paper made independently of this one."""
    run = runs[name]
    early = run.samples[run.t < 1.5]
    k = int(early["tip_distance"].argmin())
    assert early["tip_distance"][k] == pytest.approx(nearest, abs=0.1e-3)
    assert early["t"][k] == pytest.approx(at, abs=0.01)


def test_buffer_against_clamped_probe(runs):
    clamped, buffered = runs["paper_clamped"].summary, runs["paper_undamped"].summary
    assert clamped["first_contact_peak_force"] == pytest.approx(328, rel=0.01)
    assert clamped["first_contact_duration"] == pytest.approx(12.5e-3, rel=0.01)
    assert buffered["first_contact_peak_force"] == pytest.approx(131, rel=0.01)
    assert clamped["first_contact_peak_force"] > 2 * buffered["first_contact_peak_force"]
    assert buffered["first_contact_duration"] > 20 * clamped["first_contact_duration"]


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "tilt_m10"])
def test_the_three_experiments_end_in_capture(name):
    run = simulate(load_scene(name))
    assert run.verdict.label == "captured"
    latched = next(e for e in run.events if e.kind.label == "latched")
    before = [t for t in run.touches if t["start"] < latched.t]
    assert before, "the tip must have met the wall before it is caught"
    assert before[0]["peak_force"] > 10.0
    # held: from the latch on the tip stays where it was caught
    held = run.samples[run.t > latched.t]
    assert held["tip_distance"].max() < 2.5e-3
    # the events tell the story in order
    kinds = [e.kind.label for e in run.events]
    order = [
        kinds.index(k) for k in ("release", "landed", "rail_end", "touch", "moving", "latched")
    ]
    assert order == sorted(order)
    assert kinds[-1] == "end"


def test_experiments_differ_by_the_attitude_alone():
    from capture_sim.scene.parts import as_mapping

    scenes = [as_mapping(load_scene(n)) for n in ("tilt_0", "tilt_p10", "tilt_m10")]
    for scene in scenes:
        del scene["name"], scene["title"], scene["initial"]["target"]["theta"]
    assert scenes[0] == scenes[1] == scenes[2]


def test_mirrored_experiment_gives_the_mirrored_run():
    """+10 degrees and an offset to the left is -10 degrees and an offset to the right."""
    left = simulate(load_scene("tilt_p10"), t_end=3.5)
    right = simulate(load_scene("tilt_m10", ["initial.chaser.y=-0.005"]), t_end=3.5)
    sign = np.array([1, -1, -1, -1, 1, 1, -1, -1])
    n = min(left.t.size, right.t.size)
    before = left.t[:n] < left.events[-2].t - 0.05
    assert left.q[:n][before] == pytest.approx(right.q[:n][before] * sign, abs=1e-7)
    assert left.summary["peak_force"] == pytest.approx(right.summary["peak_force"], rel=1e-5)


def test_table_has_a_row_for_each_run(runs):
    text = table([run.summary for run in runs.values()])
    lines = text.splitlines()
    start = next(i for i, line in enumerate(lines) if set(line) == {"-"}) + 1
    assert [line.split()[0] for line in lines[start : start + len(runs)]] == list(runs)
    assert lines[start + len(runs)] == ""
    assert "m/s" in lines[start - 2]
    row = next(line for line in lines if line.startswith("paper_undamped"))
    assert " rebound " in row
    assert " 272.8 " in row


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "tilt_m10"])
def test_the_bench_without_latches_runs_to_its_end(name):
    """Vehicles come to rest and start again many times; nothing may pile up on one instant."""
    run = simulate(load_scene(name, ["latch=null"]))
    assert run.events[-1].kind.label == "end"
    assert run.t[-1] == pytest.approx(20.0)
    assert run.verdict.label == "captured"
