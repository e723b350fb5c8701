"""Loading of the compiled kernels, which are compiled once for each version of capture_sim."""

from __future__ import annotations

import functools
import sys
import time

from capture_sim.base.compiled import kernels
from capture_sim.base.interrupts import in_worker
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.engine.loop import advance
from capture_sim.scene.loading import load_scene


def is_compiled() -> bool:
    """Return True if the kernels of this version are compiled on this machine."""
    return kernels.is_compiled(advance)


@functools.cache
def compile_kernels(*, announce: bool = True) -> None:
    """Load the compiled kernels; compile them first if this version is not compiled yet.

    Compiling needs about half a minute of one core, once. Call this function before measuring
    times. Unless ``announce`` is false, lines on stderr report the start and the duration.
    """

    def run_briefly() -> None:
        bench = Bench(load_scene("paper_designed"))
        bench.advance(bench.times(0, 2))

    if is_compiled() or not announce:
        in_worker(run_briefly)
        return
    print(
        "capture_sim: compiling the kernels, once for this version: about 30 s of one core",
        file=sys.stderr,
        flush=True,
    )
    start = time.perf_counter()
    in_worker(run_briefly)
    print(f"capture_sim: compiled in {time.perf_counter() - start:.0f} s", file=sys.stderr)
