"""Shape and frames of the bench in a recording, so that RViz and Foxglove show it moving."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence

from capture_sim.detection.measurements import Source, Values
from capture_sim.errors import MessageError
from capture_sim.messages.convert import CHASER_FRAME, TARGET_FRAME, WORLD, Messages
from capture_sim.messages.measurements import OF_A_BENCH, MeasurementReader
from capture_sim.messages.topics import ROBOT_DESCRIPTION, TF, TF_STATIC, Topic
from capture_sim.messages.urdf import (
    CYLINDER_FRAME,
    PROBE_FRAME,
    Transform,
    static_transforms,
    urdf,
)
from capture_sim.scene.loading import load_scene_text

#: Topics of poses.
POSES = frozenset(topic for topic, source in OF_A_BENCH.items() if source is not Source.BUFFER)
#: Shortest interval between two poses of a frame, ns: more than a display draws.
MIN_INTERVAL = 16_000_000
# of a serialised TFMessage with one transform: header and length, stamp, ..., translation, rotation
_STAMP, _NUMBERS = struct.Struct("<iI"), struct.Struct("<7d")
_STAMP_OFFSET = 8


class FrameMessages:
    """Makes the messages of `/robot_description`, `/tf_static` and `/tf` for a recorded run.

    ``scene`` is the scene's text.  The poses are those of the measurements in the recording.  A
    frame follows the first topic that gives its pose, as a bench may have two.
    """

    def __init__(self, scene: str) -> None:
        self._scene = load_scene_text(scene)
        self._messages = Messages()
        self._readers: dict[Topic, MeasurementReader] = {}
        self._topics: dict[Source, Topic] = {}  # that give the poses
        self._last: dict[Source, int] = {}  # ns, stamp of the last pose
        self._templates: dict[str, bytes] = {}  # by the moving frame

    def constant(self) -> Iterator[tuple[Topic, bytes]]:
        """Yield the messages that are written once: the shape, and the frames that do not move."""
        messages = self._messages
        text = messages.new(ROBOT_DESCRIPTION.type_name, data=urdf(self._scene))
        yield ROBOT_DESCRIPTION, messages.serialise(text)
        yield TF_STATIC, self._serialised(list(static_transforms(self._scene)))

    def of(self, topic: Topic, data: bytes) -> Iterator[bytes]:
        """Yield the messages of `/tf` that a recorded message gives; none if it gives no pose."""
        source = OF_A_BENCH.get(topic)
        if source is None or self._topics.setdefault(source, topic) is not topic:
            return
        if topic not in self._readers:
            self._readers[topic] = MeasurementReader(topic)
        try:
            stamp, values = self._readers[topic](data)
        except MessageError:
            return
        if abs(stamp - self._last.get(source, -MIN_INTERVAL)) < MIN_INTERVAL:
            return
        self._last[source] = stamp
        for place in self._moved(source, values):
            if math.isfinite(place.x + place.y + place.yaw):
                yield self._filled(place, stamp)

    def _moved(self, source: Source, values: Values) -> Sequence[Transform]:
        if source is Source.CHASER:
            return [Transform(WORLD, CHASER_FRAME, *values[:3])]
        if source is Source.TARGET:
            return [Transform(WORLD, TARGET_FRAME, *values[:3])]
        stroke, torsion = values[:2]
        hinge = self._scene.buffer.hinge_offset
        return [
            Transform(CHASER_FRAME, CYLINDER_FRAME, hinge, 0.0, torsion),
            Transform(CYLINDER_FRAME, PROBE_FRAME, stroke, 0.0, 0.0),
        ]

    def _filled(self, place: Transform, stamp: int) -> bytes:
        if place.child not in self._templates:
            self._templates[place.child] = self._serialised([place])
        data = bytearray(self._templates[place.child])
        _STAMP.pack_into(data, _STAMP_OFFSET, *divmod(stamp, 1_000_000_000))
        rotation = 0.0, 0.0, math.sin(0.5 * place.yaw), math.cos(0.5 * place.yaw)
        _NUMBERS.pack_into(data, len(data) - _NUMBERS.size, place.x, place.y, 0.0, *rotation)
        return bytes(data)

    def _serialised(self, places: Sequence[Transform]) -> bytes:
        new = self._messages.new
        transforms = [
            new(
                "geometry_msgs/msg/TransformStamped",
                header=self._messages.header(0.0, place.parent),
                child_frame_id=place.child,
                **{"transform.translation.x": place.x, "transform.translation.y": place.y},
                **{
                    "transform.rotation.z": math.sin(0.5 * place.yaw),
                    "transform.rotation.w": math.cos(0.5 * place.yaw),
                },
            )
            for place in places
        ]
        return self._messages.serialise(new(TF.type_name, transforms=transforms))
