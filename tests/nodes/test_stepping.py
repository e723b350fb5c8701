"""Stepping a run, without ROS: what is sent, and what RViz is shown."""

import pytest

from capture_sim import load_scene
from capture_sim.dynamics.bench import Bench
from capture_sim.messages.convert import Messages, RunDescription
from capture_sim.messages.telemetry import BenchTelemetry
from capture_sim.messages.topics import JOINT_STATES, SIMULATOR
from capture_sim.nodes.simulation.control import SimulationControl, State
from capture_sim.nodes.simulation.pacing import RunPacer
from capture_sim.nodes.simulation.stepping import Stepping
from capture_sim.nodes.simulation.thrust import ThrustCommands

SHORT = ["run.t_end=0.5"]


@pytest.mark.parametrize(
    "changes", [[], ["sensors.motion_capture={}", "sensors.load_cell={}"]], ids=["plain", "sensors"]
)
def test_transforms_move_with_every_periodic_sample(changes):
    scene = load_scene("tilt_0", SHORT + changes)
    control = SimulationControl(State.PLAYING, RunPacer(0.0), lambda limit: None)
    description = RunDescription.of(scene, "a run", [SIMULATOR])
    telemetry = BenchTelemetry(Messages(), scene, description)
    unused = ThrustCommands(None, (), lambda: None, lambda: 0.0)  # the scene has no thrusters
    stepping = Stepping(Bench(scene), telemetry, control, unused)
    sent, shown = [], []

    def send(topic, data):
        sent.append(topic)
        return True

    control.begin()
    assert stepping.run(send, shown.append) == ""
    assert len(shown) == sent.count(JOINT_STATES) == 51
    assert [sample["t"] for sample in shown] == pytest.approx([0.01 * k for k in range(51)])
