"""The equations of motion against a second formulation, and what must be conserved."""

import numpy as np
import pytest
from four_bodies import bias, buffer_forces, kinetic, mass_matrix, momentum, tip

from capture_sim import load_scene, simulate
from capture_sim.dynamics.engine import loop
from capture_sim.dynamics.model.equations import N_TOTAL, make_system
from capture_sim.dynamics.model.parameters import pack
from capture_sim.scene.launch_plan import plan_launch


def system_of(scene):
    plan = plan_launch(scene)
    return make_system(pack(scene, plan.hanging_mass, plan.drop_height))


def random_states(scene, n, seed=1):
    rng = np.random.default_rng(seed)
    q0, _ = scene.initial_coordinates()
    for _ in range(n):
        q = q0 + rng.normal(size=8) * np.array([1, 1, 2, 0.5, 0.02, 1, 1, 2])
        q[3] = q[2] + rng.normal() * 0.5
        yield q, rng.normal(size=8) * np.array([1, 1, 3, 3, 1, 1, 1, 3])


def accelerations(scene, q, v):
    y = np.concatenate([q, v, np.zeros(N_TOTAL - 16)])
    f = np.zeros(N_TOTAL)
    loop.evaluate(system_of(scene), y, f)
    return f[8:16]


@pytest.mark.parametrize("cylinder", [1.0, 0.0])
def test_free_accelerations_agree_with_bodies_one_by_one(cylinder):
    shaped = ["k_A3=3e4", "c_A2=7", "c_A_rebound=25", "k_T3=900", "c_T2=0.4", "c_T=0.7"]
    changes = [f"cylinder.mass={cylinder}", *(f"buffer.{change}" for change in shaped)]
    scene = load_scene("paper_designed", changes)
    for q, v in random_states(scene, 50):
        expected = np.linalg.solve(
            mass_matrix(scene, q), buffer_forces(scene, q, v) - bias(scene, q, v)
        )
        found = accelerations(scene, q, v)
        assert found == pytest.approx(expected, rel=1e-7, abs=1e-7 * np.abs(expected).max())


def test_contact_force_acts_as_a_force_on_both_bodies():
    """In contact, M q'' + b - Q is J^T F of one force at one point, opposite on the target."""
    scene = load_scene("paper_designed", ["buffer.c_T=0.7"])
    result = simulate(scene, t_end=0.3, t_eval=np.linspace(0.001, 0.3, 4001))
    touching = result.samples[result.samples["walls"] > 0]
    assert touching.size > 1000
    for sample in touching[::97]:
        q, v = sample["q"], sample["v"]
        system = system_of(scene)
        touch, par = system[0]["mode"]["touch"], system[0]["par"]
        touch["on"] = [sample["walls"] & 1, sample["walls"] >> 1]
        speeds = {
            t["wall"]: t["approach_speed"]
            for t in result.touches
            if t["start"] <= sample["t"] <= t["end"]
        }
        for i, wall in enumerate((1, -1)):
            if wall in speeds:
                touch["chi"][i] = (
                    par["hysteresis"] * par["contact"]["stiffness"] / max(speeds[wall], 1e-4)
                )
        y, f = np.concatenate([q, v, np.zeros(N_TOTAL - 16)]), np.zeros(N_TOTAL)
        loop.evaluate(system, y, f)
        Q = mass_matrix(scene, q) @ f[8:16] + bias(scene, q, v) - buffer_forces(scene, q, v)
        force = sample["contact_force"]
        scale = max(np.hypot(*force), 1.0)
        assert Q[0:2] == pytest.approx(force, abs=1e-6 * scale)
        assert Q[5:7] == pytest.approx(-force, abs=1e-6 * scale)
        # moments about the world's origin cancel: same point, opposite forces
        at_tip = tip(scene, q)
        on_chaser = at_tip[0] * force[1] - at_tip[1] * force[0] + sample["contact_torque"]
        on_target = q[5] * -force[1] + q[6] * force[0] + Q[7]
        assert on_chaser + on_target == pytest.approx(0.0, abs=1e-6 * scale)


@pytest.mark.parametrize(
    "name", ["paper_undamped", "paper_designed", "paper_case_1", "tilt_p10", "tilt_m10"]
)
def test_momentum_is_conserved_and_the_energy_ledger_closes(name):
    scene = load_scene(name)
    result = simulate(scene)
    if scene.supports is None:
        states = zip(result.q[::50], result.v[::50], strict=True)
        found = np.array([momentum(scene, q, v) for q, v in states])
        assert np.abs(found - found[0]).max() <= 1e-10 * np.abs(found[0]).max()
    assert result.touches.size > 10
    assert result.samples["normal_force"].min() == 0.0  # a wall never pulls
    approach = 0.5 * scene.chaser_total_mass * 0.1**2
    assert np.abs(result.energy["energy_residual"]).max() <= 1e-6 * approach
    free = result.samples[result.samples["phase"] >= 3]
    for sample in free[::500]:
        assert sample["kinetic"] == pytest.approx(
            kinetic(scene, sample["q"], sample["v"]), rel=1e-12
        )
    for name_, values in result.energy.items():
        if name_.startswith("dissipated"):
            assert np.all(np.diff(values) >= -1e-12), name_
