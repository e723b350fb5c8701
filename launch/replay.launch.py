"""Play a recording: ros2 launch capture_sim replay.launch.py bag:=runs/tilt_0.mcap rate:=2.0."""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="an .mcap file, or a bag's folder"),
            DeclareLaunchArgument(
                "rate",
                default_value="1.0",
                description="recorded seconds per second; 0 as fast as it goes",
            ),
            DeclareLaunchArgument(
                "start", default_value="0.0", description="begin so many seconds later"
            ),
            DeclareLaunchArgument("loop", default_value="false", choices=["true", "false"]),
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
    """Return the player, and the detector if it is wanted."""

    def argument(name):
        return LaunchConfiguration(name).perform(context)

    parameters = {
        "bag": argument("bag"),
        "rate": float(argument("rate")),
        "start": float(argument("start")),
        "loop": argument("loop") == "true",
        "paused": argument("paused") == "true",
    }
    followers = []
    if argument("detect") == "true":
        parameters["consumers"] = ["capture_detector"]
        followers.append(node("capture_detector", exit_when_done=True))
    return [node("player", **parameters), *followers]


def node(name, **parameters):
    return Node(
        package="capture_sim",
        executable=name,
        name=name,
        parameters=[parameters],
        output="screen",
    )
