"""A tabulated axial spring: its curve, its energy, and how it moves a mass; all by quadrature.

The curve is evaluated here by SciPy, in the engine by its own cubics.
"""

import itertools
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, seed, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import PchipInterpolator
from set_ups import (
    ELASTIC,
    LIGHT,
    SPEED,
    altered,
    first,
    heavy_run,
    in_a_row,
    residual,
    run,
    runs_of_all_methods,
    times,
)

from capture_sim import SceneError, load_scene, simulate
from capture_sim.dynamics.bench import Bench
from capture_sim.fmu.variables import parameters as fmu_parameters
from capture_sim.scene.parts import MAX_TABLE_POINTS

#: A rubber buffer: soft at first, stiff at its end.
RUBBER = ((0.0, 0.0), (0.002, 1.5), (0.005, 2.4), (0.008, 4.8), (0.012, 14.0), (0.015, 40.0))
#: A measured gas spring with a step and a plateau.
GAS = ((0.0, 6.0), (0.001, 6.0), (0.004, 6.5), (0.005, 9.0), (0.012, 10.0), (0.02, 16.0))


def with_table(table):
    return {"buffer.k_A": 0.0, "buffer.force_table": table}


def curve_of(table):
    """Force (N) over the stroke inwards, m, mirrored outwards if it starts at 0."""
    s, F = np.array(table).T
    if F[0] == 0.0:
        s, F = np.concatenate([-s[:0:-1], s]), np.concatenate([-F[:0:-1], F])
    return PchipInterpolator(s, F)


# the curve


@pytest.mark.parametrize("table", [RUBBER, GAS], ids=["rubber", "gas"])
def test_force_and_energy_are_those_of_the_curve_at_every_sample(table):
    """Also outwards, where a spring without preload acts with the mirrored curve."""
    fast = ["run.t_end=0.4", "initial.chaser.vx=0.3", "buffer.c_A=3"]
    scene = altered(load_scene("paper_designed", fast), with_table(table))
    result = simulate(scene)
    samples = result.samples
    inwards, curve = -samples["axial_stroke"], curve_of(table)
    assert inwards.max() > 0.01
    assert (inwards.min() < -1e-3) == (table is RUBBER)
    off_seat = inwards != 0.0 if table is GAS else np.full(inwards.shape, True)
    damper = -scene.buffer.c_A * samples["v"][:, 4]
    force = samples["axial_force"][off_seat]
    inside = inwards[off_seat] <= table[-1][0]
    expected = (curve(inwards[off_seat]) + damper[off_seat])[inside]
    assert force[inside] == pytest.approx(expected, rel=1e-12, abs=1e-11)
    energy = curve.antiderivative()(inwards) - curve.antiderivative()(0.0)
    within = inwards <= table[-1][0]
    stored = samples["elastic_axial"][within]
    assert stored == pytest.approx(energy[within], rel=1e-12, abs=1e-14)
    assert residual(result) < 1e-7 * samples["kinetic"][0]


def test_beyond_the_last_point_the_force_continues_along_its_slope():
    table = ((0.0, 0.0), (0.001, 0.3), (0.003, 1.5))
    scene = altered(load_scene("paper_designed", ["run.t_end=0.2"]), with_table(table))
    samples = simulate(scene).samples
    inwards, curve = -samples["axial_stroke"], curve_of(table)
    beyond = inwards > 0.003
    assert inwards.max() > 0.006
    past = inwards[beyond] - 0.003
    slope = float(curve(0.003, 1))
    expected = 1.5 + slope * past - scene.buffer.c_A * samples["v"][beyond, 4]
    assert samples["axial_force"][beyond] == pytest.approx(expected, rel=1e-12, abs=1e-11)
    at_end = float(curve.integrate(0.0, 0.003))
    stored = at_end + 1.5 * past + 0.5 * slope * past**2
    assert samples["elastic_axial"][beyond] == pytest.approx(stored, rel=1e-12)


