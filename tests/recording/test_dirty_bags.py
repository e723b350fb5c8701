"""Recordings as laboratories make them (tests/dirty.py): what is read of each, and what is said."""

from __future__ import annotations

import dirty
import pytest

import capture_sim
from capture_sim.recording.bag import read_bag
from capture_sim.recording.read import read_run
from capture_sim.run.run import detect


@pytest.fixture(scope="module")
def scene():
    return capture_sim.load_scene("tilt_p10")


def test_clean_recording_is_read_complete_and_captured(scene, tmp_path):
    path = dirty.write(tmp_path, "plain")
    bag = read_bag(path)
    assert sum(bag.topics.values()) == len(dirty.clean())
    assert bag.problems == ()
    verdict = detect(read_run(path), scene)[-1]
    assert verdict.label == dirty.TRUE.verdict


@pytest.mark.parametrize("kind", dirty.KINDS)
def test_every_kind_is_written(kind, tmp_path):
    path = dirty.write(tmp_path, kind, dirty.clean()[:400])
    assert path.exists()
