"""Progress of the compilation of the kernels."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event


@contextmanager
def watch_compilation(report: Callable[[int, int], None]) -> Iterator[None]:
    """Call ``report(n_compiled, n_all)`` while in the context, as kernels are compiled.

    ``n_all`` counts the kernels of all modules of capture_sim that are loaded at the start.
    """
    with event.install_listener("numba:compile", _CompilationCounter(report)):
        yield


class _CompilationCounter(event.Listener):
    """Counts the compiled kernels; the outermost is the last and needs most of the time."""

    def __init__(self, report: Callable[[int, int], None]) -> None:
        self._report = report
        self._done: set[Any] = set()
        self._all = sum(
            hasattr(value, "py_func") and value.py_func.__module__ == name
            for name, module in list(sys.modules.items())
            if name.startswith("capture_sim.") and module is not None
            for value in list(vars(module).values())
        )

    def on_start(self, event: Any) -> None:
        """Report the present count when a compilation starts."""
        self._report(len(self._done), self._all)

    def on_end(self, event: Any) -> None:
        """Count a compiled kernel and report."""
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("capture_sim."):
            self._done.add(function)
            self._report(min(len(self._done), self._all), self._all)
