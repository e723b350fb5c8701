"""A Numba that differs inside from those that were tried."""

import os
import subprocess
import sys

import pytest

from capture_sim import Bench, load_scene

#: A later Numba, whose cache does not have what numba_internals calls.
DIFFERENT = (
    "import numba\n"
    "from numba.core import caching\n"
    "numba.__version__ = '99.0.0'\n"
    "inside = caching.Cache._load_overload\n"
    "caching.Cache.load_overload = lambda self, sig, context: inside(self, sig, context)\n"
    "del caching.Cache._load_overload\n"
    "from capture_sim import Bench, load_scene\n"
    "bench = Bench(load_scene('paper_designed'))\n"
    "samples = bench.advance([0.01, 0.02])\n"
    "print(*samples['q'][-1].tolist(), bench.statistics.steps)\n"
)


def test_kernels_are_compiled_by_plain_njit_with_a_line(tmp_path):
    run = subprocess.run(
        [sys.executable, "-c", DIFFERENT],
        env=os.environ | {"CAPTURE_SIM_CACHE": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    [line] = run.stderr.splitlines()
    assert line.startswith("capture-sim: Numba 99.0.0 differs inside")
    bench = Bench(load_scene("paper_designed"))
    samples = bench.advance([0.01, 0.02])
    *q, steps = map(float, run.stdout.split())
    assert q == pytest.approx(samples["q"][-1].tolist(), abs=1e-12)
    assert steps == pytest.approx(bench.statistics.steps, abs=1)
