"""SROS 2's policies name the topics that each role publishes."""

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from capture_sim.messages.measurements import TOPICS_OF_SOURCE
from capture_sim.messages.topics import CAPTURE_DETECTOR, EMERGENCY_STOP, HOLD, LAUNCHER, topics_of

POLICIES = ET.parse(Path(__file__).parents[2] / "config" / "sros2_policies.xml").getroot()


def published(role):
    paths = f".//enclave[@path='/{role}']//topics[@publish='ALLOW']/topic"
    return {topic.text for topic in POLICIES.findall(paths)}


@pytest.mark.parametrize("role", [LAUNCHER, CAPTURE_DETECTOR])
def test_each_role_may_publish_its_topics(role):
    assert {topic.name for topic in topics_of(role)} <= published(role)


def test_only_the_launcher_holds_and_only_a_driver_measures():
    roles = [enclave.get("path")[1:] for enclave in POLICIES.iter("enclave")]
    assert [role for role in roles if HOLD in published(role)] == [LAUNCHER]
    measured = {topics[0].name for topics in TOPICS_OF_SOURCE.values()}
    assert [role for role in roles if measured & published(role)] == ["driver"]
    assert EMERGENCY_STOP in published("driver")
    callers = POLICIES.findall(".//actions[@call='ALLOW']/action")
    assert [action.text for action in callers] == ["launcher/run_trial"]
