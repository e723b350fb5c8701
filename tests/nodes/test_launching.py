"""What a launch file decides, without ros2 launch: what wins, what starts, what is refused."""

from pathlib import Path

import pytest
import yaml

from capture_sim.errors import CaptureSimError
from capture_sim.nodes.launching import ARGUMENTS, REPLAY_ARGUMENTS, plan_bench, plan_replay

ROOT = Path(__file__).resolve().parents[2]
BENCH = {"simulator": "false", "scene": "tilt_0"}


def params(folder, /, **nodes):
    """Write a file of parameters, by node; return its path."""
    path = folder / "mine.yaml"
    content = {f"/**/{name}": {"ros__parameters": values} for name, values in nodes.items()}
    path.write_text(yaml.safe_dump(content))
    return str(path)


def started(given):
    return {node.program: node.parameters for node in plan_bench(given).nodes}


# nothing is released unless the user asks for it; one "none" anywhere prevents it


@pytest.mark.parametrize(
    "arguments, file, actuator",
    [
        ({}, {}, "none"),
        ({"actuator": "output"}, {}, "output"),
        ({}, {"actuator": "output"}, "output"),
        ({"actuator": "none"}, {"actuator": "output"}, "none"),
        ({"actuator": "output"}, {"actuator": "none"}, "none"),
        ({"actuator": "output", "dry_run": "true"}, {}, "none"),
        ({"dry_run": "true"}, {"actuator": "output"}, "none"),
        ({"scene": ""}, {"actuator": "none", "scene": "tilt_p10"}, "none"),
        ({"scene": ""}, {"scene": "tilt_p10"}, "none"),
        ({}, {"actuator": "simulated"}, "none"),
    ],
)
def test_output_must_be_said_and_none_wins(arguments, file, actuator, tmp_path):
    given = BENCH | arguments | {"params": params(tmp_path, launcher=file)}
    plan = plan_bench(given)
    [launcher] = [node for node in plan.nodes if node.program == "launcher"]
    assert launcher.parameters["actuator"] == actuator
    assert plan.note.startswith("dry run" if actuator == "none" else "the launcher releases")


def test_a_simulated_bench_has_no_actuator_unless_a_file_says_none(tmp_path):
    assert "actuator" not in started({})["launcher"]
    file = params(tmp_path, launcher={"actuator": "none"})
    assert started({"params": file})["launcher"]["actuator"] == "none"


# argument > file > default

#: By argument: node, parameter, a value in the file, the argument's text and what it makes.
WINS = {
    "experiment": ("simulator", "scenes", ["tilt_m10"], "tilt_p10, tilt_0", ["tilt_p10", "tilt_0"]),
    "overrides": ("simulator", "overrides", ["buffer.c_A=9"], "buffer.c_A=13", ["buffer.c_A=13"]),
    "rtf": ("simulator", "rtf", 3.0, "0", 0.0),
    "state": ("simulator", "initial_state", "paused", "stopped", "stopped"),
    "keep": ("simulator", "exit_when_done", False, "false", True),
    "out": ("recorder", "out", "/here", "/there", "/there"),
}


@pytest.mark.parametrize("name", WINS)
def test_an_argument_wins_over_the_file_and_the_file_over_the_default(name, tmp_path):
    node, parameter, in_file, text, value = WINS[name]
    file = {"params": params(tmp_path, **{node: {parameter: in_file}})}
    assert parameter not in started(file)[node]  # the node reads the file
    assert started({**file, name: text})[node][parameter] == value


def test_every_key_of_the_shipped_file_is_left_to_the_file(tmp_path):
    """A copy of nodes.yaml with a changed value: no argument that was not given wins over it."""
    shipped = yaml.safe_load((ROOT / "config" / "nodes.yaml").read_text())
    nodes = {name.removeprefix("/**/"): each["ros__parameters"] for name, each in shipped.items()}
    nodes = {name: values or {} for name, values in nodes.items()}
    nodes["simulator"]["wait_for"] = ["recorder"]
    found = started({"params": params(tmp_path, **nodes)})
    for name, own in found.items():
        assert not own.keys() & nodes.get(name, {}).keys(), name


