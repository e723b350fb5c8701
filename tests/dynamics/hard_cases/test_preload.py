"""A preloaded buffer: its probe on the seat, off it, and back on it by a plastic impact."""

import math
from xml.etree import ElementTree

import numpy as np
import pytest
from elastic_loop import advanced
from four_bodies import momentum
from scipy.integrate import quad
from set_ups import (
    ELASTIC,
    HARD,
    LIGHT,
    ON_THE_FLOOR,
    RANDOM,
    SPEED,
    first,
    heavy_run,
    in_a_row,
    pushed,
    random_run,
    residual,
    run,
    runs_of_all_methods,
    times,
)

from capture_sim import SceneError, load_scene, simulate
from capture_sim.dynamics.samples import EventKind
from capture_sim.messages.urdf import urdf

# a constant force


def test_a_force_below_the_preload_moves_the_chaser_as_one_body():
    """The probe takes its share of the force: the seat is left at F m_S / (m_S + m_P) = F_0."""
    scene = load_scene("paper_designed")
    body, probe = scene.chaser.mass + scene.cylinder.mass, scene.probe.mass
    force = 0.9999 * 20.0 * (body + probe) / body
    stage, strokes = pushed(force, {"buffer.preload": 20.0}, 500)
    assert force > 20.0
    assert np.all(strokes == 0.0)
    assert stage.v[0] == pytest.approx(-force / (body + probe) * stage.t, rel=1e-9)


# with the softer spring, ten times the preload would push the probe in up to its tip
@pytest.mark.parametrize("factor, k_A", [(1.0001, 500.0), (1.5, 500.0), (10.0, 5000.0)])
def test_a_force_above_the_preload_swings_the_probe_about_its_balance(factor, k_A):
    """Back to the seat after each period, without impact: A (1 - cos wt) with w^2 = k / mu."""
    scene = load_scene("paper_designed")
    body, probe = scene.chaser.mass + scene.cylinder.mass, scene.probe.mass
    preload, mu = 20.0, body * probe / (body + probe)
    force = factor * preload * (body + probe) / body
    _, strokes = pushed(force, {"buffer.preload": preload, "buffer.k_A": k_A}, 500)
    amplitude = (factor - 1.0) * preload / k_A
    t = 1e-3 * np.arange(1, 501)
    expected = -amplitude * (1.0 - np.cos(math.sqrt(k_A / mu) * t))
    assert strokes == pytest.approx(expected, abs=1e-4 * amplitude)


# a mass that runs against a wall

STIFFNESS, PRELOAD = 5e4, 800.0


def pressed(**options):
    """The run of a heavy chaser on an undamped, preloaded buffer."""
    changes = ELASTIC | {"buffer.preload": PRELOAD, "buffer.k_A": STIFFNESS}
    return heavy_run(changes, **options)


def test_the_probe_leaves_its_seat_when_hertz_force_of_the_whole_mass_has_grown_to_the_preload():
    """M d'' = -K d^1.5 until K d^1.5 M_S / M = F_0; t = int dd / sqrt(v^2 - 4/5 K d^2.5 / M)."""
    result = pressed(t_end=0.05)
    scene = result.scene
    M, body = scene.chaser_total_mass, scene.chaser.mass + scene.cylinder.mass
    K = scene.contact_stiffness
    depth = (PRELOAD * M / body / K) ** (2.0 / 3.0)
    t, _ = quad(lambda d: 1.0 / math.sqrt(SPEED**2 - 0.8 * K * d**2.5 / M), 0.0, depth)
    left = first(result, "unseated")
    assert left.t - first(result, "touch").t == pytest.approx(t, rel=1e-8)
    assert left.q[4] == scene.rest_length
    assert left.v[4] == 0.0
    seated = result.samples[result.t < left.t]
    assert np.all(seated["axial_stroke"] == 0.0)
    assert np.all(seated["axial_force"] <= PRELOAD)


