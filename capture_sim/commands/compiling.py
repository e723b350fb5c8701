"""The kernels' compilation, once for each version, shown as it goes."""

from __future__ import annotations

import sys
import time
from typing import Any

from numba.core import event

from capture_sim.bench import compile_kernels
from capture_sim.commands.output import Progress, echo
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
        event.install_listener("numba:compile", _Compiling(progress)),
    ):
        compile_kernels(announce=False)
    echo(f"compiled in {time.perf_counter() - began:.1f} s")


class _Compiling(event.Listener):
    """Counts the kernels that are compiled; the outermost is the last and takes longest."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._done: set[Any] = set()
        self._all = sum(
            hasattr(value, "py_func") and value.py_func.__module__ == name
            for name, module in list(sys.modules.items())
            if name.startswith("capture_sim.") and module is not None
            for value in list(vars(module).values())
        )

    def on_start(self, event: Any) -> None:
        """Show what is under way."""
        self._progress.at("compiling", len(self._done), self._all)

    def on_end(self, event: Any) -> None:
        """Count what is done."""
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("capture_sim."):
            self._done.add(function)
            self._progress.at("compiling", min(len(self._done), self._all), self._all)