@pytest.mark.parametrize("key", ["/**", "/lab/*", "/lab/simulator", "simulator", "/**/simulator"])
def test_names_of_a_file_match_as_in_ros(key, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({key: {"ros__parameters": {"wait_for": ["mine"]}}}))
    own = started({"params": str(path), "namespace": "lab"})["simulator"]
    is_match = key != "simulator"  # that one is in no namespace
    assert ("wait_for" not in own) is is_match


def test_what_is_left_out_is_not_waited_for():
    found = started({"record": "false", "launcher": "false"})
    assert found.keys() == {"capture_detector", "simulator"}
    assert found["simulator"]["wait_for"] == ["capture_detector"]
    assert started({"simulator": "false"}).keys() == {"launcher", "capture_detector", "recorder"}
    alone = started(BENCH | {"launcher": "false"})
    assert alone["capture_detector"]["scene"] == "tilt_0"


# all is checked before the first process


@pytest.mark.parametrize(
    "given, said",
    [
        ({"rtf": "abc"}, "rtf = 'abc': must be a number from 0 to 1000"),
        ({"rtf": "1,0"}, "rtf = '1,0': must be a number from 0 to 1000"),
        ({"rtf": "-1"}, "rtf = '-1': must be"),
        ({"rtf": "nan"}, "rtf = 'nan': must be"),
        ({"state": "gone"}, "state = 'gone': must be playing or paused or stopped"),
        ({"record": "yes"}, "record = 'yes': must be true or false"),
        ({"actuator": "simulated"}, "actuator = 'simulated': must be output or none"),
        ({"experiment": "tilt_1"}, "scene 'tilt_1': not found"),
        ({"experiment": "tilt_0,the crew's.yaml"}, "the crew's.yaml"),
        ({"overrides": "buffer.c_B=3"}, "buffer.c_B"),
        ({"scene": "tilt_1", "simulator": "false"}, "scene 'tilt_1': not found"),
        ({"params": "nowhere.yaml"}, "params = nowhere.yaml: must be a file"),
        ({"namespace": "a b"}, "namespace = 'a b': must be a ROS name"),
        ({"rviz": "true"}, "rviz2 is not installed"),
        ({"view": "true", "view_python": "/nope"}, "view_python = /nope: must be a Python"),
        ({"rft": "1"}, "rft: not an argument"),
    ],
)
def test_a_wrong_argument_is_named_before_anything_starts(given, said):
    with pytest.raises(CaptureSimError) as error:
        plan_bench(given, lambda _: False)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["[", "- a", "/**/simulator: 3", "a: {ros__parameters: [1]}"])
def test_a_wrong_file_of_parameters_is_named(text, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(CaptureSimError, match="params = "):
        plan_bench({"params": str(path)})


def test_a_replay_is_checked_too(tmp_path):
    bag = tmp_path / "a.mcap"
    bag.touch()
    plan = plan_replay({"bag": str(bag), "detect": "true", "rtf": "0"})
    assert [node.program for node in plan.nodes] == ["player", "capture_detector"]
    assert plan.nodes[0].parameters["rtf"] == 0.0
    for given in (
        {"bag": "gone.mcap"},
        {"bag": str(bag), "rtf": "x"},
        {"bag": str(bag), "paused": "?"},
    ):
        with pytest.raises(CaptureSimError):
            plan_replay(given)


def test_the_launch_files_declare_these_arguments():
    for name, arguments in (("bench", ARGUMENTS), ("replay", REPLAY_ARGUMENTS)):
        text = (ROOT / "launch" / f"{name}.launch.py").read_text()
        assert "ARGUMENTS.items()" in text
        assert all(len(description) > 10 for description in arguments.values())
