"""When the messages of a recording are due: rate, pause and step, without ROS."""

from __future__ import annotations

import threading
import time

#: The playing thread looks up this often while it waits, s.
_POLL = 0.2
#: Bounds of the rate when it is changed while playing, recorded seconds per second.
LEAST_RATE, GREATEST_RATE = 0.01, 1000.0


class Transport:
    """The transport of a player: one thread waits, any other one controls.

    Parameters
    ----------
    rate
        Recorded seconds per second of wall time; 0 does not wait at all.
    paused
        Whether to begin paused.
    """

    def __init__(self, rate: float, *, paused: bool = False) -> None:
        self._rate = rate
        self._changed = threading.Condition()
        self._paused = paused
        self._steps = 0  # times of messages that may pass while paused
        self._stepped: int | None = None  # the last of them, ns
        self._origin: tuple[int, float] | None = None  # stamp (ns), and when it was due (s)

    @property
    def paused(self) -> bool:
        """Whether nothing is due."""
        return self._paused

    def start(self) -> None:
        """Let time begin with the next message."""
        with self._changed:
            self._origin = None
            self._stepped = None

    def pause(self) -> str:
        """Stop; return why not, or nothing."""
        with self._changed:
            if self._paused:
                return "already paused"
            self._paused = True
            self._changed.notify_all()
        return ""

    def resume(self) -> str:
        """Go on; return why not, or nothing."""
        with self._changed:
            if not self._paused:
                return "already playing"
            self._paused, self._steps, self._stepped = False, 0, None
            self._origin = None  # what was missed while paused is not caught up
            self._changed.notify_all()
        return ""

    def change_rate(self, factor: float) -> str:
        """Play faster or slower by a factor from now on, within bounds; return the rate in words.

        A rate of 0, as fast as it goes, stays.
        """
        with self._changed:
            if self._rate == 0.0:
                return "rate: as fast as it goes"
            rate = min(max(self._rate * factor, LEAST_RATE), GREATEST_RATE)
            if self._origin is not None:  # no jump: from the time that is reached
                first, began = self._origin
                now = time.monotonic()
                self._origin = (first + round((now - began) * self._rate * 1e9), now)
            self._rate = rate
            self._changed.notify_all()
            return f"rate: {rate:g}"

    def step(self) -> str:
        """Let the messages of the next time pass; return why not, or nothing."""
        with self._changed:
            if not self._paused:
                return "stepping needs a paused player"
            self._steps += 1
            self._changed.notify_all()
        return ""

    def wait_for_steps(self, limit: float) -> bool:
        """Wait until all steps asked for have been taken, ``limit`` s at most; tell whether."""
        with self._changed:
            return self._changed.wait_for(lambda: self._steps == 0, limit)

    def wait_until(self, stamp: int) -> None:
        """Wait until the message of this stamp, ns, is due."""
        with self._changed:
            while True:
                if self._paused:
                    if stamp == self._stepped:
                        return  # of the same time as the one that has passed
                    if self._steps:
                        self._steps -= 1
                        self._stepped = stamp
                        self._changed.notify_all()
                        return
                    self._changed.wait(_POLL)
                    continue
                if self._rate == 0.0:
                    return
                now = time.monotonic()
                if self._origin is None:
                    self._origin = (stamp, now)
                first, began = self._origin
                delay = began + (stamp - first) / 1e9 / self._rate - now
                if delay <= 0.0:
                    return
                self._changed.wait(min(delay, _POLL))
