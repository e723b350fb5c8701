"""Sine and cosine of the kernels against the C library's."""

import math

import numpy as np

from capture_sim.dynamics.trig import sine_cosine
from capture_sim.kernels import kernel


@kernel
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


def test_what_is_not_a_number_stays_so():
    assert math.isnan(sine_cosine(math.nan)[0])
    assert math.isnan(sine_cosine(math.inf)[1])
