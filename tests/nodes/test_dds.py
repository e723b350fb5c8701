"""What DDS is set to where the user has not chosen: a bench is seen on its own machine only."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from rclpy.duration import Duration, Infinite
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from capture_sim.base.resources import config_dir
from capture_sim.nodes.base.dds import PEERS, PROFILES, RANGE, configure
from capture_sim.nodes.base.endpoints import qos_problem
from tests.nodes.bench_processes import Started

LOOPBACK, NETWORK = "fast_dds_loopback.xml", "fast_dds.xml"
CHOSEN = (*PROFILES, RANGE, PEERS, "ROS_LOCALHOST_ONLY")
# addresses as /proc has them
LOCALHOST = {"0100007F", "00000000000000000000000001000000"}
# waits for a service of the node and calls it: both must have found each other
PLAIN = """
import rclpy
from rcl_interfaces.srv import ListParameters
rclpy.init()
node = rclpy.create_node("plain")
client = node.create_client(ListParameters, "/launcher/list_parameters")
print("waits", flush=True)
assert client.wait_for_service(30.0)
while True:  # the first request may get lost, see bench_processes.Client
    answer = client.call_async(ListParameters.Request())
    rclpy.spin_until_future_complete(node, answer, timeout_sec=1.0)
    if answer.done():
        break
print("actuator" in answer.result().result.names, flush=True)
node.destroy_node()
rclpy.shutdown()
"""


@pytest.mark.parametrize(
    "given, profile, reach, by_default",
    [
        ({}, LOOPBACK, "SYSTEM_DEFAULT", True),
        ({RANGE: "LOCALHOST"}, LOOPBACK, "SYSTEM_DEFAULT", False),
        ({RANGE: "SUBNET"}, NETWORK, "SUBNET", False),
        ({RANGE: "OFF"}, NETWORK, "OFF", False),
        ({PEERS: "10.0.0.2"}, NETWORK, None, False),
        ({RANGE: "LOCALHOST", PEERS: "10.0.0.2"}, NETWORK, "LOCALHOST", False),
        ({RANGE: "SUBNET", "ROS_LOCALHOST_ONLY": "1"}, LOOPBACK, "SYSTEM_DEFAULT", False),
        *(({name: "/own.xml"}, None, None, False) for name in PROFILES),
    ],
)
def test_the_users_choice_of_profile_and_reach_holds(given, profile, reach, by_default):
    environment = dict(given)
    assert configure(environment) == by_default
    assert environment.get(RANGE) == reach
    if profile is None:
        assert environment == given
    else:
        assert environment[PROFILES[0]] == str(config_dir() / profile)
        assert (config_dir() / profile).is_file()


def test_both_profiles_repeat_announcements_and_messages_as_often():
    one, other = ((config_dir() / name).read_text().split() for name in (LOOPBACK, NETWORK))
    for text in (
        "<leaseDuration><sec>12</sec></leaseDuration>",
        "<leaseAnnouncement><sec>0</sec><nanosec>500000000</nanosec></leaseAnnouncement>",
        "<times><heartbeatPeriod><sec>0</sec><nanosec>10000000</nanosec></heartbeatPeriod></times>",
    ):
        assert text in one
        assert text in other


def started(program, *arguments, **chosen):
    environment = {name: value for name, value in os.environ.items() if name not in CHOSEN}
    return Started(
        subprocess.Popen(
            [sys.executable, *program, *arguments],
            env=environment | chosen,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    )


def addresses(pid):
    """Return the local addresses of a process's UDP and TCP sockets."""
    links = [str(file.readlink()) for file in Path(f"/proc/{pid}/fd").iterdir()]
    inodes = {link[8:-1] for link in links if link.startswith("socket:")}
    found = set()
    for table in ("udp", "udp6", "tcp", "tcp6"):
        for row in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = row.split()
            if words[9] in inodes:
                found.add(words[1].split(":")[0])
    return found


def test_a_node_opens_no_port_to_the_network_and_plain_nodes_find_it():
    node, plain = ("-m", "capture_sim.nodes.launcher"), ("-c", PLAIN)
    everything = [started(plain)]
    try:
        everything[0].wait_for("waits")
        launcher = started(node)
        everything.append(launcher)
        launcher.wait_for("ready")
        everything.append(started(plain))
        for one in everything[::2]:  # plain rclpy may not come to its end
            one.wait_for("True")
        assert "on this machine only; ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET" in launcher.text
        assert addresses(launcher.process.pid) <= LOCALHOST
        assert addresses(launcher.process.pid)
        # asked for, it is on the network
        everything.append(started(node, **{RANGE: "SUBNET"}))
        everything[-1].wait_for("ready")
        assert "00000000" in addresses(everything[-1].process.pid)
    finally:
        # killed, those with shared memory leave files of it
        for one in everything:
            one.process.send_signal(signal.SIGINT)
        for one in everything:
            with suppress(subprocess.TimeoutExpired):  # plain rclpy may not come to its end
                one.process.wait(20.0)
            one.process.kill()
            one.process.wait()


@pytest.mark.parametrize(
    "offered, requested, word",
    [
        ({}, {}, ""),
        ({}, {"reliability": ReliabilityPolicy.BEST_EFFORT}, ""),
        ({"reliability": ReliabilityPolicy.BEST_EFFORT}, {}, "reliable"),
        ({}, {"deadline": Duration(seconds=0.5)}, "deadline"),
        ({"deadline": Duration(seconds=0.1)}, {"deadline": Duration(seconds=0.5)}, ""),
        ({}, {"durability": DurabilityPolicy.TRANSIENT_LOCAL}, "transient local"),
    ],
)
def test_profiles_between_which_no_message_comes(offered, requested, word):
    # DDS gives the durations of a reader that sets none as infinite
    requested = {"deadline": Infinite, "liveliness_lease_duration": Infinite, **requested}
    reason = qos_problem(QoSProfile(depth=1, **offered), QoSProfile(depth=1, **requested))
    assert word in reason.lower()
    assert (reason == "") is (word == "")
