"""The joints of a driver's messages, read without decoding each."""

import numpy as np
import pytest

from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messages.definitions import blank, typestore
from capture_sim.messages.joints import NoJointsError
from capture_sim.messages.measurements import MeasurementReader
from capture_sim.messages.topics import JOINT_STATES

OTHER = "wheel"


def serialised(names, position, velocity=(), effort=(), frame="", stamp=(3, 7)):
    message = blank(JOINT_STATES.type_name)
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    message.header.frame_id, message.name = frame, list(names)
    message.position, message.velocity = np.array(position), np.array(velocity, dtype=float)
    message.effort = np.array(effort, dtype=float)
    return bytes(typestore().serialize_cdr(message, JOINT_STATES.type_name))


def test_joints_are_found_again_when_a_message_differs_in_more_than_numbers():
    pair = (HINGE_JOINT, SLIDE_JOINT)
    messages = [
        (serialised(pair, (0.1, 0.2)), (0.2, 0.1)),
        (serialised(pair, (0.3, 0.4)), (0.4, 0.3)),
        (serialised(pair[::-1], (0.5, 0.6)), (0.5, 0.6)),  # of the same length
        (serialised((OTHER, *pair), (0.0, 0.7, 0.8)), (0.8, 0.7)),
        (serialised(pair, (0.1, 0.2), velocity=(1.0, 2.0)), (0.2, 0.1, 2.0, 1.0)),
        (serialised(pair, (0.1, 0.3), velocity=(1.0, 3.0)), (0.3, 0.1, 3.0, 1.0)),
        (serialised(pair, (0.1, 0.2), effort=(1.0, 2.0)), (0.2, 0.1)),  # of the same length
        (serialised(pair, (0.1, 0.3), effort=(1.0, 3.0), frame="buffer"), (0.3, 0.1)),
    ]
    reader = MeasurementReader(JOINT_STATES)
    for data, values in [*messages, *messages[::-1]]:
        assert reader(data) == (3_000_000_007, values)
        assert all(type(value) is float for value in reader(data)[1])


def test_other_joints_are_named_after_good_ones_too():
    reader = MeasurementReader(JOINT_STATES)
    good = serialised((HINGE_JOINT, SLIDE_JOINT), (0.1, 0.2))
    for _ in range(2):
        assert reader(good)[1] == (0.2, 0.1)
        with pytest.raises(NoJointsError, match="must be"):
            reader(serialised((HINGE_JOINT, OTHER), (0.1, 0.2)))
