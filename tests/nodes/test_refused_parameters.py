"""No parameter of any node takes a wrong value, at its start or while it runs.

Nodes are made and asked in this process, as their services do; ``CAPTURE_SIM_CASES=5000`` tries
that many values.
"""

import math
import os
import re
from contextlib import contextmanager
from dataclasses import fields
from importlib import import_module

import pytest
from cases import cases
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.parameter import Parameter

from capture_sim import load_scene, simulate
from capture_sim.base.resources import config_dir
from capture_sim.errors import CaptureSimError
from capture_sim.recording.offline import write_run
from capture_sim.scene.parts import Detector
from tests.nodes.bench_client import ros_arguments
from tests.nodes.bench_processes import Started, fresh
from tests.nodes.own_domain import own_domain, participant

EXAMPLES = cases(few=60, all=300)
NODES = ("simulator", "launcher", "capture_detector", "recorder")
#: What may be changed while a node runs; all else is read-only.
CHANGED = {
    "simulator": {"rtf", "scenes", "overrides"},
    "launcher": {"auto_release", "speed_tolerance", "abort_on_deviation"},
    "capture_detector": {field.name for field in fields(Detector)},
    "recorder": set(),
}
#: What nodes.process.run shows as one line; whatever else a node's making raises is a defect.
REFUSALS = (CaptureSimError, RuntimeError, ParameterException, NameValidationException)
NUMBERS = (0.0, -0.0, 0.01, 0.5, 1.0, 5.0, -1.0, 1000.0, 1001.0, 5e-324, 1e308)
TEXTS = ("", "x", "tilt_0", "tilt_1", "run.t_end=0.5", "buffer.c_A=-1", "a\x1b[31m", "é" * 300)
#: Values of every type that ROS has for parameters.
VALUES = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.sampled_from((*NUMBERS, math.nan, math.inf, -math.inf))
    | st.floats()
    | st.sampled_from((*TEXTS, "/etc/passwd", "../x", "playing"))
    | st.lists(st.sampled_from(TEXTS), min_size=1, max_size=3)
    | st.lists(st.floats(), min_size=1, max_size=3)
    | st.lists(st.integers(-5, 5), min_size=1, max_size=3)
    | st.lists(st.booleans(), min_size=1, max_size=3)
    | st.binary(min_size=1, max_size=3).map(lambda data: [bytes([each]) for each in data])
)
HURRIED = settings(
    max_examples=EXAMPLES,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)


@contextmanager
def made(name, **parameters):
    """Make a node of ours as its command line does; it is closed at the end."""
    kind = "".join(word.capitalize() for word in (*name.split("_"), "node"))
    make = getattr(import_module(f"capture_sim.nodes.{name}"), kind)
    arguments = ros_arguments(parameters)
    node = make(context=participant(), cli_args=arguments, use_global_arguments=False)
    try:
        yield node
    finally:
        node.close()


@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    """All nodes, the simulation stopped."""
    out = tmp_path_factory.mktemp("out")
    with (
        own_domain(),
        made("simulator", initial_state="stopped") as simulator,
        made("launcher") as launcher,
        made("capture_detector") as detector,
        made("recorder", out=out) as recorder,
    ):
        yield dict(zip(NODES, (simulator, launcher, detector, recorder), strict=True))


def own_parameters(node):
    names = node.list_parameters([], 0).names
    return [name for name in names if not re.match(r"use_sim_time|start_type_desc", name)]


def is_in_range(descriptor, value):
    spans = [*descriptor.floating_point_range, *descriptor.integer_range]
    return all(span.from_value <= value <= span.to_value for span in spans)


@pytest.mark.parametrize("name", NODES)
def test_parameters_are_described_with_unit_and_range_and_have_a_value(name, nodes):
    """As `ros2 param dump` asks for all of them at once, and rclpy answers all or none."""
    node = nodes[name]
    for parameter in own_parameters(node):
        descriptor = node.describe_parameter(parameter)
        assert descriptor.description
        assert descriptor.additional_constraints
        assert descriptor.read_only == (parameter not in CHANGED[name])
        value = node.get_parameter(parameter).value
        assert value is not None
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            in_words = parameter in CHANGED["capture_detector"]
            assert in_words or descriptor.floating_point_range or descriptor.integer_range
    assert CHANGED[name] <= set(own_parameters(node))
    assert not [each for each in own_parameters(node) if each.startswith("qos_overrides")]


