"""No parameter of any node takes a wrong value, at its start or while a run is on."""

import os
from dataclasses import fields

import pytest
from bench_processes import Client, Started, processes, statuses
from forked import Forked
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
)
from rclpy.parameter import Parameter, parameter_value_to_python

from capture_sim import load_scene, simulate
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import write_run
from capture_sim.resources import config_dir
from capture_sim.scene.parts import Detector

NODES = ("simulator", "launcher", "capture_detector", "recorder")
# of every ROS 2 node
COMMON = ("use_sim_time", "start_type_description_service", "qos_overrides")
# what may be changed while a node runs, with values that may not: all others are read-only
WRONG = {
    "simulator": {
        "rtf": [-0.5, 1001.0, float("nan"), "fast", 2],
        "scenes": [["tilt_1"], ["tilt_0", "tilt_0"], ["tilt_p10"], "tilt_p10"],
        "overrides": [["buffer.c_A=-1"], ["buffer.c_B=1"], ["buffer.c_A=13"], 3.0],
    },
    "launcher": {
        "auto_release": ["no", 0],
        "speed_tolerance": [0.0, 10.5, float("nan"), "large"],
        "abort_on_deviation": ["no", 0],
    },
    "capture_detector": {
        field.name: [-1.0, float("inf"), "small", *([5.0] if field.metadata["unit"] == "m" else [])]
        for field in fields(Detector)
    },
    "recorder": {},
}
# name of the case: node, its parameters or remappings, words of the refusal
AT_THE_START = {
    "rtf out of range": ("simulator", {"rtf": "-1.0"}, ["rtf = -1.0", "0 to 1000"]),
    "rtf without point": ("simulator", {"rtf": "1"}, ["rtf = 1", "decimal point"]),
    "topics are numbers": ("recorder", {"topics": "[3]"}, ["topics = [3]", "texts"]),
    "no folder": ("recorder", {"out": "[]"}, ["out = []", "a text"]),
    "no radius": (
        "capture_detector",
        {"capture_radius": "[]"},
        ["capture_radius = []", "> 0 and <= 1 m"],
    ),
    "radius is a text": (
        "capture_detector",
        {"capture_radius": "big"},
        ["capture_radius = 'big'", "a number"],
    ),
    "radius below 0": (
        "capture_detector",
        {"capture_radius": "-0.001"},
        ["parameter capture_radius = -0.001 m: must be > 0 and <= 1"],
    ),
    "dwell without point": (
        "capture_detector",
        {"min_dwell": "1"},
        ["min_dwell = 1", "point, >= 0 s"],
    ),
    "speed is infinite": (
        "capture_detector",
        {"max_still_speed": ".inf"},
        ["parameter max_still_speed = inf m/s: must be finite and > 0"],
    ),
    "overrides are no number": ("simulator", {"overrides": ".nan"}, ["overrides = nan", "texts"]),
    "overrides of nothing": ("capture_detector", {"overrides": "[x]"}, ["overrides", "a scene"]),
    "no override of a scene": (
        "launcher",
        {"actuator": "none", "scene": "tilt_0", "overrides": "[x]"},
        ["x", "="],
    ),
    "rclpy's own parameter": ("launcher", {"use_sim_time": "[]"}, ["use_sim_time"]),
    "no name": ("launcher", {"__node": "a-b"}, ["a-b"]),
    "unknown scene": ("simulator", {"scenes": "[tilt_1]"}, ["tilt_1", "did you mean"]),
    "bad override": (
        "simulator",
        {"overrides": '["buffer.c_A=-1"]'},
        ["buffer.c_A = -1", "N s/m", ">= 0"],
    ),
    "same scene twice": ("simulator", {"scenes": "[tilt_0, tilt_0]"}, ["different names"]),
    "no scene": ("simulator", {"scenes": "[]"}, ["scenes = []", "names of scenes"]),
    "out is no folder": ("recorder", {"out": os.devnull}, [os.devnull, "folder"]),
    "no bag": ("player", {"paused": "true"}, ["parameter bag = ''"]),
    "no such bag": ("player", {"bag": "/nowhere.mcap"}, ["/nowhere.mcap: cannot read"]),
    "rtf of a player": ("player", {"bag": "x", "rtf": "-1.0"}, ["rtf = -1.0", "0 to 1000"]),
    "not in the bag": (
        "player",
        {"bag": "{bag}", "topics": "[/no/such]"},
        ["/no/such not in the recording"],
    ),
    "no such way": (
        "loop_simulator",
        {"compensation": "magic"},
        ["compensation = 'magic'", "none, prediction, model"],
    ),
    "no folder of the report": (
        "loop_simulator",
        {"report": "/no/such/r.json"},
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
    "in a file": ("simulator", {"--params-file": "{file}"}, ["reader_timeout = 5000.0"]),
    "in a file, for any namespace": (
        "simulator",
        {"--params-file": "{file}", "__ns": "/bench_2"},
        ["reader_timeout = 5000.0: must be"],
    ),
    "no syntax": ("launcher", {"auto_release": "["}, ["auto_release"]),
    "no bool": ("launcher", {"auto_release": "3"}, ["auto_release = 3", "true or false"]),
}


# one process for all: what takes long is the start of Python
@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """All nodes within a run that lasts as long as it is asked, and where it is recorded."""
    out = tmp_path_factory.mktemp("refused") / "out"
    with processes(Forked) as start, Client() as client:
        nodes = {
            "recorder": start("recorder", out=out),
            "capture_detector": start("capture_detector"),
            "launcher": start("launcher"),
            "simulator": start(
                "simulator", rtf=0.001, wait_for="[recorder, capture_detector, launcher]"
            ),
        }
        nodes["simulator"].wait_for("released")
        yield nodes, client, out / "tilt_0.mcap"


def own_parameters(client, node):
    names = client.ask(ListParameters, f"/{node}/list_parameters").result.names
    return [name for name in names if name.split(".")[0] not in COMMON]


def present(client, node, name):
    """Return a parameter's value; None where none is set."""
    values = client.ask(GetParameters, f"/{node}/get_parameters", names=[name]).values
    return parameter_value_to_python(values[0]) if values else None


def refusal(client, node, name, value):
    """Try to set a parameter; return the reason why it was not."""
    wanted = Parameter(name, value=value).to_parameter_msg()
    [result] = client.ask(SetParameters, f"/{node}/set_parameters", parameters=[wanted]).results
    assert not result.successful, (name, value)
    return result.reason


@pytest.mark.parametrize("node", NODES)
def test_wrong_values_are_refused_with_a_reason_during_a_run(node, bench):
    nodes, client, _ = bench
    names = own_parameters(client, node)
    assert set(WRONG[node]) <= set(names)
    before = {name: present(client, node, name) for name in names}
    for name, value in before.items():
        for wrong in WRONG[node].get(name, ()):
            assert len(refusal(client, node, name, wrong)) > 20
        if name not in WRONG[node]:
            # not even the value that it has: nothing is promised that is not kept
            assert "read-only" in refusal(client, node, name, ["x"] if value is None else value)
    assert repr({name: present(client, node, name) for name in names}) == repr(before)  # NaN too
    assert "done, " not in nodes["simulator"].text  # the run was on all the time


@pytest.mark.parametrize("node", NODES)
def test_parameters_are_described_with_their_range(node, bench):
    _, client, _ = bench
    names = own_parameters(client, node)
    described = client.ask(
        DescribeParameters, f"/{node}/describe_parameters", names=names
    ).descriptors
    for parameter in described:
        assert parameter.description
        assert parameter.additional_constraints
        assert parameter.read_only == (parameter.name not in WRONG[node])
        if node != "capture_detector" and parameter.type in (2, 3):  # numbers; criteria have units
            assert parameter.integer_range or parameter.floating_point_range, parameter.name


@pytest.mark.parametrize("node", NODES)
def test_every_parameter_has_a_value(node, bench):
    """As `ros2 param dump` asks for all of them at once, and rclpy answers all or none."""
    _, client, _ = bench
    names = client.ask(ListParameters, f"/{node}/list_parameters").result.names
    values = client.ask(GetParameters, f"/{node}/get_parameters", names=names).values
    assert len(values) == len(names) > 4
    by_name = {n: parameter_value_to_python(v) for n, v in zip(names, values, strict=True)}
    assert not [name for name, value in by_name.items() if value is None]
    assert not [name for name in names if name.startswith("qos_overrides.")]


def test_reasons_say_what_is_wrong(bench):
    _, client, _ = bench
    for node, name, value, words in (
        ("simulator", "scenes", ["tilt_p10"], "stopped; it is playing"),
        ("simulator", "rtf", 1001.0, "1000"),
        ("launcher", "speed_tolerance", 0.0, "0.01"),
        ("capture_detector", "min_dwell", -1.0, "min_dwell = -1.0 s: must be >= 0"),
        ("recorder", "out", "elsewhere", "read-only"),
        ("recorder", "paused", True, "read-only"),
        ("recorder", "paused", True, "read-only"),
    ):
        assert words in refusal(client, node, name, value), (node, name)


def test_run_notices_nothing_of_the_refusals(bench):
    nodes, client, path = bench
    assert client.set("simulator", rtf=0.0) == (True, "")
    assert statuses(nodes) == dict.fromkeys(NODES, 0), nodes["recorder"].text
    run = read_bag(path)
    assert run.complete
    assert run.samples.tobytes() == simulate(load_scene("tilt_0")).samples.tobytes()


def test_wrong_parameters_are_refused_at_the_start_with_one_line(tmp_path):
    bag, file = tmp_path / "run.mcap", tmp_path / "nodes.yaml"
    write_run(simulate(load_scene("tilt_0", ["run.t_end=0.1"])), bag)
    default, wrong = "reader_timeout: 10.0", "reader_timeout: 5000.0"
    file.write_text((config_dir() / "nodes.yaml").read_text().replace(default, wrong))
    begun = {}
    for case, (name, parameters, _) in AT_THE_START.items():
        arguments = ["--ros-args"]
        for key, value in parameters.items():
            text = value.format(bag=bag, file=file)
            if key.startswith("--"):
                arguments += [key, text]
            else:
                arguments += ["-r" if key.startswith("__") else "-p", f"{key}:={text}"]
        program = f"from capture_sim.nodes import {name} as node; raise SystemExit(node.main())"
        begun[case] = Started(Forked(program, arguments))
    for case, (_, _, words) in AT_THE_START.items():
        assert begun[case].status() == 2, case
        text = begun[case].text
        assert "Traceback" not in text, case
        [line] = [line for line in text.splitlines() if line.startswith("error:")]
        for word in words:
            assert word in line, case
