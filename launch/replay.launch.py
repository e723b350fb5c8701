"""Play a recording: ros2 launch capture_sim replay.launch.py bag:=runs/tilt_0.mcap rtf:=2.0."""

from launch.actions import DeclareLaunchArgument, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

FASTEST = 1000.0


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="an .mcap file, or a bag's folder"),
            DeclareLaunchArgument(
                "rtf",
                default_value="1.0",
                description="real-time factor: recorded seconds per second; 0 as fast as it goes",
            ),
            DeclareLaunchArgument(
                "start", default_value="0.0", description="begin so many seconds later"
            ),
            DeclareLaunchArgument("paused", default_value="false", choices=["true", "false"]),
            DeclareLaunchArgument(
                "detect",
                default_value="false",
                choices=["true", "false"],
                description="judge the run anew; the recorded judgement is not played",
            ),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context):
    """Return the player, and the detector if it is wanted; if one fails, both end."""

    def argument(name):
        return LaunchConfiguration(name).perform(context)

    parameters = {
        "bag": argument("bag"),
        "rtf": number("rtf", argument("rtf"), FASTEST),
        "start": number("start", argument("start")),
        "paused": argument("paused") == "true",
    }
    followers = []
    if argument("detect") == "true":
        parameters["consumers"] = ["capture_detector"]
        followers.append(node("capture_detector", exit_when_done=True))
    started = [node("player", **parameters), *followers]
    handlers = [
        RegisterEventHandler(OnProcessExit(target_action=action, on_exit=ended))
        for action in started
    ]
    return [*handlers, *started]


def number(name, text, largest=float("inf")):
    """Return the argument as a number from 0 on."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= largest or value == float("inf"):
        upward = "upward" if largest == float("inf") else f"to {largest:g}"
        raise RuntimeError(f"argument {name}:={text}: must be a number from 0 {upward}")
    return value


def ended(event, context):
    """End the launch with a status that is not zero when a node has failed."""
    if event.returncode != 0:
        raise RuntimeError(
            f"{event.action.node_name.rpartition('/')[2]}: exit status {event.returncode}"
        )


def node(name, **parameters):
    return Node(
        package="capture_sim",
        executable=name,
        name=name,
        parameters=[parameters],
        output="screen",
    )