def test_the_mass_turns_where_preload_and_spring_have_taken_its_energy():
    """M v^2 / 2 = F_0 x + k x^2 / 2; from its turn it is back on the seat after acos(..) / w."""
    result = pressed()
    M = result.scene.chaser.mass + result.scene.cylinder.mass
    deepest = (math.sqrt(PRELOAD**2 + STIFFNESS * M * SPEED**2) - PRELOAD) / STIFFNESS
    extremes = result.extremes.before_latch
    assert extremes["axial_stroke_in"] == pytest.approx(deepest, rel=LIGHT)
    assert extremes["axial_stroke_out"] < 1e-16
    assert extremes["buffer_force"] == pytest.approx(PRELOAD + STIFFNESS * deepest, rel=LIGHT)
    omega, rest = math.sqrt(STIFFNESS / M), PRELOAD / STIFFNESS
    back = math.acos(rest / (rest + deepest)) / omega
    seated = [t for t in times(result, "seated") if t > extremes["axial_stroke_in_time"]]
    assert seated[0] - extremes["axial_stroke_in_time"] == pytest.approx(back, rel=2 * LIGHT)
    stored = result.samples["elastic_axial"] + result.samples["elastic_contact"]
    assert stored.max() == pytest.approx(0.5 * M * SPEED**2, rel=LIGHT)
    assert residual(result) < 1e-8 * M * SPEED**2


def test_back_on_the_seat_half_the_reduced_mass_times_the_square_of_the_speed_is_lost():
    """On the axis of the chaser the impulse has no arm: both bodies have one speed, at once."""
    result = pressed(t_end=1.3)
    back = next(e for e in result.events if e.kind is EventKind.SEATED)
    body, probe = result.scene.chaser.mass + result.scene.cylinder.mass, result.scene.probe.mass
    mu = body * probe / (body + probe)
    around = pressed(t_eval=[back.t * (1.0 - 1e-12), back.t * (1.0 + 1e-12)])
    before, after = around.samples
    assert after["dissipated_stop"] == pytest.approx(0.5 * mu * back.v[4] ** 2, rel=1e-9)
    assert before["dissipated_stop"] == 0.0
    assert after["v"][4] == 0.0
    assert after["v"][0] - before["v"][0] == pytest.approx(
        probe / (body + probe) * back.v[4], rel=1e-9
    )


def test_impacts_on_the_seat_keep_momentum_and_the_ledger():
    """The probe turns and slides on the wall: all of the chaser's rates jump."""
    scene = load_scene("paper_designed", ["buffer.preload=20", "run.rtol=1e-10"])
    result = simulate(scene, t_end=0.5)
    assert times(result, "seated").size > 5
    states = zip(result.q, result.v, strict=True)
    found = np.array([momentum(scene, q, v) for q, v in states])
    assert np.abs(found - found[0]).max() < 1e-12 * np.abs(found[0]).max()
    assert residual(result) < 1e-10 * result.samples["kinetic"][0]
    assert result.samples["dissipated_stop"][-1] > 1e-3
    assert np.all(np.diff(result.samples["dissipated_stop"]) >= 0.0)


# limits


def test_a_preload_that_no_force_reaches_is_a_rigid_probe():
    """The limit of a stiff spring: the difference goes with its compliance."""
    changes = {"friction.law": "none", "buffer.c_A": 0.0, "initial.chaser.vx": 0.01}

    def end(**buffer):
        buffer = {f"buffer.{name}": value for name, value in buffer.items()}
        scene = in_a_row(1e-5, changes | buffer | {"run.rtol": 1e-12})
        result = run(scene, t_end=0.003, t_eval=[0.003])
        assert result.failure == ""
        return result, result.q[-1]

    rigid, place = end(preload=1e9)
    assert times(rigid, "unseated").size == 0
    assert rigid.touches.size > 0
    off = [np.abs(end(k_A=k)[1] - place).max() for k in (1e8, 1e9, 1e10)]
    assert off == pytest.approx([1e-6, 1e-7, 1e-8], rel=0.15)


def test_a_vanishing_preload_is_none_while_the_probe_is_pushed_in():
    """Until the probe first comes back to its rest length."""
    plain, light = (
        simulate(
            load_scene("paper_designed", ["run.rtol=1e-11", f"buffer.preload={preload}"]),
            t_end=0.3,
        )
        for preload in (0.0, 1e-6)
    )
    back = times(light, "seated")[0]
    assert back > 0.2
    alike = light.t < back
    assert plain.q[alike] == pytest.approx(light.q[alike], abs=1e-6)


STOP = "stops={compression: 1.0e-3, extension: null, stiffness: 1.0e+5, damping: 3000}"
OF_A_SEAT = HARD | {"stop": [STOP, "initial.chaser.vx=0.3"]}


@pytest.mark.parametrize("name", OF_A_SEAT)
@pytest.mark.parametrize("preload", [0.5, 8.0, 100.0])
def test_hard_cases_close_the_ledger_whatever_the_method(name, preload):
    step = 5e-7 if name == "dead contact" else 2e-6  # its damping is fast
    for result in runs_of_all_methods([*OF_A_SEAT[name], f"buffer.preload={preload}"], step):
        assert result.samples["axial_stroke"].max() == 0.0
        on_seat = result.samples["axial_stroke"] == 0.0
        assert result.samples["axial_force"][on_seat].max() <= preload * (1.0 + 1e-9)


