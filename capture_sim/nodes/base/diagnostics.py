"""The topic diagnostics: the state of a node's process."""

from __future__ import annotations

import time
from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

from capture_sim.nodes.base.endpoints import message_class
from capture_sim.nodes.base.node import BenchNode

#: Period of publication, s (wall).
PERIOD = 1.0


class Level(IntEnum):
    """Levels of DiagnosticStatus.msg."""

    OK = 0
    WARN = 1
    ERROR = 2


class DiagnosticStatus(NamedTuple):
    """The state of one part of a node."""

    name: str
    level: Level
    message: str
    values: Mapping[str, object]


class Diagnostics:
    """Publishes a node's statuses, stamped with wall time because they describe the process."""

    def __init__(self, node: BenchNode) -> None:
        self._node = node
        self._array, self._status, self._value = (
            message_class(f"diagnostic_msgs/msg/{name}")
            for name in ("DiagnosticArray", "DiagnosticStatus", "KeyValue")
        )
        self._publisher = node.create_publisher(self._array, "diagnostics", 10)

    def publish(self, *statuses: DiagnosticStatus) -> None:
        """Publish these statuses."""
        message = self._array(
            status=[
                self._status(
                    level=bytes([status.level]),
                    name=f"{self._node.get_name()}: {status.name}",
                    message=status.message,
                    hardware_id="capture_sim",
                    values=[self._value(key=k, value=str(v)) for k, v in status.values.items()],
                )
                for status in statuses
            ]
        )
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
        self._publisher.publish(message)
