"""Keys that control a player in a terminal."""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from capture_sim.control.pacing import FACTORS
from capture_sim.control.simulation import SimulationControl, State

HELP = "keys: space pauses and goes on, s steps, + and - play at twice and half the rate"
#: The thread looks up this often, to end with the player, s.
_POLL = 0.1
#: The slowest rate that the keys set, recorded seconds per second.
LEAST_RATE = 0.01


class Keyboard:
    """Reads keys of the terminal while it is entered; does nothing without one.

    Ctrl-C stays what it is, and the terminal is left as it was found.

    Parameters
    ----------
    control
        Of the player.
    tell
        Called with what a key did.
    """

    def __init__(self, control: SimulationControl, tell: Callable[[str], object]) -> None:
        self._control = control
        self._tell = tell
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._before: list[Any] = []

    def __enter__(self) -> Self:
        if sys.stdin is not None and sys.stdin.isatty():
            self._before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
            self._thread = threading.Thread(target=self._read, name="keyboard", daemon=True)
            self._thread.start()
            self._tell(HELP)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)

    def _read(self) -> None:
        terminal = sys.stdin.fileno()
        while not self._ended.is_set():
            if select.select([terminal], [], [], _POLL)[0]:
                keys = os.read(terminal, 64).decode(errors="ignore")
                if not keys:
                    return  # the terminal has gone
                for key in keys:
                    self.press(key)

    def press(self, key: str) -> None:
        """Do what a key is for; nothing for any other."""
        control = self._control
        if key == " ":
            paused = control.state is State.PAUSED
            control.set_state(State.PLAYING if paused else State.PAUSED)
            self._tell("playing" if paused else "paused")
        elif key == "s":
            request = control.step(1)
            refused = request.done() and request.wait().message
            self._tell(refused or "a step")
        elif key in ("+", "-"):
            rate = control.pacer.factor * (2.0 if key == "+" else 0.5)
            if rate == 0.0:
                self._tell("rate: as fast as it goes")
                return
            rate = min(max(rate, LEAST_RATE), FACTORS.high)
            control.set_factor(rate)
            self._tell(f"rate: {rate:g}")
