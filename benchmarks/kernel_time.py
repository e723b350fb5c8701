"""An executor that counts how long its tasks are in compiled kernels."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from typing import Any

from capture_sim.detection import exact
from capture_sim.engine import loop


def timed(work: Callable[[Any], Any], task: Any) -> tuple[Any, float]:
    """Do a task; return its answer and the time that it was in kernels, s."""
    spent = 0.0

    def counting(kernel: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            nonlocal spent
            began = time.perf_counter()
            try:
                return kernel(*arguments)
            finally:
                spent += time.perf_counter() - began

        return run

    kernels = loop.advance, exact.follow
    loop.advance, exact.follow = map(counting, kernels)
    try:
        return work(task), spent
    finally:
        loop.advance, exact.follow = kernels


class KernelTime(Executor):
    """Hands tasks to another executor and sums the time of their kernels, s."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self.seconds = 0.0

    def map(self, fn: Callable[..., Any], *iterables: Iterable[Any], **_: Any) -> Iterator[Any]:
        (tasks,) = map(list, iterables)
        for answer, seconds in self._executor.map(timed, [fn] * len(tasks), tasks):
            self.seconds += seconds
            yield answer
