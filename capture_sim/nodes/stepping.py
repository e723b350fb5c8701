"""One run, stepped in time: what is computed, paced, gated and handed out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from capture_sim.bench import Bench
from capture_sim.control import SimulationControl
from capture_sim.errors import SimulationError
from capture_sim.pacing import Pacer
from capture_sim.telemetry import BenchTelemetry, Sent
from capture_sim.topics import BENCH_EVENT, BENCH_STATE

#: Samples that the core computes at a time.
BLOCK = 100
#: ... fewer when they would stand for more wall time than this, s.
BLOCK_TIME = 0.01


class Stepping:
    """Steps a bench to its end and sends what it gives.

    Parameters
    ----------
    bench
        At its release.
    telemetry
        Makes its messages.
    control
        Asked before every sample.
    pacer
        Waited for with every sample.

    Attributes
    ----------
    count : int
        Samples sent.
    t : float
        Simulated time of the last one, s.
    residual : float
        Energy residual of the last one, J.
    """

    def __init__(
        self, bench: Bench, telemetry: BenchTelemetry, control: SimulationControl, pacer: Pacer
    ) -> None:
        self.bench = bench
        self.count = 0
        self.t = self.residual = 0.0
        self._telemetry = telemetry
        self._control = control
        self._pacer = pacer
        self._events = 0  # of the bench that are handed on
        self._spent = 0.0  # wall, s, running
        self._since: float | None = None  # wall, since when it runs
        self._simulated = 0.0  # s, while running
        self._from = 0.0

    def run(self, send: Callable[[Sent], None], leave_room: Callable[[int], None]) -> str:
        """Send the whole run; return why it failed, or nothing.

        Parameters
        ----------
        send
            Called with every topic and message.
        leave_room
            Called with the number of samples computed before they are sent; may wait.

        Raises
        ------
        RunCut
            The run is to end before its time.
        """
        failure = ""
        self._pacer.restart(0.0)
        self._resume()
        while not (self.bench.done or failure):
            try:
                samples = self.bench.advance(self.bench.times(self.count, self._block()))
            except SimulationError as error:
                samples, failure = error.partial, str(error)
            leave_room(self.count + len(samples))
            events, self._events = self.bench.events[self._events :], len(self.bench.events)
            self._send_block(self._telemetry.block(samples, events), samples, send)
        self._halt()
        return failure

    def _block(self) -> int:
        factor = self._pacer.factor
        if factor == 0.0:
            return BLOCK
        return int(np.clip(BLOCK_TIME * factor * self.bench.scene.run.state_rate, 1, BLOCK))

    def _send_block(
        self, block: Iterable[Sent], samples: np.ndarray, send: Callable[[Sent], None]
    ) -> None:
        times, residuals = samples["t"].tolist(), samples["energy_residual"].tolist()
        first, passed = self.count, self.count
        for sent in block:
            topic: Any = sent[0]
            if topic is BENCH_STATE or topic is BENCH_EVENT:
                if passed == self.count:
                    # the first of what belongs to the next sample
                    if not self._control.free:
                        self._halt()
                        self._control.pass_sample()
                        self._pacer.restart(times[passed - first])
                        self._resume()
                    passed += 1
                self._pacer.wait_for(sent[1].t)
                if topic is BENCH_STATE:
                    self.t, self.residual = times[self.count - first], residuals[self.count - first]
                    self.count += 1
            send(sent)

    # how fast it went

    def _resume(self) -> None:
        self._since, self._from = time.monotonic(), self.t

    def _halt(self) -> None:
        if self._since is not None:
            self._spent += time.monotonic() - self._since
            self._simulated += self.t - self._from
            self._since = None

    @property
    def wall(self) -> float:
        """Wall time spent running, without pauses, s."""
        since = self._since
        return self._spent + (0.0 if since is None else time.monotonic() - since)

    @property
    def achieved(self) -> float:
        """Simulated seconds per second so far, without pauses."""
        running = 0.0 if self._since is None else self.t - self._from
        return (self._simulated + running) / max(self.wall, 1e-9)

    @property
    def figures(self) -> str:
        """How far the run is and how fast it went, in words."""
        text = f"{self.t:.2f} s simulated in {self.wall:.2f} s ({self.achieved:.5g} x real time)"
        late = self._pacer.lateness() if self._since is None else None
        if late is not None:
            shown = ", ".join(f"{1e6 * value:.0f}" for value in late)
            text += f"; ticks late by {shown} us (p50, p99, p99.9, max)"
        return text
