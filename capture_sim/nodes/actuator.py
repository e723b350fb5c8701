"""What lets the chaser go: the simulated release, or an output for a real one.

The launcher sends its LaunchCommands in either case; the simulator obeys them, a recording
keeps them.
"""

from __future__ import annotations

from typing import Protocol

from rclpy.qos import DurabilityPolicy, QoSProfile

from capture_sim.errors import CaptureSimError
from capture_sim.nodes.running import BenchNode, message_class

#: Where the output is, relative to the namespace.
HOLD = "launcher/hold"
KINDS = ("simulated", "output")


class Actuator(Protocol):
    """Holds the chaser, or lets it go."""

    def hold(self) -> None:
        """Hold."""

    def release(self) -> None:
        """Let go."""


class SimulatedRelease:
    """Leaves it to the simulator, which has heard the command."""

    def hold(self) -> None:
        """Do nothing."""

    def release(self) -> None:
        """Do nothing."""


class OutputRelease:
    """Drives a real release, such as a magnet's relay: std_msgs/Bool, true holds.

    Latched, so that a driver which starts late holds from its first message on.
    """

    def __init__(self, node: BenchNode) -> None:
        self._bool = message_class("std_msgs/msg/Bool")
        qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(self._bool, HOLD, qos)
        self.hold()

    def hold(self) -> None:
        """Send true."""
        self._publisher.publish(self._bool(data=True))

    def release(self) -> None:
        """Send false."""
        self._publisher.publish(self._bool(data=False))


def check_kind(kind: str) -> None:
    """Refuse what is no kind of actuator.

    Raises
    ------
    CaptureSimError
        It says what is allowed.
    """
    if kind not in KINDS:
        raise CaptureSimError(f"parameter actuator = {kind!r}: allowed is {' or '.join(KINDS)}")


def make_actuator(kind: str, node: BenchNode) -> Actuator:
    """Return the actuator of a kind."""
    return OutputRelease(node) if kind == "output" else SimulatedRelease()
