"""The bench against four bodies in maximal coordinates, stepped by SciPy (maximal_model.py)."""

import numpy as np
import pytest
from cases import cases
from maximal_model import MaximalBench
from random_accuracy import first_touch, run
from random_scenes import wide_scenes

from capture_sim import load_scene, simulate
from capture_sim.dynamics.samples import EventKind
from capture_sim.scene.paths import changed

#: Scene, overrides, and times to compare at (s): each kind of contact in turn.
CASES = {
    "designed": ("paper_designed", [], (0.1, 0.35)),
    "undamped": ("paper_undamped", [], (0.1, 0.35)),
    # the tip's path passes 75 mm beside the axis: outer lip only
    "outer lip": (
        "paper_designed",
        ["initial.target.x=0.514", "initial.target.y=0.075"],
        (0.1, 0.2),
    ),
    "buffer of the real kind": (
        "paper_designed",
        [
            *("buffer.k_A3=2.0e+6", "buffer.c_A2=150", "buffer.c_A_rebound=40"),
            *("buffer.k_T3=1.0e+6", "buffer.c_T=0.3", "buffer.c_T2=2"),
            "contact.hysteresis_factor=0.9",
        ],
        (0.1, 0.35),
    ),
    "preloaded": ("paper_designed", ["buffer.preload=20"], (0.02, 0.05)),
    "preloaded and sticking": (
        "paper_designed",
        ["buffer.preload=20", "friction.law=coulomb", "friction.mu=1.5"],
        (0.02, 0.05),
    ),
    "preloaded, of the real kind": (
        "paper_designed",
        ["buffer.preload=3", "buffer.k_A3=2.0e+6", "buffer.c_A2=150", "buffer.c_A_rebound=40"],
        (0.1, 0.3),
    ),
    "tabulated": (
        "paper_designed",
        [
            "buffer.k_A=0",
            "buffer.force_table=[[0, 0], [2 mm, 1.5], [3 mm, 1.6], [6 mm, 6], [10 mm, 9]]",
        ],
        (0.1, 0.35),
    ),
    "tabulated with preload": (
        "paper_designed",
        [
            "buffer.k_A=0",
            "buffer.force_table=[[0, 3], [1 mm, 3], [2 mm, 6], [6 mm, 6.5], [10 mm, 15]]",
        ],
        (0.1, 0.3),
    ),
    "friction in the slide": (
        "paper_designed",
        ["buffer.friction=2"],
        (0.1, 0.35),
    ),
    "friction, preload and a sticking tip": (
        "paper_designed",
        ["buffer.friction=1", "buffer.preload=3", "friction.law=coulomb", "friction.mu=1.5"],
        (0.02, 0.05),
    ),
    # soft, fast and askew: the tip runs into the throat and hammers both inner edges
    "inner edges": (
        "paper_designed",
        [
            "buffer={k_A: 145.7, c_A: 19.7, k_T: 1926}",
            "initial.chaser={x: 0.3434, y: -0.01737, theta: -0.0505, vx: 0.2439, vy: -0.01233}",
            "initial.target={x: 0.79958, y: -0.0285, theta: 0.04684}",
        ],
        (0.05, 0.08),
    ),
}

FEW = ["designed", "buffer of the real kind", "preloaded and sticking", "tabulated with preload"]
FEW += ["friction, preload and a sticking tip", "inner edges"]
SEAT = (EventKind.SEATED, EventKind.UNSEATED)
SLIDE = (EventKind.STICK, EventKind.SLIP)

#: Random benches by their number: laws of contact and friction.
LAWS = {
    0: "lankarani_nikravesh tanh",
    1: "herbert_mcwhannell coulomb",
    3: "hunt_crossley brown_mcphee",
    4: "herbert_mcwhannell coulomb",
    5: "zhiying_qishao clamp",
    7: "hunt_crossley none",
    14: "exact coulomb",
}


