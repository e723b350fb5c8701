"""Messages made from core data: content, order, independence of blocks, as ROS reads them."""

from __future__ import annotations

import dataclasses
import importlib
import math
import operator
import os
import re
from collections import Counter
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

import capture_sim
from capture_sim.base.resources import message_dir
from capture_sim.dynamics.samples import SAMPLE, TOUCH, Event, EventKind, Phase
from capture_sim.errors import CaptureSimError, MessageError
from capture_sim.launcher.state_machine import Launcher
from capture_sim.messages import topics
from capture_sim.messages.cdr import Numbers, fill
from capture_sim.messages.convert import (
    EPOCH_NS,
    LaunchAction,
    Messages,
    RunDescription,
    stamp_ns,
    stamp_seconds,
    stamps_ns,
    string_phases,
)
from capture_sim.messages.definitions import is_known, learn_type, typestore
from capture_sim.messages.standard import STANDARD
from capture_sim.messages.telemetry import (
    BenchTelemetry,
    ContactInterval,
    DetectorTelemetry,
    LauncherTelemetry,
    samples_per_message,
)
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    BUFFER_STATE,
    CHASER_ODOMETRY,
    CHASER_POSE,
    CLOCK,
    CONTACT_STATE,
    CONTACT_WRENCH,
    JOINT_STATES,
    LOAD_CELL,
    SIMULATOR,
    STREAM_COUNTS,
    STRING_STATE,
    TARGET_ODOMETRY,
    TOPICS,
    Rate,
    Stamp,
)
from capture_sim.recording.offline import PUBLISHERS, run_stream


@pytest.fixture(scope="module")
def result():
    everything = ["sensors.motion_capture={}", "sensors.load_cell={}", "run.trace=true"]
    return capture_sim.simulate(capture_sim.load_scene("tilt_p10", everything))


@pytest.fixture(scope="module")
def run(result):
    return RunDescription.of(result.scene, "a run", PUBLISHERS)


@pytest.fixture(scope="module")
def stream(result, run):
    store = typestore()
    return [
        (topic, store.deserialize_cdr(data, topic.type_name))
        for topic, _, data in run_stream(result, run)
    ]


def of_topic(stream, topic):
    return [message for sent, message in stream if sent is topic]


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


# the table of topics


def test_every_interface_of_the_package_has_a_topic_and_every_topic_a_type():
    types = set(typestore().fielddefs)
    assert {topic.type_name for topic in TOPICS} <= types
    ours = {name for name in types if name.startswith("capture_sim/")}
    in_services = {
        f"capture_sim/msg/{word}"
        for path in (message_dir().parent / "srv").glob("*.srv")
        for word in re.findall(r"^([A-Z]\w+) ", path.read_text(), re.MULTILINE)
    }
    sent = {t.type_name for t in TOPICS if t.type_name.startswith("capture_sim/")}
    assert ours == sent | in_services | {topics.ROLL.type_name}


def test_standard_types_are_those_of_ros_and_others_come_on_demand():
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    store = typestore.__wrapped__()  # in which nothing was looked up yet
    assert {name: jazzy.fielddefs[name] for name in STANDARD} == STANDARD
    # what the topics need, and no more of ROS
    others = {topic.type_name for topic in TOPICS} - STANDARD.keys()
    assert all(name.startswith("capture_sim/") for name in others)
    assert store.types.keys() - STANDARD.keys() == {
        f"capture_sim/msg/{path.stem}" for path in message_dir().glob("*.msg")
    }
    for name in STANDARD:
        assert store.hash_rihs01(name) == jazzy.hash_rihs01(name)
        assert store.generate_msgdef(name) == jazzy.generate_msgdef(name)
    assert store.fielddefs["sensor_msgs/msg/Imu"] == jazzy.fielddefs["sensor_msgs/msg/Imu"]
    assert store.hash_rihs01("sensor_msgs/msg/Imu") == jazzy.hash_rihs01("sensor_msgs/msg/Imu")
    assert is_known("std_msgs/msg/String")
    assert not is_known("no_msgs/msg/Such")
    assert not learn_type("no_msgs/msg/Such", Path(os.devnull))


def test_table_says_truly_which_types_carry_stamp_and_sequence():
    for topic in TOPICS:
        fields = typestore().fielddefs[topic.type_name][1]
        names = [name for name, _ in fields]
        starts_with_header = fields[0][1] == (Nodetype.NAME, "std_msgs/msg/Header")
        assert (topic.stamp is Stamp.HEADER) == starts_with_header, topic.name
        assert topic.sequenced == (names[1:2] == ["seq"]), topic.name


