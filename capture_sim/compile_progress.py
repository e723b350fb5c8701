"""How far the compilation of the kernels is."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event


@contextmanager
def watch_compilation(report: Callable[[int, int], None]) -> Iterator[None]:
    """Call ``report`` with the kernels that are compiled and their number, while in the context."""
    with event.install_listener("numba:compile", _Compiling(report)):
        yield


class _Compiling(event.Listener):
    """Counts the kernels that are compiled; the outermost is the last and takes longest."""

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
        """Report what is under way."""
        self._report(len(self._done), self._all)

    def on_end(self, event: Any) -> None:
        """Count what is done."""
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("capture_sim."):
            self._done.add(function)
            self._report(min(len(self._done), self._all), self._all)
