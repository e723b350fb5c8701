"""One grammar of inputs for sweep, design and calibration."""

import math

import pytest

from capture_sim.errors import SceneError
from capture_sim.scene.loading import load_scene
from capture_sim.studies.evaluate.sweep import sweep
from capture_sim.studies.fit.parameters import parameters_of, read_weighed
from capture_sim.studies.search.variables import FREE, make_variables, widened
from capture_sim.studies.vary.inputs import LOGARITHM, Input, Scale, read_input, typed_unit

SCENE = load_scene("tilt_0")


def test_a_known_value_is_the_same_to_a_fit_and_to_a_sweep():
    for text in ("22.6 +- 0.02 kg", "22600 g +/- 20 g", "22.6 kg ± 0.1 %"):
        drawn = read_input(SCENE, "chaser.mass", text)
        _, weighed = read_weighed(SCENE, f"chaser.mass={text}")
        assert drawn.known == weighed
        assert (drawn.distribution.mean(), drawn.distribution.std()) == pytest.approx(weighed)
    with pytest.raises(SceneError, match="must have a width > 0"):
        read_input(SCENE, "chaser.mass", "22.6 +- 0 kg")


def test_a_distribution_without_an_allowed_draw_is_refused_before_anything_runs():
    for text in ("normal(-500, 1)", "uniform(-2, -1)"):
        with pytest.raises(SceneError, match=r"must have draws >= 0 N/m, has none"):
            read_input(SCENE, "buffer.k_A", text)
    assert read_input(SCENE, "buffer.k_A", "normal(-1, 1)").distribution  # one draw of six


@pytest.mark.parametrize("text", ["-500 +- 1", "1e999 +- 1", "5 +- 1e999", "5 +- 1 +- 1", "5 +-"])
def test_what_cannot_be_known_of_a_spring_is_refused_by_all(text):
    for ask in (
        lambda: read_input(SCENE, "buffer.k_A", text),
        lambda: read_weighed(SCENE, f"buffer.k_A={text}"),
    ):
        with pytest.raises(SceneError, match=r"buffer.k_A = .*must be .*(>= 0|in N/m)"):
            ask()


@pytest.mark.parametrize("text", ["[450,500", "450,500]", "[450", "[]", "[,]"])
def test_half_a_list_is_no_list(text):
    for ask in (
        lambda: read_input(SCENE, "buffer.k_A", text),
        lambda: make_variables(SCENE, [], [f"buffer.k_A={text}"]),
    ):
        with pytest.raises(SceneError, match=r"buffer.k_A = .*must be .*in N/m"):
            ask()


@pytest.mark.parametrize("text", ["22600 g +/- 20 g", "22.6e3 ± 20 g", "22600 g,22700 g", "[5 g]"])
def test_an_input_is_shown_in_the_unit_in_which_it_was_given(text):
    unit, factor = typed_unit(read_input(SCENE, "chaser.mass", text))
    assert unit == "g"
    assert factor == pytest.approx(1000.0)


def test_values_are_the_same_to_a_design_and_to_a_sweep():
    for text in ("[0.45 N/mm,500,560]", "400:800:5", "500"):
        (free, _) = make_variables(SCENE, [], [f"buffer.k_A={text}", "buffer.c_A=5:50"])
        assert free.values == read_input(SCENE, "buffer.k_A", text).values
    assert read_input(SCENE, "c_A", "5,6").values == read_input(SCENE, "c_A", "[5,6]").values


@pytest.mark.parametrize("name", ["c_rrr", "buffer.k_B", "colour"])
def test_an_unknown_name_is_refused_by_all_in_the_same_words(name):
    said = set()
    for ask in (
        lambda: sweep("tilt_0", {name: "1:2:2"}),
        lambda: make_variables(SCENE, [], [f"{name}=1:2"]),
        lambda: parameters_of(SCENE, [name]),
        lambda: read_weighed(SCENE, f"{name}=1 +- 0.1"),
    ):
        with pytest.raises(SceneError) as error:
            ask()
        said.add(str(error.value))
    assert len(said) == 1
    assert f"{name}: no number of tilt_0" in said.pop()


@pytest.mark.parametrize("name", ["c_rr", "e", "mu", "c_A", "drag"])
def test_a_short_name_is_known_to_all(name):
    (fitted,) = parameters_of(SCENE, [name])
    (free,) = make_variables(SCENE, [], [f"{name}=0.1:0.2"])
    varied = read_input(SCENE, name, "0.1:0.2:3")
    assert fitted.unit == free.unit == varied.unit
    assert fitted.paths == varied.paths


@pytest.mark.parametrize(
    "scale", [LOGARITHM, Scale(size=2.0), Scale.over(0.1, 10.0), Scale.over(0.0, 4.0)]
)
def test_a_scale_gives_each_value_back_and_its_slope_is_the_derivative(scale):
    for position in (0.2, 0.5, 0.9):
        value = scale.value(position)
        assert scale.position(value) == pytest.approx(position)
        step = (scale.value(position + 1e-6) - scale.value(position - 1e-6)) / 2e-6
        assert scale.slope(position) == pytest.approx(step, rel=1e-6)
    assert LOGARITHM.position(0.0) == -math.inf


def test_a_range_is_searched_from_end_to_end():
    for each in make_variables(SCENE, [], FREE):
        assert each.value(0.0) == pytest.approx(each.low)
        assert each.value(1.0) == pytest.approx(each.high)
        assert each.position(2.0 * each.high) == pytest.approx(1.0)  # the nearest of its range
        assert each.end_at(1.001 * each.low) == "lower"
        assert each.end_at(0.999 * each.high) == "upper"
        assert not each.end_at(math.sqrt(each.low * each.high))
        assert widened(each, "lower").low == each.low / 10.0
    assert not Input("x", values=(1.0, 2.0)).end_at(2.0)  # of a catalogue