@pytest.mark.parametrize("strokes", [(0.02,), (0.003, 0.004, 0.0117, 0.02), (1e-5, 2e-5, 0.05)])
@pytest.mark.parametrize("preload", [0.0, 20.0])
def test_a_table_of_a_line_is_the_linear_spring(strokes, preload):
    table = tuple((s, preload + 500.0 * s) for s in (0.0, *strokes))
    linear = load_scene("paper_designed", ["run.rtol=1e-12", f"buffer.preload={preload}"])
    line = altered(linear, {"buffer.preload": 0.0} | with_table(table))
    expected, found = (simulate(scene, t_end=0.06).samples for scene in (linear, line))
    assert found["q"] == pytest.approx(expected["q"], abs=1e-11)
    assert found["elastic_axial"] == pytest.approx(expected["elastic_axial"], abs=1e-11)
    force = preload - 500.0 * found["axial_stroke"] - 13.0 * found["v"][:, 4]
    off_seat = found["axial_stroke"] != 0.0
    assert found["axial_force"][off_seat] == pytest.approx(force[off_seat], rel=1e-12, abs=1e-11)


# a mass on it

STIFF = tuple((s, 4000.0 * force) for s, force in ((0.0, 0.0), (0.01, 0.02), (0.02, 0.1)))
STIFF += ((0.04, 400.0 * 1.3), (0.07, 400.0 * 9.0))


@pytest.mark.parametrize("preload", [0.0, 800.0])
def test_a_mass_turns_where_the_curve_has_stored_its_energy_and_when_it_has(preload):
    """M v^2 / 2 = int F ds; t = int ds / v, with the pole at the turn taken out."""
    table = tuple((s, preload + F) for s, F in STIFF)
    result = heavy_run(ELASTIC | with_table(table))
    assert result.failure == ""
    M, curve = result.scene.chaser.mass + result.scene.cylinder.mass, curve_of(table)
    stored = curve.antiderivative()
    places = np.linspace(0.0, 0.07, 70001)
    energy = 0.5 * M * SPEED**2
    stroke = float(np.interp(energy, stored(places) - stored(0.0), places))
    extremes = result.extremes.before_latch
    assert 0.04 < stroke < 0.07
    assert extremes["axial_stroke_in"] == pytest.approx(stroke, rel=LIGHT)
    assert extremes["buffer_force"] == pytest.approx(float(curve(stroke)), rel=2 * LIGHT)

    def dt(phi):
        s = stroke * math.sin(phi)
        rest = 2.0 * (stored(stroke) - stored(s)) / M
        return stroke * math.cos(phi) / math.sqrt(rest) if rest > 0.0 else 0.0

    ways = [math.asin(min(s / stroke, 1.0)) for s, _ in table]
    quarter = sum(quad(dt, a, b)[0] for a, b in itertools.pairwise(ways) if b > a)
    begun = result.touches["start"][0]
    assert extremes["axial_stroke_in_time"] - begun == pytest.approx(quarter, rel=4 * LIGHT)
    elastic = result.samples["elastic_axial"] + result.samples["elastic_contact"]
    assert elastic.max() == pytest.approx(energy, rel=LIGHT)
    assert residual(result) < 1e-8 * energy


