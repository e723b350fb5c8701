"""Choice of the Fast DDS profile, and of the network range in which nodes are discoverable."""

from __future__ import annotations

from collections.abc import MutableMapping

from rclpy.utilities import get_rmw_implementation_identifier

from capture_sim.base.resources import config_dir

#: Environment variables in which Fast DDS looks for a profile.
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS = "ROS_STATIC_PEERS"


def configure(environment: MutableMapping[str, str]) -> bool:
    """Choose a profile in the environment if the user names none; call before ``rclpy.init()``.

    Nodes are bound to the loopback interface unless ROS_AUTOMATIC_DISCOVERY_RANGE or
    ROS_STATIC_PEERS requests more.  ROS's own range LOCALHOST is not sufficient: with it,
    rmw_fastrtps limits discovery, but its UDP ports are open to all interfaces.  So the loopback
    profile limits discovery as LOCALHOST does, and rmw_fastrtps adds nothing to it
    (SYSTEM_DEFAULT).  Return True if the node is limited to this machine by default, not by a
    request of the user.
    """
    if any(environment.get(name) for name in PROFILES):
        return False
    reach = environment.get(RANGE, "")
    if environment.get("ROS_LOCALHOST_ONLY") == "1":  # from older ROS; overrides the other two
        reach = "LOCALHOST"
        for name in ("ROS_LOCALHOST_ONLY", PEERS):
            environment.pop(name, None)
    here = reach in ("", "LOCALHOST") and not environment.get(PEERS)
    if here:
        of_fast_dds = "fastrtps" in get_rmw_implementation_identifier()
        environment[RANGE] = "SYSTEM_DEFAULT" if of_fast_dds else "LOCALHOST"
    profile = "fast_dds_loopback.xml" if here else "fast_dds.xml"
    environment[PROFILES[0]] = str(config_dir() / profile)
    return here and not reach
