"""One impact of two free bodies: restitution, masses and speeds to their limits."""

import math

import numpy as np
import pytest
from maximal_model import damping_factor
from scipy.special import gamma
from set_ups import ADAPTIVE, METHODS, altered, anvil, first, free_impact, run

from capture_sim import SceneError, load_scene
from capture_sim.scene.laws import CONTACT_LAWS, exact_factor, returned_restitution

#: Allowed error of the restitution at the default tolerance (rk4: at steps of 1e-6 s).
RESTITUTION_ERROR = 1e-6


def returned(scene):
    """The restitution between the only touch's two ends, and the run."""
    result = run(scene, t_eval=[])
    assert result.failure == ""
    assert result.touches.size == 1
    before, after = first(result, "touch").v, first(result, "lift_off").v
    approach = before[0] + before[4] - before[5]
    return -(after[0] + after[4] - after[5]) / approach, result


def reduced_mass(scene):
    return scene.probe.mass * scene.target.mass / (scene.probe.mass + scene.target.mass)


def hertz(scene, speed):
    """Greatest depth, m, and duration, s, of an undamped impact: closed form."""
    m, K = reduced_mass(scene), scene.contact_stiffness
    depth = (5 * m * speed**2 / (4 * K)) ** 0.4
    return depth, 4 * math.sqrt(math.pi) * gamma(0.4) / (5 * gamma(0.9)) * depth / speed


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("e", [0.01, 0.02, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0])
def test_exact_law_returns_the_restitution_that_is_put_in(e, method):
    """Exact: e itself, and by it the energy lost, m v^2 (1 - e^2) / 2."""
    how = {"run.method": method, "run.step": 1e-6, "run.t_end": 0.005}
    scene = free_impact(1e-4, 0.1, e, how)
    found, result = returned(scene)
    assert found == pytest.approx(e, abs=RESTITUTION_ERROR)
    lost = 0.5 * reduced_mass(scene) * 0.1**2 * (1 - e**2)
    assert result.touches["dissipated"][0] == pytest.approx(lost, rel=2e-6, abs=1e-10)
    assert result.touches["impulse"][0] == pytest.approx(
        reduced_mass(scene) * 0.1 * (1 + e), rel=RESTITUTION_ERROR
    )


@pytest.mark.parametrize("law", CONTACT_LAWS)
@pytest.mark.parametrize("e", [0.1, 0.5, 0.9])
def test_every_law_returns_and_loses_what_its_published_factor_says(law, e):
    scene = free_impact(1e-4, 0.1, e, {"contact.law": law, "run.rtol": 1e-10, "run.t_end": 0.01})
    found, result = returned(scene)
    assert found == pytest.approx(returned_restitution(damping_factor(law, e)), abs=1e-6)
    lost = 0.5 * reduced_mass(scene) * 0.1**2 * (1 - found**2)
    assert result.touches[0]["dissipated"] == pytest.approx(lost, rel=1e-6)


@pytest.mark.parametrize("e", [0.01, 0.1, 0.5, 0.9, 0.99, 1.0])
def test_exact_factor_and_returned_restitution_are_inverse(e):
    a = exact_factor(e)
    assert returned_restitution(a) == pytest.approx(e, abs=1e-9)
    if 0.05 < e < 1.0:
        assert a * (1 + e) == pytest.approx(math.log((1 + a) / (1 - a * e)), rel=1e-9)


@pytest.mark.parametrize("e", [1e-6, 1e-4, 1e-3, 1 - 1e-5, 1 - 1e-9])
def test_exact_law_at_the_ends_of_its_range(e):
    """Exact: e itself, 1e-9 of it where the body nearly stops dead; e = 0 is refused."""
    scene = free_impact(1e-4, 0.1, e, {"run.rtol": 1e-10, "run.t_end": 0.5})
    found, _ = returned(scene)
    assert found == pytest.approx(e, abs=1e-12 if e < 0.5 else 1e-8)
    with pytest.raises(SceneError, match=r"contact.restitution = 0.0: must be > 0"):
        run(altered(scene, {"contact.restitution": 0.0}))


@pytest.mark.parametrize("method", ADAPTIVE)
@pytest.mark.parametrize("speed", [1e-3, 1e-2, 0.1, 1.0, 10.0])
def test_hertz_impact_from_a_millimetre_to_ten_metres_per_second(speed, method):
    """Exact: depth, duration and impulse of the undamped Hertz impact."""
    how = {"run.method": method, "run.rtol": 1e-10, "run.t_end": 0.01}
    scene = free_impact(1e-3 * speed, speed, 1.0, how)
    found, result = returned(scene)
    depth, duration = hertz(scene, speed)
    touch = result.touches[0]
    assert found == pytest.approx(1.0, abs=1e-8)
    assert touch["start"] == pytest.approx(1e-3, rel=1e-9)
    assert touch["end"] - touch["start"] == pytest.approx(duration, rel=1e-8)
    assert touch["peak_time"] - touch["start"] == pytest.approx(duration / 2, rel=1e-3)
    assert touch["approach_speed"] == pytest.approx(speed, rel=1e-12)
    assert touch["peak_force"] == pytest.approx(scene.contact_stiffness * depth**1.5, rel=1e-8)
    assert touch["impulse"] == pytest.approx(2 * reduced_mass(scene) * speed, rel=1e-8)


