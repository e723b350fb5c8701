"""The implicit method on problems with known solutions, and at work on the bench."""

import math

import numpy as np
import pytest

from capture_sim import Bench, load_scene
from capture_sim.kernels import kernel
from capture_sim.solver.radau import A, C, factor_systems, make_implicit, make_work


@kernel
def oscillators(t, y, f, par, mode, scratch):
    """A pendulum beside a spring that par[0] makes as stiff as wanted; power of the weight."""
    f[0] = y[2]
    f[1] = y[3]
    f[2] = -math.sin(y[0])
    f[3] = -par[0] * (y[1] - y[0]) - par[1] * (y[3] - y[2])
    f[4] = -math.sin(y[0]) * y[2]


@kernel
def both_directions(y, par, mode, Q):
    """All there are: the full method."""
    for i in range(2):
        for k in range(2):
            Q[i, k] = 1.0 if i == k else 0.0
    return 2


@kernel
def the_stiff_one(y, par, mode, Q):
    """The spring's, not normalised, twice: what depends on others is dropped."""
    for i in range(2):
        Q[i, 0] = -3.0
        Q[i, 1] = 3.0
    return 2


STEPS = make_implicit(oscillators, both_directions)
FEW = make_implicit(oscillators, the_stiff_one)


def compiled_step(steps):
    """Return a function that differentiates, factorises, guesses by the motion now, steps."""
    derive, solve = steps.derivatives, steps.solve_step

    @kernel
    def one_step(par, scratch, t, y, f_0, h, y_s, y_new, f_new, weights, work, F):
        derive(par, par, scratch, t, y, f_0, y_s, 1e-6, 1e-6, work)
        factor_systems(h, work)
        for k in range(3):
            for i in range(2):
                work[8][k, i] = C[k] * h * y[2 + i]
                work[8][k, 2 + i] = 0.0
        return solve(par, par, scratch, t, y, f_0, h, y_s, y_new, f_new, weights, work, F)

    return one_step


ALL_STEP, FEW_STEP = compiled_step(STEPS), compiled_step(FEW)


def run(stiffness, damping, n, t_end=2.0, one_step=ALL_STEP):
    par = np.array([stiffness, damping])
    work = tuple(make_work(2, 5))
    y, f = np.array([1.0, 1.0, 0.3, 0.3, 0.0]), np.zeros(5)
    F, scratch, y_s, weights = np.zeros((7, 5)), np.zeros(1), np.zeros(4), np.full(4, 1e13)
    h = t_end / n
    for k in range(n):
        oscillators(k * h, y, f, par, par, scratch)
        y_new, f_new = np.zeros(5), np.zeros(5)
        iterations, _, _ = one_step(
            par, scratch, k * h, y, f, h, y_s, y_new, f_new, weights, work, F
        )
        assert iterations > 0
        y = y_new
    return y


def test_coefficients_are_a_collocation_at_radau_points():
    powers = np.arange(1, 4)
    assert pytest.approx(C[:, None] ** powers / powers) == A @ C[:, None] ** (powers - 1)


def test_order_five_on_a_smooth_problem():
    exact = run(1.0, 0.1, 512)
    errors = [np.abs(run(1.0, 0.1, n) - exact).max() for n in (8, 16, 32)]
    assert np.log2(np.array(errors[:-1]) / errors[1:]) == pytest.approx([5.0, 5.0], abs=0.35)


@pytest.mark.parametrize("one_step", [ALL_STEP, FEW_STEP], ids=["all", "stiff only"])
def test_a_stiff_part_neither_blows_up_nor_needs_short_steps(one_step):
    """The spring binds y[1] to y[0]; explicit steps would have to be below 1e-6."""
    bound = run(1e12, 1e7, 20, one_step=one_step)
    assert bound[1] == pytest.approx(bound[0], abs=1e-9)
    assert bound[0] == pytest.approx(run(1.0, 0.1, 512)[0], abs=1e-6)


@pytest.mark.parametrize("name", ["paper_designed", "paper_undamped", "tilt_p10"])
def test_the_bench_agrees_with_its_explicit_self(name):
    """In sustained contact at a loose tolerance it takes over and is no less exact."""
    times = np.linspace(0.0, 0.35, 36)
    if name == "tilt_p10":
        times = np.linspace(2.5, 2.9, 41)
    exact = Bench(load_scene(name, ["run.rtol=1e-12"])).advance(times)
    found = {}
    for stiff in ("false", "true"):
        bench = Bench(load_scene(name, ["run.rtol=1e-5", f"run.stiff={stiff}"]))
        samples = bench.advance(times)
        error = np.abs(samples["q"] - exact["q"]).max()
        found[stiff] = error, bench.statistics.evaluations
        assert error < 1e-6
        assert np.abs(samples["energy_residual"]).max() < 1e-5 * 0.116
    assert found["true"][1] < 0.8 * found["false"][1]
