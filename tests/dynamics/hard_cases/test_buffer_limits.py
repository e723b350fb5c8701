"""Buffer, contact, stops and masses to their limits, against three points in a row."""

from types import SimpleNamespace

import numpy as np
import pytest
from four_bodies import momentum
from row_model import Row
from set_ups import METHODS, altered, anvil, assert_conserved, in_a_row, residual, run

from capture_sim import SimulationError, load_scene, simulate
from capture_sim.base.compiled.kernels import plain
from capture_sim.dynamics.model.equations import stop_force
from capture_sim.scene.parts import Stops

GAP = 1e-4


def compared(scene, speed, t_end, gap=GAP):
    """Run the scene and the model of three points; check that both agree on every touch."""
    result = run(altered(scene, {"initial.chaser.vx": speed, "run.t_end": t_end}))
    assert result.failure == ""
    row = Row(scene, gap, (speed, speed, 0.0)).run(t_end)
    moved = result.q[-1] - result.q[0]
    places = np.array([moved[0], moved[0] + moved[4], moved[5]])
    # nothing leaves the row
    assert np.abs(result.q[:, [1, 2, 3]]).max() < 1e-12
    assert result.touches.size == row.times("touch").size
    gained = scene.target.mass * result.v[-1, 5]
    assert result.touches["impulse"].sum() == pytest.approx(gained, rel=1e-6)
    return result, row, np.abs(places - row.y[:3]).max()


@pytest.mark.parametrize(
    "k_A, method, exactness",
    [
        *((1.0, "dop853", 1e-12), (5e2, "dopri5", 1e-12), (5e2, "rk4", 1e-9)),
        *((1e4, "dop853", 1e-12), (1e6, "dopri5", 1e-12), (1e8, "dop853", 1e-12)),
    ],
)
def test_buffer_from_very_soft_to_very_hard(k_A, method, exactness):
    """Exact: the collision of three points, touch by touch, for k_A from 1 to 1e8 N/m."""
    changes = {
        "buffer.k_A": k_A,
        "friction.law": "none",
        "run.method": method,
        "run.rtol": 1e-11,
        "run.step": 1e-6,
    }
    result, row, error = compared(in_a_row(GAP, changes), 0.1, 0.04)
    assert error < exactness
    assert result.touches["start"] == pytest.approx(row.times("touch"), abs=10 * exactness / 0.01)
    if method != "rk4":
        assert residual(result) < 1e-10 * result.samples["kinetic"][0]


@pytest.mark.parametrize(
    "ratio, method", [(1.0, "dop853"), (1e2, "dopri5"), (1e4, "dop853"), (1e6, "dopri5")]
)
def test_stiffness_ratio_of_contact_to_buffer(ratio, method):
    """Stiffness of the contact at the first touch's peak, in that of the buffer.

    Exact: the collision of three points, touch by touch, from one touch at a ratio of 1 on.
    """
    speed = 0.01
    scene = in_a_row(GAP, {})
    # 1.5 K depth^0.5 = ratio k_A at the Hertz depth (5 m v^2 / 4 K)^0.4
    energy = 1.25 * scene.probe.mass * speed**2
    K = (ratio * scene.buffer.k_A / (1.5 * energy**0.2)) ** 1.25
    E = scene.contact.tip.E * K / scene.contact_stiffness
    changes = {
        "contact.tip.E": E,
        "contact.wall.E": E,
        "friction.law": "none",
        "run.method": method,
        "run.rtol": 1e-10,
    }
    result, row, error = compared(altered(scene, changes), speed, 0.15)
    assert error < 1e-12
    assert result.touches["start"] == pytest.approx(row.times("touch"), abs=1e-8)
    assert residual(result) < 1e-9 * result.samples["kinetic"][0]


@pytest.mark.parametrize(
    "stops, method, exactness",
    [
        (Stops(compression=0.005, extension=0.01, stiffness=1e5, damping=100.0), "dopri5", 1e-10),
        (Stops(compression=0.003, extension=0.01, stiffness=1e7, damping=0.0), "dop853", 1e-10),
        (Stops(compression=1e-3, extension=1e-3, stiffness=1e6, damping=3e3), "dopri5", 1e-10),
        (Stops(compression=1e-3, extension=1e-3, stiffness=1e6, damping=3e3), "rk4", 2e-8),
    ],
    ids=["damped", "hard", "overdamped", "overdamped in fixed steps"],
)
def test_stroke_stop_hit_during_contact(stops, method, exactness):
    """Exact: the collision of three points with a stop; met at its stroke to rounding."""
    changes = {
        "stops": stops,
        "friction.law": "none",
        "run.method": method,
        "run.rtol": 1e-11,
        "run.step": 1e-6,
    }
    result, row, error = compared(in_a_row(GAP, changes), 0.1, 0.1)
    hits = [e for e in result.events if e.kind.label == "stop_hit"]
    assert len(hits) == row.times("stop_hit").size > 0
    assert [e.t for e in hits] == pytest.approx(row.times("stop_hit"), abs=1e-6)
    for hit in hits:
        stroke = hit.q[4] - result.scene.rest_length
        assert stroke == pytest.approx(-stops.compression, abs=1e-14)
        assert hit.v[4] < 0.0
    # at least one is met while the tip is on the wall
    during = [(t["start"] < h.t) & (h.t < t["end"]) for h in hits for t in result.touches]
    assert any(during)
    assert error < exactness
    if method != "rk4":
        assert residual(result) < 1e-9 * result.samples["kinetic"][0]


