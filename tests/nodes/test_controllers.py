"""Controllers over ROS: a docking in lock-step, and commands that cannot be used."""

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from capture_sim import load_scene, read_run, simulate
from capture_sim.dynamics.samples import SAMPLE
from capture_sim.dynamics.thrust import NO_THRUST
from capture_sim.errors import CaptureSimError, MessageError
from capture_sim.messages.convert import EPOCH_NS
from capture_sim.messages.topics import CHASER_CMD_WRENCH
from capture_sim.nodes.simulation.thrust import ThrustCommands
from capture_sim.run.simulation import applied_again
from capture_sim.viewing.source import resolved

EXAMPLES = Path(__file__).parents[2] / "examples"
SCENE = EXAMPLES / "free_flyer.yaml"


@pytest.fixture
def docking_sweep(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import docking_sweep

    return docking_sweep


def test_the_controller_docks_over_ros_as_in_python_bit_for_bit(start, tmp_path, docking_sweep):
    """In lock-step: the same samples, wrenches and touches, as fast as both can."""
    assert len((EXAMPLES / "docking_controller.py").read_text().splitlines()) <= 80
    command = [sys.executable, str(EXAMPLES / "docking_controller.py")]
    controller = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        recorder = start("recorder", out=tmp_path)
        awaited = "[docking_controller, recorder]"
        simulator = start("simulator", scenes=f"[{SCENE}]", wait_for=awaited, rtf=0.0)
        assert simulator.status() == 0, simulator.text
        recorder.wait_for("free_flyer.mcap")
    finally:
        controller.kill()
        controller.wait()
    found, own = read_run(tmp_path / "free_flyer.mcap"), docking_sweep.dock()
    for name in ("t", "q", "v", "thrust", "work_thrust"):
        assert np.array_equal(found.samples[name], own.samples[name]), name
    for name in ("start", "end", "wall", "approach_speed", "peak_force", "impulse"):
        assert np.array_equal(found.touches[name], own.touches[name]), name
    assert found.summary["verdict"] == own.summary["verdict"] == "captured"
    assert own.v[own.t < own.touches["start"][0]][-1, 0] == pytest.approx(0.1, abs=0.005)
    # it lets go: after one instant more, and the delay, nothing pushes
    after = own.samples["t"] > own.touches["start"][0] + 0.02 + 0.021
    assert not own.samples["thrust"][after].any()
    assert np.abs(own.samples["energy_residual"]).max() < 1e-9


def test_random_starts_are_captured_by_the_same_controller(docking_sweep):
    verdicts = [docking_sweep.dock(c).summary["verdict"] for c in docking_sweep.starts(4)]
    assert verdicts.count("captured") >= 3


class FakeNode:
    """What :class:`ThrustCommands` uses of a node; ``send`` is the network."""

    def __init__(self):
        self.publishers, self.rejected, self.callbacks = ["pilot"], [], {}
        self.queue = []

    def listen(self, topic, callback):
        self.callbacks[topic] = callback

    def resolve_topic_name(self, name):
        return f"/{name}"

    def get_publishers_info_by_topic(self, _):
        return [SimpleNamespace(node_namespace="/", node_name=name) for name in self.publishers]

    def reject(self, topic, error):
        self.rejected.append(str(error))

    def send(self, stamp, *wrench, frame="chaser/base_link", topic=CHASER_CMD_WRENCH):
        ns = 0 if stamp is None else round(stamp * 1e9) + EPOCH_NS
        fx, fy, tz = wrench
        message = SimpleNamespace(
            header=SimpleNamespace(
                stamp=SimpleNamespace(sec=ns // 10**9, nanosec=ns % 10**9), frame_id=frame
            ),
            wrench=SimpleNamespace(force=SimpleNamespace(x=fx, y=fy), torque=SimpleNamespace(z=tz)),
        )
        try:
            self.callbacks[topic](message)
        except MessageError as error:
            self.reject(topic, error)

    def serve(self):
        if self.queue:
            self.send(*self.queue.pop(0))

    def wait(self, until, limit):
        while not until():
            if not self.queue:
                return False
            self.serve()
        return True


def commanded(wait_for=()):
    """A node and its controller of the scene's chaser, at samples of given times."""
    node, scene = FakeNode(), load_scene(SCENE)
    commands = ThrustCommands(node, wait_for, lambda: None, lambda: 3.0)
    commands.listen(scene)
    control = commands.control(scene)

    def at(t):
        sample = np.zeros(1, SAMPLE)
        sample["t"] = t
        return control.command(sample[0])[0]

    return node, at


@pytest.mark.parametrize(
    "stamp, wrench, how, says",
    [
        (
            1.0,
            (np.nan, 0, 0),
            {},
            r"= \(nan, 0, 0\): must be finite, N and N m; the vehicle coasts",
        ),
        (1.0, (1, 0, np.inf), {}, "must be finite, N and N m; the vehicle coasts"),
        (1.0, (1, 0, 0), {"frame": "world"}, "frame_id = 'world': must be chaser/base_link"),
        (0.4, (1, 0, 0), {}, r"stamped 0\.6 s ago: must be <= 0\.5 s, thrusters.timeout"),
        (1.5, (1, 0, 0), {}, r"stamped 0\.5 s ahead of simulated time"),
    ],
)
def test_a_command_that_cannot_be_used_is_one_line_and_the_vehicle_coasts(stamp, wrench, how, says):
    node, at = commanded()
    node.send(1.0, 0.5, 0.0, 0.0)
    assert at(1.0) == (0.5, 0.0, 0.0)
    assert at(1.0) is None
    node.send(stamp, *wrench, **how)
    assert at(1.0) == NO_THRUST
    (line,) = node.rejected
    assert "\n" not in line
    assert re.search(says, line), line


def test_two_controllers_at_once_are_named_and_the_vehicle_coasts():
    node, at = commanded()
    node.publishers.append("autopilot")
    node.send(1.0, 1.0, 0.0, 0.0)
    assert at(1.0) == NO_THRUST
    assert node.rejected == [
        "/autopilot and /pilot command it: must be one controller; the vehicle coasts"
    ]


def test_a_command_without_stamp_or_frame_counts_from_now():
    node, at = commanded()
    node.send(None, 1.0, 0.2, 0.0, frame="")
    assert at(7.0) == (1.0, 0.2, 0.0)
    assert node.rejected == []


def test_time_waits_for_the_answer_of_a_controller_in_wait_for():
    """Answers to earlier instants are passed over; silence ends the run in one line."""
    node, at = commanded(wait_for=["pilot"])
    node.queue = [(0.98, 0.1, 0.0, 0.0), (1.0, 0.2, 0.0, 0.0), (1.02, 0.3, 0.0, 0.0)]
    assert at(1.0) == (0.2, 0.0, 0.0)
    assert len(node.queue) == 1
    assert at(1.02) == (0.3, 0.0, 0.0)
    with pytest.raises(CaptureSimError, match=r"cmd_wrench: no answer .* t = 1\.040 s within 3 s"):
        at(1.04)


def test_a_run_with_a_controller_is_made_again_from_its_recorded_thrust(docking_sweep):
    """The delay is a whole number of samples: the same wrenches, up to the integration's error."""
    own = docking_sweep.dock()
    again = simulate(own.scene, control=applied_again(own))
    assert np.array_equal(again.samples["thrust"], own.samples["thrust"])
    assert again.touches["start"] == pytest.approx(own.touches["start"], abs=1e-6)
    assert again.touches["peak_force"] == pytest.approx(own.touches["peak_force"], rel=1e-4)
    assert applied_again(simulate("paper_designed", t_end=0.01)) is None
    with pytest.raises(CaptureSimError, match="flown by a controller"):
        resolved(own)
