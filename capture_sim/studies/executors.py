"""Where independent runs are done: in this process, in several, or on a Dask cluster.

All take a function of one argument and its arguments, and give back (place, answer) as
answers come; what is done with them must not depend on their order.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol
from urllib.parse import urlsplit

from capture_sim.errors import CaptureSimError

Answers = Iterator[tuple[int, Any]]

#: Tasks per worker under way: enough to keep it busy, few enough to lose little when killed.
_AHEAD = 3


class ExecutorError(CaptureSimError):
    """The workers cannot be had, or were lost."""


class Executor(Protocol):
    """Does independent tasks."""

    def answers(self, function: Callable[[Any], Any], arguments: Sequence[Any]) -> Answers:
        """Yield (place in ``arguments``, answer) as they come."""


class InProcess:
    """One after the other, here."""

    def answers(self, function: Callable[[Any], Any], arguments: Sequence[Any]) -> Answers:
        """Yield (place in ``arguments``, answer), in order."""
        for place, argument in enumerate(arguments):
            yield place, function(argument)


class Processes:
    """Processes of this machine; they end with this one, however it ends."""

    def __init__(self, count: int) -> None:
        self._count = count
        # spawned: a fork would copy the compiler's threads in whatever state they are
        self._pool = ProcessPoolExecutor(
            count, multiprocessing.get_context("spawn"), _begin_worker, (os.getpid(),)
        )

    def answers(self, function: Callable[[Any], Any], arguments: Sequence[Any]) -> Answers:
        """Yield (place in ``arguments``, answer) as they come."""
        places = iter(range(len(arguments)))
        running: dict[Any, int] = {}
        try:
            while True:
                for place in places:
                    running[self._pool.submit(function, arguments[place])] = place
                    if len(running) >= _AHEAD * self._count:
                        break
                if not running:
                    return
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    yield running.pop(future), future.result()
        except BrokenProcessPool:
            raise ExecutorError(
                "a worker process was killed; what was kept can be resumed"
            ) from None

    def close(self) -> None:
        """End the workers."""
        self._pool.shutdown(cancel_futures=True)


def _begin_worker(parent: int) -> None:
    """Load the kernels, and see to it that a killed parent leaves no worker behind."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears of Ctrl-C, and ends us
    threading.Thread(target=watch, daemon=True).start()
    from capture_sim.bench import compile_kernels

    compile_kernels()


class DaskCluster:
    """Workers of a running Dask cluster; each needs this package of the same version."""

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise ExecutorError(
                "--scheduler: Dask is not installed; pip install -r requirements/cluster.txt"
            ) from None
        try:
            self._client = Client(address, timeout="10s", set_as_default=False)
        except (OSError, ValueError) as error:
            raise ExecutorError(f"--scheduler {address}: no answer: {error}") from None
        if not self._client.scheduler_info(n_workers=-1)["workers"]:
            self._client.close()
            raise ExecutorError(f"--scheduler {address}: the cluster has no workers")

    def answers(self, function: Callable[[Any], Any], arguments: Sequence[Any]) -> Answers:
        """Yield (place in ``arguments``, answer) as they come."""
        from distributed import CancelledError, KilledWorker, as_completed
        from distributed.comm import CommClosedError

        # a run holds the interpreter's lock all along: a second one in a worker gains nothing
        futures = self._client.map(function, arguments, pure=False, batch_size=64)
        place = {future.key: number for number, future in enumerate(futures)}
        try:
            for future, answer in as_completed(futures, loop=self._client.loop, with_results=True):
                yield place[future.key], answer
        except (CancelledError, KilledWorker, CommClosedError) as error:
            raise ExecutorError(
                f"the Dask cluster was lost ({error}); start again to go on from there"
            ) from None
        finally:
            self._client.cancel(futures)

    def close(self) -> None:
        """Leave the cluster as it was."""
        self._client.close()


def default_workers() -> int:
    """Return how many processes this one may use the cores of."""
    return len(os.sched_getaffinity(0))


@contextlib.contextmanager
def open_executor(workers: int = 1, scheduler: str | None = None) -> Iterator[Executor]:
    """Give an executor for a while.

    Parameters
    ----------
    workers
        Processes; 1 stays in this one.
    scheduler
        Address of a Dask scheduler, as ``tcp://127.0.0.1:8786``; then ``workers`` counts nothing.

    Raises
    ------
    ExecutorError
        The cluster does not answer, has no workers, or Dask is not installed.
    """
    if scheduler is not None:
        parts = urlsplit(scheduler)
        if parts.scheme not in ("tcp", "tls", "inproc", "ucx", "ws", "wss") or not parts.netloc:
            raise ExecutorError(
                f"--scheduler {scheduler}: allowed is an address like tcp://127.0.0.1:8786"
            )
        cluster = DaskCluster(scheduler)
        with contextlib.closing(cluster):
            yield cluster
    elif workers > 1:
        with contextlib.closing(Processes(workers)) as pool:
            yield pool
    else:
        yield InProcess()


def ordered(
    executor: Executor,
    function: Callable[[Any], Any],
    arguments: Sequence[Any],
    tell: Callable[[int], None] | None = None,
) -> list[Any]:
    """Return the answers in the order of the arguments; ``tell`` hears of each."""
    answers: list[Any] = [None] * len(arguments)
    for place, answer in executor.answers(function, arguments):
        answers[place] = answer
        if tell is not None:
            tell(1)
    return answers
