"""Play, pause, step, reset: the semantics of ``simulation_interfaces``, without ROS.

Requests come from any thread; the thread that steps the bench asks :meth:`pass_sample`
before every sample it sends.  What ``simulation_interfaces`` (ros-simulation, 2.1) says on a
state or result stands in its own definitions; its names and numbers are used here.
"""

from __future__ import annotations

import threading
import time
from enum import IntEnum
from typing import NamedTuple, Protocol

#: Why runs end early that somebody asked to end.
RESET, STOPPED, QUITTING = "reset", "stopped", "quitting"
#: A step waits this long for a release that does not come, s (wall).
RELEASE_PATIENCE = 5.0
#: The stepping thread looks up this often while it waits, s.
_POLL = 0.2


class State(IntEnum):
    """States of a simulation, as in SimulationState.msg."""

    STOPPED = 0
    PLAYING = 1
    PAUSED = 2
    QUITTING = 3
    NO_WORLD = 4
    LOADING_WORLD = 5


class Code(IntEnum):
    """Results, as in Result.msg and SetSimulationState.srv."""

    FEATURE_UNSUPPORTED = 0
    OK = 1
    NOT_FOUND = 2
    INCORRECT_STATE = 3
    OPERATION_FAILED = 4
    ALREADY_IN_TARGET_STATE = 101
    INCORRECT_TRANSITION = 103


class Scope(IntEnum):
    """Bits of ResetSimulation's scope."""

    DEFAULT = 0
    TIME = 1
    STATE = 2
    SPAWNED = 4
    ALL = 255


class Answer(NamedTuple):
    """What a request came to."""

    code: Code
    message: str = ""


_OK = Answer(Code.OK)


class RunCut(Exception):  # noqa: N818  # not an error: the run is to end before its time
    """The run that is on must end; the text says why.

    Attributes
    ----------
    again
        The same run is to begin anew.
    asked_for
        By a request; else something has gone wrong.
    """

    def __init__(self, reason: str, *, again: bool = False, asked_for: bool = True) -> None:
        super().__init__(reason)
        self.again = again
        self.asked_for = asked_for


class Request:
    """A request that may take a while."""

    def __init__(self, answer: Answer | None = None) -> None:
        self._done = threading.Event()
        self._answer = answer
        if answer is not None:
            self._done.set()

    def wait(self, timeout: float | None = None) -> Answer:
        """Return the answer; a failure when it takes longer than ``timeout``, s."""
        if not self._done.wait(timeout):
            return Answer(Code.OPERATION_FAILED, f"not done within {timeout:g} s")
        assert self._answer is not None
        return self._answer

    def fulfil(self, answer: Answer) -> None:
        """Give the answer; the first one counts."""
        if not self._done.is_set():
            self._answer = answer
            self._done.set()


class Control(Protocol):
    """What the services ask for, of a simulator or a player."""

    @property
    def state(self) -> State:
        """The present state."""

    def set_state(self, target: int) -> Request:
        """Ask for another state."""

    def step(self, count: int) -> Request:
        """Ask for so many steps."""

    def reset(self, scope: int) -> Request:
        """Ask for the start again."""