def test_names_are_found_relative_and_absolute():
    assert topics.topic_named("/bench/state") is BENCH_STATE
    assert topics.topic_named("bench/state") is BENCH_STATE
    assert topics.topic_named("clock") is topics.CLOCK
    assert topics.topic_named("camera/image") is None


# stamps


def test_stamps_are_exact_on_the_grid_and_come_back():
    k = np.arange(20_001)
    for rate in (1000.0, 100.0, 250.0, 1e6):
        times = (k / rate).tolist()
        stamps = [stamp_ns(t) for t in times]
        assert stamps == (EPOCH_NS + k * round(1e9 / rate)).tolist()
        assert stamps_ns(k / rate).tolist() == stamps
        assert [stamp_seconds(stamp) for stamp in stamps] == times


# content against the samples, computed here in another way


def test_bench_state_has_every_field_of_a_sample_and_no_other():
    fields = [name for name, _ in typestore().fielddefs[BENCH_STATE.type_name][1]]
    assert fields == ["header", "seq", *SAMPLE.names]


def test_odometry_is_the_pose_in_the_world_and_the_twist_in_the_own_frame(result, stream):
    every = samples_per_message(result.scene.run.state_rate, result.scene.run.rate)
    for topic, first in ((CHASER_ODOMETRY, 0), (TARGET_ODOMETRY, 5)):
        messages = of_topic(stream, topic)
        samples = result.samples[::every]
        assert len(messages) == len(samples)
        for message, sample in zip(messages, samples, strict=True):
            x, y, theta = sample["q"][first : first + 3]
            turn = message.pose.pose.orientation
            assert (message.pose.pose.position.x, message.pose.pose.position.y) == (x, y)
            assert 2 * math.atan2(turn.z, turn.w) == pytest.approx(theta, abs=1e-15)
            # back to the world by complex numbers
            linear = message.twist.twist.linear
            world = complex(linear.x, linear.y) * np.exp(1j * theta)
            assert world.real == pytest.approx(sample["v"][first], abs=1e-16)
            assert world.imag == pytest.approx(sample["v"][first + 1], abs=1e-16)
            assert message.twist.twist.angular.z == sample["v"][first + 2]
    assert messages[0].child_frame_id == "target/base_link"


def test_wrench_is_the_whole_force_on_the_tip_in_the_probe_s_frame(result, stream):
    every = samples_per_message(result.scene.run.state_rate, result.scene.run.rate)
    samples = result.samples[::every]
    forces = np.array(
        [[m.wrench.force.x, m.wrench.force.y] for m in of_topic(stream, CONTACT_WRENCH)]
    )
    world = samples["contact_force"] + samples["latch_force"]
    assert np.hypot(*forces.T) == pytest.approx(np.hypot(*world.T), abs=1e-12)
    # along the probe: the scalar product with its direction
    along = world[:, 0] * np.cos(samples["q"][:, 3]) + world[:, 1] * np.sin(samples["q"][:, 3])
    assert forces[:, 0] == pytest.approx(along, abs=1e-12)
    assert np.abs(forces).max() > 1.0


def test_joint_states_are_the_buffer_s(result, stream):
    every = samples_per_message(result.scene.run.state_rate, result.scene.run.rate)
    for message, sample in zip(
        of_topic(stream, JOINT_STATES), result.samples[::every], strict=True
    ):
        assert message.name == ["buffer_hinge", "buffer_slide"]
        assert message.position.tolist() == [sample["torsion"], sample["axial_stroke"]]
        assert message.velocity.tolist() == [
            sample["v"][3] - sample["v"][2],
            sample["v"][4],
        ]
        assert message.effort.tolist() == [sample["torsion_torque"], sample["axial_force"]]


def test_string_goes_from_taut_to_slack_when_the_mass_lands(result, stream):
    landed = next(e.t for e in result.events if e.kind is EventKind.LANDED)
    messages = of_topic(stream, STRING_STATE)
    times = np.array([stamp_seconds(stamp_of(m)) for m in messages])
    phases = np.array([m.phase for m in messages])
    assert (phases[times < landed] == 1).all()
    assert (phases[times > landed] == 2).all()
    assert all(m.tension == 0.0 for m in messages if m.phase == 2)
    speeds = [m.chaser_speed for m in messages]
    assert max(speeds) == pytest.approx(result.plan.landing_speed, rel=0.01)


# order


