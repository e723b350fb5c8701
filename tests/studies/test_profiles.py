"""Profiles of a fit: where the standard error is right, and where it is not."""

import math

import numpy as np
import pytest
from measured_trials import measured_trial, short_scene

from capture_sim import SceneError, calibrate
from capture_sim.studies.fit.profiles import DISTANCES, Profile, check_profiled

TRUE = {"contact.restitution": 0.6, "friction.mu": 0.27, "buffer.k_A": 560.0}


def test_the_error_of_a_good_fit_is_right():
    trials = [measured_trial(short_scene(angle), TRUE, n) for n, angle in enumerate((0.0, 0.1))]
    names = ["e", "mu", "buffer.k_A"]
    found = calibrate(trials, names, restarts=0, profile=["buffer.k_A"])
    (profile,) = found.profiles
    assert profile.is_gaussian, profile.text
    # the value stays fixed while the others are fitted anew: else the search would go back
    assert profile.rises == pytest.approx(np.square(DISTANCES), rel=0.45)
    assert profile.values == pytest.approx(profile.value + np.array(DISTANCES) * profile.error)
    low, high = profile.interval(1.0)
    assert (high - low) / 2.0 == pytest.approx(profile.error, rel=0.15)


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("shift", [-0.7, 0.0, 0.2])
def test_a_parabola_shows_its_error_and_its_vertex(factor, shift):
    """A standard error that is the true one times a factor, of a search that ended beside."""
    distances = np.array(DISTANCES) * factor
    rises = (distances - shift) ** 2 - shift**2
    profile = Profile("x", "m", 0.0, factor, distances, rises)
    assert profile.is_gaussian == (factor == 1.0 and shift != -0.7)


def test_ctrl_c_in_a_profile_keeps_the_fit():
    trials = [measured_trial(short_scene(), {"friction.mu": 0.27}, 0)]
    counts = []
    calibrate(trials, ["mu"], restarts=0, report=lambda done, _: counts.append(done))

    def interrupt(done, _):
        if done > counts[-1]:
            raise KeyboardInterrupt

    found = calibrate(trials, ["mu"], restarts=0, profile=["mu"], report=interrupt)
    assert [finding.kind for finding in found.findings] == ["unfinished"]
    assert found.profiles == ()
    assert abs(found.values[0] - 0.27) < 4.0 * found.errors[0]


def test_an_error_that_is_wrong_gives_way_to_an_interval():
    """chi2 of a quantity of which only the square is measured: (x^2 - 1)^2 / s^2."""
    sigma, error = 1.6, 0.8
    values = 1.0 + np.array(DISTANCES) * error
    profile = Profile("x", "m", 1.0, error, values, (values**2 - 1.0) ** 2 / sigma**2)
    assert not profile.is_gaussian
    assert "the error is wrong; 95 % interval" in profile.text
    exact = math.sqrt(1.0 + sigma)
    assert profile.interval(1.0)[1] == pytest.approx(exact, abs=0.1)


def test_what_cannot_be_simulated_has_no_end():
    rises = np.array([math.inf, 1.0, 1.0, 4.0])
    profile = Profile("x", "1", 0.5, 0.4, 0.5 + np.array(DISTANCES) * 0.4, rises)
    assert not profile.is_gaussian
    assert profile.interval(2.0) == (-math.inf, pytest.approx(1.3))
    better = profile._replace(rises=np.array([-3.0, 1.0, 1.0, 4.0]))
    assert "a better fit is there" in better.text


def test_what_is_not_fitted_has_no_profile():
    for names in (["chaser.mass"], ["e", "e"]):
        with pytest.raises(SceneError, match=r"must be one of the fitted parameters, once: e, mu"):
            check_profiled(names, ["e", "mu"])
