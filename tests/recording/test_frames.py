"""A recording shows a moving bench: its shape, its constant frames, and where each part is."""

from xml.etree import ElementTree

import numpy as np
import pytest

import capture_sim
from capture_sim.messages.convert import RunDescription, stamp_in, stamp_ns
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import CHASER_ODOMETRY, RUN_INFO, SHOWN, TF, TF_STATIC, Rate, Topic
from capture_sim.messages.urdf import moving_transforms, static_transforms
from capture_sim.recording.bag import read_bag
from capture_sim.recording.frames import MIN_INTERVAL
from capture_sim.recording.offline import PUBLISHERS, write_run
from capture_sim.recording.write import RunWriter


def transforms(bag, topic):
    """Return stamp (ns), parent, child, x, y and yaw of each transform of a topic."""
    rows = []
    for data in bag.raw(topic):
        for item in typestore().deserialize_cdr(data, topic.type_name).transforms:
            move, turn = item.transform.translation, item.transform.rotation
            yaw = 2.0 * np.arctan2(turn.z, turn.w)
            stamp = stamp_in(item)
            rows.append((stamp, item.header.frame_id, item.child_frame_id, move.x, move.y, yaw))
    return rows


@pytest.fixture(scope="module")
def result():
    return capture_sim.simulate(capture_sim.load_scene("tilt_p10", ["run.t_end=3"]))


@pytest.fixture(scope="module")
def bag(result, tmp_path_factory):
    return read_bag(write_run(result, tmp_path_factory.mktemp("frames") / "tilt_p10.mcap"))


def test_each_part_is_where_the_run_has_it(result, bag):
    expected = {
        (stamp_ns(float(sample["t"])), place.child): place
        for sample in result.samples
        for place in moving_transforms(result.scene, sample["q"].tolist())
    }
    found = transforms(bag, TF)
    assert {child for _, _, child, *_ in found} == {child for _, child in expected}
    for stamp, parent, child, x, y, yaw in found:
        place = expected[stamp, child]
        assert parent == place.parent
        assert (x, y, yaw) == pytest.approx((place.x, place.y, place.yaw), abs=1e-12)
    times = [stamp for stamp, _, child, *_ in found if child == "chaser/base_link"]
    assert min(np.diff(times)) >= MIN_INTERVAL
    assert max(np.diff(times)) <= 2 * MIN_INTERVAL


def test_shape_and_constant_frames_are_written_once(result, bag):
    [robot] = bag.columns("robot_description")["data"]
    links = {link.get("name") for link in ElementTree.fromstring(robot).iter("link")}
    assert {child for _, _, child, *_ in transforms(bag, TF)} < links
    assert len(bag.raw(TF_STATIC)) == 1
    assert [(parent, child) for _, parent, child, *_ in transforms(bag, TF_STATIC)] == [
        (place.parent, place.child) for place in static_transforms(result.scene)
    ]


def test_frames_that_a_user_records_are_not_mixed_with_ours(result, tmp_path):
    own = Topic("tf", TF.type_name, (), Rate.EVENT)
    run = RunDescription.of(result.scene, "a", PUBLISHERS)
    with RunWriter(tmp_path / "x.mcap", run, topics=(RUN_INFO, CHASER_ODOMETRY, own)) as writer:
        writer.write(RUN_INFO, b"\0\1\0\0", 1)
        writer.write(own, b"\0\1\0\0\0\0\0\0", 1)
    topics = read_bag(tmp_path / "x.mcap").topics
    assert topics["/tf"] == 1
    assert {each.absolute_name for each in SHOWN} <= topics.keys()
