"""Handling of Ctrl-C in commands and nodes.

In a command, Ctrl-C raises KeyboardInterrupt, as in any Python program.  In a compiler's callback,
a destructor or a module's import, Python loses this exception or prints a traceback.  The kernels
(the functions that Numba compiles) are therefore compiled and loaded in a separate thread.

In a node, Ctrl-C sets the event :data:`STOP`; the main thread checks it wherever it waits.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import shutil
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TypeVar

T = TypeVar("T")

#: Event that is set when a node's process has been asked to end.
STOP = threading.Event()
_WORKER_NAME = "worker"
#: Period with which :func:`wait_for` checks :data:`STOP`, s.
_POLL_PERIOD = 0.05


def watch_signals(
    stop: threading.Event, signals: Collection[signal.Signals] = (signal.SIGINT, signal.SIGTERM)
) -> Callable[[], None]:
    """Set ``stop`` whenever a signal arrives; return a function that restores the handlers.

    The given signals raise nothing, so no cleanup is interrupted and no signal is lost in a
    destructor.  Any other signal that has a handler in Python calls this handler and sets ``stop``
    too.  Outside the main thread, where Python does not allow handlers, nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        return lambda: None
    reader, writer = socket.socketpair()
    writer.setblocking(False)

    def watch() -> None:
        with reader, writer:
            while reader.recv(1):
                stop.set()

    threading.Thread(target=watch, name="signals", daemon=True).start()
    earlier_fd = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    earlier = {signum: signal.signal(signum, lambda signum, frame: None) for signum in signals}

    def restore() -> None:
        for signum, handler in earlier.items():
            signal.signal(signum, handler)
        signal.set_wakeup_fd(earlier_fd)
        writer.shutdown(socket.SHUT_WR)  # ends the thread

    return restore


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGTERM and SIGHUP while in the context, as on Ctrl-C.

    Batch queues send SIGTERM to end a job, a terminal that is closed SIGHUP.  A signal that is
    ignored, as by nohup, stays so.  Outside the main thread, where Python does not allow handlers,
    nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    earlier = {
        signum: signal.signal(signum, signal.default_int_handler)
        for signum in (signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(signum) is signal.SIG_DFL
    }
    try:
        yield
    finally:
        for signum, handler in earlier.items():
            signal.signal(signum, handler)


def tied(command: Sequence[str]) -> list[str]:
    """Return the command, extended so that its process does not outlive this one.

    The process gets SIGTERM when the thread that starts it ends, and so also when this process
    ends or is killed.  Without ``setpriv`` of util-linux, the command is returned unchanged.
    """
    keeper = shutil.which("setpriv")
    return [*((keeper, "--pdeathsig", "TERM") if keeper else ()), *command]


def end_with_parent(clean_up: Callable[[], None] = lambda: None) -> None:
    """End this process, a worker, as soon as the process that has started it ends or is killed.

    ``clean_up`` is called before.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        clean_up()
        os._exit(1)

    threading.Thread(target=wait, name="parent", daemon=True).start()


def wait_for(event: threading.Event) -> None:
    """Wait until an event is set; raise KeyboardInterrupt if :data:`STOP` is set before."""
    while not event.wait(_POLL_PERIOD):
        if STOP.is_set():
            raise KeyboardInterrupt


def in_worker(work: Callable[[], T]) -> T:
    """Call a function in a separate thread; return its result or raise its error.

    After Ctrl-C, KeyboardInterrupt is raised at once, while the function continues; see
    :func:`leave_if_busy`.  Outside the main thread, which alone receives signals, the function is
    called in the present thread.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()  # only the main thread receives signals
    results: list[T] = []
    failures: list[BaseException] = []
    done = threading.Event()

    def run() -> None:
        try:
            results.append(work())
        except BaseException as failure:
            failures.append(failure)
        done.set()

    thread = threading.Thread(target=run, name=_WORKER_NAME, daemon=True)
    thread.start()
    wait_for(done)
    thread.join()
    if failures:
        raise failures[0]
    return results[0]


def leave_if_busy(status: int, *names: str) -> None:
    """End the process at once, with this exit status, if a worker thread is still running.

    Workers are the threads of :func:`in_worker` and those of the given names.  ``os._exit`` is
    used, because a worker that compiles with LLVM cannot be interrupted: a normal exit would wait
    for it or, before Python 3.14, abort when it returns.
    """
    if any(thread.name in (_WORKER_NAME, *names) for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def end_within(seconds: int, status: int) -> None:
    """End the process with this exit status if it has not ended after ``seconds`` of wall time.

    The function itself returns at once.  Fast DDS in the ROS 2 packages of PyPI may spin forever
    when a DDS participant is destroyed while another appears or disappears (eProsima Fast-DDS
    issue 6513: a deadline overflows with the C++ library of GCC 9).  rclpy holds Python's lock
    meanwhile, so no thread, handler or ``finally`` runs.  Therefore a timer of the C library calls
    ``_exit``.  Where the C library has no such timer, nothing ends the process.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    with suppress(OSError, AttributeError):  # another C library: such a wheel does not exist
        libc = ctypes.CDLL("librt.so.1")  # older versions have the timers there
        leave = ctypes.cast(libc._exit, ctypes.c_void_p).value
        sigev_thread = 2
        # struct sigevent: value, signal, notification, function, its attributes
        event = struct.pack("PiiPP32x", status, 0, sigev_thread, leave, 0)
        timer = ctypes.c_void_p()
        if libc.timer_create(time.CLOCK_MONOTONIC, event, ctypes.byref(timer)) == 0:
            # struct itimerspec: interval and delay, s and ns each
            libc.timer_settime(timer, 0, struct.pack("4l", 0, 0, seconds, 0), None)