def test_order_is_events_then_state_then_periodic_messages(stream):
    state = -math.inf  # time of the last state sent
    waiting = []  # events since
    for topic, message in stream:
        if topic is BENCH_EVENT:
            assert message.t > state
            waiting.append(message.t)
        elif topic is BENCH_STATE:
            state = message.t
            assert waiting == sorted(waiting)
            assert all(t <= state for t in waiting)
            waiting = []
        elif topic.publishers == (SIMULATOR,) and topic.rate is Rate.PERIODIC:
            stamp = message.clock if topic is CLOCK else message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns(state)
    assert {topic for topic, _ in stream} == set(TOPICS)


def test_counts_are_those_of_the_stream(stream):
    sent = {}
    for topic, _ in stream:
        sent[topic.name] = sent.get(topic.name, 0) + 1
    told = {}
    for message in of_topic(stream, STREAM_COUNTS):
        assert message.complete
        told.update(zip(message.topics, message.counts.tolist(), strict=True))
    sent.pop(STREAM_COUNTS.name)
    assert told == sent
    assert [m.publisher for m in of_topic(stream, STREAM_COUNTS)] == list(PUBLISHERS)


def test_stream_does_not_depend_on_how_the_run_is_cut(result, run):
    def bench_stream(size):
        bench = capture_sim.Bench(result.scene)
        telemetry = BenchTelemetry(Messages(), result.scene, run)
        sent = [telemetry.begin()]
        k = seen = traced = 0
        while not bench.done:
            samples = bench.advance(bench.times(k, size))
            made = telemetry.block(samples, bench.events[seen:], bench.trace[traced:])
            sent += chain.from_iterable(made)
            k, seen, traced = k + size, len(bench.events), len(bench.trace)
        return [*sent, *telemetry.rest(), telemetry.end()]

    assert bench_stream(7) == bench_stream(1000)


def test_rates_that_do_not_divide_are_refused():
    assert samples_per_message(1000.0, 100.0) == 10
    with pytest.raises(CaptureSimError, match="whole multiple"):
        samples_per_message(1000.0, 300.0)
    with pytest.raises(CaptureSimError, match="whole multiple"):
        samples_per_message(100.0, 1000.0)


# what the contact did between two messages


def test_nothing_of_the_contact_is_lost_between_messages(result, stream):
    messages = of_topic(stream, CONTACT_STATE)
    assert sum(m.touches for m in messages) == len(result.touches)
    assert sum(m.impulse for m in messages) == pytest.approx(result.touches["impulse"].sum())
    # touches of a third of a millisecond, between samples of a millisecond
    assert max(m.peak_force for m in messages) == result.touches["peak_force"].max()
    assert result.samples["normal_force"].max() < 0.99 * result.touches["peak_force"].max()


def touch_event(start, peak_time, end, peak=50.0):
    touch = np.zeros(1, TOUCH)[0]
    touch["start"], touch["peak_time"], touch["end"], touch["peak_force"] = (
        start,
        peak_time,
        end,
        peak,
    )
    return Event(EventKind.LIFT_OFF, end, np.zeros(8), np.zeros(8), 1, "", touch)


def test_peak_that_becomes_known_after_its_interval_is_told_by_the_next_message():
    interval = ContactInterval()
    peaks = []
    for t, events in (
        (0.00, []),
        (0.01, []),  # the touch is on, its peak at 9.95 ms is not known yet
        (0.02, [touch_event(0.0098, 0.00995, 0.0101)]),
        (0.03, []),
    ):
        for event in events:
            interval.add_event(event)
        interval.add_force(3.0 if t == 0.01 else 0.0)
        peaks.append(interval.take(t, 0.0, 0)[0])
    assert peaks == [0.0, 3.0, 50.0, 0.0]


def test_old_peak_of_a_long_touch_is_not_told_again_at_its_end():
    interval = ContactInterval()
    for t in (0.0, 0.01, 0.02, 0.03):
        interval.add_force(49.0 if t == 0.01 else 1.0)
        interval.take(t, 0.0, 0)
    interval.add_event(touch_event(0.005, 0.0101, 0.035))
    interval.add_force(0.0)
    assert interval.take(0.04, 0.0, 0)[0] == 0.0


# as ROS reads it


