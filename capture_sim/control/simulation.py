"""Play, pause, step, reset, of the simulator and of a player; without ROS.

Requests come from any thread; the thread that runs asks :meth:`SimulationControl.tick` before
everything that it sends.  What ``simulation_interfaces`` (ros-simulation, 2.1) says on a state
or result stands in its own definitions; its names and numbers are used here.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from enum import IntEnum
from typing import NamedTuple

from capture_sim.control.pacing import Pacer
from capture_sim.interrupts import STOP

#: Why runs end that somebody asked to end.
RESET, STOPPED, QUITTING = "reset", "stopped", "quitting"
#: A step waits this long for a release that does not come, s (wall).
RELEASE_PATIENCE = 5.0
#: The running thread wakes this often while it waits for a request, s.
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


#: A request that may take a while.
Request = Future[Answer]


def _answered(code: Code, message: str = "") -> Request:
    request = Request()
    request.set_result(Answer(code, message))
    return request


class RunCut(Exception):  # noqa: N818  # not an error: the run is to end before its time
    """The run that is on must end; the text says why.

    ``again``: the same run begins anew; ``asked_for``: by a request, not by a failure.
    """

    def __init__(self, reason: str, *, again: bool = False, asked_for: bool = True) -> None:
        super().__init__(reason)
        self.again = again
        self.asked_for = asked_for


class SimulationControl:
    """The state of a simulator or player, and when its next tick may pass.

    ``states`` can be requested; ``resets``: a run can begin anew; ``stop`` is set when the process
    is to end, and the running thread then gets KeyboardInterrupt.  ``changed`` is notified at every
    change, and is a lock that others may share.
    """

    def __init__(
        self,
        state: State,
        pacer: Pacer,
        *,
        states: Sequence[State] = (State.STOPPED, State.PLAYING, State.PAUSED, State.QUITTING),
        resets: bool = True,
        stop: threading.Event = STOP,
    ) -> None:
        self.pacer = pacer
        self.changed = threading.Condition(threading.RLock())
        self._states, self.resets = tuple(states), resets
        self._stop = stop
        self._state = state
        self._cut: RunCut | None = None  # the run that is on is to end
        self._running = False  # a run is on
        self._pausing: list[Request] = []  # answered when nothing passes any more
        self._resetting: list[Request] = []
        self._step: Request | None = None
        self._step_since = 0.0
        self._asked = self._left = 0  # ticks of the step
        self._answers: list[tuple[Request, Answer]] = []  # given when the lock is free again

    # requests, from any thread

    @property
    def state(self) -> State:
        """The present state."""
        return self._state

    def set_state(self, target: int) -> Request:
        """Ask for another state.

        Pausing is done when no further tick will pass, stopping when the run has ended;
        quitting is answered while it can be.
        """
        with self._locked():
            if target not in self._states:
                allowed = ", ".join(f"{state:d} {state.name.lower()}" for state in self._states)
                return _answered(
                    Code.INCORRECT_TRANSITION, f"state {target}: must be one of {allowed}"
                )
            if self._state is State.QUITTING:
                return _answered(Code.INCORRECT_STATE, "already quitting")
            if target == self._state:
                return _answered(
                    Code.ALREADY_IN_TARGET_STATE, f"already {self._state.name.lower()}"
                )
            self._state = State(target)
            if self._state in (State.STOPPED, State.QUITTING):
                self._end_run()
                self._answer(self._resetting)
            if self._state is not State.PAUSED:
                self._fail_step("the state was changed to " + self._state.name.lower())
            self.changed.notify_all()
            if self._state in (State.PLAYING, State.QUITTING) or not self._running:
                return _answered(Code.OK)
            self._pausing.append(Request())
            return self._pausing[-1]

    def step(self, count: int) -> Request:
        """Ask for ``count`` ticks; done when they have passed and the run waits again."""
        with self._locked():
            if self._state is not State.PAUSED:
                text = f"stepping needs a paused run; this one is {self._state.name.lower()}"
                return _answered(Code.OPERATION_FAILED, text)
            if self._step is not None:
                return _answered(Code.OPERATION_FAILED, "still busy with another step")
            if count == 0:
                return _answered(Code.OK)
            self._step, self._asked, self._left = Request(), count, count
            self._step_since = time.monotonic()
            self.changed.notify_all()
            return self._step

    def reset(self, scope: int) -> Request:
        """Ask for the start again, of time and state together; done when the run can begin.

        A playing or paused run stays so; a stopped one is at its start already.
        """
        with self._locked():
            if not self.resets:
                text = "there is no reset: start the replay again"
                return _answered(Code.FEATURE_UNSUPPORTED, text)
            if self._state is State.QUITTING:
                return _answered(Code.INCORRECT_STATE, "already quitting")
            both = Scope.TIME | Scope.STATE
            if scope != Scope.DEFAULT and scope & both != both:
                text = f"scope {scope}: time and state are reset together, by 0, 3, 7 or 255"
                return _answered(Code.FEATURE_UNSUPPORTED, text)
            if self._state is State.STOPPED:
                return _answered(Code.OK)
            self._resetting.append(request := Request())
            if self._running:
                self._cut = RunCut(RESET, again=True)
            self._fail_step("the simulation was reset")
            self.changed.notify_all()
            return request

    def cut(self, reason: str) -> None:
        """End the run that is on, since something has gone wrong."""
        with self._locked():
            if self._running:
                self._cut = RunCut(reason, asked_for=False)
            self.changed.notify_all()

    def set_factor(self, factor: float) -> None:
        """Run faster or slower from now on, see :class:`Pacer`."""
        with self._locked():
            self.pacer.factor = factor
            self.changed.notify_all()

    # the thread that runs; all raise KeyboardInterrupt where they wait and ``stop`` is set

    def await_start(self) -> State:
        """Wait while stopped; return the state that ended it."""
        with self._locked():
            while self._state is State.STOPPED:
                self._raise_if_stopping()
                self.changed.wait(_POLL)
            return self._state

    def begin(self) -> None:
        """A run begins: from here on it can be cut."""
        with self._locked():
            self.pacer.reset()
            self._running, self._cut = True, None
            if self._state in (State.STOPPED, State.QUITTING):
                self._end_run()
            self.changed.notify_all()

    def ready(self) -> None:
        """The run could start now: resets are done."""
        with self._locked():
            self._answer(self._resetting)
            self._answer(self._pausing)

    def check(self) -> None:
        """Answer requests while the run waits for others; RunCut if the run is to end."""
        with self._locked():
            self._raise_if_cut()
            self._answer(self._pausing)
            if self._step and time.monotonic() - self._step_since > RELEASE_PATIENCE:
                self._fail_step(f"the chaser is held: no release within {RELEASE_PATIENCE:g} s")

    def tick(self, t: float) -> None:
        """Wait until time ``t`` (s) may pass: playing and due, or stepped while paused.

        The time that passed last passes again at once.  RunCut if the run is to end.
        """
        while not self._try_tick(t):
            pass

    def end(self, failure: str = "") -> None:
        """The run is over, for ``failure`` or as it should be."""
        with self._locked():
            self._running = False
            self.pacer.hold()
            self._answer(self._pausing)
            if self._left == 0:
                self._finish_step()
            self._fail_step(failure or "the run is over")
            if failure and not (self._cut is not None and self._cut.again):
                self._answer(self._resetting, Answer(Code.OPERATION_FAILED, failure))
            self.changed.notify_all()

    def finish(self) -> None:
        """Nothing is left to run: stop, unless something else was asked for meanwhile."""
        with self._locked():
            if self._state is not State.QUITTING:
                self._state = State.STOPPED
            self._answer(self._resetting)
            self.changed.notify_all()

    def close(self) -> None:
        """Nothing will be done any more: answer all that wait."""
        with self._locked():
            self._state = State.QUITTING
            self._fail_step("the simulation has ended")
            self._answer(self._resetting, Answer(Code.OPERATION_FAILED, "the simulation has ended"))
            self._answer(self._pausing)
            self.changed.notify_all()

    # under the lock

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock; answer requests after it, as their callbacks may make requests."""
        answers: list[tuple[Request, Answer]] = []
        try:
            with self.changed:
                try:
                    yield
                finally:
                    answers, self._answers = self._answers, []
        finally:
            for request, answer in answers:
                request.set_result(answer)

    def _try_tick(self, t: float) -> bool:
        """Return whether time ``t`` may pass; wait a little if not."""
        with self._locked():
            self._raise_if_cut()
            if t == self.pacer.t:
                return True
            if self._state is State.PLAYING:
                delay = self.pacer.delay(t)
                if delay <= 0.0:
                    self.pacer.tick(t)
                    return True
                self.changed.wait(min(delay, _POLL))
                return False
            self.pacer.hold()
            if self._step is not None and self._left > 0:
                self._left -= 1
                self.pacer.skip(t)
                return True
            self._finish_step()
            self._answer(self._pausing)
            if not self._answers:
                self.changed.wait(_POLL)
            return False

    def _raise_if_cut(self) -> None:
        self._raise_if_stopping()
        if self._cut is not None:
            raise self._cut

    def _raise_if_stopping(self) -> None:
        if self._stop.is_set():
            raise KeyboardInterrupt

    def _end_run(self) -> None:
        if self._running:
            self._cut = RunCut(STOPPED if self._state is State.STOPPED else QUITTING)

    def _finish_step(self) -> None:
        if self._step is not None:
            self._answers.append((self._step, Answer(Code.OK)))
            self._step = None

    def _fail_step(self, why: str) -> None:
        if self._step is not None:
            text = f"{why} after {self._asked - self._left} of {self._asked} steps"
            self._answers.append((self._step, Answer(Code.OPERATION_FAILED, text)))
            self._step = None

    def _answer(self, requests: list[Request], answer: Answer = Answer(Code.OK)) -> None:  # noqa: B008
        self._answers += [(request, answer) for request in requests]
        requests.clear()
