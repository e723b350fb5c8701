"""A node's end that does not wait for DDS longer than it may."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_SIGEV_THREAD = 2  # a thread of the C library calls the function
_CLOCK_MONOTONIC = 1


class _Event(ctypes.Structure):
    """``struct sigevent`` of the GNU C library."""

    _fields_ = (
        ("value", ctypes.c_ssize_t),
        ("signo", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("reserved", ctypes.c_char * 32),
    )


class _Setting(ctypes.Structure):
    """``struct itimerspec``: interval, then the time until it goes off, each in s and ns."""

    _fields_ = tuple((name, ctypes.c_long) for name in ("every", "every_ns", "after", "after_ns"))


@contextmanager
def ended_within(seconds: int, status: int) -> Iterator[None]:
    """End the process with this status if what is in the context takes longer than that.

    Fast DDS may spin for tens of seconds when a participant ends while others come and go on a busy
    machine (eProsima, Fast-DDS issue 6513), and rclpy holds Python's lock meanwhile: no thread of
    Python could end that, so a timer of the C library calls the C library's ``_exit``.

    Parameters
    ----------
    seconds
        (wall)
    status
        Exit status of the process, if so.
    """
    timer = ctypes.c_void_p()
    try:
        libc = ctypes.CDLL("librt.so.1")  # where older ones have the timers; newer ones find them
        leave = ctypes.cast(libc._exit, ctypes.c_void_p)
        event = _Event(value=status, notify=_SIGEV_THREAD, function=leave)
        made = libc.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0
    except (OSError, AttributeError):  # another C library
        made = False
    if not made:
        yield
        return
    sys.stdout.flush()
    sys.stderr.flush()
    libc.timer_settime(timer, 0, ctypes.byref(_Setting(after=seconds)), None)
    try:
        yield
    finally:
        libc.timer_delete(timer)