def ros_class(type_name):
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def test_rclpy_reads_what_was_sent(result, run):
    ros = pytest.importorskip("rclpy.serialization", reason="needs ROS")
    plan, store, make = Launcher(result.scene).plan, typestore(), Messages()

    def sent():
        bench, launcher, detector = (
            BenchTelemetry(make, result.scene, run),
            LauncherTelemetry(make, "r"),
            DetectorTelemetry(make, "r"),
        )
        yield bench.begin()
        yield from chain.from_iterable(bench.block(result.samples, result.events, result.trace))
        yield launcher.command(0.0, LaunchAction.ARM, plan)
        yield from launcher.status(0.1, Launcher(result.scene).status)
        yield detector.begin(result.scene.detector)
        for messages in detector.statuses((s.t, s) for s in result.statuses[::50]):
            yield from messages
        yield detector.end("é")

    seen = Counter()
    for message in sent():
        kind = message.topic.type_name
        seen[kind] += 1
        if seen[kind] % 10 != 1:
            continue
        again = ros.serialize_message(ros.deserialize_message(message.data, ros_class(kind)))
        # padding between the fields may differ, values may not
        assert bytes(store.serialize_cdr(store.deserialize_cdr(again, kind), kind)) == message.data
    assert set(seen) == {topic.type_name for topic in TOPICS}


@given(
    values=arrays(np.float64, (3, 8), elements=st.floats(width=64)),
    text=st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20),
    count=st.integers(0, 2**32 - 1),
)
@pytest.mark.parametrize("kind", ["BenchState", "BufferState", "CaptureStatus", "ContactTrace"])
def test_many_messages_are_those_that_are_serialised_one_by_one(kind, values, text, count):
    make, kind = Messages(), f"capture_sim/msg/{kind}"
    columns = {
        "header.stamp.nanosec": np.array([count, 0, 7]),
        "seq": np.array([count, 1, 2**63], np.uint64),
    }
    columns |= {"q": values} if "v" in dir(make.new(kind)) else {}
    names = [
        name for name, of in typestore().fielddefs[kind][1] if of == (Nodetype.BASE, ("float64", 0))
    ]
    columns |= {name: values[:, k % 8] for k, name in enumerate(names)}
    fixed = {"header.frame_id": text}
    alone = []
    for k in range(3):
        message = make.new(kind, **fixed)
        for path, column in columns.items():
            fill(message, path, column[k])
        alone.append(make.serialise(message))
    assert list(make.many(kind, columns, **fixed)) == alone
    assert list(make.many(kind, columns, **fixed)) == alone  # by what is kept of the first time


def numbers_in(type_name, prefix=""):
    """Yield path and count of the numbers of a message; None for a sequence's."""
    for name, (kind, of) in typestore().fielddefs[type_name][1]:
        if kind == Nodetype.NAME:
            yield from numbers_in(of, f"{prefix}{name}.")
        elif "string" not in str(of):
            counts = {Nodetype.BASE: (), Nodetype.ARRAY: of[1], Nodetype.SEQUENCE: None}
            yield f"{prefix}{name}", counts[kind]


@pytest.mark.parametrize(
    "topic",
    [BENCH_STATE, BUFFER_STATE, CHASER_ODOMETRY, CHASER_POSE, LOAD_CELL, JOINT_STATES],
    ids=lambda topic: topic.name,
)
def test_numbers_of_a_message_are_read_from_its_bytes(topic):
    store, rng = typestore(), np.random.default_rng(1)
    kinds = dict(numbers_in(topic.type_name))
    read = Numbers(store, topic.type_name, *kinds)
    # texts and sequences of other lengths move every number behind them
    for frame, length in (("world", 2), ("world", 2), ("", 2), ("é/base_link", 3), ("w", 0)):
        message = Messages().new(topic.type_name, **{"header.frame_id": frame})
        for path, count in kinds.items():
            # whole numbers suit the integers too
            values = rng.integers(1, 256, length if count is None else count)
            fill(message, path, values if values.ndim else values.item())
        data = bytes(store.serialize_cdr(message, topic.type_name))
        numbers, again = read(data), store.deserialize_cdr(data, topic.type_name)
        for path in kinds:
            assert np.array_equal(numbers[path], operator.attrgetter(path)(again)), path
    for bad in (b"", data[:-8], data + bytes(8), b"\0\0" + data[2:], data[:12] + b"\xff" * 4):
        with pytest.raises(MessageError):
            read(bad)


def test_description_of_a_run_names_its_scene_and_software(result):
    described = RunDescription.of(result.scene, "r", PUBLISHERS)
    assert any(text.startswith("numpy ") for text in described.software)
    assert described.scene == result.scene.to_yaml()
    assert len(described.scene_sha256) == 64
    other = dataclasses.replace(described, scene=described.scene + "#")
    assert other.scene_sha256 != described.scene_sha256


def test_scene_without_string_counts_as_slack():
    samples = np.zeros(1, SAMPLE)
    samples["phase"] = Phase.TAUT
    scene = capture_sim.load_scene("paper_designed")
    assert scene.string is None
    assert string_phases(samples, scene).tolist() == [2]
