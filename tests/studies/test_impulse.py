"""A load cell that is too slow to show touches: the impulse of the contact, and the cell's gain."""

from __future__ import annotations

import dataclasses

import dirty
import numpy as np
import pytest
from measured_trials import measured_trial, short_scene

import capture_sim
from capture_sim.dynamics.bench import Bench
from capture_sim.run.run import Run
from capture_sim.run.series import Series
from capture_sim.scene.paths import with_values
from capture_sim.studies.fit.calibrate import calibrate
from capture_sim.studies.fit.impulse import MeasuredImpulse, impulse_of
from capture_sim.studies.fit.trial import simulate, trial_of, view

#: Interval of the dense samples, s, and how long the bench rests before the trial.
DENSE, BEFORE = 2e-5, 0.5
NAMES = ("e", "mu", "buffer.k_A")


def forces(samples: np.ndarray) -> np.ndarray:
    """Return the force on the tip by the cone, (n, 2), N, in the cone's axes."""
    x, y = (samples["contact_force"] + samples["latch_force"]).T
    c, s = np.cos(samples["q"][:, 7]), np.sin(samples["q"][:, 7])
    return np.stack([c * x + s * y, c * y - s * x], axis=1)


def trial_with_cell(angle, rate, bandwidth, seed, *, gain=1.0, true=None, before=BEFORE) -> Run:
    """Return a trial with a cell of some rate and bandwidth (Hz; 0: without a filter)."""
    from scipy.signal import butter, lfilter

    scene, true = short_scene(angle), true or {}
    rng = np.random.default_rng(seed)
    samples = Bench(with_values(scene, true)).advance(np.arange(0.0, scene.run.t_end, DENSE))
    quiet = int(before / DENSE)
    force = np.concatenate([np.zeros((quiet, 2)), forces(samples)])
    if bandwidth:
        force = lfilter(*butter(2, bandwidth, fs=1.0 / DENSE), force, axis=0)
    every = int(1.0 / (rate * DENSE))
    first = int(rng.integers(every))
    force = gain * force[first::every]
    t = DENSE * (np.arange(force.shape[0]) * every + first - quiet)
    noisy = force + 0.2 * rng.normal(size=force.shape) + [0.5, -0.3]
    run = measured_trial(scene, true, seed, name=f"trial {angle}")
    return run.replaced(series={**run.series, "cone_force": {"a cell": Series(t, noisy)}})


def test_the_impulse_of_a_simulation_is_the_integral_of_its_force():
    """The target's momentum and what the floor took, against 50 000 samples of the force."""
    more = {"floor.tilt_x": 2e-4, "target.drag": 0.2, "target.cable_y": 0.02}
    scene = with_values(short_scene(0.15), more)
    dense = Bench(scene).advance(np.arange(0.0, 0.6, DENSE))
    sparse = Bench(scene).advance(np.arange(0.0, 0.6, 2e-3))
    begin, end = 0.01, 0.3
    inside = (sparse["t"] >= begin) & (sparse["t"] <= end)
    found = MeasuredImpulse(begin, end, np.zeros(2), np.ones(2)).of_samples(
        sparse[inside], sparse["t"][inside], scene
    )
    window = (dense["t"] >= sparse["t"][inside][0]) & (dense["t"] <= sparse["t"][inside][-1])
    force = (dense["contact_force"] + dense["latch_force"])[window]
    angle = dense["q"][window][0, 7]
    c, s = np.cos(angle), np.sin(angle)
    x, y = DENSE * (0.5 * (force[1:] + force[:-1])).sum(axis=0)
    assert found == pytest.approx([c * x + s * y, c * y - s * x], rel=2e-3)


