"""How processes find each other at once, and what got lost between them is repeated at once."""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path

#: Fast DDS repeats its announcements every 3 s, and processes that start one after another
#: wait that long for each other; a repetition every 0.2 s costs nothing on one machine.
#: Nor does a heartbeat every 0.1 s, as long as messages are not acknowledged; after the 3 s that
#: it has else, a run had stood still, or had been given up, for a single message that a full
#: queue of the shared memory had dropped.
PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="bench" is_default_profile="true">
    <rtps><builtin><discovery_config>
      <leaseAnnouncement><sec>0</sec><nanosec>200000000</nanosec></leaseAnnouncement>
    </discovery_config></builtin></rtps>
  </participant>
  <publisher profile_name="repeating" is_default_profile="true">
    <times><heartbeatPeriod><sec>0</sec><nanosec>100000000</nanosec></heartbeatPeriod></times>
  </publisher>
</profiles>
"""


def hasten(environment: MutableMapping[str, str], folder: Path) -> None:
    """Let the processes of an environment find each other fast, unless it says how itself.

    Parameters
    ----------
    environment
        Changed.
    folder
        Where a file can be put that lives as long as the processes.
    """
    if "FASTDDS_DEFAULT_PROFILES_FILE" not in environment:
        path = folder / "discovery.xml"
        path.write_text(PROFILE, encoding="utf-8")
        environment.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(path))
