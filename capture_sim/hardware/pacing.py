"""When positions are sent: at a steady rate, never hurried, and stopped if too many are late."""

from __future__ import annotations

import os
import statistics
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from capture_sim.hardware.stage import SafeStopError

#: Shares of a step: lateness up to this is caught up with, so that positions are never closer.
MAX_JITTER, MIN_INTERVAL = 0.2, 0.8
#: The share of late steps is that of so many latest steps, and known after so many.
_WINDOW, _FIRST = 1000, 200


class LoopPacer:
    """The times of positions, one every ``period`` (s, wall).

    Before each: wait :meth:`time_to_work`, work, wait :meth:`time_to_send`, :meth:`release`, send.
    A late position shifts all later ones.  ``max_lateness`` (s) of a position, ``max_late_share``
    of late ones: beyond them the loop stops.
    """

    def __init__(
        self,
        period: float,
        max_lateness: float,
        max_late_share: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.period = period
        self._max_lateness, self._max_late_share = max_lateness, max_late_share
        self._clock = clock
        self._start = self._last = clock() - period
        self._due = self._start + period
        self._work_begin = self._due
        self._work_times: deque[float] = deque([0.0], maxlen=51)  # s
        self._latest: deque[bool] = deque(maxlen=_WINDOW)  # whether late
        self.steps = self.late_steps = 0
        self.largest_lateness = 0.0  # s

    def time_to_work(self) -> float:
        """Return how long to wait before the work on the next position, s."""
        lead = min(statistics.median(self._work_times), self.period)
        self._work_begin = max(self._due - lead, self._clock())
        return max(self._work_begin - self._clock(), 0.0)

    def time_to_send(self) -> float:
        """Return how long to wait before the next position may be sent, s; 0 if it may be now."""
        earliest = max(self._due, self._last + MIN_INTERVAL * self.period)
        return max(earliest - self._clock(), 0.0)

    def work_done(self) -> None:
        """Take note that the position is known."""
        self._work_times.append(self._clock() - self._work_begin)

    def release(self) -> None:
        """Take note that the position is sent now; SafeStopError if it or too many are late."""
        now = self._clock()
        lateness = now - self._due
        is_late = lateness > MAX_JITTER * self.period
        self.steps += 1
        self._latest.append(is_late)
        if is_late:
            self.late_steps += 1
            self.largest_lateness = max(self.largest_lateness, lateness)
            self._due = now
        self._due += self.period
        self._last = now
        if lateness > self._max_lateness:
            raise SafeStopError(
                f"lateness of a step = {lateness:.3g} s: must be <= {self._max_lateness:g} "
                "(lateness_limit)"
            )
        share = sum(self._latest) / len(self._latest)
        if len(self._latest) >= _FIRST and share > self._max_late_share:
            raise SafeStopError(
                f"share of late steps = {share:.3g}: must be <= {self._max_late_share:g} "
                f"(late_share_limit); {self.rate:.0f} steps per second of {1.0 / self.period:.0f}"
            )

    @property
    def rate(self) -> float:
        """Positions per second (wall) so far."""
        return self.steps / max(self._last - self._start, 1e-9)

    @property
    def late_share(self) -> float:
        """Share of all positions that were late."""
        return self.late_steps / max(self.steps, 1)


def request_priority(priority: int) -> str:
    """Ask for SCHED_FIFO with this priority for all threads; return why not, empty if granted."""
    try:
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:  # another system has no such call
        reason = error.strerror if isinstance(error, OSError) else "not on this system"
        return (
            f"priority = {priority}: SCHED_FIFO not granted: {reason}; add '@realtime - rtprio 99' "
            "to /etc/security/limits.conf, your user to the group realtime, and log in again"
        )
    return ""
