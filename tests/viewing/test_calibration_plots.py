"""Plots of a calibration: one for each trial, whatever its file is called."""

from types import SimpleNamespace

import pytest

from capture_sim.viewing import calibration


@pytest.mark.parametrize(
    "files",
    [
        ["a.mcap", "b.mcap"],
        ["x/a.mcap", "y/a.mcap", "z/a.mcap"],
        ["a_2.mcap", "x/a.mcap", "y/a.mcap"],
        ["prediction.mcap", "correlation.mcap", ""],
    ],
)
def test_every_trial_has_its_figure(files, monkeypatch):
    monkeypatch.setattr(calibration, "_draw_trial", lambda _, number: number)
    monkeypatch.setattr(calibration, "_draw_values", lambda _: "values")
    monkeypatch.setattr(calibration, "_draw_correlation", lambda _: "correlation")
    monkeypatch.setattr(calibration, "_draw_prediction", lambda _: "prediction")
    trials = [SimpleNamespace(name=file) for file in files]
    found = SimpleNamespace(
        problem=SimpleNamespace(trials=trials), names=["k_A", "c_A"], prediction="to come"
    )
    figures = calibration.draw_calibration(found)
    assert figures.pop("values") == "values"
    assert figures.pop("correlation") == "correlation"
    assert figures.pop("prediction") == "prediction"
    assert list(figures.values()) == list(range(len(files)))
