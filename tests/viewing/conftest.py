"""Runs that many tests draw; none changes them."""

from __future__ import annotations

import pytest

import capture_sim


@pytest.fixture(autouse=True)
def pictures():
    """Here they are looked at."""


@pytest.fixture(scope="session")
def runs():
    """The target at 0, +10 and -10 degrees."""
    names = ("tilt_0", "tilt_p10", "tilt_m10")
    return [capture_sim.simulate(capture_sim.load_scene(name)) for name in names]


@pytest.fixture(scope="session")
def undamped():
    """Many touches, and a rebound."""
    return capture_sim.simulate(capture_sim.load_scene("paper_undamped"))