@pytest.mark.parametrize("name", NODES)
def test_any_value_is_taken_in_its_range_or_refused_by_name(name, nodes):
    """While the node runs, by its service: what is refused changes nothing."""
    node = nodes[name]
    names = sorted(own_parameters(node))

    @HURRIED
    @given(st.sampled_from(names), VALUES)
    def try_value(parameter, value):
        before = repr(node.get_parameter(parameter).value)  # also of NaN
        [result] = node.set_parameters([Parameter(parameter, value=value)])
        after = node.get_parameter(parameter).value
        if result.successful:
            assert parameter in CHANGED[name]
            assert type(after) is type(value)
            assert repr(after) == repr(value)
            assert (
                math.isnan(value)
                if value != value
                else is_in_range(node.describe_parameter(parameter), value)
            )
        else:
            assert repr(after) == before
            if parameter not in CHANGED[name]:
                assert "read-only" in result.reason
            else:
                # an override is refused by its own name, as the scene's file would be
                known = (parameter, *(text.split("=")[0] for text in TEXTS), "scene")
                assert any(text and text in result.reason for text in known), result.reason
                assert "\n" not in result.reason
        assert node.failure is None

    try_value()


def test_reasons_say_what_is_wrong(nodes):
    for name, parameter, value, words in (
        ("simulator", "rtf", 1001.0, "1000"),
        ("simulator", "scenes", ["tilt_0", "tilt_0"], "different names"),
        ("simulator", "scenes", ["tilt_1"], "did you mean"),
        ("simulator", "overrides", ["buffer.c_A=-1"], "N s/m: must be >= 0"),
        ("launcher", "speed_tolerance", 0.0, "0.01"),
        ("capture_detector", "min_dwell", -1.0, "min_dwell = -1.0 s: must be >= 0"),
        ("recorder", "out", "elsewhere", "read-only"),
    ):
        [result] = nodes[name].set_parameters([Parameter(parameter, value=value)])
        assert not result.successful
        assert words in result.reason, (name, parameter)


def test_a_scene_is_not_changed_while_a_run_is_on():
    with made("simulator", initial_state="paused") as node:
        [result] = node.set_parameters([Parameter("scenes", value=["tilt_p10"])])
        assert "may be changed while the simulation is stopped; it is paused" in result.reason


# at the start

