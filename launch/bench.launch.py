"""Run scenes with the nodes: ros2 launch capture_sim bench.launch.py experiment:=tilt_p10.

Every node may be left out, for a real one or one of your own that publishes the same topics:
simulator:=false, launcher:=false, detector:=false, record:=false.  What starts, and with which
parameters, is decided in capture_sim.nodes.launching, before the first process.
"""

import os
import shutil
import sys

from ament_index_python.packages import get_packages_with_prefixes
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
)
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from capture_sim.base.resources import config_dir
from capture_sim.errors import CaptureSimError
from capture_sim.messages.topics import SIMULATOR
from capture_sim.nodes.base.dds import RANGE
from capture_sim.nodes.launching import ARGUMENTS, plan_bench
from launch import LaunchDescription

#: What a sourced ROS would mix into the viewer's own environment.
MIXES = (
    *("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONHOME", "PYTHONPATH"),
    *("VIRTUAL_ENV", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"),
)
#: A node ends in order when this launch is killed.
TIED = "setpriv --pdeathsig INT" if shutil.which("setpriv") else ""


def fail_with(event, context):
    """End the launch, with a status that is not zero, because of a node that has failed."""
    if event.returncode != 0:
        raise RuntimeError(f"{event.process_name}: exit status {event.returncode}")


def start(context):
    """Return the actions that start what the arguments ask for."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    try:
        plan = plan_bench(given, lambda package: package in get_packages_with_prefixes())
    except CaptureSimError as error:
        raise RuntimeError(str(error)) from None
    reach = os.environ.get(RANGE) or "LOCALHOST"
    actions = [
        LogInfo(msg=f"Fast DDS: nodes are discoverable by {RANGE}={reach}; SUBNET opens them")
    ]
    if plan.note:
        actions.append(LogInfo(msg=plan.note))
    for program, parameters in plan.nodes:
        ends = {"on_exit": Shutdown(reason="the simulator has ended")}
        node = Node(
            package="capture_sim",
            executable=program,
            name=program,
            namespace=plan.namespace,
            parameters=[*([plan.params] if plan.params else []), parameters],
            output="screen",
            prefix=TIED,
            **(ends if program == SIMULATOR else {}),
        )
        ended = OnProcessExit(target_action=node, on_exit=fail_with)
        actions += [RegisterEventHandler(ended), node]
    if "view" in plan.shows:
        actions.append(
            ExecuteProcess(
                cmd=[
                    *(plan.shows["view"] or sys.executable, "-m", "capture_sim.nodes.viewer"),
                    *("--ros-args", "-r", f"__ns:={plan.namespace}"),
                ],
                name="viewer",
                env={key: value for key, value in os.environ.items() if key not in MIXES},
                output="screen",
                prefix=TIED,
            )
        )
    if "rviz" in plan.shows:
        actions.append(
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=plan.namespace,
                arguments=["-d", str(config_dir() / "bench.rviz")],
                remappings=[("/tf", "tf"), ("/tf_static", "tf_static")],
                prefix=TIED,
            )
        )
    return actions


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(name, default_value="", description=description)
        for name, description in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
