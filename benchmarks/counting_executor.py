"""An executor that counts how long its tasks are in compiled kernels, and outside them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from typing import Any

from capture_sim.detection import exact
from capture_sim.dynamics.engine import loop


def timed(work: Callable[[Any], Any], task: Any) -> tuple[Any, float, float, float]:
    """Do a task; return its answer, its kernels' wall time, their processor time and its own, s."""
    wall = processor = 0.0

    def counting(kernel: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            nonlocal wall, processor
            began, used = time.perf_counter(), time.process_time()
            try:
                return kernel(*arguments)
            finally:
                wall += time.perf_counter() - began
                processor += time.process_time() - used

        return run

    kernels, used = (loop.advance, exact.follow), time.process_time()
    loop.advance, exact.follow = map(counting, kernels)
    try:
        answer = work(task)
        return answer, wall, processor, time.process_time() - used
    finally:
        loop.advance, exact.follow = kernels


class KernelTime(Executor):
    """Hands tasks to another executor and sums their times, s.

    Attributes
    ----------
    wall, processor : float
        Of the kernels.
    tasks : float
        Processor time of the tasks, the kernels included.
    """

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self.wall = self.processor = self.tasks = 0.0

    def map(self, fn: Callable[..., Any], *iterables: Iterable[Any], **_: Any) -> Iterator[Any]:
        """Return the answers in the order of the tasks."""
        (tasks,) = map(list, iterables)
        for answer, wall, processor, whole in self._executor.map(timed, [fn] * len(tasks), tasks):
            self.wall += wall
            self.processor += processor
            self.tasks += whole
            yield answer
