"""A player's transport by the semantics of ``simulation_interfaces``."""

from __future__ import annotations

import threading

from capture_sim.control.playing import Transport
from capture_sim.control.simulation_control import Answer, Code, Request, State

#: What SimulatorFeatures.msg lists and a player has, by its numbers there.
FEATURES = {
    "SIMULATION_STATE_GETTING": 24,
    "SIMULATION_STATE_SETTING": 25,
    "SIMULATION_STATE_PAUSE": 26,
    "STEP_SIMULATION_SINGLE": 31,
    "STEP_SIMULATION_MULTIPLE": 32,
}
INFO = "a step is all messages of the next time; playing and paused are the states it has."
#: A step that finds no further message is given up after this, s (wall).
STEP_LIMIT = 30.0


class PlayerControl:
    """Plays, pauses and steps a transport.

    Parameters
    ----------
    transport
        Of the player.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    @property
    def state(self) -> State:
        """PLAYING or PAUSED."""
        return State.PAUSED if self._transport.paused else State.PLAYING

    def set_state(self, target: int) -> Request:
        """Ask for PLAYING or PAUSED."""
        if target not in (State.PLAYING, State.PAUSED):
            text = f"state {target}: allowed are 1 playing, 2 paused"
            return Request(Answer(Code.INCORRECT_TRANSITION, text))
        act = self._transport.pause if target == State.PAUSED else self._transport.resume
        refused = act()
        if refused:
            return Request(Answer(Code.ALREADY_IN_TARGET_STATE, refused))
        return Request(Answer(Code.OK))

    def step(self, count: int) -> Request:
        """Ask for the messages of the next ``count`` times; done when they have passed."""
        for _ in range(count):
            refused = self._transport.step()
            if refused:
                return Request(Answer(Code.OPERATION_FAILED, refused))
        request = Request()
        threading.Thread(target=self._wait, args=(request,), daemon=True).start()
        return request

    def reset(self, scope: int) -> Request:
        """Refuse: a recording is played again by starting it again, or by ``loop``."""
        del scope
        text = "a player has no reset: start it again, or let it loop"
        return Request(Answer(Code.FEATURE_UNSUPPORTED, text))

    def _wait(self, request: Request) -> None:
        if self._transport.wait_for_steps(STEP_LIMIT):
            request.fulfil(Answer(Code.OK))
        else:
            request.fulfil(Answer(Code.OPERATION_FAILED, "no further message"))
