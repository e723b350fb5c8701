"""The two messages of the loop: where the tip is, and what acts on it."""

from __future__ import annotations

import math
from typing import Any

from capture_sim.errors import CaptureSimError
from capture_sim.hardware.in_the_loop import TipState, Wrench
from capture_sim.messages.convert import CONE_FRAME, TIP_FRAME, Message, Messages, stamp_seconds


def stamp_of(message: Any) -> float:
    """Return the stamp of a message with a header, s since the loop's start."""
    stamp = message.header.stamp
    return stamp_seconds(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec))


class LoopMessages(Messages):
    """Makes the loop's messages."""

    def tip(self, tip: TipState) -> Message:
        """Return Odometry of the tip against the cone: pose in its frame, twist in the tip's."""
        cos, sin = math.cos(tip.theta), math.sin(tip.theta)
        return self._odometry(
            header=self.header(tip.t, CONE_FRAME),
            child_frame_id=TIP_FRAME,
            pose=self._pose_with_covariance(
                pose=self._pose(
                    position=self._point(x=tip.x, y=tip.y, z=0.0),
                    orientation=self._quaternion(
                        x=0.0, y=0.0, z=math.sin(tip.theta / 2.0), w=math.cos(tip.theta / 2.0)
                    ),
                ),
                covariance=self._no_covariance,
            ),
            twist=self._twist_with_covariance(
                twist=self._twist(
                    linear=self._vector3(
                        x=cos * tip.vx + sin * tip.vy, y=cos * tip.vy - sin * tip.vx, z=0.0
                    ),
                    angular=self._vector3(x=0.0, y=0.0, z=tip.omega),
                ),
                covariance=self._no_covariance,
            ),
        )

    def wrench(self, t: float, wrench: Wrench) -> Message:
        """Return WrenchStamped on the tip, about its centre, in the axes of target/cone.

        ``t`` is the time of the tip's place that it answers, s.
        """
        fx, fy, torque = wrench
        return self._wrench_stamped(
            header=self.header(t, CONE_FRAME),
            wrench=self._wrench(
                force=self._vector3(x=fx, y=fy, z=0.0),
                torque=self._vector3(x=0.0, y=0.0, z=torque),
            ),
        )


def tip_of(message: Any) -> TipState:
    """Return what a message says of the tip.

    Raises
    ------
    CaptureSimError
        It is given in another frame than target/cone.
    """
    _check_frame(message)
    pose, twist = message.pose.pose, message.twist.twist
    theta = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    cos, sin = math.cos(theta), math.sin(theta)
    return TipState(
        t=stamp_of(message),
        x=pose.position.x,
        y=pose.position.y,
        theta=theta,
        vx=cos * twist.linear.x - sin * twist.linear.y,
        vy=sin * twist.linear.x + cos * twist.linear.y,
        omega=twist.angular.z,
    )


def wrench_of(message: Any) -> Wrench:
    """Return the wrench that a message says.

    Raises
    ------
    CaptureSimError
        It is given in another frame than target/cone.
    """
    _check_frame(message)
    force, torque = message.wrench.force, message.wrench.torque
    return force.x, force.y, torque.z


def _check_frame(message: Any) -> None:
    frame = message.header.frame_id
    if frame != CONE_FRAME:
        raise CaptureSimError(f"header.frame_id = {frame!r}: allowed is {CONE_FRAME}")
