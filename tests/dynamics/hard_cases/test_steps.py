"""Bench.step: a loop of one's own, as by thrust and advance, in one cheap call."""

import numpy as np
import pytest

from capture_sim import Bench, SceneError, load_scene
from capture_sim.errors import SimulationError

FLYER = {
    "thrusters": {"chaser": {"force": 5.0, "torque": 1.0}, "target": {"force": 5, "torque": 1}}
}
BENCHES = {
    "free": ("paper_designed", FLYER),
    "rail": ("tilt_p10", FLYER | {"run.t_end": 4}),
    "tilted": ("tilt_p10", FLYER | {"approach.speed": 0.1, "floor.tilt_x": 3e-4, "run.t_end": 1}),
}


def wrench_at(k):
    """Change at each step, in some not at all, in some to none of a vehicle."""
    k -= k % 3
    target = (0.0, 0.0, 0.0) if k % 7 else (0.1 * np.sin(k), 0.0, 0.01)
    return (0.5 * np.cos(0.3 * k), 0.1 * np.sin(k), 0.0), tuple(map(float, target))


@pytest.mark.parametrize("name", BENCHES)
def test_steps_are_thrust_and_advance(name):
    scene = load_scene(*BENCHES[name])
    one, other = Bench(scene), Bench(scene)
    t, k = 0.0, 0
    while not one.done:
        found = one.step(*wrench_at(k), 0.004).copy()
        until = min(round(t + 0.004, 12), scene.run.t_end)
        if other.is_on_rail:
            other.pause_at(until)
        else:
            other.thrust(*wrench_at(k), until)
        expected = other.advance(np.array([until]))[0]
        assert found == expected
        t, k = other.t, k + 1
    assert other.done
    assert [(e.kind, e.t) for e in one.events] == [(e.kind, e.t) for e in other.events]
    assert np.array_equal(one.touches, other.touches)
    assert one.touches.size > 0
    assert one.step((0, 0, 0), (0, 0, 0), 1.0) == found  # the run has ended


@pytest.mark.parametrize(
    "arguments, says",
    [
        (((np.nan, 0.0, 0.0), (0.0, 0.0, 0.0), 0.01), "thrust = nan"),
        (((1.0, 0.0), (0.0, 0.0, 0.0, 0.0), 0.01), "thrust = 1.0, 0.0"),
        (((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0), "duration = 0.0 s: must be > 0"),
        (((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.nan), "duration = nan s: must be finite and > 0"),
    ],
)
def test_wrong_steps_are_refused_and_change_nothing(arguments, says):
    bench, same = (Bench(load_scene(*BENCHES["free"])) for _ in range(2))
    push = (0.3, 0.0, 0.0), (0.0, 0.0, 0.0), 0.01
    bench.step(*push)
    with pytest.raises(SceneError, match=says):
        bench.step(*arguments)
    same.step(*push)
    assert bench.step(*push) == same.step(*push)


def test_a_step_that_fails_says_so_again():
    bench = Bench(load_scene("paper_designed", FLYER | {"run.max_steps": 100}))
    still = (0.0, 0.0, 0.0)
    for _ in range(2):
        with pytest.raises(SimulationError, match="max_steps"):
            bench.step(still, still, 5.0)