@pytest.mark.parametrize("length", [0.0, 0.1365])
def test_massless_cylinder_is_the_limit_of_a_light_one(length):
    """Exact: the motion depends on m_C smoothly, so it tends to that without in step with m_C."""
    light = {"cylinder.length": length, "run.rtol": 1e-12}
    base = altered(load_scene("paper_designed"), light)

    def end(mass):
        return run(altered(base, {"cylinder.mass": mass}), t_end=0.02, t_eval=[0.02]).q[-1]

    limit = end(0.0)
    masses = np.array([1e-3, 1e-4, 1e-5, 1e-6])
    off = np.array([np.abs(end(m) - limit).max() for m in masses])
    assert off[-1] < 1e-9
    assert off / masses == pytest.approx(off[-1] / masses[-1], rel=0.2)


@pytest.mark.parametrize("mass", [1e-3, 1.0, 1e3, 1e6])
def test_chaser_or_target_light_or_heavy(mass):
    """Exact: momentum and energy of all four bodies, whichever vehicle is the light one."""
    for vehicle in ("chaser", "target"):
        changes = {f"{vehicle}.mass": mass, f"{vehicle}.inertia": 0.02 * mass, "run.rtol": 1e-11}
        result = run(altered(load_scene("paper_designed"), changes), t_end=0.5)
        assert result.failure == ""
        assert result.touches.size > 0
        before = momentum(result.scene, result.q[0], result.v[0])
        assert_conserved(result, 1e-9 * max(1.0, np.abs(before).max()))


@pytest.mark.parametrize("speed", [1e-3, 1e-2, 0.1, 1.0])
def test_paper_case_from_a_millimetre_to_a_metre_per_second(speed):
    """Exact: momentum and energy; and two methods at a tight tolerance agree."""
    changes = {"initial.chaser.vx": speed, "run.rtol": 1e-12}
    scene = altered(load_scene("paper_designed"), changes)
    t_end = 0.001 * 0.1 / speed + 0.05
    result = run(scene, t_end=t_end)
    assert result.failure == ""
    assert result.touches.size > 0
    assert_conserved(result, 1e-10 * np.abs(momentum(scene, result.q[0], result.v[0])).max())
    other = run(altered(scene, {"run.method": "dopri5"}), t_end=t_end)
    assert other.touches.size == result.touches.size
    assert other.q[-1] == pytest.approx(result.q[-1], abs=1e-9)


def test_ten_metres_per_second_needs_stops():
    """Without stops the probe is pushed in up to its tip: an error, not a verdict.

    Exact, with stops: momentum and energy.
    """
    fast = altered(load_scene("paper_designed"), {"initial.chaser.vx": 10.0, "run.rtol": 1e-10})
    with pytest.raises(SimulationError, match=r"stopped at t = 0.0.* in phase .*: the probe"):
        simulate(fast, t_end=0.5)
    stops = Stops(compression=0.1, extension=0.1, stiffness=1e7, damping=1e3)
    result = run(altered(fast, {"stops": stops}), t_end=0.05)
    assert result.failure == ""
    assert result.samples["axial_stroke"].min() < -0.1
    assert_conserved(result, 1e-6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("E", [1e2, 1e3, 1e4])
def test_wall_too_soft_to_hold_the_tip_is_an_error(E, method):
    """A depth of the tip's radius would let it through: an error that names the cause."""
    soft = {"contact.tip.E": E, "contact.wall.E": E, "run.method": method}
    with pytest.raises(SimulationError, match=r"in phase contact: the tip is pressed into a wall"):
        simulate(altered(anvil(GAP, soft), {"initial.chaser.vx": 0.1}), t_end=1.0)


@pytest.mark.parametrize("step", [3e-4, 1e-3, 3e-3, 1e-2])
def test_fixed_step_too_long_for_the_contact_is_an_error(step):
    """A contact that lasts 0.35 ms can not be seen with such steps: no number is returned."""
    scene = load_scene("paper_designed", ["run.method=rk4", f"run.step={step!r}"])
    with pytest.raises(SimulationError, match=r"phase contact: .*run.step"):
        simulate(scene, t_end=0.35)


@pytest.mark.parametrize("stop", [-1, 1])
def test_stops_push_and_never_pull(stop):
    """At any depth and rate, also of a probe that leaves a strongly damped stop fast."""
    par = SimpleNamespace(stop_compressed=-0.01, stop_extended=0.01, k_stop=1e4, c_stop=500.0)
    rng = np.random.default_rng(2)
    for depth, rate in zip(rng.uniform(0.0, 2e-3, 2000), rng.uniform(-1.0, 1.0, 2000), strict=True):
        force, _ = plain(stop_force)(stop * (0.01 + depth), rate, stop, par)
        assert -stop * force >= 0.0  # towards the middle, or nothing
