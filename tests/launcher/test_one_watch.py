"""Offline runs evaluate a launch as nodes and benches do, and abort none that the plan predicts.

tests/nodes/test_launcher_node.py compares what nodes send with the offline run.
"""

from dataclasses import replace

import numpy as np
import pytest
from random_scenes import random_scene

from capture_sim import load_scene, scene_names, simulate
from capture_sim.launcher.state_machine import (
    Launcher,
    LauncherPhase,
    LaunchObservation,
    is_predicted,
)
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.definitions import decoded
from capture_sim.messages.topics import LAUNCHER_PHASE
from capture_sim.recording.offline import PUBLISHERS, run_stream
from capture_sim.scene.launch_plan import plan_launch

#: The target moves away: the plan, made for a target at rest, does not predict the contact.
MOVING_TARGET = ["initial.target.x=0.6", "initial.target.vx=0.05", "run.t_end=6"]


def recorded_phases(scene):
    """Return the launcher's phases and reasons in the recording of an offline run."""
    run = RunDescription.of(scene, "x", PUBLISHERS)
    sent = [m for m in run_stream(simulate(scene), run) if m.topic is LAUNCHER_PHASE]
    messages = [decoded(LAUNCHER_PHASE, m.data) for m in sent]
    return [(LauncherPhase(m.state).label, m.reason) for m in messages]


@pytest.mark.parametrize("name", scene_names())
def test_packaged_scenes_are_delivered_or_miss(name):
    phases = recorded_phases(load_scene(name, ["run.t_end=4"]))
    assert all(reason == "" for _, reason in phases)
    assert [label for label, _ in phases] == ["armed", "released", "landed", "delivered"]


def test_a_target_that_moves_aborts_no_launch():
    """S6: `run` gave rebound with 28 touches where `bench` aborted at 1.83 s."""
    scene = load_scene("paper_designed", MOVING_TARGET)
    assert not is_predicted(scene, plan_launch(scene))
    assert simulate(scene).verdict == "rebound"
    assert recorded_phases(scene)[-1] == ("delivered", "")


def test_random_benches_are_never_aborted():
    rng = np.random.default_rng(5)
    for k in range(12):
        scene = random_scene(rng, with_supports=bool(k % 2))
        scene = replace(scene, run=replace(scene.run, t_end=1.5))
        assert all(reason == "" for _, reason in recorded_phases(scene)), scene


@pytest.mark.parametrize(
    "change, is_known",
    [
        ({}, True),
        ({"initial.target.vx": 0.01}, False),
        ({"initial.target.omega": 0.01}, False),
        ({"initial.chaser.vy": 0.01}, False),
        ({"initial.chaser.omega": 0.01}, False),
        ({"initial.chaser.vx": 0.0}, False),
        ({"initial.target.y": 1.0}, False),  # it misses
    ],
    ids=str,
)
def test_a_launch_is_evaluated_where_its_plan_predicts_it(change, is_known):
    scene = load_scene("paper_designed", change)
    assert is_predicted(scene, plan_launch(scene)) is is_known
    launcher = Launcher(scene)
    launcher.release()
    late = LaunchObservation(1e3, 5.0, 0.1, is_slack=True, has_touched=False)
    assert (launcher.observe(late).state is LauncherPhase.ABORTED) is is_known
