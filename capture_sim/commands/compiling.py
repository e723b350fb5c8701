"""Compilation of the numerical kernels, once for each version, with a display of the progress."""

from __future__ import annotations

import time
from functools import partial

from capture_sim.commands.output import Progress, echo
from capture_sim.dynamics.compilation import compile_kernels, is_compiled


def compile_first() -> None:
    """Load the compiled kernels.

    If this version of capture_sim is not compiled yet, compile it first and show the progress.
    """
    if is_compiled():
        compile_kernels()
        return
    from capture_sim.base.compiled.progress import watch_compilation  # half a second: Numba

    echo("compiling the kernels, once for this version: about 30 s of CPU time on one core")
    began = time.perf_counter()
    with (
        Progress("kernels") as progress,
        watch_compilation(partial(progress.at, "compiling")),
    ):
        compile_kernels(announce=False)
    echo(f"compiled in {time.perf_counter() - began:.1f} s")
