"""Whatever a scene or an override says: a scene comes of it, or one line.

Some hundred cases with fixed seeds; CAPTURE_SIM_EXAMPLES=20000 tries more.
"""

import dataclasses
import os

import numpy as np
import pytest
from hypothesis import Phase, example, given, seed, settings
from hypothesis import strategies as st

from capture_sim import Bench, Scene, SceneError, SimulationError, load_scene, scene_names
from capture_sim.launch.scenes import load_scene_text
from capture_sim.scene.files import MAX_TEXT, parse

CASES = int(os.environ.get("CAPTURE_SIM_EXAMPLES", "120"))
TEXT = load_scene("tilt_0").to_yaml()


def some(cases=CASES):
    """Return settings for a test of so many fixed cases."""
    return settings(
        max_examples=cases,
        deadline=None,
        database=None,
        print_blob=False,
        phases=[Phase.explicit, Phase.generate],
    )


def one_line(load):
    """Return the scene that is loaded, or check that its refusal is one short line."""
    try:
        return load()
    except SceneError as error:
        message = str(error)
        assert "\n" not in message
        assert len(message) < 2500  # five mistakes at most
        assert message.isprintable()
        return None


def fields(part, where=""):
    """Yield the dotted name of every number, name and switch of a scene."""
    for f in dataclasses.fields(part):
        value = getattr(part, f.name)
        yield f"{where}{f.name}"
        if dataclasses.is_dataclass(value):
            yield from fields(value, f"{where}{f.name}.")


NAMES = st.sampled_from(sorted(fields(load_scene("tilt_0"))))
NUMBERS = st.one_of(
    st.floats(),
    st.integers(),
    st.sampled_from([0, -0.0, 5e-324, 1e-300, 1e300, 1.8e308, 10**400, -(10**4000), 2**63]),
)
PLAIN = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(max_size=30),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=12,
)
ODD_TEXTS = st.sampled_from(
    [
        *("{[1]: 2}", "{{a: 1}: 2}", "{null: 1}", "{1: 2}", "2020-13-45", "2020-01-01"),
        *("!!int x", "!!float y", "!!binary '*'", "!!set {a}", "!!timestamp now"),
        *("!!python/object/apply:os.system ['true']", "&a [*a]", "<<: {a: 1}"),
        *("9" * 401, "9" * 5000, "1e999", ".inf", "-.inf", ".nan", "1:1:1:1", "0x10", "0b1"),
        *("1_000", "[" * 1000, "{a: " * 1000, "- " * 3000, "[" + "0," * 2_000 + "0]"),
        *("\t", "\x00", "\x1b[2J", "\ud800", "a\nb: c", "'" + "x" * 50_000 + "'"),
        *("%YAML 9.9\n---\n1", "---\n1\n---\n2"),
    ]
)


@seed(14)
@some()
@given(NAMES, NUMBERS)
@example("run.max_steps", 2**1024)
def test_any_number_in_any_place(name, number):
    scene = one_line(lambda: load_scene("tilt_0", {name: number}))
    if scene is not None:
        assert isinstance(scene, Scene)
        with np.errstate(all="ignore"):
            Bench(scene)  # its parameters can be computed
        assert load_scene_text(scene.to_yaml()) == scene


@seed(15)
@some()
@given(st.dictionaries(NAMES | st.text(max_size=40), PLAIN, max_size=4))
def test_any_plain_values_in_any_place(overrides):
    one_line(lambda: load_scene("paper_designed", overrides))


@seed(16)
@some(max(1, CASES // 3))
@given(NAMES | st.text(max_size=40), ODD_TEXTS | st.text(max_size=60))
def test_any_override_on_a_command_line(name, text):
    one_line(lambda: load_scene("tilt_0", [f"{name}={text}"]))
    one_line(lambda: load_scene("tilt_0", [name + text]))


@seed(17)
@some()
@given(st.data())
def test_a_damaged_scene(data):
    text = TEXT
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text)))
        length = data.draw(st.integers(0, 40))
        put = data.draw(st.text(max_size=8) | ODD_TEXTS)
        text = text[:at] + put + text[at + length :]
    scene = one_line(lambda: load_scene_text(text))
    assert scene is None or isinstance(scene, Scene)


@seed(18)
@some()
@given(st.binary(max_size=300), st.integers(0, 3000))
def test_a_file_of_any_bytes(tmp_path_factory, data, at):
    path = tmp_path_factory.mktemp("bytes") / "odd.yaml"
    good = TEXT.encode()
    path.write_bytes(good[:at] + data + good[at + len(data) :])
    one_line(lambda: load_scene(path))


@seed(19)
@some(50)
@given(st.text(max_size=400))
def test_a_name_or_path_of_any_text(text):
    scene = one_line(lambda: load_scene(text))
    assert scene is None or text.rpartition("/")[2].removesuffix(".yaml") in scene_names()


