"""No touch, latch or stop is stepped over, however short it is and wherever it lies."""

import math

import numpy as np
import pytest
from set_ups import (
    ADAPTIVE,
    METHODS,
    ON_THE_FLOOR,
    altered,
    anvil,
    first,
    outer_lip,
    run,
    slowed,
    times,
)

from capture_sim import Bench, load_scene, simulate
from capture_sim.scene.parts import Latch, Stops


def flying_by(overlap, ahead, changes, base="paper_designed"):
    """The tip flies past the outer lip of the -y wall, which it overlaps by ``overlap``.

    ``ahead`` (m) is the way to where the lip lies abeam.
    """
    scene = load_scene(base)
    x, y = outer_lip(scene, -1.0)
    reach = scene.buffer.hinge_offset + scene.rest_length
    there = {
        "friction.law": "none",
        "contact.law": "exact",
        "contact.restitution": 1.0,
        "target.mass": 1e6,
        "target.inertia": 1e6,
        "initial.chaser.x": 0.0,
        "initial.chaser.y": 0.0,
        "initial.target.x": reach + ahead - x,
        "initial.target.y": scene.probe.tip_radius - overlap - y,
        "run.state_rate": 1.0,
        "run.rate": 1.0,
    }
    return altered(scene, there | changes)


def way_to_touch(overlap, ahead, radius=0.015):
    """Way of the tip until it touches the lip it overlaps, m: half a chord less."""
    return ahead - math.sqrt(radius**2 - (radius - overlap) ** 2)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("overlap", [1e-14, 1e-12, 1e-9, 1e-6, 1e-3, 5e-3, 1.49e-2])
def test_tip_that_grazes_the_lip_touches_it(overlap, method):
    """A touch of 40 nm to 30 mm of way anywhere in a flight of up to 0.6 m.

    Exact: place of the first touch by Pythagoras.  Near the graze it is ill-conditioned
    (half a chord is the root of the overlap), so rounding of places counts by its square
    root.
    """
    rng = np.random.default_rng(7)
    error = 1e-12 + 2e-16 * 0.015 / math.sqrt(2 * 0.015 * overlap)
    for _ in range(5):
        speed = 10 ** rng.uniform(-3 if method != "rk4" else -0.5, 1)
        ahead = rng.uniform(0.05, 0.4)
        how = {"run.method": method, "initial.chaser.vx": speed, "run.t_end": 1.5 * ahead / speed}
        result = run(flying_by(overlap, ahead, how), t_eval=[])
        began = times(result, "touch")
        assert began.size >= 1, f"missed at {speed} m/s over {ahead} m"
        assert began[0] * speed == pytest.approx(way_to_touch(overlap, ahead), abs=error)


@pytest.mark.parametrize("method", METHODS)
def test_tip_that_just_misses_the_lip_does_not_touch_it(method):
    """Exact: no touch, and a tip whose motion has not changed by a bit."""
    rng = np.random.default_rng(8)
    for clearance in (1e-14, 1e-12, 1e-9, 1e-6):
        speed, ahead = 10 ** rng.uniform(-0.5, 1), rng.uniform(0.05, 0.4)
        how = {"run.method": method, "initial.chaser.vx": speed, "run.t_end": 1.5 * ahead / speed}
        result = run(flying_by(-clearance, ahead, how))
        assert result.failure == ""
        assert result.touches.size == 0
        assert np.all(result.v == result.v[0])


