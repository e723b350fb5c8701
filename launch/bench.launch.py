"""Run experiments with the nodes: ros2 launch capture_sim bench.launch.py experiment:=tilt_p10."""

from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "experiment",
                default_value="tilt_0",
                description="names or files of scenes, separated by commas",
            ),
            DeclareLaunchArgument(
                "record", default_value="true", choices=["true", "false"], description="to MCAP"
            ),
            DeclareLaunchArgument(
                "rtf",
                default_value="0.0",
                description="simulated seconds per second; 0 as fast as it goes",
            ),
            DeclareLaunchArgument("out", default_value="runs", description="folder of recordings"),
            OpaqueFunction(function=suite),
        ]
    )


def suite(context):
    """Return the four nodes; they end by themselves after the last run."""

    def argument(name):
        return LaunchConfiguration(name).perform(context)

    followers = {"launcher": {}, "capture_detector": {}}
    if argument("record") == "true":
        followers["recorder"] = {"out": argument("out")}
    simulator = node(
        "simulator",
        scenes=[name.strip() for name in argument("experiment").split(",")],
        pace=float(argument("rtf")),
        consumers=list(followers),
    )
    return [
        simulator,
        *(node(name, **parameters) for name, parameters in followers.items()),
        RegisterEventHandler(OnProcessExit(target_action=simulator, on_exit=end_after_failure)),
    ]


def node(name, **parameters):
    return Node(
        package="capture_sim",
        executable=name,
        name=name,
        parameters=[{"exit_when_done": True, **parameters}],
        output="screen",
    )


def end_after_failure(event, _):
    """End the others when the simulator could not even announce a run to them."""
    if event.returncode != 0:
        return [EmitEvent(event=Shutdown(reason=f"simulator: exit status {event.returncode}"))]
    return []
