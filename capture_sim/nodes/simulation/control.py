"""Play, pause and reset of the simulator and of a player, without ROS.

Requests are handled in callbacks, which run while the simulating or playing code waits, see
:meth:`SimulationControl.tick`.  No message of the run is therefore sent between a pause and the
reply to its request.  States, results and their numbers are those of ``simulation_interfaces``
(ros-simulation, 2.1), which defines their meaning.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

from capture_sim.nodes.protocol.ends import CutKind
from capture_sim.nodes.simulation.pacing import RunPacer

#: Period at which callbacks run while simulated time advances, s (wall).  A shorter wait is a sleep
#: without callbacks, because a wait of the executor would end 0.1 ms later.
SERVICE_PERIOD = 0.005


class State(IntEnum):
    """States of a simulation, as in SimulationState.msg, without its states of loading a world."""

    STOPPED = 0
    PLAYING = 1
    PAUSED = 2
    QUITTING = 3


class Code(IntEnum):
    """Result codes of requests, as in Result.msg and SetSimulationState.srv."""

    FEATURE_UNSUPPORTED = 0
    OK = 1
    INCORRECT_STATE = 3
    ALREADY_IN_TARGET_STATE = 101
    INCORRECT_TRANSITION = 103


class Scope(IntEnum):
    """Bits of the field ``scope`` of a ResetSimulation request."""

    DEFAULT = 0
    TIME = 1
    STATE = 2
    SPAWNED = 4
    ALL = 255


class Reply(NamedTuple):
    """Result of a request; ``message`` is empty if the code is OK."""

    code: Code
    message: str = ""


class RunCut(Exception):  # noqa: N818  # not an error: the run is to end before its time
    """Raised to end the current run early; the text gives the reason, ``kind`` its kind."""

    def __init__(self, kind: CutKind, reason: str = "") -> None:
        super().__init__(reason or kind.value)
        self.kind = kind


class SimulationControl:
    """Keeps the state of a simulator or player, and delays each tick until it is due.

    A tick is the instant at which the messages of one simulated or recorded time are sent.
    ``wait`` is a function that runs callbacks for a time, s (wall), and raises KeyboardInterrupt if
    the process is to end.
    """

    def __init__(
        self,
        state: State,
        pacer: RunPacer,
        wait: Callable[[float], object],
    ) -> None:
        self.pacer = pacer
        self.state = state
        self._wait = wait
        self._cut: RunCut | None = None  # the run that is on is to end
        self._is_running = False
        self._served = -math.inf  # s (wall), when callbacks have had their turn

    # requests

    def set_state(self, target: int) -> Reply:
        """Change the state; STOPPED and QUITTING end the current run at its next check or tick.

        ``target`` is the number of a :class:`State`.  Any other number is answered with
        INCORRECT_TRANSITION.
        """
        if target not in list(State):
            states = ", ".join(f"{state:d} {state.name.lower()}" for state in State)
            text = f"state {target}: must be one of {states}"
            return Reply(Code.INCORRECT_TRANSITION, text)
        if self.state is State.QUITTING:
            return Reply(Code.INCORRECT_STATE, "already quitting")
        if target == self.state:
            return Reply(Code.ALREADY_IN_TARGET_STATE, f"already {self.state.name.lower()}")
        self.state = State(target)
        if self.state in (State.STOPPED, State.QUITTING):
            self._cut_for(self.state)
        return Reply(Code.OK)

    def reset(self, scope: int) -> Reply:
        """Restart the current run, with time and state together.

        The restarted run is playing or paused as before.  Without a run, or if stopped, the reply
        is OK and nothing changes.  A ``scope`` other than 0 must contain the bits of both time and
        state, else the reply is FEATURE_UNSUPPORTED.
        """
        if self.state is State.QUITTING:
            return Reply(Code.INCORRECT_STATE, "already quitting")
        both = Scope.TIME | Scope.STATE
        if scope != Scope.DEFAULT and scope & both != both:
            text = f"scope {scope}: time and state are reset together, by 0, 3, 7 or 255"
            return Reply(Code.FEATURE_UNSUPPORTED, text)
        if self._is_running and self.state is not State.STOPPED:
            self._cut = RunCut(CutKind.RESET)
        return Reply(Code.OK)

    def abort(self, reason: str) -> None:
        """End the current run, if any, because of an error, which ``reason`` describes."""
        if self._is_running:
            self._cut = RunCut(CutKind.ABORTED, reason)

    # the code that runs

    def begin(self) -> None:
        """Note that a run begins and restart the pacer; the run can be ended early from now on.

        If the state is STOPPED or QUITTING, the run's first check or tick ends it.
        """
        self.pacer.reset()
        self._is_running, self._cut = True, None
        if self.state in (State.STOPPED, State.QUITTING):
            self._cut_for(self.state)

    @property
    def cut_kind(self) -> CutKind | None:
        """Reason why the current or last run was requested to end early; None if it was not."""
        return None if self._cut is None else self._cut.kind

    def check(self) -> None:
        """Raise RunCut if the current run is to end early."""
        if self._cut is not None:
            raise self._cut

    def tick(self, t: float) -> None:
        """Wait until the state is PLAYING and time ``t`` (s, simulated or recorded) is due.

        Run callbacks meanwhile.  Return at once if ``t`` is the time of the last tick.  RunCut if
        the run is to end early.
        """
        while True:
            self.check()
            if t == self.pacer.t:
                return
            if self.state is not State.PLAYING:
                self.pacer.pause()
                self._serve(math.inf)
                continue
            now = time.monotonic()
            delay = self.pacer.delay(t)
            if now > self._served + SERVICE_PERIOD:
                self._serve(max(0.0, delay - SERVICE_PERIOD))
            elif delay > SERVICE_PERIOD:
                self._serve(delay - SERVICE_PERIOD)
            elif delay > 0.0:
                time.sleep(delay)
            else:
                self.pacer.tick(t)
                return

    def end(self) -> None:
        """Note that the run is over: it can no longer be ended early, and the pacer pauses."""
        self._is_running = False
        self.pacer.pause()

    def finish(self) -> None:
        """Set the state to STOPPED, because nothing is left to run; QUITTING remains."""
        if self.state is not State.QUITTING:
            self.state = State.STOPPED

    def _serve(self, limit: float) -> None:
        """Let callbacks run for ``limit`` s (wall), 0.1 s at most."""
        self._wait(min(limit, 0.1))
        self._served = time.monotonic()

    def _cut_for(self, state: State) -> None:
        if self._is_running:
            kind = CutKind.STOPPED if state is State.STOPPED else CutKind.QUITTING
            self._cut = RunCut(kind)
