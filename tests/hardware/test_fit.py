"""The fit of a law to one touch, on touches whose law is known."""

import numpy as np
import pytest

from capture_sim.hardware.fit import LawEstimate, fit_touch
from capture_sim.hardware.law import WallLaw
from capture_sim.scene.laws import exact_factor

SPEED = 0.1  # m/s


def touch(law, lag=0.0, noise=0.1, n=60, duration=0.05, seed=1):
    """Return samples of a tip that goes in and comes out on half a sine, measured late."""
    t = np.linspace(-0.4, 1.4, n) * duration
    amplitude = SPEED * duration / np.pi

    def path(t):
        w = np.pi / duration
        inside = np.clip(t, 0.0, duration)
        depth = amplitude * np.sin(w * inside) + SPEED * np.minimum(t, 0.0)
        depth -= SPEED * np.maximum(t - duration, 0.0)
        rate = SPEED * np.cos(w * inside)
        return depth, rate

    depth, rate = path(t)
    late, late_rate = path(t - lag)
    inside = np.maximum(late + law.offset, 0.0)
    normal = inside**law.exponent * (law.stiffness + law.damping * late_rate)
    normal = np.maximum(normal, 0.0)
    slip = np.linspace(0.02, -0.01, n)
    rng = np.random.default_rng(seed)
    tangential = -law.friction * normal * np.tanh(slip / law.slip_speed)
    tangential += noise * rng.normal(size=n)
    normal = normal + noise * rng.normal(size=n)
    return np.stack([t, depth, rate, normal, tangential, slip], axis=1)


def fitted(samples, guess, noise=0.1):
    fit = fit_touch(samples, LawEstimate(guess), SPEED, noise, 6 * noise)
    for n in range(1000):
        try:
            next(fit)
        except StopIteration as done:
            return done.value, n
    raise AssertionError("the fit has no end")


@pytest.mark.parametrize("exponent", [1.0, 1.5])
@pytest.mark.parametrize("restitution", [1.0, 0.6, 0.3])
@pytest.mark.parametrize("lag", [0.0, 0.005])
@pytest.mark.parametrize("guess", [0.1, 10.0])
def test_stiffness_loss_wall_and_lag_are_found(exponent, restitution, lag, guess):
    stiffness = 5e4 if exponent == 1.0 else 2e6
    loss = exact_factor(restitution) if restitution < 1.0 else 0.0
    law = WallLaw(stiffness, exponent, loss * stiffness / SPEED, 5e-5, 0.25)
    start = WallLaw(guess * stiffness, exponent)
    found, steps = fitted(touch(law, lag), start)
    assert found.law.stiffness == pytest.approx(stiffness, rel=0.03)
    assert found.restitution == pytest.approx(restitution, rel=0.02)
    assert found.law.offset == pytest.approx(5e-5, abs=5e-6)
    assert found.lag == pytest.approx(lag, abs=2e-4)
    assert found.law.friction == pytest.approx(0.25, abs=0.01)
    assert found.residual < 0.2
    assert steps < 250  # one a step: a quarter of a second


def test_what_is_said_of_the_uncertainty_is_true():
    """Over forty touches the errors are as large as their standard deviations say."""
    law = WallLaw(5e4, damping=exact_factor(0.6) * 5e4 / SPEED)
    errors = []
    for seed in range(40):
        found, _ = fitted(touch(law, noise=1.0, seed=seed), WallLaw(2e4), 1.0)
        errors.append(
            [
                np.log(found.law.stiffness / 5e4) / found.deviations[0],
                found.law.offset / found.deviations[2],
                found.lag / found.lag_deviation,
                (found.restitution - 0.6) / found.restitution_deviation,
            ]
        )
    assert np.sqrt(np.mean(np.square(errors), axis=0)) == pytest.approx([1.0] * 4, abs=0.5)


def test_a_fit_never_generates_energy():
    """Less force on the way in than on the way out, by more than a lag explains."""
    samples = touch(WallLaw(5e4), noise=0.0)
    samples[:, 3] *= np.where(samples[:, 2] > 0.0, 0.5, 1.5)
    found, _ = fitted(samples, WallLaw(5e4))
    assert found.law.damping >= 0.0
    assert found.law.friction >= 0.0
    assert found.law.stiffness > 0.0
