"""Recordings that several tests of the studies read: a run, another one, and a bench's bag."""

import pytest
from recorded_bags import rewritten

import capture_sim
from capture_sim.recording.offline import write_run


@pytest.fixture(scope="session")
def result():
    return capture_sim.simulate(capture_sim.load_scene("tilt_0"))


@pytest.fixture(scope="session")
def path(result, tmp_path_factory):
    return write_run(result, tmp_path_factory.mktemp("runs") / "tilt_0.mcap")


@pytest.fixture(scope="session")
def other(tmp_path_factory):
    scene = capture_sim.load_scene("tilt_0", ["friction.mu=0.25", "buffer.c_A=11"])
    folder = tmp_path_factory.mktemp("others")
    return write_run(capture_sim.simulate(scene), folder / "other.mcap")


@pytest.fixture(scope="session")
def bench_bag(path, tmp_path_factory):
    """A bag as a real bench makes one: standard topics and BufferState, no scene, no state."""
    return rewritten(path, tmp_path_factory.mktemp("bench") / "bag")
