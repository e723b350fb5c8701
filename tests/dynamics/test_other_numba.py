"""A Numba that differs inside from those that were tried."""

import os
import subprocess
import sys

import numpy as np
import pytest

from capture_sim import Bench, load_scene
from capture_sim.detection.exact import ExactDetector

#: A later Numba, whose cache does not have what numba_internals calls.  It compiles the detector's
#: kernels, which call those of the model; the engine's would need a minute.
DIFFERENT = """
import sys
import numba
import numpy as np
from numba.core import caching
numba.__version__ = "99.0.0"
inside = caching.Cache._load_overload
caching.Cache.load_overload = lambda self, sig, context: inside(self, sig, context)
del caching.Cache._load_overload
from capture_sim import load_scene
from capture_sim.detection.exact import ExactDetector
detector = ExactDetector(load_scene("paper_designed"))
detector.to_end(np.load(sys.argv[1]))
status = detector.finish()
print(status.label, status.nearest_distance, status.time_in_state, sep="\\n")
"""


def test_kernels_are_compiled_by_plain_njit_with_a_line(tmp_path):
    bench = Bench(load_scene("paper_designed"))
    samples = bench.advance(np.arange(100) / 50.0)
    np.save(tmp_path / "samples.npy", samples)
    run = subprocess.run(
        [sys.executable, "-c", DIFFERENT, tmp_path / "samples.npy"],
        env=os.environ | {"CAPTURE_SIM_CACHE": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    [line] = run.stderr.splitlines()
    assert line.startswith("capture-sim: Numba 99.0.0 differs inside")
    assert list(tmp_path.rglob("exact.follow*.nbc"))
    detector = ExactDetector(bench.scene)
    detector.to_end(samples)
    status = detector.finish()
    label, nearest, time = run.stdout.splitlines()
    assert label == status.label
    assert float(nearest) == pytest.approx(status.nearest_distance, abs=1e-12)
    assert float(time) == pytest.approx(status.time_in_state, abs=1e-12)
