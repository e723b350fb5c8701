"""Who takes part in a run, and how far each has come: so that no queue overflows.

Even a reliable subscriber loses messages once its queue is full, and an unpaced run is
faster than any subscriber.  So the followers of a run acknowledge the samples they have
taken in, and the simulator waits for the slowest.  Without ROS, for any transport.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

#: A waiting simulator looks for those that keep silent this often, s.
POLL = 0.01
#: Messages that may be under way to one process.  Fast DDS's shared memory holds 512, and 512 kB;
#: what does not fit is dropped, and sent again when a heartbeat has told that it is missing.
UNDER_WAY = 400
#: Samples between two acknowledgements at most.
ACK_EVERY = 100
#: Messages with every periodic sample: the simulator's eight, the launcher's, the detector's.
_PERIODIC = 10


def samples_between_acks(state_rate: float, rate: float) -> int:
    """Return how many samples to acknowledge at a time: two such lots may be under way.

    Parameters
    ----------
    state_rate, rate
        Of the run, Hz.
    """
    of_each = 1.0 + _PERIODIC * rate / state_rate
    return max(1, min(ACK_EVERY, int(UNDER_WAY / (2.0 * of_each))))


@dataclass
class _Follower:
    heard: float | None = None  # wall, last sign of life
    run_id: str = ""  # the run that it says it is in; empty for none
    received: int = 0  # samples of the run taken in
    moved: float = 0.0  # wall, when that last grew
    member: bool = False  # took part in the run that is on from its start, and still does
    away: bool = False  # left behind, and not heard of since


class Followers:
    """The nodes that take part in a run.

    One thread may report what is :meth:`heard` while another waits.

    Parameters
    ----------
    names
        Of the nodes.
    timeout
        s (wall); a follower that keeps silent, or the run waiting, for longer is lost.

    Attributes
    ----------
    changed : threading.Condition
        Notified whenever something was heard; may be waited on together with other news.
    lost : dict
        Followers that were left behind and have not come back, and why.
    """

    def __init__(self, names: Sequence[str], timeout: float) -> None:
        self.changed = threading.Condition(threading.RLock())
        self.lost: dict[str, str] = {}
        self._timeout = timeout
        self._followers = {name: _Follower() for name in names}

    @property
    def names(self) -> list[str]:
        """Those that still take part."""
        return [name for name, f in self._followers.items() if not f.away]

    def start(self, run_id: str) -> None:
        """Begin a run: from here on those that are in it are waited for.

        One that comes later follows the run without being waited for, and counts from the next.
        """
        with self.changed:
            for follower in self._followers.values():
                follower.member = follower.run_id == run_id and not follower.away

    def heard(self, name: str, run_id: str, received: int) -> None:
        """Take in an acknowledgement: so many samples of that run are taken in."""
        with self.changed:
            follower = self._followers.get(name)
            if follower is None:
                return
            now = time.monotonic()
            if follower.away and (run_id, received) != (follower.run_id, follower.received):
                follower.away = False  # it is back: takes part again from the next run on
                del self.lost[name]
            if run_id != follower.run_id:
                follower.run_id, follower.received, follower.moved = run_id, 0, now
                follower.member = False
            if received > follower.received:
                follower.received, follower.moved = received, now
            follower.heard = now
            self.changed.notify_all()

    def unheard(self) -> list[str]:
        """Return those that have not been heard of."""
        return [name for name, f in self._followers.items() if f.heard is None or f.away]

    def not_in(self, run_id: str) -> list[str]:
        """Return those that are not in this run; an empty ``run_id``: not free."""
        return [name for name, f in self._followers.items() if f.run_id != run_id and not f.away]

    def drop_silent(self) -> list[str]:
        """Leave those behind that have fallen silent, and return them."""
        now = time.monotonic()
        silent = [
            name
            for name, f in self._followers.items()
            if f.heard is not None and not f.away and now - f.heard > self._timeout
        ]
        for name in silent:
            self._drop(name, f"no sign of life for {self._timeout:g} s")
        return silent

    def wait_for(self, count: int, run_id: str) -> list[str]:
        """Wait until all in the run have taken in ``count`` samples.

        Those that are silent, or make the run wait without coming on, are left behind.

        Returns
        -------
        list of str
            Those left behind now.
        """
        began = time.monotonic()
        with self.changed:
            dropped = self.drop_silent()
            while late := self._behind(count, run_id):
                now = time.monotonic()
                for name in late:
                    if now - max(began, self._followers[name].moved) > self._timeout:
                        received = self._followers[name].received
                        self._drop(name, f"stood still for {self._timeout:g} s at {received}")
                        dropped.append(name)
                self.changed.wait(POLL)
                dropped += self.drop_silent()
        return dropped

    def _behind(self, count: int, run_id: str) -> list[str]:
        """Return those with fewer samples; one that has ended the run is not waited for."""
        return [
            name
            for name, f in self._followers.items()
            if f.member and f.run_id == run_id and f.received < count
        ]

    def _drop(self, name: str, why: str) -> None:
        follower = self._followers[name]
        follower.away, follower.member = True, False
        self.lost[name] = why
