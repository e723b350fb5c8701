"""Observed order of the integrators: error against length of the steps, in logarithms.

On each of several neighbouring scenes the run is made with ever finer settings; the slope
through the means of log(error) and log(length) is the order.  Means over scenes are needed
because where an event falls in its step is a matter of chance.

Steps that the error controls are uneven, and the error of a method of order p is the sum of
h^p h: what counts is the p-th mean of their length over time, not their number.  Unevenness dies
out as rtol falls (here from a spread of 10 % at 1e-9 to 5 % at 1e-12: the estimate swings with
the buffer, which is sampled ever more often), so against the number alone DOP853 seems to be of
order 8.5, on the same runs that show 8.1 at each rtol against the mean; SciPy's DOP853 in equal
steps of these lengths has 8.07 to 8.14.
"""

from dataclasses import replace

import numpy as np
import pytest

from capture_sim import Bench, load_scene
from capture_sim.dynamics.engine import loop
from capture_sim.dynamics.engine.state import StepStatus
from capture_sim.dynamics.samples import SAMPLE

#: Nominal order, setting of the run that is refined, and its values.
METHODS = {
    "dop853": (8, "rtol", np.logspace(-7, -11, 7)),
    # at a larger rtol stability limits the steps of order 5: the error falls, their length does not
    "dopri5": (5, "rtol", np.logspace(-9, -11, 5)),
    "rk4": (4, "step", np.logspace(-2.7, -3.7, 7)),
}


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


def mean_length(scene, t_end, order, **settings):
    """Mean of the steps' length over time, as an error of this order sees it, s."""
    settings = replace(scene.run, t_end=t_end + 1e-3, **settings)
    bench = Bench(replace(scene, run=settings))
    progress, step = bench._record["progress"], bench._record["step"]
    sample, ends = np.empty(1, SAMPLE), [0.0]
    while ends[-1] < t_end:
        # the engine's own call: by the bench's each step would cost ten times as much
        progress["n_log"] = 0
        just_after = np.array([np.nextafter(ends[-1], np.inf)])
        loop.advance(bench._workspace, just_after, sample, bench._trace_room)
        assert progress["status"] == StepStatus.SERVED
        ends.append(float(step["t1"]))
    h = np.diff(ends)
    return (np.sum(h ** (order + 1)) / h.sum()) ** (1.0 / order)


def observed(scenes, times, method, setting, values, order=None):
    """Slope of log(error) against log(setting), or against log(mean length) for an order."""
    errors, settings = np.zeros((2, len(scenes), len(values)))
    for i, scene in enumerate(scenes):
        exact, _ = run(scene, times, method="dop853", rtol=1e-13)
        for k, value in enumerate(values):
            chosen = {"method": method, setting: float(value)}
            q, _ = run(scene, times, **chosen)
            errors[i, k] = np.abs(q - exact).max()
            settings[i, k] = mean_length(scene, times[-1], order, **chosen) if order else value
    return np.polyfit(np.log(settings).mean(axis=0), np.log(errors).mean(axis=0), 1)[0]


def observed_order(scenes, method):
    order, setting, values = METHODS[method]
    uneven = order if setting == "rtol" else None
    return observed(scenes, np.linspace(0.0, 2.0, 100), method, setting, values, uneven)


@pytest.mark.parametrize("method", METHODS)
def test_order_on_a_smooth_scene(method):
    found = observed_order(list(spinning(8)), method)
    assert found == pytest.approx(METHODS[method][0], abs=0.2)


@pytest.mark.parametrize("method", METHODS)
def test_order_across_located_events(method):
    """The probe hits a stroke stop and leaves it: the force is smooth on each side."""
    stops = "stops={compression: 0.01, extension: 0.0006, stiffness: 2000, damping: 0}"
    scenes = list(spinning(12, [stops]))
    for scene in scenes:
        _, bench = run(scene, np.array([0.5]), rtol=1e-8)
        assert len(bench.events) in (3, 5)  # release, then the stop hit and left, once or twice
    found = observed_order(scenes, method)
    assert found == pytest.approx(METHODS[method][0], abs=0.2)


@pytest.mark.parametrize("method", ["dop853", "dopri5"])
def test_error_follows_the_tolerance_across_touches(method):
    """Behind a touch F ~ delta^1.5 makes the way ~ t^3.5: no order to be had, steps grade."""
    times = np.linspace(0.003, 0.01, 20)
    found = observed(list(bouncing(12)), times, method, "rtol", np.logspace(-6, -11, 6))
    assert found == pytest.approx(0.85, abs=0.2)


def test_fixed_steps_lose_order_at_touches():
    """The velocity is ~ t^2.5 behind a touch, so one step of it is wrong by h^2.5."""
    times = np.linspace(0.003, 0.01, 20)
    found = observed(list(bouncing(12)), times, "rk4", "step", np.logspace(-5, -6.5, 6))
    assert found == pytest.approx(2.5, abs=0.3)
