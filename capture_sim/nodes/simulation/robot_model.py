"""The bench for RViz and Foxglove: robot_description, and tf if tf2_msgs is installed."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from capture_sim.messages.convert import stamp_ns
from capture_sim.messages.topics import ROBOT_DESCRIPTION, TF, TF_STATIC
from capture_sim.messages.urdf import (
    Transform,
    moving_transforms,
    static_transforms,
    urdf,
)
from capture_sim.nodes.base.endpoints import message_class, qos_of
from capture_sim.nodes.base.node import BenchNode
from capture_sim.scene.parts import Scene


class RobotModel:
    """Publishes the bench's shape (URDF), and the poses of its parts if tf2_msgs is installed.

    These messages serve only to show the bench.  They are not counted, and no run waits for their
    readers.  A recorder does not read them: it makes its own from the poses that it records, see
    :mod:`capture_sim.recording.frames`.
    """

    def __init__(self, node: BenchNode) -> None:
        self._node = node
        self._string = message_class("std_msgs/msg/String")
        self._description = node.create_publisher(
            self._string, ROBOT_DESCRIPTION.name, qos_of(ROBOT_DESCRIPTION)
        )
        self._moving: Any = None
        self._scene: Scene | None = None
        try:
            self._tf = message_class("tf2_msgs/msg/TFMessage")
        except ImportError:  # not among the wheels
            return
        self._stamped = message_class("geometry_msgs/msg/TransformStamped")
        self._moving = node.create_publisher(self._tf, TF.name, qos_of(TF))
        self._static = node.create_publisher(self._tf, TF_STATIC.name, qos_of(TF_STATIC))

    def begin(self, scene: Scene) -> None:
        """Publish the shape of this scene's bench, and the poses of its parts at the start."""
        self._scene = scene
        self._description.publish(self._string(data=urdf(scene)))
        if self._moving is not None:
            self._static.publish(self._message(static_transforms(scene), 0.0))
            q, _ = scene.initial_coordinates()
            self._moving.publish(self._message(moving_transforms(scene, q.tolist()), 0.0))

    def move(self, sample: np.void) -> None:
        """Publish the poses of the parts in this sample (dtype SAMPLE), if a node reads tf.

        Without a reader they are not made, because they need a third of a simulator's time.
        """
        if self._moving is None or self._scene is None:
            return
        if self._moving.get_subscription_count():
            transforms = moving_transforms(self._scene, sample["q"].tolist())
            self._moving.publish(self._message(transforms, float(sample["t"])))

    def _message(self, transforms: Iterable[Transform], t: float) -> Any:
        return self._tf(transforms=[self._transform(transform, t) for transform in transforms])

    def _transform(self, place: Transform, t: float) -> Any:
        message = self._stamped(child_frame_id=place.child)
        message.header.frame_id = place.parent
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(stamp_ns(t), 1_000_000_000)
        message.transform.translation.x = place.x
        message.transform.translation.y = place.y
        message.transform.rotation.z = math.sin(0.5 * place.yaw)
        message.transform.rotation.w = math.cos(0.5 * place.yaw)
        return message
