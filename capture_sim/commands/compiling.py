"""The kernels' compilation, once for each version, shown as it goes."""

from __future__ import annotations

import time
from functools import partial

from capture_sim.bench import compile_kernels
from capture_sim.commands.output import Progress, echo
from capture_sim.compile_progress import watch_compilation
from capture_sim.kernels import is_compiled


def compile_first() -> None:
    """Load the kernels; compile them if this version never was, and show how far that is."""
    if is_compiled():
        compile_kernels()
        return
    echo("compiling the kernels, once for this version: about half a minute of one core")
    began = time.perf_counter()
    with (
        Progress("kernels") as progress,
        watch_compilation(partial(progress.at, "compiling")),
    ):
        compile_kernels(announce=False)
    echo(f"compiled in {time.perf_counter() - began:.1f} s")
