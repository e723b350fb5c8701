"""Pacing of the loop: when each position is sent to the rig, and a stop if too many are late."""

from __future__ import annotations

import os
import statistics
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from capture_sim.hardware.stage import SafeStopError

#: Shares of a period: a position later than the first is late and shifts all later ones; two
#: positions are at least the second apart.
MAX_JITTER, MIN_INTERVAL = 0.2, 0.8
#: Number of latest steps in which the share of late steps is computed, and number of steps before
#: which it is not checked.
_WINDOW, _FIRST = 1000, 200


class LoopPacer:
    """Determines when to send each position, one every ``period`` (s, wall time).

    For each position: wait :meth:`time_to_work`, compute the position, call :meth:`work_done`, wait
    :meth:`time_to_send`, call :meth:`release`, and send.  A late position shifts all later ones.
    The loop stops if a position is later than ``max_lateness`` (s), or if the share of late
    positions among the latest exceeds ``max_late_share``.  ``clock`` returns the wall time, s.
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
        """Return how long to wait before computing the next position, s.

        The median of the latest computing times gives the time that this takes.
        """
        lead = min(statistics.median(self._work_times), self.period)
        self._work_begin = max(self._due - lead, self._clock())
        return max(self._work_begin - self._clock(), 0.0)

    def time_to_send(self) -> float:
        """Return how long to wait before sending the next position, s; 0 if it is due."""
        earliest = max(self._due, self._last + MIN_INTERVAL * self.period)
        return max(earliest - self._clock(), 0.0)

    def work_done(self) -> None:
        """Record that the next position has been computed; call it before :meth:`time_to_send`."""
        self._work_times.append(self._clock() - self._work_begin)

    def release(self) -> None:
        """Record that a position is sent now, and set when the next one is due.

        Raise SafeStopError if the position is too late, or if too many of the latest were late.
        """
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
        """Mean number of positions per second of wall time so far."""
        return self.steps / max(self._last - self._start, 1e-9)

    @property
    def late_share(self) -> float:
        """Share of late positions among all positions so far, 0 to 1."""
        return self.late_steps / max(self.steps, 1)


def request_priority(priority: int) -> str:
    """Request SCHED_FIFO scheduling with a priority for all threads of this process.

    Return the reason for a refusal with a remedy, empty if the request was granted.
    """
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
