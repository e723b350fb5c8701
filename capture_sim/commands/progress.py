"""Progress of long commands: a bar on a terminal, a line now and then into a pipe."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

try:
    from tqdm import tqdm
except ImportError:  # an ordinary workstation may lack it: then without a bar
    tqdm = None


class Progress:
    """A bar that starts anew with each round of work."""

    def __init__(self, unit: str = "run") -> None:
        self._unit, self._name = unit, ""
        self._bar: Any = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def at(self, name: str, done: int, count: int) -> None:
        """Show that ``done`` of ``count`` in the round ``name`` are done."""
        if tqdm is None:
            return
        if self._bar is None or name != self._name:
            self._close()
            self._name = name
            calm = 0.2 if sys.stderr.isatty() else 10.0
            self._bar = tqdm(
                desc=name, total=count, unit=self._unit, initial=done, mininterval=calm, ncols=80
            )
        self._bar.update(done - self._bar.n)
        if done == count:
            self._close()
