"""A contact of one's own: another exponent, a given stiffness, a measured curve with kinks.

An impact of two free bodies is one equation, m delta'' = -f(delta) (1 + a delta' / v_0).
"""

import math

import numpy as np
import pytest
from maximal_model import damping_factor
from scipy.integrate import solve_ivp
from scipy.interpolate import PchipInterpolator
from set_ups import ADAPTIVE, METHODS, altered, first, free_impact, residual, run
from test_impacts import reduced_mass, returned

from capture_sim import Bench, SceneError, load_scene, simulate
from capture_sim.base.compiled.kernels import plain
from capture_sim.dynamics.model.contact import (
    contact_slope,
    elastic_contact_energy,
    expected_depth,
    measured_law,
    normal_force,
    normal_force_and_rate,
    power_law,
)
from capture_sim.scene.laws import CONTACT_LAWS, exact_factor, returned_restitution

#: A soft lining on a stiffer wall, its kink at 0.2 mm.
LINING = ((0.0, 0.0), (2e-4, 4.0), (2e-4, 4.0), (2e-3, 400.0))
#: A lip that gives way, then the wall, without a kink.
LIP = ((0.0, 0.0), (1e-4, 2.0), (3e-4, 2.5), (6e-4, 20.0), (1e-3, 90.0))
#: A wall whose lining is pressed together in advance: the force jumps at the touch.
SPEED = 0.1


def impact(e, changes, speed=SPEED):
    return free_impact(1e-4, speed, e, {"run.rtol": 1e-12, "run.t_end": 0.2} | changes)


def one_equation(scene, force, a, kinks, t_end=0.1):
    """Start, peak force, its time and duration of the impact, by SciPy from kink to kink."""
    m, v_0 = reduced_mass(scene), SPEED

    def rate(t, y):
        return [y[1], -force(max(y[0], 0.0)) * (1.0 + a * y[1] / v_0) / m]

    def leaves(t, y):
        return y[0]

    leaves.direction = -1.0

    def passes(depth):
        return lambda t, y: y[0] - depth

    events = [leaves, *(passes(depth) for depth in kinks)]
    for event in events:
        event.terminal = True
    t, y, peak = 0.0, [0.0, v_0], 0.0
    while True:
        how = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-18, "max_step": t_end / 2000}
        part = solve_ivp(rate, (t, t_end), y, events=events, dense_output=True, **how)
        times = np.linspace(t, part.t[-1], 20001)
        depth, speed = part.sol(times)
        forces = np.array([force(max(d, 0.0)) for d in depth]) * (1.0 + a * speed / v_0)
        k = int(forces.argmax())
        if 0 < k < 20000:  # the top of the parabola through three points
            left, top, right = forces[k - 1 : k + 2]
            peak = max(peak, top + (right - left) ** 2 / (8.0 * (2.0 * top - left - right)))
        peak = max(peak, forces[k])
        if part.t_events[0].size:
            return part.t[-1], peak
        # onwards, just past the kink
        t, y = part.t[-1] + 1e-15, part.y[:, -1] + 1e-15 * np.array(rate(0, part.y[:, -1]))


# a spring and other powers


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("speed", [1e-2, 0.1, 1.0])
def test_a_linear_contact_is_half_a_period_of_its_spring(method, speed):
    """Exact: duration pi / omega, peak v sqrt(k m), at half the time."""
    k = 3e5
    how = {"contact.stiffness": k, "contact.exponent": 1.0, "run.method": method}
    scene = impact(
        1.0, how | {"run.step": 2e-6, "run.t_end": 0.02 if speed > 0.05 else 0.05}, speed
    )
    found, result = returned(scene)
    m, touch = reduced_mass(scene), result.touches[0]
    limit = 1e-6 if method == "rk4" else 1e-9
    duration = math.pi * math.sqrt(m / k)
    assert found == pytest.approx(1.0, abs=limit)
    assert touch["end"] - touch["start"] == pytest.approx(duration, rel=limit)
    assert touch["peak_force"] == pytest.approx(speed * math.sqrt(k * m), rel=limit)
    assert touch["peak_time"] - touch["start"] == pytest.approx(duration / 2, rel=1e-3)


