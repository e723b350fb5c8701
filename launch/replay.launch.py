"""Play a recording: ros2 launch capture_sim replay.launch.py bag:=/data/tilt_0.mcap rtf:=2.0."""

from typing import List  # noqa: UP035

from launch.actions import DeclareLaunchArgument, RegisterEventHandler, Shutdown
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

TEXTS = List[str]  # noqa: UP006  # by which launch knows a list
SWITCH = ("true", "false")
#: Name, default, description and choices.
ARGUMENTS = (
    ("bag", None, "an .mcap file, or a bag's folder", None),
    ("rtf", "1.0", "real-time factor, 0 to 1000; 0 plays without pacing", None),
    ("start", "0.0", "time after the recording's start at which to begin, s", None),
    ("namespace", "/", "namespace of all nodes and topics", None),
    ("paused", "false", "start paused", SWITCH),
    ("detect", "false", "evaluate the run again; the recorded verdict is not played", SWITCH),
)


def fail_with(event, context):
    """End the launch, with a status that is not zero, because of a node that has failed."""
    if event.returncode != 0:
        raise RuntimeError(f"{event.process_name}: exit status {event.returncode}")


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description, choices=choices)
        for name, default, description, choices in ARGUMENTS
    ]
    detect = LaunchConfiguration("detect")
    wait_for = PythonExpression(["['capture_detector' if '", detect, "' == 'true' else '']"])
    player = Node(
        package="capture_sim",
        executable="player",
        name="player",
        namespace=LaunchConfiguration("namespace"),
        on_exit=Shutdown(reason="the player has ended"),
        parameters=[
            {
                "bag": LaunchConfiguration("bag"),
                "rtf": ParameterValue(LaunchConfiguration("rtf"), value_type=float),
                "start": ParameterValue(LaunchConfiguration("start"), value_type=float),
                "paused": ParameterValue(LaunchConfiguration("paused"), value_type=bool),
                "wait_for": ParameterValue(wait_for, value_type=TEXTS),
            }
        ],
        output="screen",
    )
    detector = Node(
        package="capture_sim",
        executable="capture_detector",
        name="capture_detector",
        namespace=LaunchConfiguration("namespace"),
        condition=IfCondition(detect),
        output="screen",
    )
    ends = RegisterEventHandler(OnProcessExit(on_exit=fail_with))
    return LaunchDescription([*arguments, ends, player, detector])
