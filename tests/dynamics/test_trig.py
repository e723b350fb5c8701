"""Sine, cosine and hyperbolic tangent of the kernels against the C library's."""

import math

import numpy as np
import pytest

from capture_sim.base.compiled.kernels import entry_kernel
from capture_sim.dynamics.model.trig import hyperbolic_tangent, sine_cosine, sines_cosines


@entry_kernel
def both(angles, sines, cosines):
    """Evaluate a whole array."""
    for i in range(angles.size):
        sines[i], cosines[i] = sine_cosine(angles[i])


def test_to_the_last_place_over_all_quarters_and_sizes():
    rng = np.random.default_rng(7)
    quarters = np.arange(-64, 65) * (math.pi / 4)
    angles = np.concatenate(
        [
            rng.uniform(-10, 10, 50_000),
            rng.uniform(-9e4, 9e4, 50_000),
            rng.uniform(-1e9, 1e9, 1_000),
            rng.uniform(-1e-9, 1e-9, 1_000),
            *(quarters + shift for shift in (0.0, 1e-9, -1e-9, 1e-16)),
            [0.0],
        ]
    )
    sines, cosines = np.zeros_like(angles), np.zeros_like(angles)
    both(angles, sines, cosines)
    assert np.abs(sines - np.sin(angles)).max() <= 1.2e-16
    assert np.abs(cosines - np.cos(angles)).max() <= 1.2e-16


@entry_kernel
def of_three(angles, found):
    """Evaluate rows of three angles."""
    for i in range(angles.shape[0]):
        found[i] = sines_cosines(angles[i, 0], angles[i, 1], angles[i, 2])


@pytest.mark.parametrize("largest", [0.78, 2.0])  # all in one vector register, or one by one
def test_three_angles_at_once(largest):
    angles = np.random.default_rng(3).uniform(-largest, largest, (20_000, 3))
    angles[0] = 0.0, -1e-9, 0.3
    found = np.zeros((len(angles), 6))
    of_three(angles, found)
    assert np.abs(found[:, 0::2] - np.sin(angles)).max() <= 1.2e-16
    assert np.abs(found[:, 1::2] - np.cos(angles)).max() <= 1.2e-16


def test_what_is_not_a_number_stays_so():
    angles = np.array([math.nan, math.inf])
    sines, cosines = np.zeros(2), np.zeros(2)
    both(angles, sines, cosines)
    assert np.isnan(sines[0])
    assert np.isnan(cosines[1])


@entry_kernel
def tangents(x, out):
    """Evaluate a whole array."""
    for i in range(x.size):
        out[i] = hyperbolic_tangent(x[i])


def test_hyperbolic_tangent_to_four_units_in_the_last_place():
    rng = np.random.default_rng(8)
    steps = np.concatenate([[0.45, 20.0, 21.0], np.arange(1, 40) * math.log(2) / 4])
    x = np.concatenate(
        [
            rng.uniform(-25, 25, 50_000),
            rng.uniform(-1, 1, 50_000),
            10.0 ** rng.uniform(-300, -1, 1_000),
            *(steps * (1.0 + shift) for shift in (0.0, 2e-16, -2e-16, 1e-9)),
            [0.0, 1e300, -math.inf],
        ]
    )
    out = np.zeros_like(x)
    tangents(x, out)
    true = np.tanh(x.astype(np.longdouble))
    assert (np.abs(out - true) <= 4 * np.spacing(np.abs(true).astype(float))).all()
    assert np.array_equal(np.signbit(out), np.signbit(x))
    assert math.isnan(hyperbolic_tangent.py_func(math.nan))
