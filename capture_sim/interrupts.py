"""Work in a thread of its own, while the main thread waits for nothing but its end or Ctrl-C.

Where Ctrl-C meets a compiler's callback, a destructor or a module's import, Python loses it there,
or tells of it in a traceback.  Compiling and loading the kernels is little else than that.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

_NAME = "worker"


def in_worker(work: Callable[[], T]) -> T:
    """Do some work; return what it returns, raise what it raises.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, at once: the work goes on behind, see :func:`leave_if_busy`.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()  # signals are not for this thread
    results: list[T] = []
    failures: list[BaseException] = []

    def run() -> None:
        try:
            results.append(work())
        except BaseException as failure:
            failures.append(failure)

    thread = threading.Thread(target=run, name=_NAME, daemon=True)
    thread.start()
    thread.join()
    if failures:
        raise failures[0]
    return results[0]


def leave_if_busy(status: int, *names: str) -> None:
    """End the process here and now if a thread is still at work outside of Python.

    ``os._exit``, as nothing else can: LLVM takes no interruption, and Python's own end would wait
    for the thread, or, where it does not, abort when that comes back (before Python 3.14).

    Parameters
    ----------
    status
        Exit status of the process.
    names
        Of other threads that may be; those of :func:`in_worker` always count.
    """
    if any(thread.name in (_NAME, *names) for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
