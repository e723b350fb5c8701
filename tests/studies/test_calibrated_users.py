"""Sweeps, designs and comparisons use the covariance of a calibration."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from measured_trials import measured_trial, short_scene

from capture_sim.errors import SceneError
from capture_sim.studies.fit import prediction
from capture_sim.studies.fit.files import (
    KIND,
    Calibrated,
    calibrated_dispersions,
    read_calibrated,
)
from capture_sim.studies.fit.new_trial import agreement_of
from capture_sim.studies.fit.parameters import parameters_of
from capture_sim.studies.fit.prediction import Placement
from capture_sim.studies.vary.inputs import read_input
from capture_sim.studies.vary.sampling import make_samples

NAMES = ("c_rr", "mu", "buffer.k_A")
VALUES = np.array([1e-3, 0.27, 560.0])
ERRORS = np.array([1e-6, 1e-3, 0.5])
CORRELATION = np.array([[1.0, 0.3, 0.0], [0.3, 1.0, -0.9], [0.0, -0.9, 1.0]])
BENCH = Calibrated("file", NAMES, VALUES, CORRELATION * np.outer(ERRORS, ERRORS), True, ())
TRUE = {"friction.mu": 0.27, "buffer.k_A": 560.0}


def test_draws_have_the_covariance_of_the_calibration():
    vary, correlations = calibrated_dispersions(BENCH)
    axes = [read_input(short_scene(), name, given) for name, given in vary.items()]
    rows = np.array(make_samples(axes, 4000, correlations=correlations).rows)
    names = [axis.name for axis in axes]
    assert names == ["supports.chaser.c_rr", "supports.target.c_rr", "friction.mu", "buffer.k_A"]
    # both vehicles have one rolling resistance
    assert np.abs(rows[:, 0] - rows[:, 1]).max() < 1e-3 * ERRORS[0]
    found = np.cov(rows[:, 1:].T)
    scale = np.outer(ERRORS, ERRORS)
    assert np.abs(found - BENCH.covariance).max() < np.inf
    assert np.abs((found - BENCH.covariance) / scale).max() < 0.1  # 4000 draws: 0.022 each


def test_what_a_design_chooses_is_left_out_of_the_draws():
    vary, correlations = calibrated_dispersions(BENCH, ("buffer.k_A",))
    assert "buffer.k_A" not in vary
    assert all("buffer.k_A" not in pair for pair in correlations)
    assert ("supports.chaser.c_rr", "friction.mu") in correlations


def written(tmp_path, **changes):
    data = {
        "kind": KIND,
        "names": list(NAMES),
        "values": VALUES.tolist(),
        "covariance": BENCH.covariance.tolist(),
        "is_found": False,
        "findings": [{"text": "not converged", "advice": "weigh one"}],
    }
    (tmp_path / "calibration.json").write_text(json.dumps({**data, **changes}))
    return tmp_path


def test_a_calibration_is_read_from_its_folder(tmp_path):
    read = read_calibrated(written(tmp_path))
    assert read.names == NAMES
    assert read.covariance == pytest.approx(BENCH.covariance)
    assert read.findings == ("not converged; weigh one",)


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"kind": "another"}, "must be a calibration.json of capture-sim calibrate"),
        ({"values": [1.0]}, "do not belong together"),
        ({"covariance": (-np.eye(3)).tolist()}, "must have no negative variance"),
        ({"values": [1.0, None, 2.0]}, "do not belong together|must be a calibration"),
    ],
)
def test_what_is_no_calibration_is_refused_in_one_line(tmp_path, changes, said):
    with pytest.raises(SceneError, match=said) as caught:
        read_calibrated(written(tmp_path, **changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "true, shift, said",
    [
        (TRUE, (0.0, 0.0, 0.0), "the trial agrees with the calibration"),
        ({**TRUE, "buffer.k_A": 570.0}, (0.0, 0.0, 0.0), "its parameters differ"),
        (TRUE, (0.0, 5e-3, 0.0), "its vehicles were not placed to each other as the scene says"),
    ],
)
def test_a_trial_is_compared_with_a_calibrated_bench(true, shift, said):
    run = measured_trial(short_scene(0.1), true, 3, shift=shift)
    found = agreement_of(run, BENCH, Placement(2e-4, 1e-3))
    assert said in found.sentence
    assert found.agrees == (said == "the trial agrees with the calibration")


def test_a_parameter_may_be_known_exactly():
    covariance = BENCH.covariance.copy()
    covariance[0] = covariance[:, 0] = 0.0
    exact = replace(BENCH, covariance=covariance)
    run = measured_trial(short_scene(0.1), TRUE, 3)
    with np.errstate(all="raise"):
        found = agreement_of(run, exact, Placement(2e-4, 1e-3))
    assert found.agrees
    assert found.parameters.freedom <= 2
    assert found.furthest != "c_rr"


@pytest.mark.parametrize("placement", [None, Placement(1e-4, 1e-4)])
def test_a_draw_is_simulated_once_for_each_kind_of_error(monkeypatch, placement):
    simulated = []

    def counted(scene):
        simulated.append(scene)
        if len(simulated) == 5:
            raise SceneError("a draw that fails")
        return run(scene)

    run = prediction._run
    monkeypatch.setattr(prediction, "_run", counted)
    scene = short_scene(0.1)
    parameters = parameters_of(scene, NAMES)
    place = np.array([p.position(p.begin) for p in parameters])
    found = prediction.predict(scene, parameters, place, 1e-6 * np.eye(3), placement, draws=6)
    assert found.failed == 1
    # the bench itself, then each draw without and perhaps with errors of the placement
    assert len(simulated) == (1 + 6 if placement is None else 1 + 2 * 6)
    if placement is None:
        assert all(f.error == f.spread for f in found.figures if not math.isnan(f.value))