def bomb(depth):
    """Return a text whose aliases would stand for 9**depth values."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, depth)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text, says",
    [
        (bomb(9), "aliases"),
        ("a: &a [*a]", "aliases"),
        ("x" * (MAX_TEXT + 1), "longer than"),
        ("a: [" + "1, " * 10**6 + "1]", "longer than"),
        ("[" * 5000, "nested deeper"),
        ("a:\n" + "".join(f"{' ' * k}b:\n" for k in range(1, 200)), "nested deeper"),
        ("{[1]: 2}", "not a field name"),
        ("2: 3", "not a field name"),
        ("x: !!int y", "not valid YAML"),
        ("x: !!python/name:os.system", "not valid YAML"),
        ("x: \x00", "not valid YAML"),
    ],
    ids=lambda value: value[:20],
)
def test_what_would_take_memory_or_time_is_refused_in_one_line(text, says):
    with pytest.raises(SceneError, match=says) as caught:
        parse(text, "mine.yaml")
    assert str(caught.value).startswith("mine.yaml")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_dates_and_sexagesimal_numbers_are_texts():
    assert parse("[2020-01-01, 1:30, 0x10, 1_0, 010, 1e3, 12]", "x") == [
        "2020-01-01",
        "1:30",
        "0x10",
        "1_0",
        10,
        1000.0,
        12,
    ]


def test_a_large_file_is_not_read_whole(tmp_path):
    path = tmp_path / "large.yaml"
    with path.open("wb") as file:
        file.truncate(10**10)  # sparse
    with pytest.raises(SceneError, match=r"large.yaml: longer than"):
        load_scene(path)


def test_files_that_extend_each_other_by_other_paths_are_seen(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.yaml").write_text("extends: sub/../a.yaml\n")
    with pytest.raises(SceneError, match="extends itself"):
        load_scene(tmp_path / "a.yaml")
    (tmp_path / "b.yaml").symlink_to("c.yaml")
    (tmp_path / "c.yaml").write_text("extends: b\n")
    with pytest.raises(SceneError, match="extends itself"):
        load_scene(tmp_path / "b.yaml")


def test_a_chain_of_files_is_bounded(tmp_path):
    for k in range(100):
        (tmp_path / f"s{k}.yaml").write_text(f"extends: s{k + 1}\n")
    (tmp_path / "s100.yaml").write_text("extends: tilt_0\n")
    with pytest.raises(SceneError, match="more than 20 files"):
        load_scene(tmp_path / "s0.yaml")
    assert load_scene(tmp_path / "s90.yaml").cone == load_scene("tilt_0").cone


@pytest.mark.parametrize(
    "path",
    ["x" * 300 + ".yaml", "x/" * 3000 + "a.yaml", "a\0b.yaml", "/", "/dev/null/a.yaml", ""],
    ids=lambda path: path[:20],
)
def test_odd_paths_are_no_files(path):
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert len(str(caught.value)) < 300


def test_a_long_value_is_not_shown_whole():
    for name, value in (
        ("buffer.k_A", list(range(10**6))),
        ("title", 10**5000),
        ("run.seed", "x" * 10**6),
    ):
        with pytest.raises(SceneError) as caught:
            load_scene("tilt_0", {name: value})
        assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    "name, value",
    [
        *(("probe.length", 1e300), ("cylinder.length", 1e200), ("cone.L_T", 1e300)),
        *(("probe.tip_radius", 5e-324), ("initial.chaser.vx", 1e300), ("buffer.k_A", 1e308)),
        *(("initial.chaser.x", 1e300), ("initial.target.y", -1e300), ("gravity", 1e-200)),
    ],
)
def test_sizes_that_overflow_or_vanish_are_refused_by_field(name, value):
    """They raised OverflowError, warned, or ran to a verdict with a penetration of infinity."""
    with pytest.raises(
        SceneError, match=rf"{name.rpartition('.')[2]} = .*must be.*1e-30 and 1e\+30"
    ):
        load_scene("paper_designed", {name: value})


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [1e-30, 1e30])
@pytest.mark.parametrize(
    "name", ["probe.length", "cylinder.length", "cone.L_T", "initial.chaser.vx", "initial.chaser.x"]
)
def test_extreme_sizes_run_to_finite_numbers_or_are_an_error(name, size):
    """Without a warning of NumPy, which is an error here."""
    try:
        bench = Bench(load_scene("paper_designed", {name: size, "run.max_steps": 1000}))
        samples = bench.advance(np.array([0.0, 1e-3]))
    except (SceneError, SimulationError):
        return
    assert np.isfinite(samples["penetration"]).all()
