"""Coulomb friction of the probe in its slide: closed forms, the ledger, and hard cases."""

import math

import numpy as np
import pytest
from four_bodies import momentum
from set_ups import (
    HARD,
    RANDOM,
    altered,
    in_a_row,
    pushed,
    random_run,
    residual,
    run,
    runs_of_all_methods,
)

from capture_sim import load_scene, simulate
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.samples import EventKind
from capture_sim.fmu.variables import parameters as fmu_parameters

SLIDE = (EventKind.STICK, EventKind.SLIP)


def slides(result):
    """Events of the probe in its slide."""
    return [e for e in result.events if e.kind in SLIDE and e.wall == 0]


def halves(scene):
    """Chaser without probe, and probe: masses and reduced mass, kg."""
    body, probe = scene.chaser.mass + scene.cylinder.mass, scene.probe.mass
    return body, probe, body * probe / (body + probe)


# a free swing after an elastic impact on the axis

STIFFNESS, FRICTION = 100.0, 0.02
SWING = {
    "friction.law": "none",
    "contact.law": "exact",
    "contact.restitution": 1.0,
    "buffer.c_A": 0.0,
    "buffer.k_T": 1e5,
    "buffer.k_A": STIFFNESS,
    "buffer.friction": FRICTION,
    "target.mass": 0.05,
    "run.rtol": 1e-11,
    "run.state_rate": 1000.0,
}


def test_a_swing_loses_4_F_over_k_in_each_cycle_and_stops_where_the_spring_cannot_move_it():
    """Half cycles of pi / w about +-F / k; at rest with k |x| < F; F times the path is lost."""
    result = run(in_a_row(1e-5, SWING), t_end=1.0)
    assert result.failure == ""
    scene, rest = result.scene, result.scene.rest_length
    turns = slides(result)[1:]  # but for the start
    x, t = np.array([e.q[4] - rest for e in turns]), np.array([e.t for e in turns])
    assert len(turns) == 5
    assert np.all(np.sign(x[1:]) == -np.sign(x[:-1]))
    assert np.diff(np.abs(x)) == pytest.approx(-2.0 * FRICTION / STIFFNESS, rel=1e-8)
    omega = math.sqrt(STIFFNESS / halves(scene)[2])
    assert np.diff(t) == pytest.approx(math.pi / omega, rel=1e-7)
    assert [e.kind for e in turns] == [EventKind.SLIP] * 4 + [EventKind.STICK]
    assert STIFFNESS * abs(x[-1]) < FRICTION < STIFFNESS * abs(x[-2])
    after = result.samples[result.t > t[-1]]
    assert np.all(after["axial_stroke"] == x[-1])
    path = abs(x[0]) + np.abs(np.diff(x)).sum()
    assert after["dissipated_slide"] == pytest.approx(FRICTION * path, rel=1e-9)
    assert np.all(np.diff(result.samples["dissipated_slide"]) >= 0.0)
    assert residual(result) < 1e-11 * result.samples["kinetic"][0]


def test_force_and_energy_of_the_slide_at_every_sample():
    """The buffer's force is spring and friction; held, it is what the motion needs: about zero."""
    result = run(in_a_row(1e-5, SWING), t_end=1.0)
    s = result.samples[result.t > result.touches["end"][-1]]
    rate = s["v"][:, 4]
    sliding = rate != 0.0
    expected = -STIFFNESS * s["axial_stroke"] - FRICTION * np.sign(rate)
    assert s["axial_force"][sliding] == pytest.approx(expected[sliding], rel=1e-9, abs=1e-12)
    assert (~sliding).sum() > 10
    assert s["axial_force"][~sliding] == pytest.approx(0.0, abs=1e-12)


# a constant force


@pytest.mark.parametrize("preload", [0.0, 12.0])
def test_a_force_below_friction_and_preload_moves_the_chaser_as_one_body(preload):
    body, probe, _ = halves(load_scene("paper_designed"))
    force = 0.9999 * (preload + 8.0) * (body + probe) / body
    stage, strokes = pushed(force, {"buffer.preload": preload, "buffer.friction": 8.0}, 300)
    assert np.all(strokes == 0.0)
    assert stage.v[0] == pytest.approx(-force / (body + probe) * stage.t, rel=1e-9)


