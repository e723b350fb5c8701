"""The verdict of a flight: holding, backing off and a second attempt are ordinary."""

import math
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from cases import cases

from capture_sim import load_scene, simulate
from capture_sim.detection.criteria import CaptureState
from capture_sim.dynamics.drive import Control
from capture_sim.dynamics.samples import EventKind
from capture_sim.run.simulation import RunError

sys.path.append(str(Path(__file__).parents[2] / "examples"))
from docking_controller import command as docking

EXAMPLE = Path(__file__).parents[2] / "examples" / "free_flyer.yaml"
#: Closest approach at which the latch of the example closes, m.
LATCH = 0.003


def vehicle(sample, at):
    heading = sample["q"][at + 2]
    c, s = math.cos(heading), math.sin(heading)
    u, v, spin = sample["v"][at : at + 3]
    half = 0.5 * heading
    return (
        *(sample["q"][at], sample["q"][at + 1], math.sin(half), math.cos(half)),
        *(c * u + s * v, c * v - s * u, spin),
    )


def flight(plan):
    """Return a control whose speed along the axis, m/s, is a function of time and gap, m.

    None: the example's own controller flies, which coasts once it has touched.
    """
    touched = [False]

    def command(sample):
        touched[0] = touched[0] or bool(sample["touches"])
        chaser, target = vehicle(sample, 0), vehicle(sample, 5)
        speed = plan(float(sample["t"]), float(sample["tip_axial"]))
        if speed is None:
            return docking(chaser, target, touched[0]), None
        fx, fy, tz = docking(chaser, target, False)
        along = 60.0 * (speed - 0.1)  # of the example's law, for another speed
        return (fx + along, fy, tz), None

    return Control(command)


def flown(plan, t_end=40.0, **changes):
    return simulate(EXAMPLE, {"run.t_end": t_end, **changes}, control=flight(plan))


def is_latched(run):
    return any(event.kind is EventKind.LATCHED for event in run.events)


PLANS = {
    "at once": lambda t, gap: None,
    "waits 3 s": lambda t, gap: 0.0 if t < 3.0 else None,
    "holds 8 s on the way": lambda t, gap: 0.0 if gap < 0.1 and t < 12.0 else None,
    "backs off first": lambda t, gap: -0.05 if t < 3.0 else None,
    "backs off at the cone": lambda t, gap: (
        0.1 if t < 1.0 else -0.05 if t < 5.0 else 0.0 if t < 8.0 else None
    ),
}


@pytest.mark.parametrize("name", PLANS)
def test_a_docking_is_captured_whenever_it_happens(name):
    run = flown(PLANS[name])
    assert is_latched(run)
    assert run.verdict == "captured"
    states = [status.state for status in run.statuses]
    final = [status.final for status in run.statuses]
    assert final.index(True) == states.index(CaptureState.CAPTURED)


def test_states_before_a_docking_are_named_and_left():
    run = flown(PLANS["backs off at the cone"])
    states = list(dict.fromkeys(status.state for status in run.statuses))
    assert states[-1] is CaptureState.CAPTURED
    left = {CaptureState.MISSED, CaptureState.STUCK, CaptureState.REBOUND} & set(states)
    assert left


def test_a_flight_that_never_comes_is_missed_or_stuck():
    for plan, verdict in ((lambda t, gap: -0.05, "missed"), (lambda t, gap: 0.0, "stuck")):
        run = flown(plan, t_end=12.0)
        assert not is_latched(run)
        assert run.verdict == verdict
        assert run.statuses[-1].final


def test_random_flights_have_the_verdict_of_their_motion():
    """Speeds that change at random: captured where the latch has closed or the tip stayed."""
    source = np.random.default_rng(3)
    for _ in range(cases(few=12, all=500)):
        ends = np.cumsum(source.uniform(0.5, 6.0, 6))
        speeds = source.choice([0.0, -0.05, 0.1, 0.1, None], 6)

        def plan(t, gap, ends=ends, speeds=speeds):
            k = int(np.searchsorted(ends, t))
            return None if k == len(speeds) else speeds[k]

        run = flown(plan)
        near = run.samples["tip_distance"] < 0.005
        edges = np.flatnonzero(np.diff(np.concatenate([[0], near, [0]])))
        stays = [run.samples["t"][b - 1] - run.samples["t"][a] for a, b in edges.reshape(-1, 2)]
        was_captured = is_latched(run) or max(stays, default=0.0) > 0.22
        axial, lateral = run.samples["tip_axial"], run.samples["tip_lateral"]
        behind = np.flatnonzero((axial[1:] < 0.0) & (axial[:-1] >= 0.0))
        inside = np.abs(lateral[behind]) < load_scene(EXAMPLE).cone.R_c  # of the throat
        passed = inside.any()
        assert (run.verdict == "captured") == (was_captured or passed), (ends, speeds)


# a command that is none


@pytest.mark.parametrize(
    "wrong",
    [
        ((math.nan, 0.0, 0.0), None),
        ((math.inf, 0.0, 0.0), None),
        ((0.0, 0.0), None),
        ((0.0, 0.0, 0.0, 0.0), None),
        (("a", 0.0, 0.0), None),
        None,
        (None,),
        3.0,
    ],
)
def test_a_wrong_command_is_one_warning_and_no_thrust(wrong):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run = simulate(EXAMPLE, {"run.t_end": 1.0}, control=Control(lambda sample: wrong))
    [warning] = [w for w in caught if w.category is RuntimeWarning]
    assert "command of the controller at 0 s" in str(warning.message)
    assert "must be finite" in str(warning.message)
    assert np.abs(run.samples["v"]).max() < 1e-12


def test_a_controller_that_raises_ends_the_run_and_keeps_it():
    def command(sample):
        if sample["t"] > 0.3:
            raise ZeroDivisionError("of mine")
        return (0.1, 0.0, 0.0), None

    with pytest.raises(RunError, match="ZeroDivisionError: of mine") as error:
        simulate(EXAMPLE, {"run.t_end": 1.0}, control=Control(command))
    assert "controller at 0.32 s" in str(error.value)
    assert error.value.result.samples["t"][-1] == pytest.approx(0.32)


def test_launched_trials_keep_their_final_verdicts():
    run = simulate(load_scene("tilt_p10"))
    final = [status.final for status in run.statuses]
    assert final.index(True) < len(final) - 1