@pytest.mark.parametrize("e", [0.05, 0.3, 0.6, 0.95])
@pytest.mark.parametrize(
    "contact",
    [
        {"contact.stiffness": 3e5, "contact.exponent": 1.0},
        {"contact.stiffness": 1e8, "contact.exponent": 2.2},
        {"contact.force_table": LINING},
        {"contact.force_table": LIP},
    ],
    ids=["spring", "2.2", "lining", "lip"],
)
def test_the_exact_law_returns_its_restitution_with_every_force(e, contact):
    """Exact: e and the energy lost do not depend on the elastic force."""
    found, result = returned(impact(e, contact))
    assert found == pytest.approx(e, abs=2e-8)
    lost = 0.5 * reduced_mass(result.scene) * SPEED**2 * (1 - e**2)
    assert result.touches["dissipated"][0] == pytest.approx(lost, rel=1e-6)


@pytest.mark.parametrize("law", CONTACT_LAWS)
def test_every_damping_law_keeps_its_restitution_with_a_table(law):
    found, _ = returned(impact(0.5, {"contact.force_table": LINING, "contact.law": law}))
    assert found == pytest.approx(returned_restitution(damping_factor(law, 0.5)), abs=1e-8)


def test_the_stiffness_of_the_materials_given_by_number_changes_nothing():
    scene = load_scene("tilt_p10")
    given = {"contact.stiffness": scene.contact_stiffness}
    same = simulate(scene, given)
    assert np.array_equal(same.samples["q"], simulate(scene).samples["q"])


# measured curves


@pytest.mark.parametrize("a", [0.0, 0.5625])
@pytest.mark.parametrize("method", ADAPTIVE)
def test_a_bilinear_lining_agrees_with_an_independent_integration(method, a):
    """Independent: SciPy on the one equation, begun anew at the kink; 1e-10."""
    (_, _), (d, f), _, (d_2, f_2) = LINING
    how = {"contact.hysteresis_factor": a, "run.rtol": 1e-13, "run.method": method}
    _, result = returned(impact(0.5, {"contact.force_table": LINING} | how))
    slope = (f_2 - f) / (d_2 - d)

    def force(x):
        return f / d * x if x < d else f + slope * (x - d)

    duration, peak = one_equation(result.scene, force, a, [d])
    touch = result.touches[0]
    assert touch["end"] - touch["start"] == pytest.approx(duration, rel=1e-10)
    assert touch["peak_force"] == pytest.approx(peak, rel=1e-10)


def test_the_error_of_a_sampled_curve_falls_with_the_number_of_its_points():
    """Exact: Hertz's peak and duration; points at the squares of equal distances."""
    hertz = impact(1.0, {"run.t_end": 0.01})
    _, exact = returned(hertz)
    K, touch = hertz.contact_stiffness, exact.touches[0]
    deepest = (touch["peak_force"] / K) ** (2 / 3)
    errors = []
    for n in (16, 32, 64):
        depths = 1.5 * deepest * np.linspace(0.0, 1.0, n) ** 2
        table = [[d, K * d**1.5] for d in depths.tolist()]
        _, found = returned(altered(hertz, {"contact.force_table": table}))
        errors.append(abs(found.touches[0]["peak_force"] / touch["peak_force"] - 1.0))
    assert errors[0] < 1e-3
    assert errors[1] < errors[0] / 4
    assert errors[2] < errors[1] / 4


