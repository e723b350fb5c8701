"""The paper's numerical cases and the three experiments, against its figures."""

import pytest

from capture_sim import load_scene, simulate
from capture_sim.run.first_contact import first_cluster


@pytest.fixture(scope="module")
def runs():
    names = ("undamped", "designed", "case_1", "case_2", "case_3", "clamped")
    return {f"paper_{name}": simulate(load_scene(f"paper_{name}")) for name in names}


def test_undamped_first_contact_rebound_and_second_wall(runs):
    run = runs["paper_undamped"]
    assert run.summary["first_contact_duration"] == pytest.approx(0.2734, rel=0.01)
    first = first_cluster(run.touches)
    assert {int(w) for w in first["wall"]} == {-1}
    later = run.touches[run.touches["start"] > first["end"].max()]
    assert 1 in later["wall"], "the second hit is on the other wall"


@pytest.mark.parametrize(
    "name, nearest, at, verdict",
    [
        ("paper_undamped", 9.6e-3, 0.75, "rebound"),
        ("paper_designed", 3.9e-3, 1.25, "captured"),
        ("paper_case_1", 13.6e-3, 0.69, "rebound"),
        ("paper_case_2", 2.9e-3, 1.23, "captured"),
        ("paper_case_3", 5.6e-3, 0.78, "rebound"),
    ],
)
def test_nearest_approach_is_that_of_the_independent_model(runs, name, nearest, at, verdict):
    """Figures of an implementation of the paper made independently of this one."""
    run = runs[name]
    early = run.samples[run.t < 1.5]
    k = int(early["tip_distance"].argmin())
    assert early["tip_distance"][k] == pytest.approx(nearest, abs=0.1e-3)
    assert early["t"][k] == pytest.approx(at, abs=0.01)
    assert run.verdict == verdict


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
    assert run.verdict == "captured"
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


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "tilt_m10"])
def test_the_bench_without_latches_runs_to_its_end(name):
    """Vehicles come to rest and start again many times; nothing may pile up on one instant."""
    run = simulate(load_scene(name, ["latch=null"]))
    assert run.events[-1].kind.label == "end"
    assert run.t[-1] == pytest.approx(20.0)
    assert run.verdict == "captured"


def test_case_3_without_memory_of_the_damping_rebounds_after_the_end_of_its_run():
    """At 3 s the tip is less than 5 mm beyond its closest approach (evidence/reproduction.md)."""
    without_memory = load_scene("paper_case_3", ["contact.min_approach_speed=0.1"])
    at_end, later = simulate(without_memory), simulate(without_memory, t_end=4.0)
    beyond = at_end.samples["tip_distance"][-1] - at_end.loads["nearest_distance"]
    assert beyond == pytest.approx(3.9e-3, abs=0.05e-3)
    assert (at_end.verdict, later.verdict) == ("undecided", "rebound")