@pytest.mark.parametrize("share, sticks", [(1.001, True), (1.5, True), (2.9, True), (3.1, False)])
def test_a_force_above_friction_pushes_the_probe_to_twice_its_balance(share, sticks):
    """A (1 - cos wt) with A = (P - F) / k; it stays there if the spring, 2 kA, asks for P < 3 F."""
    body, probe, mu = halves(load_scene("paper_designed"))
    friction, k_A = 8.0, 500.0
    force = share * friction * (body + probe) / body
    _, strokes = pushed(force, {"buffer.friction": friction}, 300)
    amplitude = (share - 1.0) * friction / k_A
    t = 1e-3 * np.arange(1, 301)
    half = math.pi / math.sqrt(k_A / mu)
    angle = np.minimum(math.sqrt(k_A / mu) * t, math.pi)
    expected = -amplitude * (1.0 - np.cos(angle))
    until = t <= half if not sticks else t > 0.0
    assert strokes[until] == pytest.approx(expected[until], abs=1e-4 * amplitude)

    assert (np.ptp(strokes[t > 1.05 * half]) == 0.0) == sticks


# ledger


def test_stick_and_slip_keep_momentum_and_the_ledger():
    scene = load_scene("paper_designed", ["buffer.friction=2", "run.rtol=1e-10"])
    result = simulate(scene, t_end=0.5)
    assert {e.kind for e in slides(result)} == set(SLIDE)
    states = zip(result.q, result.v, strict=True)
    found = np.array([momentum(scene, q, v) for q, v in states])
    assert np.abs(found - found[0]).max() < 1e-11 * np.abs(found[0]).max()
    assert residual(result) < 1e-9 * result.samples["kinetic"][0]
    assert result.samples["dissipated_slide"][-1] > 1e-3


def test_error_follows_the_tolerance():
    base = load_scene("paper_designed", ["buffer.friction=2"])

    def end(rtol):
        return simulate(altered(base, {"run.rtol": rtol}), t_end=0.1, t_eval=[0.1]).q[-1]

    reference = end(1e-13)
    for rtol in (1e-6, 1e-8, 1e-10):
        assert np.abs(end(rtol) - reference).max() < rtol


def test_friction_that_no_force_reaches_is_a_rigid_probe():
    """As a preload that no force reaches."""
    changes = {"friction.law": "none", "initial.chaser.vx": 0.01, "run.rtol": 1e-12}
    places = []
    for buffer in ({"buffer.friction": 1e9}, {"buffer.preload": 1e9}):
        result = run(in_a_row(1e-5, changes | buffer), t_end=0.003, t_eval=[0.003])
        assert result.failure == ""
        assert not slides(result)
        places.append(result.q[-1])
    assert places[0] == pytest.approx(places[1], abs=1e-15)


OF_THE_SLIDE = HARD | {
    "stops": [
        "stops={compression: 1.0e-3, extension: 1.0e-3, stiffness: 1.0e+5, damping: 30}",
        "initial.chaser.vx=0.3",
    ],
    "preload": ["buffer.preload=3"],
    "table": ["buffer.k_A=0", "buffer.force_table=[[0, 1], [2 mm, 2], [6 mm, 9]]"],
    "no spring": ["buffer.k_A=0", "buffer.c_A=0"],
}


@pytest.mark.parametrize("name", OF_THE_SLIDE)
@pytest.mark.parametrize("friction", [0.1, 3.0, 60.0])
def test_hard_cases_close_the_ledger_whatever_the_method(name, friction):
    step = 5e-7 if name == "dead contact" else 2e-6  # its damping is fast
    changes = [*OF_THE_SLIDE[name], f"buffer.friction={friction}"]
    for result in runs_of_all_methods(changes, step):
        held = result.samples["v"][:, 4] == 0.0
        loads = result.extremes.before_latch
        assert loads["buffer_force"] >= np.abs(result.samples["axial_force"][held]).max() - 1e-9


@pytest.mark.parametrize("number", RANDOM)
@pytest.mark.parametrize("friction", [0.5, 8.0])
def test_random_benches(number, friction):
    result = random_run(number, {"buffer.friction": friction})
    lost = result.samples["dissipated_slide"]
    assert np.all(np.diff(lost) >= -1e-15)
    moved = np.abs(np.diff(result.samples["axial_stroke"])).sum()
    assert lost[-1] >= friction * moved * (1.0 - 1e-9) - 1e-12


def test_on_the_ground_bench_the_probe_stays_put_until_the_contact():
    result = simulate(load_scene("tilt_p10", ["buffer.friction=1"]))
    touch = result.touches["start"][0]
    before = result.samples[result.t < touch]
    assert np.all(before["axial_stroke"] == 0.0)
    assert residual(result) < 1e-6 * result.samples["work_string"].max()
    assert result.verdict == "captured"


# scenes


def test_a_unit_sets_the_friction_of_a_slide_that_has_one():
    for friction, has in ((0.0, False), (2.0, True)):
        scene = load_scene("paper_designed", {"buffer.friction": friction})
        found = fmu_parameters(scene, Bench(scene).initial_workspace())
        assert ("buffer.friction" in {each.name for each in found}) == has