@pytest.mark.parametrize("table", [LINING, LIP], ids=["lining", "lip"])
def test_force_and_energy_of_a_run_are_those_of_the_curve(table):
    """SciPy's curve from kink to kink, and its integral."""
    scene = load_scene("paper_designed", {"contact.force_table": table, "run.t_end": 0.3})
    result = simulate(scene, {"contact.hysteresis_factor": 0.0})
    depths, forces = np.array(table).T
    kinks = np.flatnonzero(np.diff(depths) == 0.0) + 1
    pieces = [
        PchipInterpolator(x, y)
        for x, y in zip(np.split(depths, kinks), np.split(forces, kinks), strict=True)
    ]
    samples = result.samples
    side = int(samples["normal_force"].max(axis=0).argmax())
    touching = samples[(samples["normal_force"][:, side] > 0) & (samples["walls"] != 3)]
    assert len(touching) > 10
    for sample in touching[:: len(touching) // 10]:
        x, stored = sample["penetration"][side], 0.0
        assert x < depths[-1]
        for piece in pieces:
            low, high = piece.x[[0, -1]]
            if x <= low:
                break
            stored += piece.integrate(low, min(x, high))
            force = float(piece(min(x, high)))
        assert sample["normal_force"][side] == pytest.approx(force, rel=1e-12)
        assert sample["elastic_contact"] == pytest.approx(stored, rel=1e-10)
    assert residual(result) < 1e-9


@pytest.mark.parametrize("name, friction", [("paper_designed", "tanh"), ("tilt_p10", "coulomb")])
@pytest.mark.parametrize("contact", [LINING, LIP, 1.0, 2.0], ids=["lining", "lip", "p1", "p2"])
def test_the_ledger_of_whole_scenes_closes(name, friction, contact):
    changes = {"friction.law": friction, "run.rtol": 1e-9}
    if isinstance(contact, float):
        changes |= {"contact.exponent": contact, "contact.stiffness": 1e5 * 1e4 ** (contact - 1)}
    else:
        changes |= {"contact.force_table": contact}
    result = run(load_scene(name, changes))
    assert result.failure == ""
    assert result.touches.size > 0
    assert residual(result) < 1e-9


def test_the_faces_of_a_law_agree_with_each_other():
    """Differences of the energy are the force, those of the force its slope and rate."""
    faces = (contact_slope, elastic_contact_energy, expected_depth, normal_force)
    slope, energy, deepest, force = map(plain, faces)
    force_and_rate = plain(normal_force_and_rate)
    laws = [power_law(3e5, 1.0), power_law(6e9, 1.5), power_law(1e8, 2.2)]
    laws += [measured_law(table) for table in (LINING, LIP)]
    for record in laws:
        law = record.view(np.recarray)[0]
        for x in (3e-5, 1.5e-4, 4e-4, 3e-3):
            h, chi = 1e-4 * x, 0.3
            f = [force(x + k * h, 0.0, 0.0, law)[1] for k in (-1, 0, 1)]
            E = [energy(-x - k * h, law) for k in (-1, 0, 1)]
            assert (E[2] - E[0]) / (2 * h) == pytest.approx(f[1], rel=1e-6)
            assert (f[2] - f[0]) / (2 * h) == pytest.approx(slope(x, chi, law)[0], rel=1e-6)
            ends = [force(x + k * 0.2 * h, 0.2 + k * 3.0 * h, chi, law)[0] for k in (-1, 1)]
            now, rate = force_and_rate(x, 0.2, 3.0, chi, law)
            assert now == force(x, 0.2, chi, law)[0]
            assert (ends[1] - ends[0]) / (2 * h) == pytest.approx(rate, rel=1e-6)
            speed = math.sqrt(2 * E[1] / 0.2)
            assert deepest(0.2, speed, law) == pytest.approx(x, rel=1e-4)


def test_factor_and_curve_do_not_change_what_is_swept():
    """A value of the curve's scene can vary like any other; the curve itself cannot."""
    scene = load_scene("paper_designed", {"contact.force_table": LINING, "run.t_end": 0.05})
    peaks = [
        simulate(scene, {"contact.hysteresis_factor": exact_factor(e)}).touches["peak_force"][0]
        for e in (0.3, 0.9)
    ]
    assert peaks[0] != peaks[1]
    assert load_scene("paper_designed").contact.force_table is None
    assert first(simulate(scene), "touch").t > 0.0


def test_a_bench_without_the_exact_depth_names_the_table():
    """The stiffest part of a run that stops is named by the field that makes it stiff."""
    scene = load_scene("paper_designed", {"contact.force_table": LINING, "run.max_steps": 100})
    with pytest.raises(Exception, match="max_steps") as stopped:
        Bench(scene).advance(np.zeros(0))
    assert "axial spring" in str(stopped.value) or "contact.force_table" in str(stopped.value)


# what is refused


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"exponent": 1.0}, r"contact\.exponent = 1\.0: must be 1\.5 without contact\.stiffness"),
        ({"exponent": 0.5, "stiffness": 1e4}, r"exponent = 0\.5: must be >= 1 and <= 3"),
        ({"stiffness": 0.0}, r"stiffness = 0\.0 N/m\^p: must be > 0"),
        ({"stiffness": -1.0}, r"stiffness = -1\.0 N/m\^p: must be > 0"),
        ({"stiffness": math.nan}, r"stiffness = nan N/m\^p: must be finite and > 0"),
        ({"table": LINING, "stiffness": 1e4}, r"stiffness = 10000\.0 N/m\^p: must be null with"),
        (
            {"table": LINING, "stiffness": None, "exponent": 2.0},
            r"exponent = 2\.0: must be 1\.5 with contact\.force_table",
        ),
        ({"table": [[0, 0]]}, "must be 2 to 64 points"),
        ({"table": [[1e-4, 0], [1e-3, 5]]}, r"\[0\], depth = 0\.0001 m: must be 0, the start"),
        ({"table": [[0, 0], [1e-3, 5], [5e-4, 9]]}, r"\[2\], depth = 0\.0005 m: must be >= 0\.001"),
        ({"table": [[0, 0], [1e-3, 5], [2e-3, 4]]}, r"\[2\], force = 4\.0 N: must be >= 5"),
        ({"table": [[0, -1], [1e-3, 5]]}, r"\[0\], force = -1\.0 N: must be >= 0"),
        ({"table": [[0, 0], [1e-3, 0]]}, r"\[1\], force = 0\.0 N: must be > 0, .* no stiffness"),
        ({"table": [[0, 5], [1e-3, 6]]}, r"\[0\], force = 5\.0 N: must be 0: a force cannot jump"),
        ({"table": "[[0, 0], [1 mm, 5 N"}, "must be 2 to 64 points"),
        ({"table": [[0, 0], [0.02, 5]]}, r"\[1\], depth = 0\.02 m: must be <= 0\.01125, 3/4"),
        ({"table": [[0, 0], [0, 0], [1e-3, 5]]}, r"\[1\], depth = 0\.0 m: must be >= 1e-09"),
        ({"table": [[0, 0], [1e-3, 5], [1e-3, 5]]}, r"\[2\], depth = 0\.001 m: must be >="),
        ({"table": [[0, 0], [1e-3, 5], [1e-3, 6], [2e-3, 9]]}, r"\[2\], depth = 0\.001 m"),
    ],
)
def test_bad_contacts_are_refused_with_field_value_unit_and_range(changes, says):
    changes = {"force_table" if k == "table" else k: v for k, v in changes.items()}
    with pytest.raises(SceneError, match=says) as refused:
        load_scene("paper_designed", {f"contact.{name}": v for name, v in changes.items()})
    assert "\n" not in str(refused.value)


def test_steps_too_long_for_the_steepest_part_of_a_table_are_refused():
    table = {"contact.force_table": [[0, 0], [1e-6, 100]], "run.method": "rk4", "run.step": 1e-3}
    with pytest.raises(SceneError, match=r"run\.step = 0\.001 s: must be <= .* steepest part"):
        load_scene("paper_designed", table)