def test_the_free_probe_swings_both_ways_in_the_time_of_the_quadrature():
    """After an elastic impact on the axis: T = 4 int ds / v with the reduced mass, undamped."""
    table = ((0.0, 0.0), (0.0005, 0.02), (0.001, 0.09), (0.002, 0.12), (0.004, 0.6))
    changes = {
        "friction.law": "none",
        "contact.law": "exact",
        "contact.restitution": 1.0,
        "buffer.c_A": 0.0,
        "buffer.k_T": 1e5,
        "target.mass": 0.05,
        "run.rtol": 1e-12,
    }
    scene = in_a_row(1e-5, changes | with_table(table))
    result = run(scene, t_end=1.2)
    off = result.touches["end"][-1]
    assert result.touches.size < 3
    t = np.linspace(off, 1.2, 12001)
    strokes = run(scene, t_end=1.2, t_eval=t).samples
    s, v = strokes["axial_stroke"], strokes["v"][:, 4]
    body, probe = scene.chaser.mass + scene.cylinder.mass, scene.probe.mass
    mu = body * probe / (body + probe)
    curve = curve_of(table)
    stored = curve.antiderivative()
    energy = 0.5 * mu * v[0] ** 2 + float(stored(s[0]) - stored(0.0))
    places = np.linspace(0.0, 0.004, 400001)
    amplitude = float(np.interp(energy, stored(places) - stored(0.0), places))
    assert 0.002 < amplitude < 0.004
    assert np.abs(s).max() == pytest.approx(amplitude, rel=1e-4)
    knots = [math.asin(x / amplitude) for x in (0.0, 0.0005, 0.001, 0.002)] + [math.pi / 2]

    def dt(phi):
        x = amplitude * math.sin(phi)
        rest = 2.0 * (energy - float(stored(x) - stored(0.0))) / mu
        return amplitude * math.cos(phi) / math.sqrt(rest) if rest > 0.0 else 0.0

    period = 4.0 * sum(quad(dt, a, b)[0] for a, b in itertools.pairwise(knots))
    up = np.flatnonzero((s[:-1] < 0.0) & (s[1:] >= 0.0))
    # roots by the secant of a nearly straight piece
    roots = t[up] - s[up] * (t[up + 1] - t[up]) / (s[up + 1] - s[up])
    assert roots.size > 3
    assert np.diff(roots) == pytest.approx(period, rel=1e-5)


# the integrator


@pytest.mark.parametrize("table", [RUBBER, GAS], ids=["rubber", "gas"])
def test_error_follows_the_tolerance_over_the_points(table):
    """The second derivative of the force jumps at each point; the first touch takes 0.2 s."""
    base = altered(load_scene("paper_undamped"), with_table(table))

    def end(rtol, method="dop853"):
        scene = altered(base, {"run.rtol": rtol, "run.method": method})
        return simulate(scene, t_end=0.1, t_eval=[0.1]).q[-1]

    reference = end(1e-13)
    # the seat of a preload loses energy in each of many impacts, by which errors grow
    allowed = 1.0 if table is RUBBER else 100.0
    for method in ("dop853", "dopri5"):
        for rtol in (1e-6, 1e-8, 1e-10):
            assert np.abs(end(rtol, method) - reference).max() < allowed * rtol


@pytest.mark.parametrize("table", [RUBBER, GAS], ids=["rubber", "gas"])
def test_every_method_closes_the_ledger(table):
    points = [list(point) for point in table]
    runs_of_all_methods(["buffer.k_A=0", f"buffer.force_table={points}"])


def test_the_first_force_is_the_preload_of_a_seat():
    result = simulate(altered(load_scene("paper_designed"), with_table(GAS)), t_end=0.4)
    assert result.scene.outward_stroke == 0.0
    assert first(result, "unseated").t >= result.touches["start"][0]
    assert times(result, "seated").size > 0
    assert result.samples["axial_stroke"].max() == 0.0
    on_seat = result.samples["axial_stroke"] == 0.0
    assert result.samples["axial_force"][on_seat].max() <= 6.0 * (1.0 + 1e-9)


# scenes


def test_strokes_and_forces_take_units_and_come_back_from_yaml(tmp_path):
    text = "[[0, 0 N], ['5 mm', 2.5], [20 mm, '0.01 kN']]"
    scene = load_scene("paper_designed", ["buffer.k_A=0", f"buffer.force_table={text}"])
    assert scene.buffer.force_table == ((0.0, 0.0), (0.005, 2.5), (0.02, 10.0))
    path = tmp_path / "mine.yaml"
    path.write_text(scene.to_yaml())
    assert load_scene(path) == scene


