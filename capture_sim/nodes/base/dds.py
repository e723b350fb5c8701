"""Which profile of Fast DDS the nodes use, and how far they reach."""

from __future__ import annotations

from collections.abc import MutableMapping

from rclpy.utilities import get_rmw_implementation_identifier

from capture_sim.base.resources import config_dir

#: Where Fast DDS looks for a profile.
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS = "ROS_STATIC_PEERS"


def configure(environment: MutableMapping[str, str]) -> bool:
    """Choose the profile where the user names none; comes before ``rclpy.init()``.

    Nodes are bound to the loopback interface unless ROS_AUTOMATIC_DISCOVERY_RANGE or
    ROS_STATIC_PEERS asks for more.  ROS's own LOCALHOST does not do that: with it rmw_fastrtps
    limits discovery, on UDP ports that are open to all interfaces.  So the profile for loopback
    does what LOCALHOST does, and rmw_fastrtps adds nothing to it (SYSTEM_DEFAULT).  Return whether
    the node stays on this machine without having been asked to.
    """
    if any(environment.get(name) for name in PROFILES):
        return False
    reach = environment.get(RANGE, "")
    if environment.get("ROS_LOCALHOST_ONLY") == "1":  # of older ROS, stronger than the others
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
