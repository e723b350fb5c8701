"""How exact the default run is, over random benches, and how well a run knows it.

Errors are those of the coordinates in metres, angles counted by their arm, against the same
engine at rtol 1e-12; the order-5 pair at 1e-12 confirms that reference, and
test_second_formulation.py the equations.
"""

from dataclasses import replace

import numpy as np
import pytest
from cases import cases
from random_accuracy import (
    GRID,
    against_itself,
    difference,
    residual,
    residual_ratios,
    run,
    sequence,
)
from random_scenes import random_scenes

from capture_sim import load_scene, scene_names, simulate

#: CAPTURE_SIM_CASES=200 tries more.
SCENES = cases(few=80, all=80)
#: m: what the default promises, up to 0.35 s after the first touch (measured: 2e-8).
PROMISED = 1e-6
#: The check, a run at rtol / 100, tells the error to this factor, down to the floor below
#: (docs/evidence/random_scenes.md).
TRUST = 20.0
#: m: a vehicle on its supports that creeps about the limit of rest may stop or not; each time
#: up to 5 v_eps of its speed are in doubt.
FLOOR = 5e-8


@pytest.fixture(scope="module")
def measured():
    return [against_itself(scene) for scene in random_scenes(SCENES)]


def test_default_keeps_its_promise(measured):
    errors = np.array([m.error for m in measured])
    assert errors[:, 1].max() < PROMISED
    assert np.median(errors[:, 1]) < 1e-9
    # later, the promise holds wherever the touches themselves are well conditioned
    for m in measured:
        assert m.error[2] < PROMISED or m.flagged or m.estimate[2] > PROMISED / TRUST
    assert np.mean(errors[:, 2] < PROMISED) > 0.97
    assert max(m.peak for m in measured if not m.wrong) < 1e-4


def test_check_knows_the_error(measured):
    for m in measured:
        floor = FLOOR if m.on_floor else 1e-12
        assert np.all(m.error < TRUST * m.estimate + floor)
    ratios = np.array([m.error / m.estimate for m in measured if not m.on_floor])
    assert np.median(ratios) == pytest.approx(1.0, abs=0.2)


def test_no_wrong_touch_sequence_goes_unflagged(measured):
    assert not [m for m in measured if m.wrong and not m.flagged]


@pytest.fixture(scope="module")
def doubtful():
    """Benches whose touches may depend on the tolerance, with their exact runs.

    199 lifts off by a nanometre or not at all; at the throat's edges an error of 569 grows 2.5-fold
    with every touch.
    """
    scenes = random_scenes(570, seed=21)
    chosen = (scenes[199], scenes[569], *scenes[: SCENES // 2])
    return [(scene, run(scene, GRID, 1e-12)) for scene in chosen]


@pytest.mark.parametrize("rtol", [1e-4, 1e-5, 1e-6, 1e-8])
def test_no_wrong_run_goes_unflagged_at_any_tolerance(rtol, doubtful):
    """The touches of some benches depend on the tolerance; which ones do, on the processor too.

    Of 402 benches, 187 runs were wrong at 1e-4, 23 at 1e-5, 6 at 1e-6.
    """
    for scene, exact in doubtful:
        checked = run(scene, GRID, rtol, check=True)
        is_wrong = sequence(checked) != sequence(exact)
        is_wrong |= bool(difference(checked, exact).max() > PROMISED)
        is_flagged = not checked.check.same_touches or checked.check.error[-1] > PROMISED / TRUST
        assert is_flagged or not is_wrong


def test_both_pairs_converge_to_the_same_run():
    for scene in random_scenes(SCENES)[::20]:
        times = np.arange(0.0, 0.45, 5e-3)
        one, other = (run(scene, times, 1e-12, method) for method in ("dop853", "dopri5"))
        assert sequence(one) == sequence(other)
        assert difference(one, other).max() < (FLOOR if scene.supports else 1e-11)


def test_energy_residual_tracks_the_error_of_random_benches():
    """In all but a few; it does not see how bouncing makes an error grow."""
    scenes = [scene for scene in random_scenes(60) if scene.supports is None]
    ratios = [ratio for scene in scenes for ratio in residual_ratios(scene)]
    inside = [0.01 < ratio < 100.0 for ratio in ratios]
    assert np.mean(inside) > 0.95
    assert np.median(ratios) == pytest.approx(1.0, rel=0.6)


@pytest.mark.parametrize(
    "overrides",
    [
        ["run.method=rk4", "run.step=2e-5"],
        ["run.rtol=1e-13"],
        ["run.rtol=1e-12"],
    ],
)
def test_check_never_compares_a_run_with_itself(overrides):
    """Fixed steps have no tolerance to refine, and below 1e-13 there is none left."""
    scene = load_scene("paper_designed", overrides)
    checked = simulate(scene, t_end=0.35, check=True)
    exact = simulate(
        load_scene("paper_designed", ["run.rtol=1e-12", "run.method=dopri5"]), t_end=0.35
    )
    error = difference(checked, exact).max()
    assert checked.check.error[-1] > error / TRUST - 1e-12


@pytest.mark.parametrize("method", ["dop853", "dopri5", "rk4"])
def test_a_refined_run_has_other_settings(method):
    for divisors in ((100.0, 4.0), (2.0, 2.0)):  # of simulate and sweep
        for rtol, step in ((1e-8, 2e-5), (1.5e-13, 1.5e-9), (1e-13, 1e-9)):
            run = load_scene("paper_designed").run
            settings = replace(run, method=method, rtol=rtol, step=step)
            refined = settings.refined(*divisors)
            assert refined != settings
            assert refined.rtol <= rtol
            assert refined.step <= step


@pytest.mark.parametrize("name", scene_names())
def test_energy_ledger_closes_at_a_tight_tolerance(name):
    """To 1e-9 of the largest kinetic energy, over the whole run, at rtol 1e-10."""
    assert residual(simulate(load_scene(name, ["run.rtol=1e-10"]))) < 1e-9