@pytest.mark.parametrize(
    "rate, bandwidth",
    [(200.0, 40.0), (1000.0, 200.0), (1000.0, 0.0), (5000.0, 1000.0), (10000.0, 50.0)],
)
def test_the_impulse_is_known_at_any_rate_and_bandwidth(rate, bandwidth):
    off = []
    for seed in range(6):
        trial = trial_of(
            trial_with_cell(0.15 * (seed % 2), rate, bandwidth, seed), has_impulse=True
        )
        assert trial.impulse is not None
        motion = simulate(trial, {}, np.zeros(7), {})
        off.append((trial.impulse.value - motion.impulse) / trial.impulse.sigma)
        if bandwidth:  # without a filter half of the touches fall between two samples
            assert np.hypot(*trial.impulse.sigma) < 0.08 * np.hypot(*trial.impulse.value)
    assert np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.abs(off).max() < 4.0


def test_the_gain_of_a_cell_is_found_and_moves_nothing_else():
    """A cell that reads 5 % too much says so; the restitution does not take it."""
    true = {"contact.restitution": 0.6, "friction.mu": 0.27}
    trials = [
        trial_with_cell(a, 1000.0, 200.0, k, gain=1.05, true=true)
        for k, a in enumerate((0.0, 0.15))
    ]
    found = calibrate(trials, NAMES, restarts=1)
    assert any("only the impulse of the contact is used" in note for note in found.notes)
    gain = {one.name: one for one in found.held}["scale.force"]
    assert abs(gain.fitted - 1.05) < 3.0 * gain.known_to < 0.06
    truth = [0.6, 0.27, trials[0].scene.buffer.k_A]
    assert np.abs((found.values - truth) / found.errors).max() < 4.0
    assert "scale.force" not in {
        one.name for one in calibrate(trials, NAMES, restarts=0, touches=0).held
    }


def test_touches_of_a_cell_that_reads_too_much_are_its_gains():
    """The derivative by the gain is that of the residuals, of touches and of an impulse."""
    from capture_sim.run.touches import located
    from capture_sim.studies.fit.trial import residuals, sensor_column

    run = trial_with_cell(0.0, 1000.0, 200.0, 1)
    whole = trial_of(run, has_impulse=True)
    motion = simulate(whole, {}, np.zeros(7), {})
    met = located(motion.touches).of(slice(3)).with_default_noise(1e-4, 1.0)
    sampled = dataclasses.replace(met, spacing=2e-5)
    for trial in (whole, dataclasses.replace(whole, impulse=None, touches=sampled)):
        seen = view(trial, motion, np.zeros(7), {})
        more = view(trial, motion, np.zeros(7), {"scale.force": 1.01})
        step = residuals(trial, motion, more, 0.0) - residuals(trial, motion, seen, 0.0)
        assert sensor_column(trial, motion, seen, "scale.force") * 0.01 == pytest.approx(step)
        assert np.any(step)


@pytest.mark.parametrize(
    "kind, said",
    [
        ("plain", "only the impulse of the contact is used"),
        ("cell_inverted", "is not used, since it is doubted (force_impulse)"),
    ],
)
def test_a_force_that_is_doubted_moves_no_value(kind, said, tmp_path):
    scene = capture_sim.load_scene("tilt_p10")
    run = capture_sim.read_run(dirty.write(tmp_path, kind), scene=scene)
    found = calibrate([run], ["mu"], restarts=0, until=3.2)
    assert any(said in note for note in found.notes)


def test_a_force_with_a_hole_in_the_contact_or_too_few_samples_has_no_impulse():
    run = trial_with_cell(0.0, 1000.0, 200.0, 1)
    (cell,) = run.series["cone_force"].values()
    assert impulse_of(run, 1.0) is not None
    for kept in ((cell.t < 0.03) | (cell.t > 0.04), np.arange(cell.t.size) % 20 == 0):
        holed = {"a cell": Series(cell.t[kept], cell.values[kept])}
        assert impulse_of(run.replaced(series={**run.series, "cone_force": holed}), 1.0) is None


def test_a_force_that_begins_in_the_contact_has_no_impulse():
    run = trial_with_cell(0.0, 1000.0, 200.0, 1, before=0.0)
    late = {name: Series(s.t - 0.1, s.values) for name, s in run.series["cone_force"].items()}
    assert impulse_of(run.replaced(series={**run.series, "cone_force": late}), -0.07) is None
