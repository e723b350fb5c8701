"""The node that simulates vehicles and buffer while the contact comes from a topic."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from capture_sim.errors import CaptureSimError
from capture_sim.hardware.closed_loop import Loop
from capture_sim.hardware.compensation import compensation
from capture_sim.hardware.in_the_loop import (
    LOOP_SIMULATOR,
    TIP,
    TIP_WRENCH,
    LoopStage,
    SafeStopError,
    WrenchHold,
)
from capture_sim.hardware.loop_messages import stamp_of, tip_message, wrench_of
from capture_sim.hardware.walls import WallLaw
from capture_sim.interrupts import STOP
from capture_sim.launch.scenes import load_scene
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.process import run
from capture_sim.nodes.start import FAILED, OK

#: The tip's first place is sent this often until it is answered, s (wall).
KNOCK = 0.02


class LoopSimulatorNode(BenchNode):
    """Sends where the tip is, and goes on with the wrench that has come, step by step.

    It starts when the first place has been answered.  A wrench is held until a newer one
    comes; without one for ``timeout``, with one beyond ``force_limit``, or when the loop has made
    more energy than ``energy_limit``, the vehicles are stopped and the node ends with exit
    status 1.
    """

    def __init__(self) -> None:
        super().__init__(LOOP_SIMULATOR)
        name = self.declare("scene", "_loop", "name in config/scenes, or file")
        overrides = self.declare("overrides", list, "changes of the scene, as buffer.c_A=13 (SI)")
        rate = self.declare("rate", 1000.0, "Hz, of steps and messages", low=10.0, high=10000.0)
        self._rtf = self.declare(
            "rtf",
            1.0,
            "real-time factor: simulated seconds per second",
            low=0.001,
            high=1.0,
        )
        timeout = self.declare(
            "timeout", 0.02, "s, age up to which a wrench is held", low=0.001, high=10.0
        )
        force_limit = self.declare(
            "force_limit", 500.0, "N, beyond which a wrench is a fault", low=0.0, high=1e9
        )
        mass = self.declare(
            "mass", 0.0, "kg, that the contact feels; 0: the tip's", low=0.0, high=1e6
        )
        energy_limit = self.declare(
            "energy_limit", 0.1, "J, that the loop may make", low=0.0, high=1e6
        )
        way = self.declare(
            "compensation",
            "none",
            "of the delay: none, passivity, hybrid, prediction1, prediction2, model, or several "
            "joined by +",
            check=compensation,
        )
        stiffness = self.declare(
            "stiffness",
            0.0,
            "N/m^exponent, of the walls: what model begins with (0: the scene's contact), and the "
            "virtual spring of hybrid",
            low=0.0,
            high=1e12,
        )
        exponent = self.declare(
            "exponent",
            1.5,
            "of the penetration, for stiffness: 1 a spring, 1.5 Hertz",
            low=1.0,
            high=3.0,
        )
        drag = self.declare(
            "drag", 0.0, "N s/m, of the virtual damper of hybrid", low=0.0, high=1e9
        )
        self._patience = self.declare(
            "start_timeout", 60.0, "s (wall), wait for the first wrench", low=0.1, high=86400.0
        )
        self._report = self.declare("report", "", "JSON file of what was measured; none if empty")
        substeps = max(1, round(40.0 * 1000.0 / rate))
        scene = load_scene(name, overrides)
        self._stage = LoopStage(scene, 1.0 / rate, substeps)
        chosen = compensation(way)
        law = WallLaw(stiffness, exponent, drag=drag)
        if chosen.model:
            law = WallLaw(stiffness or scene.contact_stiffness, exponent)
        self._loop = Loop(self._stage, chosen, law, energy_limit, mass or None)
        self._hold = WrenchHold(timeout, force_limit)
        self._lock = threading.Lock()
        self._now = 0.0  # of the loop, s
        self._sent: dict[float, float] = {}  # wall time by the tip's time
        self._round_trips: list[float] = []
        self.open((TIP,))
        self.listen(TIP_WRENCH, self._wrench_came)

    def _wrench_came(self, message: Any) -> None:
        came = time.monotonic()
        stamp = stamp_of(message)
        wrench = wrench_of(message)
        with self._lock:
            reason = self._hold.offer(stamp, self._now, wrench)
            sent = self._sent.pop(round(stamp, 9), None)
        if sent is not None and not reason:
            self._round_trips.append(came - sent)

    def work(self) -> int:
        """Run the loop to the scene's end; return the exit status."""
        self._await_first()
        stopped, late = "", 0
        began = time.monotonic()
        steps = round(self._stage.scene.run.t_end / self._stage.step)
        try:
            for k in range(steps):
                due = began + k * self._stage.step / self._rtf
                delay = due - time.monotonic()
                if STOP.wait(max(0.0, delay)):
                    raise KeyboardInterrupt
                late += delay < -self._stage.step / self._rtf
                with self._lock:
                    stamp, wrench = self._hold.at(self._now)
                place = self._loop.advance(stamp, wrench)
                with self._lock:
                    self._now = place.t
                    self._sent[round(place.t, 9)] = time.monotonic()
                self.send(TIP, tip_message(self.messages, place))
        except SafeStopError as stop:
            stopped = str(stop)
            self.get_logger().error(stopped)
        self._report_result(stopped, late)
        return FAILED if stopped else OK

    def _await_first(self) -> None:
        self.get_logger().info("waiting for the first wrench")
        deadline = time.monotonic() + self._patience
        while True:
            with self._lock:
                received = self._hold.received
            if received:
                self.get_logger().info("the first wrench has come: the loop is closed")
                return
            if time.monotonic() > deadline:
                raise CaptureSimError(f"no wrench came for {self._patience:g} s")
            self.send(TIP, tip_message(self.messages, self._stage.tip))
            if STOP.wait(KNOCK):
                raise KeyboardInterrupt

    def _report_result(self, stopped: str, late: int) -> None:
        """Say what was measured, and write it where that is asked for."""
        touches = [
            {**asdict(touch), "restitution": touch.restitution} for touch in self._loop.touches
        ]
        found: dict[str, Any] = {
            "stopped": stopped,
            "steps": round(self._stage.t / self._stage.step),
            "late_steps": late,
            "refused": self._hold.refused,
            "ages": self._hold.ages,
            "round_trips": self._round_trips,
            "work": self._loop.work,
            "touches": touches,
        }
        if self._report:
            Path(self._report).write_text(json.dumps(found), encoding="utf-8")
        ages = sorted(self._hold.ages) or [0.0]
        self.get_logger().info(
            f"{found['steps']} steps, wrench {ages[len(ages) // 2] * 1e3:.1f} ms old (median), "
            f"{ages[-1] * 1e3:.1f} ms (most); work of the wrench {self._loop.work:.4g} J"
        )
        if touches:
            first = self._loop.touches[0]
            self.get_logger().info(f"first touch: restitution {first.restitution:.4f}")


main = partial(run, LoopSimulatorNode)

if __name__ == "__main__":
    raise SystemExit(main())
