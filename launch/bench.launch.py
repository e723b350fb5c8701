"""Run experiments with the nodes: ros2 launch capture_sim bench.launch.py experiment:=tilt_p10.

Every node may be left out, for a real one or one of your own that speaks the same topics:
simulator:=false, launcher:=false, detector:=false, record:=false.
"""

import os
from pathlib import Path

from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

FASTEST = 1000.0
STATES = ("playing", "paused", "stopped")
#: What a sourced ROS would mix into the viewer's own environment.
MIXES = (
    *("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONHOME", "PYTHONPATH"),
    *("VIRTUAL_ENV", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"),
)

SWITCHES = {
    "simulator": ("true", "start the simulator; false: a real bench, or another simulator"),
    "launcher": ("true", "start the launcher"),
    "detector": ("true", "start the capture detector"),
    "record": ("true", "record to MCAP"),
    "view": ("false", "show the bench live with rerun"),
    "keep": ("false", "keep the nodes after the last run, to play or reset again"),
}


def generate_launch_description():
    texts = {
        "experiment": "names or files of scenes, separated by commas (tilt_0)",
        "rtf": f"real-time factor, 0 to {FASTEST:g}; 0 as fast as it goes (1)",
        "state": f"of the simulation at the start: {', '.join(STATES)} (playing)",
        "out": "folder of the recordings (runs)",
        "overrides": "changes of the scenes, as buffer.c_A=13, separated by commas (none)",
        "scene": "of a bench without simulator: the launcher begins its trials and drives the real "
        "release; without launcher the detector judges by it from the start (none)",
        "params": "YAML file of parameters, as config/nodes.yaml; what is set here wins",
        "namespace": "of all nodes and topics (/)",
        "view_python": "Python with rerun for the viewer, as `make setup` makes it, since rerun "
        "needs NumPy 2 and an apt Jazzy has 1.26 (.venv/bin/python)",
    }
    arguments = [
        DeclareLaunchArgument(name, default_value="", description=text)
        for name, text in texts.items()
    ]
    arguments += [
        DeclareLaunchArgument(
            name, default_value=default, choices=["true", "false"], description=text
        )
        for name, (default, text) in SWITCHES.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=suite)])


def suite(context):
    """Return the nodes that are asked for."""

    def argument(name):
        return LaunchConfiguration(name).perform(context)

    def wanted(name):
        return argument(name) == "true"

    started = [
        name
        for name, switch in (
            ("launcher", "launcher"),
            ("capture_detector", "detector"),
            ("recorder", "record"),
        )
        if wanted(switch)
    ]
    # on a real bench nobody says that it is all over
    ends = wanted("simulator") and not wanted("keep")
    parameters = {name: {"exit_when_done": ends} for name in (*started, "simulator")}
    parameters["simulator"] |= checked(argument)
    if started:  # ROS has no empty list
        parameters["simulator"]["consumers"] = list(started)
    if argument("scene"):
        parameters |= of_a_bench(argument, started, parameters)
    if argument("out") and wanted("record"):
        parameters["recorder"]["out"] = argument("out")
    if wanted("simulator"):
        started.append("simulator")

    files = [argument("params")] if argument("params") else []
    nodes = [
        Node(
            package="capture_sim",
            executable=name,
            name=name,
            namespace=argument("namespace"),
            parameters=[*files, parameters[name]],
            output="screen",
        )
        for name in started
    ]
    watch = Watch(len(nodes), ends)
    handlers = [
        RegisterEventHandler(OnProcessExit(target_action=node, on_exit=watch.ended))
        for node in nodes
    ]
    if wanted("view"):
        nodes.append(viewer(argument("view_python"), argument("namespace")))
    return [*handlers, *nodes]


def checked(argument):
    """Return the simulator's parameters that are given as arguments."""
    found = {}
    if argument("experiment"):
        found["scenes"] = listed(argument("experiment"))
    if argument("overrides"):
        found["overrides"] = listed(argument("overrides"))
    for name in ("experiment", "rtf", "state"):
        if argument(name) and argument("simulator") != "true":
            refuse(name, argument(name), "nothing where simulator:=false")
    if argument("overrides") and argument("simulator") != "true" and not argument("scene"):
        refuse("overrides", argument("overrides"), "nothing where simulator:=false and no scene:=")
    if argument("scene") and argument("simulator") == "true":
        refuse("scene", argument("scene"), "nothing but with simulator:=false")
    if argument("rtf"):
        try:
            found["rtf"] = float(argument("rtf"))
        except ValueError:
            found["rtf"] = -1.0
        if not 0.0 <= found["rtf"] <= FASTEST:
            refuse("rtf", argument("rtf"), f"a number from 0 to {FASTEST:g}, 1")
    if argument("state"):
        if argument("state") not in STATES:
            refuse("state", argument("state"), ", ".join(STATES))
        found["initial_state"] = argument("state")
    if argument("params") and not Path(argument("params")).is_file():
        refuse("params", argument("params"), "a YAML file that exists")
    return found


def of_a_bench(argument, started, parameters):
    """Return the parameters of the node that begins the trials of a bench without simulator."""
    begins = next((name for name in ("launcher", "capture_detector") if name in started), None)
    if begins is None:
        refuse("scene", argument("scene"), "nothing where neither launcher nor detector is started")
    found = parameters[begins] | {"scene": argument("scene")}
    if begins == "launcher":
        found["actuator"] = "output"
    if argument("overrides"):
        found["overrides"] = listed(argument("overrides"))
    return {begins: found}


def listed(text):
    return [word.strip() for word in text.split(",")]


def refuse(name, value, allowed):
    raise RuntimeError(f"argument {name}:={value}: must be {allowed}")


def viewer(python, namespace):
    """Return the viewer's process, in an environment of its own."""
    python = Path(python or ".venv/bin/python")
    if not python.is_file():
        refuse("view_python", python, "a Python that exists and has rerun: see `make setup`")
    return ExecuteProcess(
        cmd=[
            *(str(python), "-m", "capture_sim.nodes.viewer", "--ros-args"),
            *("-r", f"__ns:={namespace or '/'}"),
        ],
        name="viewer",
        env={key: value for key, value in os.environ.items() if key not in MIXES},
        output="screen",
    )


class Watch:
    """Notes how the nodes end; the launch fails if one of them has."""

    def __init__(self, count, ends):
        self.left = count
        self.ends = ends
        self.failed = []

    def ended(self, event, context):
        """Take in that a process has ended; a simulator that fails ends the others."""
        name = event.action.node_name if isinstance(event.action, Node) else event.process_name
        self.left -= 1
        if event.returncode != 0:
            self.failed.append(f"{name}: exit status {event.returncode}")
        if self.left == 0 and self.failed:
            # the only way for a launch file to make `ros2 launch` fail
            raise RuntimeError("; ".join(self.failed))
        if event.returncode != 0 and self.ends and name.endswith("simulator"):
            return [EmitEvent(event=Shutdown(reason=self.failed[-1]))]
        return []
