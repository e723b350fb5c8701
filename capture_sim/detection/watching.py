"""From messages to verdict: the detector's inputs, whoever sends them.

One :class:`Watch` serves the node, a bag and the offline run.  Where the scene has motion
capture, it is judged by what that sees; else by the poses of the odometry.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from capture_sim.detection.align import Aligner, Source, Values
from capture_sim.detection.exact import CaptureDetector, CaptureStatus
from capture_sim.messages.convert import stamp_ns, stamp_seconds
from capture_sim.messages.topics import (
    BUFFER_STATE,
    CHASER_ODOMETRY,
    CHASER_POSE,
    TARGET_ODOMETRY,
    TARGET_POSE,
    Topic,
)
from capture_sim.scene.parts import Scene
from capture_sim.sensors import Sensors


def watched(scene: Scene) -> dict[Topic, Source]:
    """Return the topics that the detector judges by, and what each of them measures."""
    if scene.sensors is not None and scene.sensors.motion_capture is not None:
        poses = {CHASER_POSE: Source.CHASER, TARGET_POSE: Source.TARGET}
    else:
        poses = {CHASER_ODOMETRY: Source.CHASER, TARGET_ODOMETRY: Source.TARGET}
    return {**poses, BUFFER_STATE: Source.BUFFER}


class Watch:
    """Follows the messages of one run to its verdict.

    Parameters
    ----------
    scene
        Geometry, criteria, and what is measured.
    """

    def __init__(self, scene: Scene) -> None:
        self.detector = CaptureDetector(scene)
        self.aligner = Aligner(scene.detector.gap)
        #: What is judged by: the source by the topic's name.
        self.sources = {topic.name: source for topic, source in watched(scene).items()}

    def take(self, name: str, message: Any) -> list[CaptureStatus]:
        """Take in a message; return the judgements that it completes.

        Parameters
        ----------
        name
            Of the topic; messages of topics that are not judged by are passed over.
        message
            nav_msgs/Odometry, geometry_msgs/PoseStamped or capture_sim/BufferState, of any
            library.
        """
        source = self.sources.get(name.lstrip("/"))
        if source is None:
            return []
        stamp = message.header.stamp
        t = stamp_seconds(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec))
        return self.measure(source, t, measured(source, message))

    def measure(self, source: Source, t: float, values: Values) -> list[CaptureStatus]:
        """Take in a measurement, see :class:`capture_sim.detection.align.Source`."""
        return [self.detector.update(seen) for seen in self.aligner.add(source, t, values)]

    def finish(self, *, cut: bool = False) -> list[CaptureStatus]:
        """Return the judgements of what was still waiting, the final verdict last.

        ``cut``: the run was ended before its end, and may have come to no verdict.
        """
        rest = [self.detector.update(seen) for seen in self.aligner.flush()]
        return [*rest, self.detector.finish(cut=cut)]


def measured(source: Source, message: Any) -> Values:
    """Return what a message says, see :class:`capture_sim.detection.align.Source`."""
    if source is Source.BUFFER:
        return (message.axial_stroke, message.torsion, message.axial_rate, message.torsion_rate)
    if not hasattr(message, "twist"):
        return _planar(message.pose)
    pose, twist = _planar(message.pose.pose), message.twist.twist
    return (*pose, *twist_values(pose[2], twist.linear.x, twist.linear.y, twist.angular.z))


def pose_values(x: float, y: float, qz: float, qw: float) -> tuple[float, float, float]:
    """Return x, y (m) and heading (rad) of a position and a quaternion about z."""
    return x, y, 2.0 * math.atan2(qz, qw)


def twist_values(theta: float, vx: float, vy: float, omega: float) -> tuple[float, float, float]:
    """Return velocity (m/s) and rate (rad/s) in the world of those in the own frame."""
    c, s = math.cos(theta), math.sin(theta)
    return c * vx - s * vy, s * vx + c * vy, omega


def _planar(pose: Any) -> tuple[float, float, float]:
    return pose_values(pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w)


class MotionCaptureWatch(Watch):
    """Judges the samples of a run with motion capture as the node judges its messages.

    Parameters
    ----------
    scene
        Has motion capture.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._sensors = Sensors(scene)
        self._every = round(scene.run.state_rate / scene.run.rate)
        self._count = 0

    def look(self, samples: np.ndarray) -> list[CaptureStatus]:
        """Take in the next samples, (n,) of dtype SAMPLE; return the judgements."""
        statuses = []
        for sample in samples:
            t = stamp_seconds(stamp_ns(float(sample["t"])))
            if self._count % self._every == 0:
                v = sample["v"].tolist()
                values = (float(sample["axial_stroke"]), float(sample["torsion"]))
                statuses += self.measure(Source.BUFFER, t, (*values, v[4], v[3] - v[2]))
            read = self._sensors.read(sample)
            for source, pose in ((Source.CHASER, read.chaser), (Source.TARGET, read.target)):
                if pose is not None:
                    statuses += self.measure(source, t, _through_quaternion(pose))
            self._count += 1
        return statuses


def _through_quaternion(pose: tuple[float, float, float]) -> Values:
    """Return the pose as it comes out of a message, to the last bit."""
    x, y, theta = pose
    return x, y, 2.0 * math.atan2(math.sin(theta / 2.0), math.cos(theta / 2.0))