@pytest.mark.parametrize(
    "changes, says",
    [
        ([], r"buffer\.k_A = 500\.0 N/m: must be 0 with buffer\.force_table"),
        (["k_A=0", "k_A3=1"], r"buffer\.k_A3 = 1\.0 N/m\^3: must be 0 with buffer\.force_table"),
        (["k_A=0", "preload=1"], r"buffer\.preload = 1\.0 N: must be 0 with buffer\.force_table"),
        (["k_A=0", "force_table=[[0, 0]]"], "must be 2 to 64 points"),
        (["k_A=0", "force_table=[[0, 0], [0.1, 1 kg]]"], "must be 2 to 64 points"),
        (["k_A=0", "force_table=[[0.1, 0], [0.2, 1]]"], r"\[0\], stroke = 0\.1 m: must be 0"),
        (["k_A=0", "force_table=[[0, 0], [2, 1], [1, 2]]"], r"\[2\], stroke = 1\.0 m: must be >="),
        (["k_A=0", "force_table=[[0, 0], [1, -2]]"], r"\[1\], force = -2\.0 N: must be >= 0"),
    ],
)
def test_bad_tables_are_rejected_with_field_value_unit_and_range(changes, says):
    base = ["buffer.force_table=[[0, 0], [0.01, 5]]"]
    with pytest.raises(SceneError, match=says):
        load_scene("paper_designed", [*base, *(f"buffer.{change}" for change in changes)])


def test_an_outward_stop_next_to_the_seat_of_a_table_is_rejected():
    stops = "stops={compression: 0.01, extension: 0.01, stiffness: 1.0e+5, damping: 10}"
    changes = ["buffer.k_A=0", "buffer.force_table=[[0, 5], [0.01, 9]]", stops]
    expected = r"must be null with buffer\.force_table\[0\], force = 5 N"
    with pytest.raises(SceneError, match=expected):
        load_scene("paper_designed", changes)


def test_a_unit_has_no_stiffness_to_set_next_to_a_table():
    scene = altered(load_scene("paper_designed"), with_table(RUBBER))
    names = {each.name for each in fmu_parameters(scene, Bench(scene).initial_workspace())}
    assert "buffer.c_A" in names
    assert not {"buffer.k_A", "buffer.k_A3"} & names


def rising(rows):
    """A table of the widths of its intervals, m, and the forces at their ends, N."""
    strokes = itertools.accumulate(width for width, _ in rows)
    return [[0.0, 0.0], *([s, F] for s, (_, F) in zip(strokes, rows, strict=True))]


COORDINATES = st.one_of(
    st.floats(),
    st.floats(0.0, 0.05),
    st.floats(0.0, 100.0),
    st.sampled_from([0.0, -0.0, 1e-6, 5e-324, 1e300, 1e-300, "5 mm", "3 N", "x", None, True]),
)
TABLES = st.one_of(
    st.lists(st.lists(COORDINATES, max_size=3), max_size=5),
    st.lists(st.tuples(st.floats(1e-6, 0.02), st.floats(0.0, 50.0)), min_size=1, max_size=9).map(
        lambda rows: [[0.0, rows[0][1]], *[[float(s), F] for s, F in rows]]
    ),
    st.lists(
        st.tuples(st.floats(1e-6, 0.02), st.sampled_from([0.0, 1e-9, 1.0, 1.0, 80.0])),
        min_size=1,
        max_size=MAX_TABLE_POINTS - 1,
    ).map(rising),
)


def one_line(table):
    """Return the scene of a table, or check that its refusal is one line."""
    try:
        return load_scene("paper_designed", {"buffer.k_A": 0.0, "buffer.force_table": table})
    except SceneError as error:
        message = str(error)
        assert "\n" not in message
        assert message.startswith("buffer.force_table")
        return None


@seed(38)
@settings(max_examples=60, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(TABLES)
@example([[0.0, 0.0], [1e-6, 80.0]])
@example([[0.0, 80.0], [1e-6, 0.0], [2e-6, 80.0]])
def test_any_table_is_refused_in_one_line_or_runs_with_its_ledger(table):
    scene = one_line(table)
    if scene is None:
        return
    result = run(scene, t_end=0.02)
    if result.failure:  # a spring without force stops nothing
        assert result.failure.endswith("the scene needs stops, or a stiffer buffer")
        assert "\n" not in result.failure
    # 2e-6 at most in 400 drawn ones, where 80 N rise within micrometres
    assert residual(result) < 1e-5 * result.samples["kinetic"][0]
