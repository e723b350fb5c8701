"""Progressive springs, orifice and rebound damping, and a given hysteresis factor: closed forms.

A heavy chaser runs with its probe against a wall that does not move: one mass on the buffer.
"""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from set_ups import LIGHT, SPEED, first, free_impact, heavy_run, residual, run

from capture_sim import SceneError, load_scene, simulate
from capture_sim.scene.laws import returned_restitution


def pressed(t_end, **buffer):
    """The chaser's run against the wall, sampled every millisecond."""
    changes = {f"buffer.{name}": value for name, value in buffer.items()}
    return heavy_run({"run.t_end": t_end} | changes)


def moving_mass(scene):
    return scene.chaser.mass + scene.cylinder.mass


def test_progressive_spring_stops_the_mass_where_its_energy_is_stored():
    """M v^2 / 2 = k_A s^2 / 2 + k_A3 s^4 / 4, after the quarter of the oscillator's period."""
    k_A, k_A3 = 5e3, 3e7
    result = pressed(1.5, k_A=k_A, k_A3=k_A3)
    M = moving_mass(result.scene)
    square = (-k_A + math.sqrt(k_A**2 + 2.0 * k_A3 * M * SPEED**2)) / k_A3
    stroke = math.sqrt(square)
    extremes = result.extremes.before_latch
    assert extremes["axial_stroke_in"] == pytest.approx(stroke, rel=LIGHT)

    # t = int ds / v with the pole at the end taken out: s = stroke sin(phi)
    def dt(phi):
        s = stroke * math.sin(phi)
        rest = (k_A + 0.5 * k_A3 * (stroke**2 + s**2)) / M
        return 1.0 / math.sqrt(rest)

    quarter, _ = quad(dt, 0.0, math.pi / 2.0)
    begun = result.touches["start"][0]
    assert extremes["axial_stroke_in_time"] - begun == pytest.approx(quarter, rel=2 * LIGHT)
    stored = result.samples["elastic_axial"] + result.samples["elastic_contact"]
    assert stored.max() == pytest.approx(0.5 * M * SPEED**2, rel=LIGHT)
    assert residual(result) < 1e-8 * M * SPEED**2


def test_orifice_slows_the_mass_by_the_square_of_its_speed():
    """M v' = -c_A2 v^2: s = M / c_A2 ln(1 + c_A2 v_0 t / M), and the ledger has what is lost."""
    c_A2 = 2e5
    result = pressed(1.0, c_A2=c_A2)
    M = moving_mass(result.scene)
    t = result.t - result.touches["start"][0]
    late = t > 0.3  # the probe has come to rest on the wall
    stroke = M / c_A2 * np.log1p(c_A2 * SPEED * t[late] / M)
    assert -result.samples["axial_stroke"][late] == pytest.approx(stroke, abs=2e-4 * stroke.max())
    speed = SPEED / (1.0 + c_A2 * SPEED * t[late] / M)
    lost = 0.5 * M * (SPEED**2 - speed**2)
    assert result.samples["dissipated_axial"][late] == pytest.approx(lost, rel=5e-3)
    assert residual(result) < 1e-8 * M * SPEED**2


def test_rebound_is_damped_by_its_own_coefficient():
    """Inwards an undamped oscillator, outwards a damped one until its force is zero."""
    k_A, c = 5e4, 8e3
    result = pressed(1.6, k_A=k_A, c_A_rebound=c)
    M = moving_mass(result.scene)
    omega = math.sqrt(k_A / M)
    stroke = result.extremes.before_latch["axial_stroke_in"]
    assert stroke == pytest.approx(SPEED / omega, rel=LIGHT)
    turned = result.extremes.before_latch["axial_stroke_in_time"]
    # s = e^(-d t) (cos w t + d / w sin w t), from rest; k_A s + c s' = 0 where the tip lifts off
    d = 0.5 * c / M
    w = math.sqrt(omega**2 - d * d)
    t = math.atan2(w, c * omega**2 / k_A - d)
    lift = t / w
    speed = stroke * omega**2 / w * math.exp(-d * lift) * math.sin(w * lift)
    off = [e for e in result.events if e.kind.label == "lift_off" and e.t > turned][-1]
    assert off.t - turned == pytest.approx(lift, rel=5e-3)
    assert -off.v[0] == pytest.approx(speed, rel=5e-3)
    before = result.samples["dissipated_axial"][result.t < turned]
    # what the probe loses that chatters before it
    assert before.max() < LIGHT * 0.5 * M * SPEED**2
    lost = 0.5 * M * (SPEED**2 - speed**2)
    assert result.samples["dissipated_axial"][-1] == pytest.approx(lost, rel=2e-2)


def test_progressive_hinge_and_its_orifice_close_the_ledger_and_are_felt():
    """Eccentric: the probe turns; energy and the torque's own law hold at every sample."""
    changes = ["buffer.k_T3=2.0e+6", "buffer.c_T2=3", "run.t_end=0.3", "run.state_rate=2000"]
    result = simulate(load_scene("paper_designed", changes))
    b, s = result.scene.buffer, result.samples
    twist = s["v"][:, 3] - s["v"][:, 2]
    torque = -b.k_T * s["torsion"] - 2.0e6 * s["torsion"] ** 3 - 3.0 * np.abs(twist) * twist
    assert s["torsion_torque"] == pytest.approx(torque, rel=1e-9, abs=1e-12)
    assert s["dissipated_torsion"][-1] > 0.0
    assert residual(result) < 1e-6 * s["kinetic"][0]


@pytest.mark.parametrize("factor", [0.05, 0.5625, 3.0])
def test_a_given_hysteresis_factor_returns_the_restitution_of_its_relation(factor):
    """A (1 + e) = ln((1 + a) / (1 - a e)) between free bodies, whatever law stands beside it."""
    scene = free_impact(1e-5, 0.1, 0.5, {"contact.hysteresis_factor": factor, "run.t_end": 0.01})
    off = first(run(scene), "lift_off")
    restitution = (off.v[5] - off.v[0] - off.v[4]) / 0.1
    assert restitution == pytest.approx(returned_restitution(factor), abs=1e-6)


def test_a_law_that_needs_a_restitution_does_not_where_the_factor_is_given():
    changes = ["contact.law=flores", "contact.restitution=0"]
    with pytest.raises(SceneError, match=r"contact\.restitution"):
        load_scene("paper_designed", changes)
    load_scene("paper_designed", [*changes, "contact.hysteresis_factor=1"])
    with pytest.raises(SceneError, match=r"contact\.hysteresis_factor = -1"):
        load_scene("paper_designed", ["contact.hysteresis_factor=-1"])


@pytest.mark.parametrize(
    "given",
    [
        ["buffer.k_A3=0", "buffer.c_A2=0", "buffer.c_A_rebound=13", "buffer.k_T3=0"],
        ["buffer.preload=0"],
        ["buffer.friction=0"],
        ["buffer.force_table=null"],
    ],
)
def test_terms_that_are_given_as_nothing_change_no_bit(given):
    plain, same = (
        simulate(load_scene("paper_designed", ["run.t_end=0.3", *changes]))
        for changes in ([], given)
    )
    assert plain.samples.tobytes() == same.samples.tobytes()
