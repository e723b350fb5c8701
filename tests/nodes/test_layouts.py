"""Layouts of RViz and Foxglove show topics, of the types they ask for, that the nodes publish."""

import json

import pytest
import yaml

from capture_sim.base.resources import config_dir
from capture_sim.nodes.base.endpoints import message_class
from tests.nodes.bench_client import Client, wait_until
from tests.nodes.bench_processes import processes
from tests.nodes.forked import Forked
from tests.nodes.own_domain import own_domain

#: What a display of RViz draws.
DRAWN = {
    "Odometry": "nav_msgs/msg/Odometry",
    "Pose": "geometry_msgs/msg/PoseStamped",
    "RobotModel": "std_msgs/msg/String",
    "Wrench": "geometry_msgs/msg/WrenchStamped",
}


@pytest.fixture(scope="module")
def published():
    """The topics of a bench, with their type."""
    with own_domain(), processes(Forked) as start, Client() as client:
        start("simulator", initial_state="stopped", exit_when_done="false")
        start("launcher")
        start("capture_detector")
        topics = {}

        def complete():
            topics.update(
                (name, types[0]) for name, types in client.node.get_topic_names_and_types()
            )
            # the roll is the last that a node announces
            roll = client.node.get_publishers_info_by_topic("/bench/roll")
            own = {"/capture/verdict", "/launcher/phase", "/diagnostics", "/bench/run_info"}
            return len(roll) == 3 and own <= topics.keys()

        wait_until(complete)
        yield topics


def test_rviz_shows_what_is_published(published):
    displays = yaml.safe_load((config_dir() / "bench.rviz").read_text())
    shown = {}
    for display in displays["Visualization Manager"]["Displays"]:
        topic = display.get("Topic") or display.get("Description Topic")
        if topic is not None:
            shown[topic["Value"]] = DRAWN[display["Class"].rpartition("/")[2]]
    assert len(shown) == 5
    for name, kind in shown.items():
        assert published[f"/{name}"] == kind


def test_foxglove_shows_fields_that_are_published(published):
    panels = json.loads((config_dir() / "bench.foxglove.json").read_text())["configById"]
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    paths += panels["3D!bench"]["topics"]
    paths += [panels["RawMessages!verdict"]["topicPath"]]
    paths += [panels["DiagnosticSummary!simulator"]["topicToRender"]]
    assert len(paths) == 12
    for path in paths:
        name, *fields = path.split(".")
        part = message_class(published[name])()
        for field in fields:
            part = getattr(part, field)
        assert not fields or isinstance(part, (int, float)), path


def test_layouts_have_all_their_panels():
    layout = json.loads((config_dir() / "bench.foxglove.json").read_text())
    found = []

    def collect(part):
        if isinstance(part, str):
            found.append(part)
        else:
            collect(part["first"])
            collect(part["second"])

    collect(layout["layout"])
    assert sorted(found) == sorted(layout["configById"])
