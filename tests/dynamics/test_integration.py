"""The integrators on problems with known solutions, and the bench against SciPy's."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from capture_sim import load_scene, simulate
from capture_sim.base.compiled.kernels import entry_kernel, kernel, plain
from capture_sim.dynamics.engine.step_length import next_factor
from capture_sim.dynamics.solver.pairs import PAIRS
from capture_sim.dynamics.solver.roots import cubic_minimum, may_cross
from capture_sim.dynamics.solver.runge_kutta import (
    dense,
    make_stepper,
    set_pair,
    stepper_type,
)


@kernel
def pendulum(t, y, f, system):
    """Mathematical pendulum; the third place integrates the power of its weight."""
    f[0] = y[1]
    f[1] = -math.sin(y[0]) + 0.1 * math.cos(3.0 * t)
    f[2] = -math.sin(y[0]) * y[1]


STEPPER = make_stepper(pendulum, 2, 3, 2)


@entry_kernel
def take_steps(steps, places, between, n, h):
    """Integrate with n equal steps; dense values at places (0..1) of the last one."""
    step = steps[0]
    for i in range(n):
        pendulum(i * h, step.y, step.K[0], steps)
        STEPPER.try_step(steps, step, i * h, h)
        if i == n - 1:
            STEPPER.prepare_dense(steps, step, i * h, h)
            for k in range(places.size):
                dense(step, places[k], step.y_stage, 3)
                for j in range(3):
                    between[k, j] = step.y_stage[j]
        for j in range(3):
            step.y[j] = step.y_new[j]


def fixed_steps(name, n, t_end=2.0, fractions=()):
    """Integrate with n equal steps; dense values at fractions of the last step."""
    steps = np.zeros(1, stepper_type(3, 2))
    set_pair(steps[0], PAIRS[name]())
    steps["y"] = [1.0, 0.3, 0.0]
    steps["weights"] = 1.0
    h = t_end / n
    between = np.zeros((len(fractions), 3))
    take_steps(steps, np.array(fractions, dtype=float), between, n, h)
    return steps["y"][0], [((n - 1 + x) * h, y) for x, y in zip(fractions, between, strict=True)]


@pytest.fixture(scope="module")
def reference():
    def motion(t, y):
        return [
            y[1],
            -math.sin(y[0]) + 0.1 * math.cos(3 * t),
            -math.sin(y[0]) * y[1],
        ]

    return solve_ivp(
        motion, (0, 2), [1.0, 0.3, 0.0], method="DOP853", rtol=1e-13, atol=1e-15, dense_output=True
    )


@pytest.mark.parametrize("name, coarse", [("dopri5", 16), ("dop853", 4), ("rk4", 20)])
def test_order_of_the_step_and_of_its_integrals(name, coarse, reference):
    exact = reference.y[:, -1]
    errors = [np.linalg.norm(fixed_steps(name, coarse * k)[0] - exact) for k in (1, 2, 4)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > PAIRS[name]().order - 0.5)


@pytest.mark.parametrize(
    "name, n, error", [("dopri5", 20, 3e-7), ("dop853", 8, 1e-8), ("rk4", 40, 1e-6)]
)
def test_dense_output_between_steps(name, n, error, reference):
    _, between = fixed_steps(name, n, fractions=(0.0, 0.25, 0.5, 0.9, 1.0))
    for t, y in between:
        assert y == pytest.approx(reference.sol(t), abs=error)


@pytest.mark.parametrize("error", [1e-3, 0.3, 1.0, 2.0, 40.0])
@pytest.mark.parametrize("previous", [1e-6, 0.02, 0.9])
def test_next_step_is_that_of_dopri5(error, previous):
    # exponents 0.2 - 0.75 BETA and BETA = 0.04, both limits of the factor: Hairer's DOPRI5
    factor = 0.9 * error**-0.17
    if error <= 1.0:
        factor *= max(previous, 1e-4) ** 0.04
    assert plain(next_factor)(error, previous, 5) == pytest.approx(
        min(max(factor, 0.2), 6.0), rel=1e-12
    )


@pytest.mark.parametrize("order", [5, 8])
@pytest.mark.parametrize("error", [1e-9, 1e9])
def test_steps_settle_below_the_tolerance(order, error):
    """An error that goes with the step's power: soon no step is rejected, and none is wasted."""
    errors = [error]
    previous = 1.0
    for _ in range(20):
        factor = plain(next_factor)(errors[-1], previous, order)
        previous = errors[-1] if errors[-1] <= 1.0 else previous
        errors.append(errors[-1] * factor**order)
    assert all(0.1 < e < 1.0 for e in errors[-8:])


def test_kernels_for_kernels_are_refused_to_python():
    with pytest.raises(TypeError):
        cubic_minimum(1.0, -6.0, 1.0, 6.0)


def test_cubic_sees_a_dip_between_two_positive_ends():
    place, low = plain(cubic_minimum)(1.0, -6.0, 1.0, 6.0)
    assert place == pytest.approx(0.5)
    assert low == pytest.approx(-0.5)
    assert plain(may_cross)(1.0, -6.0, 1.0, 6.0, 0.05)
    assert not plain(may_cross)(1.0, -0.1, 1.0, 0.1, 0.05)
    assert plain(may_cross)(1.0, 0.0, -0.1, 0.0, 0.05)


@pytest.mark.parametrize("method", ["dopri5", "dop853"])
def test_state_converges_with_the_tolerance(method):
    tight = simulate(load_scene("paper_designed", ["run.rtol=1e-12"]), t_end=0.35, t_eval=[0.35])
    errors = []
    for rtol in (1e-6, 1e-8, 1e-10):
        scene = load_scene("paper_designed", [f"run.rtol={rtol}", f"run.method={method}"])
        found = simulate(scene, t_end=0.35, t_eval=[0.35])
        errors.append(np.abs(found.q[0] - tight.q[0]).max())
        assert found.touches.size == tight.touches.size
    assert errors[0] < 1e-6
    assert errors[1] < 1e-8
    assert errors[2] < 1e-9


def test_extra_sample_times_change_nothing_and_are_met():
    scene = load_scene("tilt_0")
    asked = np.array([0.0, 0.12345, 2.7938, 4.096, 4.0961, 5.0005, 19.0])
    result = simulate(scene, t_eval=asked)
    assert np.array_equal(result.t, asked[:-1])
    whole = simulate(scene)
    assert [(e.kind, e.t, *e.q) for e in result.events] == [
        (e.kind, e.t, *e.q) for e in whole.events
    ]
    on_grid = whole.samples[whole.t == 4.096]
    assert result.samples[3].tobytes() == on_grid[0].tobytes()
