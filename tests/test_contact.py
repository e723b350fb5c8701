"""One impact of two free bodies, where everything is known in closed form."""

import math

import numpy as np
import pytest
from scipy.special import gamma

from capture_sim import load_scene, simulate
from capture_sim.model.contact import (
    HYSTERESIS_FACTOR,
    exact_factor,
    returned_restitution,
)
from capture_sim.scene.parts import CONTACT_LAWS


def head_on(e=1.0, law="lankarani_nikravesh", speed=0.1, rtol=1e-10):
    """The probe alone against the target, through both centres of mass.

    With no axial spring the probe slides freely in the cylinder, and the outer lip of the
    wall is turned so that it lies between the tip and the target's centre.
    """
    scene = load_scene("paper_designed")
    cone = scene.cone
    lip = np.array(
        [
            -cone.L_T - cone.L_c * math.cos(cone.half_angle),
            cone.R_c + cone.L_c * math.sin(cone.half_angle),
        ]
    )
    theta = math.pi - math.atan2(lip[1], lip[0])
    ahead = (
        scene.buffer.hinge_offset + scene.rest_length + scene.probe.tip_radius + math.hypot(*lip)
    )
    return load_scene(
        "paper_designed",
        [
            "buffer.k_A=0",
            "buffer.c_A=0",
            f"contact.restitution={e!r}",
            f"contact.law={law}",
            f"initial.chaser.vx={speed!r}",
            f"initial.target.x={ahead + 0.001 * speed!r}",
            "initial.target.y=0.0",
            f"initial.target.theta={theta!r}",
            f"run.rtol={rtol!r}",
            "run.t_end=0.01",
        ],
    )


def returned(scene):
    result = simulate(scene, t_eval=[])
    touch = [e for e in result.events if e.kind.label == "touch"]
    lift = [e for e in result.events if e.kind.label == "lift_off"]
    assert len(touch) == len(lift) == 1
    before = touch[0].v[0] + touch[0].v[4] - touch[0].v[5]
    after = lift[0].v[0] + lift[0].v[4] - lift[0].v[5]
    return -after / before, result


@pytest.mark.parametrize("speed", [0.01, 0.1, 1.0])
def test_hertz_impact_has_its_closed_form(speed):
    scene = head_on(1.0, speed=speed)
    e, result = returned(scene)
    m = scene.probe.mass * scene.target.mass / (scene.probe.mass + scene.target.mass)
    K = scene.contact_stiffness
    depth = (5 * m * speed**2 / (4 * K)) ** 0.4
    duration = 4 * math.sqrt(math.pi) * gamma(0.4) / (5 * gamma(0.9)) * depth / speed
    touch = result.touches[0]
    assert (touch["peak_force"] / K) ** (2 / 3) == pytest.approx(depth, rel=1e-6)
    assert touch["end"] - touch["start"] == pytest.approx(duration, rel=1e-6)
    assert touch["peak_time"] - touch["start"] == pytest.approx(duration / 2, rel=1e-3)
    assert touch["start"] == pytest.approx(0.001, rel=1e-9)
    assert touch["approach_speed"] == pytest.approx(speed, rel=1e-12)
    assert touch["impulse"] == pytest.approx(2 * m * speed, rel=1e-8)
    assert e == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize("e, expected", [(0.1, 0.665), (0.5, 0.725), (0.7, 0.796), (0.9, 0.913)])
def test_lankarani_nikravesh_returns_the_published_restitution(e, expected):
    found, _ = returned(head_on(e))
    assert found == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("law", CONTACT_LAWS)
@pytest.mark.parametrize("e", [0.1, 0.5, 0.9])
def test_every_law_returns_what_its_factor_says(law, e):
    found, result = returned(head_on(e, law))
    assert found == pytest.approx(returned_restitution(HYSTERESIS_FACTOR[law](e)), abs=1e-6)
    if law == "exact":
        assert found == pytest.approx(e, abs=1e-6)
    scene = result.scene
    m = scene.probe.mass * scene.target.mass / (scene.probe.mass + scene.target.mass)
    lost = 0.5 * m * 0.1**2 * (1 - found**2)
    assert result.touches[0]["dissipated"] == pytest.approx(lost, rel=1e-6)


@pytest.mark.parametrize("e", [0.01, 0.1, 0.5, 0.9, 0.99, 1.0])
def test_exact_factor_and_returned_restitution_are_inverse(e):
    a = exact_factor(e)
    assert returned_restitution(a) == pytest.approx(e, abs=1e-9)
    if 0.05 < e < 1.0:
        assert a * (1 + e) == pytest.approx(math.log((1 + a) / (1 - a * e)), rel=1e-9)


def test_contact_force_never_pulls():
    result = simulate(load_scene("paper_designed"), t_end=0.5, t_eval=np.linspace(0, 0.5, 20001))
    assert result.samples["normal_force"].min() == 0.0
    assert result.samples["normal_force"].max() > 50.0


def test_peak_between_steps_is_no_less_than_any_sample():
    result = simulate(load_scene("paper_designed"), t_end=0.02, t_eval=np.linspace(0, 0.02, 200001))
    for touch in result.touches:
        during = (result.t >= touch["start"]) & (result.t <= touch["end"])
        sampled = result.samples["normal_force"][during].max()
        assert sampled <= touch["peak_force"] * (1 + 1e-9)
        assert sampled == pytest.approx(touch["peak_force"], rel=1e-4)


def test_stiffness_is_that_of_aluminium():
    assert load_scene("paper_designed").contact_stiffness == pytest.approx(6.43e9, rel=1e-3)


def test_trace_has_the_contact_at_the_integrators_resolution():
    """Exact: the force over the time of a touch is its impulse, and no step is above its peak."""
    scene = load_scene("paper_designed")
    result = simulate(scene, t_end=0.06, trace=True)
    trace = result.trace
    assert (np.diff(trace["t"]) > 0.0).all()
    seen = 0
    for touch in result.touches:
        inside = (trace["t"] > touch["start"]) & (trace["t"] <= touch["end"])
        seen += inside.sum()
        assert inside.sum() >= 8
        t = np.concatenate([[touch["start"]], trace["t"][inside]])
        force = np.concatenate([[0.0], trace["normal_force"][inside].sum(axis=1)])
        impulse = (0.5 * (force[1:] + force[:-1]) * np.diff(t)).sum()
        assert impulse == pytest.approx(touch["impulse"], rel=0.02)
        assert 0.95 * touch["peak_force"] < force.max() <= touch["peak_force"] * (1 + 1e-9)
    assert seen == trace.size
    # looking changes nothing
    plain = simulate(scene, t_end=0.06)
    assert plain.trace is None
    assert plain.samples.tobytes() == result.samples.tobytes()
    assert plain.statistics == result.statistics
