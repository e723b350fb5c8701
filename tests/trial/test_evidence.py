"""What a node keeps of its messages for the rules, before a release and in a trial."""

import pytest

from capture_sim import load_scene
from capture_sim.messages.convert import Messages
from capture_sim.messages.topics import JOINT_STATES
from capture_sim.nodes.trials.evidence import Evidence

MESSAGES = Messages()


def sent(stamp):
    seconds, nanoseconds = divmod(round(stamp * 1e9), 10**9)
    new = MESSAGES.new
    time = new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    header = new("std_msgs/msg/Header", stamp=time, frame_id="")
    names, values = ["buffer_hinge", "buffer_slide"], [1e-6 * (seconds % 7), 0.0]
    return MESSAGES.serialise(
        new("sensor_msgs/msg/JointState", header=header, name=names, position=values)
    )


@pytest.mark.parametrize("waived, counts", [((), True), (("machine_clock", "start"), False)])
def test_before_a_release_a_clock_that_was_set_is_refused_whatever_clock_will_do(waived, counts):
    """In a trial it is not where any clock will do, since its rate may vary."""
    evidence = Evidence(waived)
    for k in range(150):
        stamp = 1.7e9 + 0.01 * k - (0.5 if k > 100 else 0.0)
        evidence.add(JOINT_STATES, sent(stamp), 10_000_000 * k)

    def names(doubts):
        return {doubt.rule.name for doubt in doubts}

    now = 1_500_000_000
    assert "clock_steps" in names(evidence.before_release(evidence.latest(now), None))
    in_trial = names(evidence.of_trial(load_scene("tilt_0")))
    assert ("clock_steps" in in_trial) == counts
