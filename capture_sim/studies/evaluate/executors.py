"""Executors of independent runs: in this process, in other processes, or on a Dask cluster.

All executors have the interface of ``concurrent.futures``.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
)
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

from capture_sim.base.interrupts import end_with_parent
from capture_sim.base.threads import limit_linear_algebra
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.errors import CaptureSimError, import_failure


class ExecutorError(CaptureSimError):
    """Raised if workers are not available or were lost."""


class InProcess(Executor):
    """Executor that runs each task in this process, when its result is read."""

    def map(self, fn: Callable[..., Any], *iterables: Iterable[Any], **_: Any) -> Iterator[Any]:
        """Return the results in the order of the arguments."""
        return map(fn, *iterables)


class _Processes(ProcessPoolExecutor):
    """Processes on this machine.

    They do not receive Ctrl-C, and they end when this process ends.
    """

    def __init__(self, count: int) -> None:
        limit_linear_algebra()  # the cores are taken by these processes
        # spawn, because a fork would copy the compiler's threads in an undefined state
        super().__init__(count, multiprocessing.get_context("spawn"), _begin_worker)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        # replace __main__ while a process may start: the new process then does not run the user's
        # script again, because its tasks use only this package
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            with _interrupts_held():
                return super().submit(fn, *args, **kwargs)
        finally:
            sys.modules["__main__"] = main

    def __exit__(self, *_: object) -> None:
        self.shutdown(cancel_futures=True)


#: Signals that end a study: SIGINT (Ctrl-C), and SIGTERM, which batch queues send.
_ENDING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Delay the handling of SIGINT and SIGTERM until the end of the block.

    A process that is started in the block inherits the signal mask, so it does not receive these
    signals.  A signal during its start would make it print its own traceback or survive as an
    orphan.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)  # inherited by new processes
    held: list[int] = []
    # The mask applies to this thread only.  Another thread may receive the signal, and Python then
    # calls the handler in the main thread: so replace the handlers, too.
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        handlers = {number: signal.getsignal(number) for number in _ENDING}
        handlers = {number: found for number, found in handlers.items() if callable(found)}
    for number in handlers:
        signal.signal(number, lambda number, _: held.append(number))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if held:
        handler = handlers[signal.Signals(held[0])]
        assert callable(handler)
        handler(held[0], None)


def workers_of(executor: Executor) -> int:
    """Return the number of runs that an executor makes side by side."""
    return int(getattr(executor, "workers", 0) or getattr(executor, "_max_workers", 1))


def _begin_worker() -> None:
    end_with_parent()
    compile_kernels()


@contextmanager
def open_executor(workers: int | None = None, scheduler: str | None = None) -> Iterator[Executor]:
    """Open an executor: processes, or a Dask cluster by the address of its scheduler.

    One worker means this process; None means one process for each core.  With a scheduler,
    ``workers`` is not used: the cluster has its own.  Raises ExecutorError if the cluster does not
    respond or has no workers, or if Dask is not installed.
    """
    workers = workers or len(os.sched_getaffinity(0))
    if scheduler is not None:
        with _dask_client(scheduler) as client:
            executor = client.get_executor(pure=False)
            executor.workers = sum(client.ncores().values())
            yield executor
    elif workers > 1:
        with ExitStack() as stack:
            with _interrupts_held():
                pool = stack.enter_context(_Processes(workers))
            yield pool
    else:
        yield InProcess()


def _dask_client(address: str) -> Any:
    """Return a client of a cluster; its workers need the same version of this package."""
    parts = urlsplit(address)
    if parts.scheme not in ("tcp", "tls", "inproc", "ucx", "ws", "wss") or not parts.netloc:
        raise ExecutorError(f"--scheduler {address}: must be an address like tcp://127.0.0.1:8786")
    try:
        from distributed import Client
    except ImportError as error:
        text = import_failure("--scheduler needs Dask", error, "cluster")
        raise ExecutorError(text) from None
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise ExecutorError(f"--scheduler {address}: no answer: {error}") from None
    if not client.scheduler_info(n_workers=-1)["workers"]:
        client.close()
        raise ExecutorError(f"--scheduler {address}: the cluster has no workers")
    return client


def answers(
    executor: Executor,
    function: Callable[[Any], Any],
    arguments: Sequence[Any],
    report: Callable[[int, int], None] | None = None,
) -> Iterator[Any]:
    """Yield the results of a function in the order of its arguments.

    A result is yielded as soon as it and all results before it are available.  ``report`` is called
    with the number of results and the number of arguments.  Raises ExecutorError if the workers
    were lost.
    """
    try:
        for done, answer in enumerate(executor.map(function, arguments), 1):
            if report is not None:
                report(done, len(arguments))
            yield answer
    except Exception as error:
        # exceptions of Dask, e.g. KilledWorker, can be imported only if Dask is installed
        if not isinstance(error, (BrokenExecutor, CancelledError)) and (
            type(error).__module__.partition(".")[0] != "distributed"
        ):
            raise
        first_line = str(error).partition("\n")[0] or type(error).__name__
        raise ExecutorError(f"the workers were lost ({first_line})") from None