@pytest.mark.parametrize("method", ADAPTIVE)
@pytest.mark.parametrize("overlap", [1e-9, 1e-6, 1e-3, 1e-2])
def test_touch_is_found_by_a_tip_that_starts_without_speed(overlap, method):
    """The target runs ahead at the tip's own speed and is slowed by the floor.

    The step has no error to go by (the motion is a parabola) and no speed to begin with.
    Exact: time of the first touch, by s = a t^2 / 2.
    """
    rng = np.random.default_rng(9)
    for _ in range(8):
        ahead = rng.uniform(0.03, 0.4)
        how = ON_THE_FLOOR | {"run.method": method, "run.t_end": 4.0, "buffer.k_A": 1e5}
        scene = slowed(flying_by(overlap, ahead, how, base="tilt_0"), 0.1, 3.0, rigid=True)
        began = times(run(scene, t_eval=[]), "touch")
        assert began.size >= 1, f"missed over {ahead} m"
        expected = math.sqrt(2 * way_to_touch(overlap, ahead) / 0.1)
        assert began[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("back", [0.01, 0.1, 1.0, 10.0])
def test_longer_way_to_the_first_touch_changes_nothing_but_its_time(back):
    """Exact: the paper's case begun earlier is the paper's case, by uniform motion."""
    scene = load_scene("paper_designed", ["run.rtol=1e-10"])
    near = run(scene, t_end=0.3)
    far = altered(scene, {"initial.chaser.x": -back})
    later = run(far, t_end=0.3 + back / 0.1, t_eval=[0.3 + back / 0.1])
    assert later.touches.size == near.touches.size
    assert later.touches["start"] - back / 0.1 == pytest.approx(near.touches["start"], abs=1e-8)
    assert later.q[-1, :5] == pytest.approx(near.q[-1, :5], abs=1e-9)


@pytest.mark.parametrize("method", ADAPTIVE)
@pytest.mark.parametrize("radius", [1e-4, 5e-4, 2e-3, 1e-2])
def test_latch_catches_a_tip_that_crosses_its_zone(radius, method):
    """A wide throat, a tip that crosses the latch's circle at any offset and speed.

    Exact: where it is caught, by Pythagoras; and that it is not caught beside the circle.
    """
    rng = np.random.default_rng(10)
    base = load_scene("paper_designed")
    reach = base.buffer.hinge_offset + base.rest_length
    for _ in range(12):
        speed, ahead = 10 ** rng.uniform(-2, 0.5), rng.uniform(0.06, 0.3)
        offset = rng.uniform(-2, 2) * radius
        scene = altered(
            base,
            {
                "cone.R_c": 0.05,
                "latch": Latch(radius, stiffness=2e4, damping=80.0),
                "initial.chaser.vx": speed,
                "initial.target.x": reach + ahead + base.cone.L_T,
                "initial.target.y": offset,
                "run.method": method,
                "run.t_end": 1.3 * ahead / speed,
                "run.state_rate": 1.0,
                "run.rate": 1.0,
                "run.after_latch": 0.0,
            },
        )
        caught = times(run(scene, t_eval=[]), "latched")
        if abs(offset) > radius:
            assert caught.size == 0
        else:
            assert caught.size == 1, f"missed at {speed} m/s, {offset} m beside"
            way = ahead - math.sqrt(radius**2 - offset**2)
            assert caught[0] * speed == pytest.approx(way, abs=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_touch_at_exactly_a_sample_time(method):
    """Exact: the sample is there once, and lies on the touch's start; so does the event.

    Gap and speed are powers of two, so the touch begins at 1/64 s to the last bit or the
    one beside it.
    """
    start = 1.0 / 64
    changes = {
        "initial.chaser.vx": 0.125,
        "run.state_rate": 1024.0,
        "run.rate": 128.0,
        "run.method": method,
        "run.t_end": 0.0625,
    }
    result = run(anvil(0.125 * start, changes))
    assert result.touches["start"][0] == pytest.approx(start, abs=1e-15)
    assert np.all(np.diff(result.t) > 0.0)
    assert result.t == pytest.approx(np.arange(65) / 1024, abs=0)
    at = result.samples[result.t == start][0]
    assert at["penetration"][0] == pytest.approx(0.0, abs=1e-15)
    assert at["normal_force"][0] == pytest.approx(0.0, abs=1e-9)
    extra = run(result.scene, t_eval=[np.nextafter(start, 0), start, np.nextafter(start, 1)])
    assert np.abs(extra.q - extra.q[1]).max() < 1e-15
    assert [(e.kind, e.t) for e in extra.events] == [(e.kind, e.t) for e in result.events]


@pytest.mark.parametrize("method", METHODS)
def test_run_that_ends_at_the_instant_of_a_touch(method):
    """Exact: the last sample is the state at the touch; a touch begun there has lasted 0 s."""
    changes = {"initial.chaser.vx": 0.125, "run.method": method, "run.t_end": 1.0 / 64}
    result = run(anvil(0.125 / 64, changes), t_eval=[1.0 / 64])
    assert result.failure == ""
    assert result.events[-1].kind.label == "end"
    assert result.q[-1, 0] == pytest.approx(0.125 / 64, abs=1e-15)
    assert np.all(result.touches["end"] - result.touches["start"] < 1e-12)


def test_samples_around_every_event_join():
    """Exact: the state just before and just after each located event is the event's own."""
    scene = load_scene("paper_designed")
    whole = simulate(scene, t_end=0.3)
    at = np.array([e.t for e in whole.events if e.kind.label in ("touch", "lift_off")][:-1])
    asked = np.sort(np.concatenate([at - 1e-12, at + 1e-12]))
    around = Bench(scene).advance(asked)
    for k, t in enumerate(at):
        before, after = around[2 * k], around[2 * k + 1]
        event = next(e for e in whole.events if e.t == t)
        assert np.abs(before["q"] - event.q).max() < 1e-12
        assert np.abs(after["q"] - event.q).max() < 1e-12
        assert np.abs(before["v"] - event.v).max() < 1e-8
        assert np.abs(after["v"] - event.v).max() < 1e-8


@pytest.mark.parametrize("method", METHODS)
def test_stop_that_is_met_for_a_moment_only(method):
    """The probe swings freely on its spring after an impact and just reaches a stop.

    Exact: the stop is met if and only if it lies within the swing, by 1e-9 of it.
    """
    # the impact on a heavy target makes the probe swing; its largest stroke is located first
    changes = {"initial.chaser.vx": 0.1, "buffer.c_A": 0.0, "target.mass": 1e6, "run.t_end": 0.012}
    changes |= {"run.method": method, "run.rtol": 1e-11, "run.step": 1e-6}
    free = anvil(1e-4, changes)
    swing = run(free, t_eval=np.linspace(0.0, 0.012, 24001))
    greatest = -swing.samples["axial_stroke"].min()
    assert swing.touches.size == 1
    for share, met in ((1 - 1e-6, True), (1 + 1e-6, False)):
        stops = Stops(float(share * greatest), extension=1.0, stiffness=1e4, damping=0.0)
        limited = altered(free, {"stops": stops})
        result = run(limited, t_eval=[])
        assert (times(result, "stop_hit").size == 1) is met
        if met:
            hit = first(result, "stop_hit")
            assert hit.q[4] - free.rest_length == pytest.approx(-share * greatest, abs=1e-14)


@pytest.mark.parametrize("method", ADAPTIVE)
@pytest.mark.parametrize("spin", [0.1, 3.0, -100.0])
def test_lip_that_a_spinning_target_sweeps_against_a_standing_tip(spin, method):
    """Nothing moves but the target, about its centre of mass, up to 16 turns a second.

    Exact: the angle at which the outer lip first meets the tip, by the law of cosines.
    """
    base = load_scene("paper_designed")
    x, y = outer_lip(base, -math.copysign(1.0, spin))  # seen from outside the cone
    lip, bearing = math.hypot(x, y), math.atan2(y, x)
    reach, radius = base.buffer.hinge_offset + base.rest_length, base.probe.tip_radius
    # the tip lies on the lip's circle, 1 rad of its way ahead; seen from the target at pi
    start = math.pi - bearing - math.copysign(1.0, spin)
    scene = altered(
        base,
        {
            "initial.chaser.vx": 0.0,
            "initial.target.x": reach + lip,
            "initial.target.y": 0.0,
            "initial.target.theta": math.remainder(start, 2 * math.pi),
            "initial.target.omega": spin,
            "run.method": method,
            "run.t_end": 2.0 / abs(spin),
            "run.state_rate": 100.0,
            "run.rate": 100.0,
        },
    )
    # the chord from the lip to the tip's centre is R_t
    angle = 1.0 - 2 * math.asin(radius / (2 * lip))
    result = run(scene, t_eval=[])
    began = times(result, "touch")
    assert began.size >= 1
    assert began[0] == pytest.approx(angle / abs(spin), rel=1e-12)
    closing = abs(spin) * lip * math.cos(math.asin(radius / (2 * lip)))
    assert result.touches["approach_speed"][0] == pytest.approx(closing, rel=1e-12)