@pytest.mark.parametrize("ratio", [1e-3, 1.0, 1e2, 1e4, 1e6])
def test_mass_ratio_from_one_to_a_million(ratio):
    """Exact: both speeds after the impact, by momentum and restitution."""
    heavy = load_scene("paper_designed").probe.mass * ratio
    masses = {"target.mass": heavy, "target.inertia": 0.02 * heavy}
    how = {"run.rtol": 1e-10, "run.t_end": 0.005}
    scene = free_impact(1e-4, 0.1, 0.5, masses | how)
    found, result = returned(scene)
    assert found == pytest.approx(0.5, abs=1e-8)
    after = first(result, "lift_off").v
    target = 0.1 * 1.5 / (1 + ratio)
    assert after[5] == pytest.approx(target, rel=1e-8)
    assert after[0] + after[4] == pytest.approx(0.1 - ratio * target, abs=1e-9)


@pytest.mark.parametrize("e", [0.5, 1.0])
@pytest.mark.parametrize("speed", [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9])
def test_grazing_approach_down_to_a_nanometre_per_second(speed, e):
    """The tip glides along the wall at 0.1 m/s and nears it at ``speed``, without friction.

    Exact: the same as a head-on impact at ``speed``, by Galileo.  Below v_0_floor the
    damping factor is a(e) speed / v_0_floor, and the restitution the one that this factor
    returns: e tends to 1.  The speed's error must stay below a hundred times what
    a step may make, rtol of the scene's speed (0.1 m/s).
    """
    duration = hertz(anvil(1e-12, {}), speed)[1]
    changes = {
        "buffer.k_A": 0.0,
        "buffer.c_A": 0.0,
        "contact.law": "exact",
        "contact.restitution": e,
        "friction.law": "none",
        "initial.chaser.vx": speed,
        "initial.chaser.vy": 0.1,
        "run.rtol": 1e-12,
        "run.t_end": 0.01 + 2 * duration,
    }
    scene = anvil(0.01 * speed, changes)
    found, result = returned(scene)
    floor = scene.contact.min_approach_speed
    expected = returned_restitution(exact_factor(e) * min(1.0, speed / floor))
    touch = result.touches[0]
    # places are of the order of 0.5 m: they are known to 1e-16 m
    assert touch["start"] == pytest.approx(0.01, abs=1e-9 * 0.01 + 2e-16 / speed)
    assert touch["approach_speed"] == pytest.approx(speed, abs=1e-16)
    assert found * speed == pytest.approx(expected * speed, abs=1e-11)
    if e == 1.0:
        assert touch["end"] - touch["start"] == pytest.approx(duration, rel=1e-3)


def test_stiffness_is_that_of_aluminium():
    assert load_scene("paper_designed").contact_stiffness == pytest.approx(6.43e9, rel=1e-3)


def test_gliding_along_the_wall_without_nearing_it_never_touches():
    """Exact: a gap of 1e-9 m stays; a gap of -1e-9 m is an overlap and refused."""
    gliding = {"friction.law": "none", "initial.chaser.vy": 0.1, "run.t_end": 0.2}
    result = run(anvil(1e-9, gliding))
    assert result.touches.size == 0
    assert result.samples["penetration"][:, 0] == pytest.approx(-1e-9, abs=1e-15)
    with pytest.raises(SceneError, match=r"tip starts 1e-09 m inside the cone's \+y wall"):
        run(anvil(-1e-9, gliding))


@pytest.mark.parametrize("method", METHODS)
def test_touch_at_rest_stays_at_rest(method):
    """Exact: nothing moves, not by a bit, and no touch begins."""
    result = run(anvil(1e-16, {"run.method": method, "run.t_end": 1.0, "run.step": 1e-3}))
    assert [e.kind.label for e in result.events] == ["release", "end"]
    assert np.all(result.q == result.q[0])
    assert np.all(result.v == 0.0)


@pytest.mark.parametrize("gap", [1e-16, 1e-15, 1e-13])
def test_touch_begins_at_once_where_the_tip_is_at_the_wall(gap):
    """Exact: with a speed towards the wall the touch begins at the release."""
    scene = free_impact(gap, 0.1, 0.5, {"run.rtol": 1e-10, "run.t_end": 0.002})
    found, result = returned(scene)
    assert found == pytest.approx(0.5, abs=1e-8)
    assert result.touches["start"][0] == pytest.approx(gap / 0.1, abs=2e-15)
    leaving = altered(scene, {"initial.chaser.vx": -0.1})
    assert run(leaving).touches.size == 0


@pytest.mark.parametrize("overlap", [1e-13, 1e-9, 1e-4, 1e-2])
def test_overlap_at_the_start_is_refused(overlap):
    """Exact: the message names how deep, at the lip and at the face."""
    with pytest.raises(SceneError, match=r"initial: the tip starts .* m inside") as caught:
        run(free_impact(-overlap, 0.1, 0.5, {}))
    assert float(str(caught.value).split()[4]) == pytest.approx(overlap, abs=2e-16)
    with pytest.raises(SceneError, match=r"initial: the tip starts .* m inside"):
        run(anvil(-overlap, {}))
