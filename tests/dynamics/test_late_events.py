"""Events that a fixed step applies at its end, as it has located too many before.

Without Numba the limit can be set to zero: then every event is late.
"""

import json
import os
import subprocess
import sys

RUN = """
import json, sys
import numpy as np
from capture_sim import Bench, SimulationError, load_scene
from capture_sim.dynamics.engine import segment
from capture_sim.base.compiled.kernels import records
from capture_sim.dynamics.model.equations import slip_of

segment._MAX_SUBSTEPS = 0
options = json.loads(sys.argv[1])
scene = load_scene("paper_designed", ["run.method=rk4", *options["overrides"]])
bench = Bench(scene)
failure = ""
try:
    bench.advance([])
except SimulationError as error:
    failure = str(error)
events = [event for event in bench.events if event.kind.label == options["kind"]]
par = records(bench._system)["par"]
slips = [
    slip_of(np.concatenate([event.q, event.v]), par, 0 if event.wall > 0 else 1)
    for event in events
    if event.wall
]
around = Bench(scene).advance(np.ravel([(event.t, event.t + 1e-12) for event in events]))
print(json.dumps({
    "failure": failure,
    "kinds": [event.kind.label for event in bench.events],
    "strokes": [event.q[4] - scene.rest_length for event in events],
    "slips": slips,
    "residuals": around["energy_residual"].tolist(),
    "strokes_around": around["axial_stroke"].tolist(),
    "rates_around": around["v"][:, 4].tolist(),
    "kinetic": around["kinetic"].tolist(),
}))
"""


def late(kind, *overrides):
    """Events of a kind, with samples just before and after each."""
    run = subprocess.run(
        [sys.executable, "-c", RUN, json.dumps({"kind": kind, "overrides": overrides})],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


def test_the_ledger_books_the_way_back_to_the_seat():
    result = late("seated", "buffer.preload=20", "run.step=5e-5", "run.t_end=0.007")
    assert result["failure"] == ""
    assert max(result["strokes"]) > 1e-9
    assert all(stroke >= 0.0 for stroke in result["strokes"])
    before, after = result["residuals"][::2], result["residuals"][1::2]
    for earlier, later, kinetic in zip(before, after, result["kinetic"][::2], strict=True):
        assert abs(later - earlier) < 1e-12 * kinetic
    assert all(stroke == 0.0 for stroke in result["strokes_around"][1::2])
    assert all(rate == 0.0 for rate in result["rates_around"][1::2])


def test_a_tip_that_has_reversed_before_its_event_slides_the_other_way():
    """It sticks where its slip is zero only, not with whatever slip it has at the end of a step."""
    overrides = ["friction.law=coulomb", "friction.mu=1.5", "run.step=5e-5", "run.t_end=0.006"]
    result = late("slip", *overrides)
    assert result["failure"] == ""
    assert max(map(abs, result["slips"])) > 1e-6
    assert "stick" not in result["kinds"]


def test_a_pile_up_is_reported_in_its_own_phase():
    code = (
        "from capture_sim import Bench, SimulationError, load_scene\n"
        "from capture_sim.dynamics.engine import loop\n"
        "bench = Bench(load_scene('paper_designed', ['run.rtol=1e-4']))\n"
        "bench.advance([1.2e-3])\n"
        "loop._MAX_EVENTS_AT_T0 = -1\n"
        "try:\n"
        "    bench.advance([])\n"
        "except SimulationError as error:\n"
        "    print(error)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "in phase contact: more than 100 events fell on one instant" in run.stdout
