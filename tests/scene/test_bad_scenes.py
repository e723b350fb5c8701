"""Whatever a scene or an override says: a scene comes of it, or one line that tells what is wrong.

The same cases every time; CAPTURE_SIM_CASES=20000 tries more.
"""

import dataclasses
import re

import numpy as np
import pytest
from cases import cases
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from capture_sim import Bench, Scene, SceneError, SimulationError, load_scene, scene_names
from capture_sim.scene.files import MAX_TEXT, parse
from capture_sim.scene.loading import load_scene_text
from capture_sim.scene.quantities import ANY, declared, shown

pytestmark = pytest.mark.filterwarnings("error")  # of NumPy: a number has overflowed
EXAMPLES = cases(few=40, all=120)
some = settings(
    max_examples=EXAMPLES,
    derandomize=True,
    deadline=None,
    database=None,
    phases=[Phase.explicit, Phase.generate],
)
TEXT = load_scene("tilt_0").to_yaml()


def one_line(load):
    """Return the scene that is loaded, None if it is rejected in one short line."""
    try:
        return load()
    except SceneError as error:
        message = str(error)
        assert "\n" not in message
        assert len(message) < 2500  # five mistakes at most
        assert message.isprintable()
        return None


def declarations(part=Scene, prefix=""):
    """Yield the dotted name of every number, name and switch of a scene, and what it may be."""
    for name, spec in declared(part).items():
        if dataclasses.is_dataclass(spec.kind):
            yield from declarations(spec.kind, f"{prefix}{name}.")
        else:
            yield prefix + name, spec


FIELDS = dict(declarations())
NAMES = st.sampled_from(sorted(FIELDS))
HUGE = [1e-300, 5e-324, 1e300, 1.8e308, 10**400, -(10**4000), 2**1024]
NUMBERS = st.floats() | st.integers() | st.sampled_from([0, -0.0, 2**63, *HUGE])
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
        *("%YAML 9.9\n---\n1", "---\n1\n---\n2", "5 parsnips", "1e400 N/m", "0,5", "5 m^99999999"),
    ]
)


def wrong_for(spec):
    """Return values that a field does not accept."""
    wrong = [[1.0], {"a": 1}, True if spec.kind is not bool else "perhaps"]
    if spec.kind in (float, int):
        wrong += [float("nan"), float("inf"), -float("inf"), "heavy", "½", *HUGE]
        if spec.unit not in ("", "1"):
            wrong += ["5 parsnips"]
        if spec.kind is int:
            wrong += [1.5, "7"]
        allowed = spec.allowed
        if allowed is not None and allowed.low > -1e30:
            wrong += [allowed.low - 1.0, *([allowed.low] if allowed.low_open else [])]
        if allowed is not None and allowed.high < 1e30:
            wrong += [allowed.high + 1.0, *([allowed.high] if allowed.high_open else [])]
    elif spec.kind is tuple:
        wrong += [12, "ball", [[0.0, 0.0]], [[0.0, 1.0, 2.0]] * 3, [[0.0, float("nan")]] * 3]
    else:
        wrong += [12, 1.5, *(["nonsense"] if spec.options else [])]
    return st.sampled_from(wrong)


@settings(some, max_examples=3 * EXAMPLES)
@given(st.data())
def test_a_wrong_value_is_rejected_with_field_value_unit_and_range(data):
    name = data.draw(NAMES)
    spec = FIELDS[name]
    value = data.draw(wrong_for(spec))
    with pytest.raises(SceneError) as caught:
        load_scene("tilt_0", {name: value})
    message = str(caught.value)
    assert one_line(lambda: load_scene("tilt_0", {name: value})) is None
    said = re.search(rf"(?:^|; ){re.escape(name)} = (.*?): must be (.*)", message)
    assert said, message
    assert shown(value).partition("(")[0] in said[1]
    if spec.kind in (float, int):
        assert spec.unit in ("", "1") or spec.unit in said[0]
        assert spec.allowed in (None, ANY) or str(spec.allowed) in said[2]
    for option in spec.options if isinstance(value, str) else ():
        assert option in said[2]


