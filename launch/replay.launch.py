"""Play a recording: ros2 launch capture_sim replay.launch.py bag:=/data/tilt_0.mcap rtf:=2.0."""

import shutil

from launch.actions import DeclareLaunchArgument, OpaqueFunction, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from capture_sim.errors import CaptureSimError
from capture_sim.messages.topics import PLAYER
from capture_sim.nodes.launching import REPLAY_ARGUMENTS, plan_replay
from launch import LaunchDescription

#: A node ends in order when this launch is killed.
TIED = "setpriv --pdeathsig INT" if shutil.which("setpriv") else ""


def fail_with(event, context):
    """End the launch, with a status that is not zero, because of a node that has failed."""
    if event.returncode != 0:
        raise RuntimeError(f"{event.process_name}: exit status {event.returncode}")


def start(context):
    """Return the actions that start what the arguments ask for."""
    given = {name: LaunchConfiguration(name).perform(context) for name in REPLAY_ARGUMENTS}
    try:
        plan = plan_replay(given)
    except CaptureSimError as error:
        raise RuntimeError(str(error)) from None
    actions = []
    for program, parameters in plan.nodes:
        ends = {"on_exit": Shutdown(reason="the player has ended")}
        node = Node(
            package="capture_sim",
            executable=program,
            name=program,
            namespace=plan.namespace,
            parameters=[parameters],
            output="screen",
            prefix=TIED,
            **(ends if program == PLAYER else {}),
        )
        ended = OnProcessExit(target_action=node, on_exit=fail_with)
        actions += [RegisterEventHandler(ended), node]
    return actions


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(name, default_value="", description=description)
        for name, description in REPLAY_ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