class SimulationControl:
    """What the simulation is to do.

    Parameters
    ----------
    state
        At the start: STOPPED, PLAYING or PAUSED.
    changed
        Notified at every change; a lock that the caller may share with other news.
    """

    def __init__(
        self, state: State = State.STOPPED, changed: threading.Condition | None = None
    ) -> None:
        self.changed = threading.Condition(threading.RLock()) if changed is None else changed
        self._state = state
        self._cut: RunCut | None = None  # the run that is on is to end
        self._running = False  # a run is on
        self._free = state is State.PLAYING  # samples may pass without a look
        self._pausing: list[Request] = []
        self._resetting: list[Request] = []
        self._step: Request | None = None
        self._step_since = 0.0
        self._asked = self._left = 0  # samples of the step

    # requests

    @property
    def state(self) -> State:
        """The present state."""
        return self._state

    def set_state(self, target: int) -> Request:
        """Ask for STOPPED, PLAYING, PAUSED or QUITTING.

        Pausing is done when no further sample will be sent, stopping when the run has ended;
        quitting is answered while it can be.
        """
        with self.changed:
            if target not in (State.STOPPED, State.PLAYING, State.PAUSED, State.QUITTING):
                text = f"state {target}: allowed are 0 stopped, 1 playing, 2 paused, 3 quitting"
                return Request(Answer(Code.INCORRECT_TRANSITION, text))
            if self._state is State.QUITTING:
                return Request(Answer(Code.INCORRECT_STATE, "the simulator is quitting"))
            if target == self._state:
                text = f"already {self._state.name.lower()}"
                return Request(Answer(Code.ALREADY_IN_TARGET_STATE, text))
            self._state = State(target)
            request = Request()
            if self._state in (State.STOPPED, State.QUITTING):
                self._end(STOPPED if self._state is State.STOPPED else QUITTING, again=False)
                self._fulfil_resets(_OK)
            if self._state is not State.PAUSED:
                self._fail_step("the state was changed to " + self._state.name.lower())
            if self._state in (State.PLAYING, State.QUITTING) or not self._running:
                request.fulfil(_OK)
            else:
                self._pausing.append(request)
            self._update()
            return request

    def step(self, count: int) -> Request:
        """Ask for ``count`` samples; done when they are sent and the simulation waits again."""
        with self.changed:
            if self._state is not State.PAUSED:
                text = f"stepping needs a paused simulation; this one is {self._state.name.lower()}"
                return Request(Answer(Code.OPERATION_FAILED, text))
            if self._step is not None:
                return Request(Answer(Code.OPERATION_FAILED, "still busy with another step"))
            if count == 0:
                return Request(_OK)
            self._step, self._asked, self._left = Request(), count, count
            self._step_since = time.monotonic()
            self._update()
            return self._step

    def reset(self, scope: int) -> Request:
        """Ask for the start again, of time and state together; done when the run can begin.

        The simulation stays playing or paused; a stopped one is at its start already.
        """
        with self.changed:
            if self._state is State.QUITTING:
                return Request(Answer(Code.INCORRECT_STATE, "the simulator is quitting"))
            both = Scope.TIME | Scope.STATE
            if scope != Scope.DEFAULT and scope & both != both:
                text = f"scope {scope}: time and state are reset together, by 0, 3, 7 or 255"
                return Request(Answer(Code.FEATURE_UNSUPPORTED, text))
            if self._state is State.STOPPED:
                return Request(_OK)
            request = Request()
            self._resetting.append(request)
            if self._running:
                self._end(RESET, again=True)
            self._fail_step("the simulation was reset")
            self._update()
            return request

    def cut(self, reason: str) -> None:
        """End the run that is on, since something has gone wrong."""
        with self.changed:
            if self._running:
                self._cut = RunCut(reason, asked_for=False)
            self._update()

    # the stepping thread

    def await_start(self) -> State:
        """Wait while stopped; return the state that ended it."""
        with self.changed:
            while self._state is State.STOPPED:
                self.changed.wait(_POLL)
            return self._state

    def begin(self) -> None:
        """A run begins: from here on it can be cut."""
        with self.changed:
            self._running, self._cut = True, None
            if self._state in (State.STOPPED, State.QUITTING):
                self._end(STOPPED if self._state is State.STOPPED else QUITTING, again=False)
            self._update()

    def ready(self) -> None:
        """The run could start now: resets are done."""
        with self.changed:
            self._fulfil_resets(_OK)
            self._settle()

    def look(self) -> None:
        """Look up while waiting for others.

        Raises
        ------
        RunCut
            The run is to end.
        """
        with self.changed:
            if self._cut is not None:
                raise self._cut
            self._settle()
            if self._step and time.monotonic() - self._step_since > RELEASE_PATIENCE:
                self._fail_step(f"the chaser is held: no release within {RELEASE_PATIENCE:g} s")

    @property
    def free(self) -> bool:
        """Whether samples may be sent without asking."""
        return self._free

    def pass_sample(self) -> None:
        """Let one more sample be sent, once it may be.

        Raises
        ------
        RunCut
            The run is to end.
        """
        with self.changed:
            while True:
                if self._cut is not None:
                    raise self._cut
                if self._state is State.PLAYING:
                    self._update()
                    return
                if self._step is not None and self._left > 0:
                    self._left -= 1
                    return
                if self._step is not None:
                    self._step.fulfil(_OK)
                    self._step = None
                self._settle()
                self.changed.wait(_POLL)

    def end(self, failure: str = "") -> None:
        """The run is over, for ``failure`` or as it should be."""
        with self.changed:
            self._running = False
            self._settle()
            if self._step is not None and self._left == 0:
                self._step.fulfil(_OK)
                self._step = None
            self._fail_step(failure or "the run is over")
            if failure and not (self._cut is not None and self._cut.again):
                self._fulfil_resets(Answer(Code.OPERATION_FAILED, failure))
            self._update()

    def finish(self) -> None:
        """Nothing is left to run: stop, unless something else was asked for meanwhile."""
        with self.changed:
            if self._state is not State.QUITTING:
                self._state = State.STOPPED
            self._fulfil_resets(_OK)
            self._update()

    def close(self) -> None:
        """Nothing will be done any more: answer all that wait."""
        with self.changed:
            self._state = State.QUITTING
            self._fail_step("the simulator has ended")
            self._fulfil_resets(Answer(Code.OPERATION_FAILED, "the simulator has ended"))
            self._settle()
            self._update()

    # under the lock

    def _end(self, reason: str, again: bool) -> None:
        if self._running:
            self._cut = RunCut(reason, again=again)

    def _fail_step(self, why: str) -> None:
        if self._step is not None:
            done = self._asked - self._left
            self._step.fulfil(
                Answer(Code.OPERATION_FAILED, f"{why} after {done} of {self._asked} steps")
            )
            self._step = None

    def _fulfil_resets(self, answer: Answer) -> None:
        for request in self._resetting:
            request.fulfil(answer)
        self._resetting.clear()

    def _settle(self) -> None:
        for request in self._pausing:
            request.fulfil(_OK)
        self._pausing.clear()

    def _update(self) -> None:
        self._free = self._state is State.PLAYING and self._cut is None
        self.changed.notify_all()