@settings(some, max_examples=2 * EXAMPLES)
@given(
    st.one_of(
        st.dictionaries(NAMES, NUMBERS, min_size=1, max_size=1),
        st.dictionaries(NAMES | st.text(max_size=40), PLAIN, max_size=4),
        st.tuples(NAMES | st.text(max_size=40), ODD_TEXTS | st.text(max_size=60)).map(
            lambda pair: [f"{pair[0]}={pair[1]}"]
        ),
        st.lists(st.text(max_size=60), min_size=1, max_size=2),
    )
)
@example({"run.max_steps": 2**1024})
def test_of_any_override_comes_a_scene_that_can_be_written_or_one_line(overrides):
    scene = one_line(lambda: load_scene("tilt_0", overrides))
    if scene is not None:
        Bench(scene)  # its parameters can be computed
        assert load_scene_text(scene.to_yaml()) == scene


@some
@given(st.data())
def test_of_a_scene_file_of_any_content_comes_a_scene_or_one_line(tmp_path_factory, data):
    text = TEXT
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text)))
        put = data.draw(st.text(max_size=8) | ODD_TEXTS)
        text = text[:at] + put + text[at + data.draw(st.integers(0, 40)) :]
    scene = one_line(lambda: load_scene_text(text))
    assert scene is None or isinstance(scene, Scene)
    content = bytearray(TEXT.encode())
    at, damage = data.draw(st.integers(0, len(content))), data.draw(st.binary(max_size=300))
    content[at : at + len(damage)] = damage
    path = tmp_path_factory.mktemp("bytes") / "odd.yaml"
    path.write_bytes(content)
    one_line(lambda: load_scene(path))
    name = data.draw(st.text(max_size=400))
    scene = one_line(lambda: load_scene(name))
    assert scene is None or name.rpartition("/")[2].removesuffix(".yaml") in scene_names()


def bomb(depth):
    """Return a text whose aliases would stand for 9**depth values."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, depth)]
    return "\n".join(lines)


COSTLY = {
    "aliases that multiply": (bomb(9), "aliases"),
    "an alias of itself": ("a: &a [*a]", "aliases"),
    "a long text": ("x" * (MAX_TEXT + 1), "longer than"),
    "deep lists": ("[" * 5000, "nested deeper"),
    "deep mappings": (
        "a:\n" + "".join(f"{' ' * k}b:\n" for k in range(1, 200)),
        "nested deeper",
    ),
    "a list as a key": ("{[1]: 2}", "not a field name"),
    "a number as a key": ("2: 3", "not a field name"),
    "a tag": ("x: !!int y", "not valid YAML"),
    "a tag of Python": ("x: !!python/name:os.system", "not valid YAML"),
    "a null byte": ("x: \x00", "not valid YAML"),
}


@pytest.mark.parametrize("text, says", COSTLY.values(), ids=COSTLY)
def test_a_text_that_needs_much_memory_or_time_is_rejected(text, says):
    with pytest.raises(SceneError, match=says) as caught:
        parse(text, "mine.yaml")
    assert str(caught.value).startswith("mine.yaml")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_dates_and_sexagesimal_numbers_are_texts():
    text = "[2020-01-01, 1:30, 0x10, 1_0, 010, 1e3, 12]"
    assert parse(text, "x") == ["2020-01-01", "1:30", "0x10", "1_0", 10, 1000.0, 12]


def test_a_large_file_is_not_read_whole(tmp_path):
    path = tmp_path / "large.yaml"
    with path.open("wb") as file:
        file.truncate(10**10)  # sparse
    with pytest.raises(SceneError, match=r"large.yaml: longer than"):
        load_scene(path)


def test_files_that_extend_each_other_are_bounded(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.yaml").write_text("extends: sub/../a.yaml\n")
    (tmp_path / "b.yaml").symlink_to("c.yaml")
    (tmp_path / "c.yaml").write_text("extends: b\n")
    for name in ("a.yaml", "b.yaml"):
        with pytest.raises(SceneError, match="extends itself"):
            load_scene(tmp_path / name)
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


@pytest.mark.parametrize("size", [1e-30, 1e30])
@pytest.mark.parametrize(
    "name", ["probe.length", "cylinder.length", "cone.L_T", "initial.chaser.vx", "initial.chaser.x"]
)
def test_extreme_sizes_run_to_finite_numbers_or_are_an_error(name, size):
    try:
        bench = Bench(load_scene("paper_designed", {name: size, "run.max_steps": 1000}))
        samples = bench.advance(np.array([0.0, 1e-3]))
    except (SceneError, SimulationError):
        return
    assert np.isfinite(samples["penetration"]).all()
