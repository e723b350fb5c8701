"""What a benchmark ran on, and whether others were at work there meanwhile."""

from __future__ import annotations

import datetime
import math
import os
import platform
import time
from pathlib import Path

from capture_sim import __version__
from capture_sim.base.compiled.kernels import code_hash
from capture_sim.dynamics.engine.loop import advance
from tools.run_tests import loop_seconds

#: Cores that others may keep busy on average before a measurement is no more to be trusted.
QUIET = 0.1
#: Written at the top of what was measured then.
BUSY = "Measured on a busy machine: neither times nor ratios count; measure again on a quiet one."


class OthersAtWork:
    """How many cores other processes, and other guests of the host, kept busy since it was made."""

    def __init__(self) -> None:
        self._since, self._before = time.monotonic(), self._others()

    def cores(self) -> float:
        """Return the average number of cores; NaN where the system does not say."""
        return (self._others() - self._before) / (time.monotonic() - self._since)

    @staticmethod
    def _others() -> float:
        """Return the processor time of all others since the system's start, s."""
        counters = Path("/proc/stat")
        if not counters.is_file():
            return math.nan
        # a guest's time, which follows, is part of its user's
        line = counters.read_text(encoding="utf-8").split("\n", 1)[0]
        user, low, system, _idle, _wait, *others = map(int, line.split()[1:9])
        ticks = user + low + system + sum(others)
        return ticks / os.sysconf("SC_CLK_TCK") - sum(os.times()[:4])


def is_busy(others: float) -> bool:
    """Whether others (cores) disturbed, or may have: then nothing counts as met."""
    return not others <= QUIET


def processor() -> str:
    """Return the processor's model."""
    info = Path("/proc/cpuinfo")
    for line in info.read_text(encoding="utf-8").splitlines() if info.is_file() else ():
        key, _, value = line.partition(":")
        if key.strip() == "model name":
            return value.strip()
    return platform.processor() or platform.machine()


def stamp(others: float, *, timed: bool = True) -> str:
    """Return what a reader must know of a measurement: no names of hosts, users or folders.

    ``timed``: it contains times, on which a busy machine has an effect.
    """
    today = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d")
    load = max(others, 0.0)  # counters of idle cores may differ by less than their resolution
    line = (
        f"*{today}, {os.cpu_count()} cores {processor()}, Python {platform.python_version()}, "
        f"capture_sim {__version__}, kernels {code_hash(advance)}; "
        f"10 million additions take {loop_seconds():.2f} s; background load {load:.2f} cores.*"
    )
    return f"**{BUSY}**\n\n{line}" if timed and is_busy(others) else line
