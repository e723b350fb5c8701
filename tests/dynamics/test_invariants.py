"""What must hold between the groups of the engine's record, in a run without Numba."""

import json
import os
import subprocess
import sys

import pytest

RUN = """
import json, sys, invariants
from capture_sim import Bench, load_scene
invariants.install()
for scene, overrides in json.loads(sys.argv[1]):
    bench = Bench(load_scene(scene, ["run.rtol=1e-4", *overrides]))
    bench.advance([])
    print(*(event.kind.label for event in bench.events))
"""
STOPS = "stops={compression: 1.0e-3, extension: 0.01, stiffness: 1.0e+5, damping: 10}"
STICKS = ("friction.law=coulomb", "friction.mu=1.5")
#: Scene, overrides, and events of the run.
CASES = [
    ("paper_designed", ["run.t_end=0.016"], {"touch", "lift_off"}),
    ("paper_designed", ["run.t_end=0.016", *STICKS], {"stick", "slip", "lift_off"}),
    ("paper_designed", ["run.t_end=0.026", STOPS], {"stop_hit", "stop_left"}),
    ("paper_designed", ["run.t_end=0.02", "buffer.preload=20"], {"unseated", "seated"}),
    ("tilt_0", ["run.t_end=3"], {"landed", "rail_end", "moving", "touch", "latched"}),
    # seated in segments that events cut: the rate of the seat's load is read after extremes
    ("paper_designed", ["run.t_end=0.02", "buffer.preload=200", *STICKS], {"stick", "lift_off"}),
]


@pytest.mark.long
def test_groups_of_the_record_agree_between_all_segments():
    run = subprocess.run(
        [sys.executable, "-c", RUN, json.dumps([case[:2] for case in CASES])],
        env=os.environ
        | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(["tests", *sys.path])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    for (*case, expected), line in zip(CASES, run.stdout.splitlines(), strict=True):
        assert expected <= set(line.split()), case
