"""Run scenes with the nodes: ros2 launch capture_sim bench.launch.py experiment:=tilt_p10.

Every node may be left out, for a real one or one of your own that publishes the same topics:
simulator:=false, launcher:=false, detector:=false, record:=false.
"""

import os
import sys
from pathlib import Path
from typing import List  # noqa: UP035

from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from capture_sim.base.resources import config_dir
from launch import LaunchDescription, Substitution

TEXTS = List[str]  # noqa: UP006  # by which launch knows a list
SWITCH = ("true", "false")
#: Name, default, description and choices; `ros2 launch -s capture_sim bench.launch.py` shows them.
ARGUMENTS = (
    ("experiment", "tilt_0", "scenes in turn, separated by commas: names or files", None),
    ("overrides", "", "changes of the scenes, SI units, e.g. buffer.c_A=13,buffer.k_A=500", None),
    ("rtf", "1.0", "real-time factor, 0 to 1000; 0 runs without pacing", None),
    ("state", "playing", "initial state of the simulation", ("playing", "paused", "stopped")),
    ("out", str(Path.home() / "capture_sim_runs"), "folder of the recordings", None),
    (
        "scene",
        "",
        "scene of a bench without simulator: the launcher serves its trials, action "
        "launcher/run_trial, and drives the real release; without launcher, the detector evaluates "
        "by it from the start",
        None,
    ),
    (
        "params",
        str(config_dir() / "nodes.yaml"),
        "YAML file of further parameters, e.g. criteria; arguments take precedence",
        None,
    ),
    ("namespace", "/", "namespace of all nodes and topics", None),
    ("simulator", "true", "start the simulator; false: a real bench, or another one", SWITCH),
    ("launcher", "true", "start the launcher", SWITCH),
    ("detector", "true", "start the capture detector", SWITCH),
    ("record", "true", "record to MCAP", SWITCH),
    ("keep", "false", "keep the nodes after the last run, to play or reset again", SWITCH),
    ("rviz", "false", "show the bench in RViz, where rviz2 is installed", SWITCH),
    ("view", "false", "show the bench live with rerun", SWITCH),
    (
        "view_python",
        sys.executable,
        "Python with rerun for the viewer, e.g. of `make setup`: rerun needs NumPy 2, an apt Jazzy "
        "has 1.26",
        None,
    ),
)
#: What a sourced ROS would mix into the viewer's own environment.
MIXES = (
    *("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONHOME", "PYTHONPATH"),
    *("VIRTUAL_ENV", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"),
)


class Quoted(Substitution):
    """The text of an argument as Python writes it, whatever quotes it contains."""

    def __init__(self, name):
        super().__init__()
        self._name = name

    def perform(self, context):
        return repr(context.launch_configurations[self._name])


def python(*parts, **kind):
    """Return the value of a Python expression of texts and, as `$name`, of arguments."""
    expression = PythonExpression(
        [Quoted(part[1:]) if part.startswith("$") else part for part in parts]
    )
    return ParameterValue(expression, value_type=kind["kind"]) if kind else expression


def bench_node(name, switch, parameters, **more):
    return Node(
        package="capture_sim",
        executable=name,
        name=name,
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params"), parameters],
        condition=IfCondition(LaunchConfiguration(switch)),
        output="screen",
        **more,
    )


def fail_with(event, context):
    """End the launch, with a status that is not zero, because of a node that has failed."""
    if event.returncode != 0:
        raise RuntimeError(f"{event.process_name}: exit status {event.returncode}")


def check_params(context):
    """Reject a file of parameters that is missing: launch_ros would only warn of it."""
    path = LaunchConfiguration("params").perform(context)
    if not Path(path).is_file():
        raise RuntimeError(f"params = {path}: must be a file")


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description, choices=choices)
        for name, default, description, choices in ARGUMENTS
    ]
    # the simulator's end shuts the others down
    ends = {"exit_when_done": python("$keep", " == 'false'", kind=bool)}
    changes = python("[c.strip() for c in ", "$overrides", ".split(',')]", kind=TEXTS)
    # the launcher serves trials of a bench without simulator
    by_launcher = ("$scene", " if ", "$simulator", " == 'false' else ''")
    by_detector = ("$scene", " if ", "$simulator", " == ", "$launcher", " == 'false' else ''")

    def trials(scene):
        changes_of_it = ("[c.strip() for c in ", "$overrides", ".split(',')] if (", *scene)
        return {
            "scene": python(*scene, kind=str),
            "overrides": python(*changes_of_it, ") else ['']", kind=TEXTS),
        }

    wait_for = python(
        *("[name for name, switch in (('launcher', ", "$launcher", "), ('capture_detector', "),
        *("$detector", "), ('recorder', ", "$record", ")) if switch == 'true'] or ['']"),
        kind=TEXTS,
    )
    actuator = python(
        "'output' if ", "$simulator", " == 'false' and ", "$scene", " else 'simulated'"
    )
    nodes = [
        bench_node("launcher", "launcher", trials(by_launcher) | {"actuator": actuator}),
        bench_node("capture_detector", "detector", trials(by_detector)),
        bench_node("recorder", "record", {"out": LaunchConfiguration("out")}),
        bench_node(
            "simulator",
            "simulator",
            ends
            | {
                "scenes": python(
                    *("[name.strip() for name in ", "$experiment", ".split(',')]"), kind=TEXTS
                ),
                "overrides": changes,
                "rtf": ParameterValue(LaunchConfiguration("rtf"), value_type=float),
                "initial_state": LaunchConfiguration("state"),
                "wait_for": wait_for,
            },
            on_exit=Shutdown(reason="the simulator has ended"),
        ),
    ]
    viewer = ExecuteProcess(
        cmd=[
            *(LaunchConfiguration("view_python"), "-m", "capture_sim.nodes.viewer", "--ros-args"),
            *("-r", ["__ns:=", LaunchConfiguration("namespace")]),
        ],
        name="viewer",
        env={key: value for key, value in os.environ.items() if key not in MIXES},
        condition=IfCondition(LaunchConfiguration("view")),
        output="screen",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),
        arguments=["-d", str(config_dir() / "bench.rviz")],
        remappings=[("/tf", "tf"), ("/tf_static", "tf_static")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    handlers = [
        RegisterEventHandler(OnProcessExit(target_action=node, on_exit=fail_with)) for node in nodes
    ]
    check = OpaqueFunction(function=check_params)
    return LaunchDescription([*arguments, check, *handlers, *nodes, viewer, rviz])