def test_a_latched_pull_outwards_is_carried_by_the_seat():
    result = simulate(load_scene("tilt_0", ["buffer.preload=20"]))
    latched = first(result, "latched")
    after = result.samples[result.t > latched.t]
    assert after["axial_stroke"].max() == 0.0
    # the same pull would stretch the spring
    assert after["axial_force"].min() < -1.0
    extremes = result.extremes
    assert extremes.after_latch["axial_stroke_out"] < 1e-16
    assert extremes.after_latch["buffer_force"] >= np.abs(after["axial_force"]).max() - 1e-9


def test_an_impact_on_the_seat_takes_a_held_chaser_off_its_supports():
    """The target pushes the probe in and goes; friction of the floor is a finite force."""
    changes = ON_THE_FLOOR | {
        "buffer.preload": 2.0,
        "buffer.c_A": 0.0,
        "supports.chaser.c_rr": 0.5,
        "supports.target.c_rr": 0.0,
        "target.mass": 0.5,
        "initial.chaser.vx": 0.0,
        "initial.target.vx": -0.3,
        "friction.law": "none",
        "run.rtol": 1e-10,
    }
    scene = in_a_row(1e-4, changes, base="tilt_0")
    result = run(scene, t_end=0.3, t_eval=np.linspace(0.0, 0.3, 30001))
    assert result.failure == ""
    back, moving = first(result, "seated"), first(result, "moving")
    assert moving.t == back.t
    assert np.all(back.v[:3] == 0.0)
    speed = scene.probe.mass / scene.chaser_total_mass * back.v[4]
    assert moving.v[0] == pytest.approx(speed, rel=1e-9)
    rested = [t for t in times(result, "at_rest") if t > back.t]
    assert rested
    assert residual(result) < 1e-8 * result.samples["kinetic"][0]


@pytest.mark.parametrize("number", RANDOM)
@pytest.mark.parametrize("preload", [0.5, 8.0, 64.0])
def test_random_preloaded_benches(number, preload):
    """Number 7 at 64 N meets its seat within the quarter of a step in which it still moves in."""
    result = random_run(number, {"buffer.preload": preload})
    assert result.samples["axial_stroke"].max() == 0.0


# in the loop


def test_the_seat_in_the_loop_is_that_of_the_offline_bench():
    """The elastic law of the walls in the loop's steps, against the bench's located events."""
    changes = ["contact.restitution=1.0", "friction.law=none", "buffer.preload=20"]
    scene = load_scene("paper_designed", changes)
    until = 0.04
    result = simulate(scene, t_end=until)
    assert times(result, "seated").size > 2
    stage, energy_change = advanced(scene, until)
    assert stage.q == pytest.approx(result.q[-1], abs=2e-7)
    assert stage.v == pytest.approx(result.v[-1], abs=2e-5)
    assert energy_change == pytest.approx(0.0, abs=1e-7)


# scenes


def test_an_outward_stop_next_to_a_seat_is_rejected():
    stops = "stops={compression: 0.01, extension: 0.01, stiffness: 1.0e+5, damping: 10}"
    expected = r"stops.extension = 0.01 m: must be null with buffer.preload = 5 N"
    with pytest.raises(SceneError, match=expected):
        load_scene("paper_designed", ["buffer.preload=5", stops])
    with pytest.raises(SceneError, match=r"buffer.preload = -1 N: must be >= 0"):
        load_scene("paper_designed", ["buffer.preload=-1"])


@pytest.mark.parametrize(
    "changes, outward",
    [
        ([], None),
        (["buffer.preload=5"], 0.0),
        (["stops={compression: 0.01, extension: null, stiffness: 1.0e+5, damping: 10}"], None),
        (["stops={compression: 0.01, extension: 0.02, stiffness: 1.0e+5, damping: 10}"], 0.02),
    ],
)
def test_the_robot_model_has_the_stroke_outwards_that_the_scene_has(changes, outward):
    scene = load_scene("paper_designed", changes)
    assert scene.outward_stroke == outward
    limit = ElementTree.fromstring(urdf(scene)).find("joint[@type='prismatic']/limit")
    reach = scene.rest_length if outward is None else outward
    assert float(limit.get("upper")) == pytest.approx(reach, rel=1e-9)
