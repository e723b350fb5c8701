"""Parameters fitted to noisy measurements: near the true ones by their own standard errors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from noisy_bench import NAMES, POSE_NOISE, noisy_run

import capture_sim
from capture_sim.dynamics.bench import Bench
from capture_sim.errors import SceneError
from capture_sim.run.given import Given
from capture_sim.run.run import MeasuredRun
from capture_sim.run.series import STATE, Series, series_in
from capture_sim.run.touches import located
from capture_sim.studies.fit.trial import scatter
from tests.one_trial import identify, is_explained

HERE = "tilt_0"


def test_a_noisy_run_gives_its_parameters_back():
    """Of the other experiments it is the whole command, see test_identify_bag.py."""
    run = noisy_run("tilt_m10", 2)
    fit = identify(run.scene, run.run, NAMES, touches=run.touches)
    assert is_explained(fit)
    # four errors of one run beyond 3.5 sigma happen once in 500
    assert np.abs((fit.values - run.true) / fit.errors).max() < 3.5
    # and they are worth something: rolling resistance to 0.1 %, damping to 1 %
    assert fit.errors[0] < 1e-3 * run.true[0]
    assert fit.errors[3] < 1e-2 * run.true[3]


@pytest.mark.long
def test_standard_errors_are_those_of_many_noises():
    # the same run seen 12 times: the fitted values scatter as the errors say
    fits = []
    for seed in range(12):
        run = noisy_run(HERE, seed, true=(0.001, 0.5, 0.33, 13.0))
        fits.append(identify(run.scene, run.run, ("mu", "c_A"), starts=1))
    spread = np.std([fit.values for fit in fits], axis=0, ddof=1)
    told = np.mean([fit.errors for fit in fits], axis=0)
    assert np.mean([fit.chi2 for fit in fits]) == pytest.approx(1.0, abs=0.1)
    # chi-square of 11: 0.1 % quantiles at 0.38 and 1.69
    assert np.all((spread / told > 0.38) & (spread / told < 1.69))


def test_model_that_is_wrong_is_not_believed():
    run = noisy_run(HERE, 4)
    scene = dataclasses.replace(run.scene, buffer=dataclasses.replace(run.scene.buffer, k_A=350.0))
    fit = identify(scene, run.run, ("mu",), starts=1)
    assert not is_explained(fit)
    assert fit.chi2 > 10.0


def test_parameter_that_the_data_do_not_tell_has_an_error_without_bound():
    # nothing has touched yet: friction of the tip cannot be known, rolling resistance can
    run = noisy_run(HERE, 5)
    fit = identify(run.scene, run.run, ("c_rr", "mu"), until=2.5)
    assert np.isinf(fit.errors[1])
    assert abs(fit.values[0] - run.true[0]) < 4.0 * fit.errors[0]


def test_any_number_of_the_scene():
    scene = capture_sim.load_scene("paper_designed")
    t = np.arange(0.0, 0.6, 0.01)
    true = dataclasses.replace(
        scene, buffer=dataclasses.replace(scene.buffer, k_A=530.0, k_T=190.0)
    )
    exact = series_in(Bench(true).advance(t))
    run = MeasuredRun(HERE, Given(series={name: {STATE: one} for name, one in exact.items()}))
    fit = identify(scene, run, ("buffer.k_A", "buffer.k_T"))
    assert fit.values == pytest.approx([530.0, 190.0], rel=1e-4)
    assert fit.scene.buffer.k_A == fit.values[0]


def test_noise_is_found_in_the_series():
    rng = np.random.default_rng(6)
    t = np.arange(0.0, 6.0, 0.01)
    smooth = np.stack([0.02 * np.sin(5.0 * t), 0.1 * t**2, np.where(t > 3.0, t - 3.0, 0.0)], axis=1)
    series = Series(t, smooth + rng.normal(size=smooth.shape) * np.array(POSE_NOISE))
    assert scatter(series) == pytest.approx(POSE_NOISE, rel=0.15)


@pytest.mark.parametrize(
    "names, said",
    [
        (("friction.nu",), "friction.nu: no number of tilt_0; did you mean friction.mu"),
        (("friction.law",), "parameter friction.law"),
        (("mu", "mu"), "must be given once"),
        (("stops.stiffness",), "stops.stiffness"),
        (
            ("run.t_end",),
            "parameter run.t_end: must be one of c_rr, e, mu, c_A, drag, or a number of the",
        ),
        (
            ("mu", "detector.capture_radius"),
            "parameter detector.capture_radius: .* not of run, detector, sensors",
        ),
        (("sensors.seed",), "sensors.seed"),
        (("probe.rod_mass",), "probe.rod_mass"),
        (("friction.mu.real",), "friction.mu.real"),
        (("string.hanging_mass",), "parameter string.hanging_mass: .* as recorded"),
    ],
)
def test_what_cannot_be_fitted_is_refused_in_one_line(names, said):
    run = noisy_run(HERE, 7)
    with pytest.raises(SceneError, match=said) as caught:
        identify(run.scene, run.run, names)
    assert "\n" not in str(caught.value)


def test_touches_behind_the_end_do_not_count():
    scene = capture_sim.load_scene("tilt_0")
    result = capture_sim.simulate(scene)
    touches = located(result.touches[:4]).with_noise(2e-4, 2.0)
    fit = identify(scene, result, ["buffer.k_A"], touches=touches, until=0.1, starts=1)
    assert fit.touches == 0
    assert fit.chi2 < 1.0
    assert fit.undetermined == ("buffer.k_A",)  # nothing touches so early
