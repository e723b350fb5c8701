"""What must hold between the groups of the engine's record, in a run without Numba."""

import os
import subprocess
import sys

import pytest

RUN = (
    "import sys, invariants\n"
    "from capture_sim import Bench, load_scene\n"
    "invariants.install()\n"
    "bench = Bench(load_scene(sys.argv[1], sys.argv[2:]))\n"
    "bench.advance([])\n"
    "print(*(event.kind.label for event in bench.events))\n"
)
STOPS = "stops={compression: 1.0e-3, extension: 0.01, stiffness: 1.0e+5, damping: 10}"


@pytest.mark.parametrize(
    "scene, overrides, expected",
    [
        ("paper_designed", ["run.t_end=0.016"], {"touch", "lift_off"}),
        (
            "paper_designed",
            ["run.t_end=0.016", "friction.law=coulomb", "friction.mu=1.5"],
            {"stick", "slip", "lift_off"},
        ),
        ("paper_designed", ["run.t_end=0.026", STOPS], {"stop_hit", "stop_left"}),
        ("paper_designed", ["run.t_end=0.02", "buffer.preload=20"], {"unseated", "seated"}),
        ("tilt_0", ["run.t_end=3"], {"landed", "rail_end", "moving", "touch", "latched"}),
        # seated in segments that events cut: the rate of the seat's load is read after extremes
        (
            "paper_designed",
            ["run.t_end=0.02", "buffer.preload=200", "friction.law=coulomb", "friction.mu=1.5"],
            {"stick", "lift_off"},
        ),
    ],
)
def test_groups_of_the_record_agree_between_all_segments(scene, overrides, expected):
    run = subprocess.run(
        [sys.executable, "-c", RUN, scene, "run.rtol=1e-4", *overrides],
        env=os.environ
        | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(["tests", *sys.path])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert expected <= set(run.stdout.split())
