"""Which answers of a rig are used, what stops the loop, and the messages."""

import math

import numpy as np
import pytest

from capture_sim import load_scene
from capture_sim.errors import CaptureSimError
from capture_sim.hardware.answers import Answers
from capture_sim.hardware.guard import Guard, LoopLimits
from capture_sim.hardware.law import NO_WRENCH, TipState, Wrench
from capture_sim.hardware.messages import tip_message, tip_of, wrench_message, wrench_of
from capture_sim.hardware.stage import LoopStage, SafeStopError
from capture_sim.messages.convert import CONE_FRAME, Messages
from capture_sim.messages.definitions import typestore


def at_rest(limits=LoopLimits(), rest=(NO_WRENCH,) * 100):  # noqa: B008 - frozen
    answers = Answers(Guard(LoopStage(load_scene("_loop")), limits))
    for wrench in rest:
        answers.offer(0.0, 0.0, wrench, None)
    answers.tare()
    return answers


def test_bias_and_noise_are_taken_at_rest():
    rng = np.random.default_rng(1)
    bias = Wrench(0.5, -0.3, 4.0, 0.1, 0.0, -0.02)
    rest = [Wrench(*(np.array(bias) + 0.1 * rng.normal(size=6))) for _ in range(200)]
    answers = at_rest(rest=rest)
    assert answers.n_at_rest == 200
    assert answers.bias == pytest.approx(bias, abs=0.04)
    assert answers.noise == pytest.approx(0.1, rel=0.2)
    got = answers.offer(0.001, 0.002, Wrench(10.5, -0.3, 4.0, 0.1, 0.0, -0.02), None)
    assert got.wrench == pytest.approx((10.0, 0, 0, 0, 0, 0), abs=0.04)


def test_a_cell_that_is_loaded_at_rest_stops_the_loop():
    with pytest.raises(SafeStopError, match=r"force at rest = 18.4 N: must be <= 10 .bias_limit"):
        at_rest(rest=[Wrench(0.0, -18.4)] * 100)


def test_what_cannot_be_used_is_counted_by_its_reason():
    answers = at_rest()
    for stamp, wrench in (
        (0.001, Wrench(math.nan)),
        (0.001, Wrench(tz=math.inf)),
        (math.nan, NO_WRENCH),
        (0.005, Wrench(1.0)),
        (1.7e9, Wrench(1.0)),
        (-1.0, Wrench(1.0)),  # an unset stamp: the loop's own begin at 1 s
        (0.0, Wrench(1.0)),
    ):
        assert answers.offer(stamp, 0.002, wrench, None) is None
    assert answers.offer(0.002, 0.002, Wrench(3.0), None).wrench.fx == 3.0
    assert answers.offer(0.001, 0.003, Wrench(9.0), None) is None
    assert dict(answers.rejections) == {
        "not finite": 3,
        "stamped ahead of the loop": 1,
        "stamped by a wall clock; must be the stamp of the position it answers": 1,
        "stamped before the loop's start": 1,
        "not newer than the previous wrench": 2,
    }
    with pytest.raises(SafeStopError, match=r"0\.098 s: must be <= 0\.05 \(timeout\); 8 wr"):
        answers.check_latency(0.1)


def test_a_wrench_is_held_up_to_the_limit_and_no_longer():
    answers = at_rest(LoopLimits(latency=0.01))
    answers.offer(0.001, 0.001, Wrench(1.0), None)
    answers.check_latency(0.011)
    with pytest.raises(
        SafeStopError, match=r"latency of the wrench = 0\.011 s: must be <= 0\.01 \(timeout\)$"
    ):
        answers.check_latency(0.012)


@pytest.mark.parametrize("stamp", [0.002, 0.001, -1.0, 5.0, 1.7e9])
@pytest.mark.parametrize(
    "wrench, message",
    [
        (Wrench(200.0, 200.0, 200.0), "force on the rig = 346.4 N: must be <= 300"),
        (Wrench(fz=-301.0), "force on the rig = 301 N"),
        (Wrench(tx=20.0, tz=25.0), "torque on the rig = 32.02 N m: must be <= 30"),
    ],
)
def test_all_six_components_are_limited_whatever_the_stamp_is(wrench, message, stamp):
    answers = at_rest()
    answers.offer(0.001, 0.002, NO_WRENCH, None)
    with pytest.raises(SafeStopError, match=message):
        answers.offer(stamp, 0.002, wrench, None)


def test_messages_say_what_was_put_in():
    make = Messages()
    tip_state = TipState(0.125, -0.02, 0.004, 0.3, 0.1, -0.05, 0.7)
    read = typestore().deserialize_cdr
    got = tip_of(read(tip_message(make, 0.125, tip_state), "nav_msgs/msg/Odometry"))
    assert got == pytest.approx(tip_state, rel=1e-14)
    wrench = Wrench(1.0, -2.0, 3.0, 0.1, 0.2, 0.3)
    message = read(wrench_message(make, 0.125, wrench), "geometry_msgs/msg/WrenchStamped")
    assert wrench_of(message) == wrench
    message.header.frame_id = "world"
    with pytest.raises(CaptureSimError, match=f"'world': must be {CONE_FRAME}"):
        wrench_of(message)
