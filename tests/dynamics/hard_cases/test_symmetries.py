"""The same bench mirrored, turned, moved and in uniform motion gives the same run."""

import math

import numpy as np
import pytest
from set_ups import ON_THE_FLOOR, altered, run, turned

from capture_sim import load_scene

LAWS = ("tanh", "coulomb")


def bench(law, on_the_floor):
    """A scene with touches of face and edge, and where to look at it."""
    name = "tilt_p10" if on_the_floor else "paper_designed"
    changes = {"friction.law": law, "run.rtol": 1e-11, "run.t_end": 0.15}
    if on_the_floor:
        changes |= ON_THE_FLOOR | {"initial.chaser.x": 0.17, "initial.chaser.vx": 0.2}
    return altered(load_scene(name), changes)


def both(scene, changes):
    """The run as it is and the changed one, which must have the same events."""
    one, other = run(scene), run(altered(scene, changes))
    assert one.touches.size == other.touches.size > 2
    assert [e.kind for e in one.events] == [e.kind for e in other.events]
    assert other.touches["start"] == pytest.approx(one.touches["start"], abs=1e-9)
    assert other.touches["peak_force"] == pytest.approx(one.touches["peak_force"], rel=1e-6)
    return one, other


@pytest.mark.parametrize("on_the_floor", [False, True])
@pytest.mark.parametrize("law", LAWS)
def test_mirror_image(law, on_the_floor):
    """Exact: y and all angles change sign, +y wall and -y wall their places."""
    scene = bench(law, on_the_floor)
    c, t = scene.initial.chaser, scene.initial.target
    mirrored = {
        "initial.chaser.y": -c.y,
        "initial.target.y": -t.y,
        "initial.target.theta": -t.theta,
    }
    one, other = both(scene, mirrored)
    assert np.all(other.touches["wall"] == -one.touches["wall"])
    signs = np.array([1, -1, -1, -1, 1, 1, -1, -1])
    assert other.q[-1] * signs == pytest.approx(one.q[-1], abs=1e-10)
    assert other.v[-1] * signs == pytest.approx(one.v[-1], abs=1e-8)


@pytest.mark.parametrize("on_the_floor", [False, True])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("angle", [0.7, -2.0, math.pi / 2])
def test_bench_turned_and_moved_on_the_floor(angle, law, on_the_floor):
    """Exact: wherever and however the whole bench stands, its parts move alike."""
    scene = bench(law, on_the_floor)
    c, t = scene.initial.chaser, scene.initial.target
    away = np.array([3.0, -7.0])
    chaser, target = away + turned(angle, c.x, c.y), away + turned(angle, t.x, t.y)
    speed = turned(angle, c.vx, c.vy)
    moved = {
        "initial.chaser.x": float(chaser[0]),
        "initial.chaser.y": float(chaser[1]),
        "initial.chaser.vx": float(speed[0]),
        "initial.chaser.vy": float(speed[1]),
        "initial.chaser.theta": math.remainder(c.theta + angle, 2 * math.pi),
        "initial.target.x": float(target[0]),
        "initial.target.y": float(target[1]),
        "initial.target.theta": math.remainder(t.theta + angle, 2 * math.pi),
    }
    one, other = both(scene, moved)
    for places in ([0, 1], [5, 6]):
        expected = away + turned(angle, *one.q[-1, places])
        assert other.q[-1, places] == pytest.approx(expected, abs=1e-9)
    assert other.q[-1, 4] == pytest.approx(one.q[-1, 4], abs=1e-10)
    turn = other.q[-1, [2, 3, 7]] - one.q[-1, [2, 3, 7]] - angle
    assert np.cos(turn) == pytest.approx(1.0, abs=1e-15)
    assert np.sin(turn) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("drift", [(1.0, 0.0), (-0.3, 0.4)])
def test_uniform_motion_of_the_whole_bench(drift, law):
    """Exact (Galileo): a drift of all bodies adds to their places and changes nothing else."""
    scene = bench(law, False)
    c, t = scene.initial.chaser, scene.initial.target
    drifting = {
        "initial.chaser.vx": c.vx + drift[0],
        "initial.chaser.vy": c.vy + drift[1],
        "initial.target.vx": t.vx + drift[0],
        "initial.target.vy": t.vy + drift[1],
    }
    one, other = both(scene, drifting)
    back = other.q[-1].copy()
    back[[0, 5]] -= drift[0] * other.t[-1]
    back[[1, 6]] -= drift[1] * other.t[-1]
    assert back == pytest.approx(one.q[-1], abs=1e-10)


@pytest.mark.parametrize("t_end", [1e-15, 1e-12, 1e-9, 9e-4])
def test_run_of_next_to_no_time(t_end):
    """Exact: uniform motion up to the first touch; the run ends where it is told to."""
    result = run(load_scene("paper_designed"), t_end=t_end, t_eval=[0.0, t_end])
    assert result.failure == ""
    assert [e.kind.label for e in result.events] == ["release", "end"]
    assert result.events[-1].t == t_end
    assert result.q[-1, 0] == pytest.approx(0.1 * t_end, rel=1e-12)