# name of the case: node, its parameters or remappings, words of the refusal
AT_THE_START = {
    "rtf out of range": ("simulator", {"rtf": "-1.0"}, ["rtf = -1.0", "0 to 1000"]),
    "rtf without point": ("simulator", {"rtf": "1"}, ["rtf = 1", "decimal point"]),
    "topics are numbers": ("recorder", {"topics": "[3]"}, ["topics = [3]", "texts"]),
    "no folder": ("recorder", {"out": "[]"}, ["out = []", "a text"]),
    "no radius": (
        *("capture_detector", {"capture_radius": "[]"}),
        ["capture_radius = []", "> 0 and <= 1 m"],
    ),
    "radius below 0": (
        *("capture_detector", {"capture_radius": "-0.001"}),
        ["parameter capture_radius = -0.001 m: must be > 0 and <= 1"],
    ),
    "speed is infinite": (
        *("capture_detector", {"max_still_speed": ".inf"}),
        ["parameter max_still_speed = inf m/s: must be finite and > 0"],
    ),
    "overrides are no number": (
        "simulator",
        {"overrides": ".nan"},
        ["overrides = nan", "PART.FIELD"],
    ),
    "overrides of nothing": ("capture_detector", {"overrides": "[x]"}, ["overrides", "a scene"]),
    "no override of a scene": (
        *("launcher", {"actuator": "none", "scene": "tilt_0", "overrides": "[x]"}),
        ["x", "="],
    ),
    "rclpy's own parameter": ("launcher", {"use_sim_time": "[]"}, ["use_sim_time"]),
    "no name": ("launcher", {"__node": "a-b"}, ["a-b"]),
    "unknown scene": ("simulator", {"scenes": "[tilt_1]"}, ["tilt_1", "did you mean"]),
    "bad override": (
        *("simulator", {"overrides": '["buffer.c_A=-1"]'}),
        ["buffer.c_A = -1", "N s/m", ">= 0"],
    ),
    "same scene twice": ("simulator", {"scenes": "[tilt_0, tilt_0]"}, ["different names"]),
    "no scene": ("simulator", {"scenes": "[]"}, ["scenes = []", "names of scenes"]),
    "out is no folder": ("recorder", {"out": os.devnull}, [os.devnull, "folder"]),
    "no bag": ("player", {"paused": "true"}, ["parameter bag = ''"]),
    "no such bag": ("player", {"bag": "/nowhere.mcap"}, ["/nowhere.mcap: cannot read"]),
    "rtf of a player": ("player", {"bag": "x", "rtf": "-1.0"}, ["rtf = -1.0", "0 to 1000"]),
    "not in the bag": (
        *("player", {"bag": "{bag}", "topics": "[/no/such]"}),
        ["/no/such not in the recording"],
    ),
    "no such way": (
        *("loop_simulator", {"compensation": "magic"}),
        ["compensation = 'magic'", "none, prediction, model"],
    ),
    "no folder of the report": (
        *("loop_simulator", {"report": "/no/such/r.json"}),
        ["parameter report = '/no/such/r.json'", "/no/such is not a folder"],
    ),
    "no folder of the record": (
        "loop_simulator",
        {"record": "/no/such/r.mcap"},
        ["parameter record = '/no/such/r.mcap'", "/no/such is not a folder"],
    ),
    "report is a folder": ("loop_simulator", {"report": "/"}, ["report = '/'", "it is a folder"]),
    "no such actuator": ("launcher", {"actuator": "hand"}, ["'hand'", "simulated, output, none"]),
    "scene of a simulator": ("launcher", {"scene": "tilt_0"}, ["scene = 'tilt_0'", "be empty"]),
    "pose age": ("launcher", {"max_pose_age": "0.0"}, ["max_pose_age = 0.0", "0.02 to 10"]),
    "no such state": ("simulator", {"initial_state": "gone"}, ["'gone'", "stopped, playing"]),
    "in a file, for any namespace": (
        *("simulator", {"--params-file": "{file}", "__ns": "/bench_2"}),
        ["reader_timeout = 5000.0: must be"],
    ),
    "no syntax": ("launcher", {"auto_release": "["}, ["auto_release"]),
    "no bool": ("launcher", {"auto_release": "3"}, ["auto_release = 3", "true or false"]),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    bag, file = folder / "run.mcap", folder / "nodes.yaml"
    write_run(simulate(load_scene("tilt_0", ["run.t_end=0.1"])), bag)
    default, wrong = "reader_timeout: 15.0", "reader_timeout: 5000.0"
    file.write_text((config_dir() / "nodes.yaml").read_text().replace(default, wrong))
    return {"bag": bag, "file": file}


@pytest.mark.parametrize("case", AT_THE_START)
def test_wrong_parameters_are_refused_at_the_start(case, files):
    name, parameters, words = AT_THE_START[case]
    given = {key: value.format(**files) for key, value in parameters.items()}
    with pytest.raises(REFUSALS) as refusal, made(name, **given):
        pass
    line = str(refusal.value).splitlines()[0]
    for word in words:
        assert word in line


def test_any_value_at_the_start_makes_a_node_or_is_refused_by_name(nodes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {name: sorted(own_parameters(node)) for name, node in nodes.items()}
    chosen = st.one_of(st.tuples(st.just(name), st.sampled_from(names[name])) for name in NODES[1:])
    texts = VALUES.map(str) | st.sampled_from(("[]", "{}", "[[1]]", "!!x", "'", "[1, a]", "~"))

    @settings(HURRIED, max_examples=EXAMPLES // 3)
    @given(chosen, texts)
    def try_value(which, text):
        name, parameter = which
        reason = ""
        try:
            with made(name, **{parameter: text}):
                pass
        except REFUSALS as error:
            reason = str(error)
        assert not reason or parameter in reason or "scene" in reason, reason

    try_value()


def test_a_refusal_is_one_line_and_status_2():
    program = "from capture_sim.nodes import recorder as node; raise SystemExit(node.main())"
    node = Started(fresh(program, ros_arguments({"out": os.devnull})))
    assert node.status() == 2
    [line] = [line for line in node.text.splitlines() if line.startswith("error:")]
    assert f"parameter out = '{os.devnull}': must be a folder" in line
    assert "Traceback" not in node.text
