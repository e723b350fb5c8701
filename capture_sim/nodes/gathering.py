"""What a run waits for before it begins: its followers, their connections, the release."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from capture_sim.control.simulation import SimulationControl
from capture_sim.errors import CaptureSimError
from capture_sim.messages.topics import SIMULATOR, topics_of
from capture_sim.nodes.flow_control import POLL, Followers
from capture_sim.nodes.following import connections
from capture_sim.nodes.running import BenchNode

#: What is waited for is said after this long, then ever more seldom, s (wall).
REPORT_PERIOD = 2.0


class Gathering:
    """Waits for the followers of a run.

    Parameters
    ----------
    node
        The simulator.
    followers
        Those that take part.
    control
        May cut the waiting short.
    replaced : bool
        Whether a follower that dies is waited for, since it may be started again; else the
        run fails at once.
    """

    def __init__(
        self, node: BenchNode, followers: Followers, control: SimulationControl, replaced: bool
    ) -> None:
        self._node = node
        self._followers = followers
        self._control = control
        self._replaced = replaced

    def all_free(self) -> str:
        """Return whom the next run waits for; nothing if all are free."""
        if unheard := self._followers.unheard():
            return f"waiting for {', '.join(unheard)} to start"
        if busy := self._followers.not_in(""):
            return f"waiting for {', '.join(busy)} to end the last run"
        return ""

    def all_closed(self) -> str:
        """Return who is still busy with the last run; nothing if none is."""
        busy = self._followers.not_in("")
        return f"waiting for {', '.join(busy)} to end the run" if busy else ""

    def all_ready(self, run_id: str) -> str:
        """Return whom this run waits for; nothing if all have taken it up."""
        if unheard := self._followers.unheard():
            return f"waiting for {', '.join(unheard)} to start"
        if outside := self._followers.not_in(run_id):
            return f"waiting for {', '.join(outside)} to take up the run"
        for topic in topics_of(SIMULATOR):
            wanted = connections(topic, self._followers.names)
            if self._node.matched(topic) < wanted:
                return f"waiting for {topic.name} to be connected to all {wanted} subscribers"
        return ""

    def wait(self, what: str, lacking: Callable[[], str], limit: float | None) -> None:
        """Wait until ``lacking`` returns nothing; say what it returns, ever more seldom.

        Raises
        ------
        CaptureSimError
            After ``limit`` (s), or when a follower falls silent that is not replaced.
        RunCut
            The run is to end.
        """
        log: Any = self._node.get_logger()
        began = said = time.monotonic()
        silence = REPORT_PERIOD
        with self._followers.changed:
            while text := lacking():
                self._control.check()
                self._followers.changed.wait(POLL)
                for name in self._followers.drop_silent():
                    why = f"{name}: {self._followers.lost[name]}"
                    if not self._replaced:
                        raise CaptureSimError(why)
                    log.warning(f"{what}: {why}")
                now = time.monotonic()
                if limit is not None and now - began > limit:
                    raise CaptureSimError(f"{text}: given up after {limit:g} s")
                if now - said > silence:
                    said, silence = now, 2.0 * silence
                    log.info(f"{what}: {text}")
