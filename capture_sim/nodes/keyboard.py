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

from capture_sim.control.playing import Transport

HELP = "keys: space pauses and goes on, s steps, + and - play at twice and half the rate"
#: The thread looks up this often, to end with the player, s.
_POLL = 0.1


class Keyboard:
    """Reads keys of the terminal while it is entered; does nothing without one.

    Ctrl-C stays what it is, and the terminal is left as it was found.

    Parameters
    ----------
    transport
        Is controlled.
    tell
        Called with what a key did.
    """

    def __init__(self, transport: Transport, tell: Callable[[str], object]) -> None:
        self._transport = transport
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
        transport = self._transport
        if key == " ":
            if transport.paused:
                transport.resume()
                self._tell("playing")
            else:
                transport.pause()
                self._tell("paused")
        elif key == "s":
            self._tell(transport.step() or "a step")
        elif key in ("+", "-"):
            self._tell(transport.change_rate(2.0 if key == "+" else 0.5))
