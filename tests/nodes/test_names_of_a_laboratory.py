"""A trial by the documented commands in a namespace, and with every topic remapped."""

import re
from pathlib import Path

import pytest
from rig_session import PACE, RATE, SUCCEEDED, WAITS, FakeRig, Goal, actions_of, rig

from capture_sim.cli import main
from capture_sim.messages.topics import HOLD, ROLL, TOPICS
from capture_sim.recording.bag import read_bag

PAGE = Path(__file__).parents[2] / "docs" / "your_rig.md"
#: The list of topics that the page recommends to record.
LISTED = re.search(r'"topics:=(\[.*?\])"', PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
LISTED = LISTED.replace("\\", "").replace("\n", "")
LAB = {"__ns": "/lab1"}
OTHER_NAMES = {name: f"/lab/{name.replace('/', '_')}" for name in [HOLD, ROLL.name]}
OTHER_NAMES |= {topic.name: f"/lab/{topic.name.replace('/', '_')}" for topic in TOPICS}


@pytest.mark.parametrize("remaps, node", [(LAB, "/lab1/launcher"), (OTHER_NAMES, "/launcher")])
def test_a_trial_under_other_names_is_complete(start, client, tmp_path, remaps, node):
    detector = start("capture_detector", **remaps)
    recorder = start("recorder", out=tmp_path, topics=LISTED, **remaps)
    settings = {**WAITS, "after_verdict": 0.1, "waive": "[machine_clock]", "max_hold_silence": 10.0}
    settings |= {"max_pose_age": 10.0, "max_buffer_age": 10.0, "scene": "tilt_0"}
    launcher = start("launcher", actuator="output", **settings, **remaps)
    bench = {"pace": PACE, "rate": RATE, "hold_timeout": 60.0}
    with rig(
        FakeRig,
        bench
        | {n: t for n, t in remaps.items() if n in (HOLD, "__ns")}
        | {n: t for n, t in remaps.items() if n.startswith(("motion", "joint", "load"))},
    ) as driver:
        actions = actions_of(client, node)
        status, result = Goal(actions).result()
        assert (status, result.verdict) == (SUCCEEDED, "captured"), launcher.text
        assert driver.armed
    assert (result.complete, list(result.problems)) == (True, [])
    assert recorder.end() == detector.end() == launcher.end() == 0
    assert "INCOMPLETE" not in recorder.text
    recorded = read_bag(result.recording)
    assert recorded.problems == ()
    assert len(recorded.raw(f"/{HOLD}")) > 3  # under this name always: no player plays it
    assert main(["detect", result.recording]) == 0
