"""Takes one run through its time: computes it ahead in blocks and sends it sample by sample."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.drive import drive
from capture_sim.messages.telemetry import BenchTelemetry
from capture_sim.messages.topics import Topic
from capture_sim.nodes.simulation.control import RunCut, SimulationControl
from capture_sim.nodes.simulation.thrust import ThrustCommands

#: The samples of one block stand for at most this wall time, s, if they are two or more.
BLOCK_TIME = 0.01
#: Maximum number of samples of a block.
LARGEST_BLOCK = 200


class Stepping:
    """Steps a bench from its release to the end of its run and sends its messages.

    Before every sample it calls ``control.tick``, which waits for the sample's time, and raises
    RunCut if somebody has asked to end the run.  Attributes: ``count`` is the number of samples
    that were sent; ``t`` (s) and ``residual`` (J) are the simulated time and the energy residual of
    the last one.
    """

    def __init__(
        self,
        bench: Bench,
        telemetry: BenchTelemetry,
        control: SimulationControl,
        thrust: ThrustCommands,
    ) -> None:
        self.bench = bench
        self.count = 0
        self.t = self.residual = 0.0
        self._telemetry = telemetry
        self._control = control
        self._thrust = thrust

    def run(self, send: Callable[[Topic, Any], bool], show: Callable[[np.void], None]) -> str:
        """Send the messages of the run; return the reason why it failed, or an empty text.

        ``send`` is called with the topic and the bytes of every message, and returns True if the
        message was sent.  ``show`` is called with each sample of which the messages at ``run.rate``
        were sent, after them.  RunCut and KeyboardInterrupt end the run and are passed on; messages
        that were made ahead are then not counted as sent.
        """
        made, sent = dict(self._telemetry.by_topic), Counter[Topic]()
        failure = ""
        try:
            thrust = self._thrust.control(self.bench.scene)
            for piece in drive(self.bench, block=self._block, control=thrust):
                if thrust is not None:
                    self._thrust.report(piece.events)
                block = self._telemetry.block(piece.samples, piece.events, piece.trace)
                for sample, due in zip(piece.samples, block, strict=True):
                    self._control.tick(float(sample["t"]))
                    for topic, _, data in due:
                        sent[topic] += send(topic, data)
                    self.count += 1
                    self.t = float(sample["t"])
                    self.residual = float(sample["energy_residual"])
                    if any(topic is BenchTelemetry.LAST_PERIODIC for topic, *_ in due):
                        show(sample)
                failure = str(piece.failure or "")
        except (RunCut, KeyboardInterrupt):
            self._telemetry.cut(made, sent)
            raise
        self._control.pacer.pause()
        return failure

    def _block(self) -> int:
        factor, run = self._control.pacer.factor, self.bench.scene.run
        if factor == 0.0:
            return LARGEST_BLOCK
        return int(np.clip(BLOCK_TIME * factor * run.state_rate, 1, LARGEST_BLOCK))

    @property
    def figures(self) -> str:
        """Simulated time, wall time, their ratio, and the lateness of the samples, as one text.

        The lateness is added once the pacer has stopped, and only of a paced run.
        """
        pacer = self._control.pacer
        text = f"{self.t:.2f} s simulated in {pacer.wall:.2f} s ({pacer.achieved:.5g} x real time)"
        late = None if pacer.running else pacer.lateness()
        if late is not None:
            shown = ", ".join(f"{1e6 * value:.0f}" for value in late)
            text += f"; ticks late by {shown} us (p50, p99, p99.9, max)"
        return text