def agree(found, other, times, exact):
    """Compare states, touches and peaks of a Result with a MaximalRun."""
    assert other.drift < 1e-12
    for k in range(len(times)):
        assert np.abs(found.q[k] - other.q[k]).max() < exact
        assert np.abs(found.v[k] - other.v[k]).max() < 100 * exact
        # a normal impulse is a change of rates times a mass, of some kilograms at the most
        assert found.samples["impulse"][k] == pytest.approx(other.impulse[k], abs=100 * exact)
    starts = [e for e in found.events if e.kind is EventKind.TOUCH and e.t < times[-1]]
    assert [e.wall for e in starts] == [touch.side for touch in other.touches]
    assert [e.t for e in starts] == pytest.approx([t.start for t in other.touches], abs=10 * exact)
    seat = [e.t for e in found.events if e.kind in SEAT and e.t < times[-1]]
    assert seat == pytest.approx(other.seat, abs=1e3 * exact)
    slide = [e.t for e in found.events if e.kind in SLIDE and e.wall == 0 and e.t < times[-1]]
    assert slide == pytest.approx(other.slide, abs=1e3 * exact)
    over = found.touches[found.touches["end"] < times[-1]]
    ended = {(t.side, round(t.start, 8)): t for t in other.touches if np.isfinite(t.end)}
    assert len(over) == len(ended)
    for touch in over:
        twin = ended[(int(touch["wall"]), round(float(touch["start"]), 8))]
        assert touch["end"] == pytest.approx(twin.end, abs=10 * exact)
        assert touch["approach_speed"] == pytest.approx(twin.speed, abs=100 * exact)
        assert touch["peak_force"] == pytest.approx(twin.peak, rel=1e-7)


@pytest.mark.parametrize("name", cases(few=FEW, all=list(CASES)))
def test_maximal_coordinates_agree(name):
    scene_name, overrides, times = CASES[name]
    # steps go over the kink of the rebound's damping wherever the stroke turns
    tolerance = "1e-13" if "buffer.c_A_rebound=40" in overrides else "1e-12"
    scene = load_scene(scene_name, [*overrides, f"run.rtol={tolerance}"])
    found = simulate(scene, t_end=times[-1] + 1e-3, t_eval=np.array(times))
    # where the tip hammers the edges an error grows with every touch, the model's own as well
    rtol, atol = (1e-13, 1e-14) if name == "inner edges" else (1e-12, 1e-15)
    other = MaximalBench(scene, 0.0, *scene.initial_coordinates(), rtol, atol)
    agree(found, other.advance(list(times)), times, exact=1e-11)
    walls = {touch.side for touch in other.run.touches}
    assert walls == ({-1, 1} if name == "inner edges" else {-1})


@pytest.mark.parametrize("number", cases(few=[1, 4, 5], all=list(LAWS)))
def test_maximal_coordinates_agree_on_random_benches(number):
    """Other masses, cones, spins and laws; docs/evidence/random_scenes.md has more, and to 1 s."""
    scene = wide_scenes(number + 1)[number]
    assert f"{scene.contact.law} {scene.friction.law}" == LAWS[number]
    touch = first_touch(scene)
    times = (touch + 1e-3, touch + 0.03)
    found = run(scene, np.array(times), 1e-12)
    other = MaximalBench(scene, 0.0, *scene.initial_coordinates(), rtol=1e-13, atol=1e-14)
    agree(found, other.advance(list(times)), times, exact=1e-11)
    kinds = {event.kind for event in found.events}
    assert ({EventKind.STICK, EventKind.SLIP} <= kinds) == (number == 4)


@pytest.mark.parametrize(
    "number, preload", cases(few=[(9, 30.0)], all=[(3, 2.0), (4, 20.0), (9, 30.0)])
)
def test_maximal_coordinates_agree_on_random_preloaded_benches(number, preload):
    scene = changed(wide_scenes(number + 1)[number], "buffer.preload", preload)
    touch = first_touch(scene)
    times = (touch + 1e-3, touch + 0.03)
    found = run(scene, np.array(times), 1e-12)
    other = MaximalBench(scene, 0.0, *scene.initial_coordinates(), rtol=1e-13, atol=1e-14)
    agree(found, other.advance(list(times)), times, exact=1e-11)
    assert other.run.seat


def test_maximal_coordinates_agree_on_the_floor():
    """From the rail's end: coasting on the balls, the target's rest, its first move, contact."""
    scene = load_scene("tilt_p10", ["run.rtol=1e-12"])
    whole = simulate(scene, t_end=3.2)
    leave = next(e for e in whole.events if e.kind is EventKind.RAIL_END)
    touch = next(e for e in whole.events if e.kind is EventKind.TOUCH)
    moves = next(e for e in whole.events if e.kind is EventKind.MOVING)
    times = (touch.t - 1e-3, touch.t + 0.1, touch.t + 0.35)
    found = simulate(scene, t_end=times[-1] + 1e-3, t_eval=np.array(times))
    other = MaximalBench(scene, leave.t, leave.q, leave.v, rtol=1e-12)
    agree(found, other.advance(list(times)), times, exact=1e-11)
    assert other.run.moving == pytest.approx([moves.t], abs=1e-11)
