"""The node that simulates vehicles and buffer while the contact comes from a topic."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim.errors import CaptureSimError, MessageError, RecordingError
from capture_sim.files import why_no_file
from capture_sim.hardware.law import TipState, WallLaw, Wrench
from capture_sim.hardware.limits import LIMITS, Limits
from capture_sim.hardware.loop import MAX_START_DISTANCE, METHODS, N_AT_REST, Loop
from capture_sim.hardware.messages import (
    LOOP_SIMULATOR,
    RIG_TIP,
    TIP,
    TIP_WRENCH,
    stamp_of,
    tip_message,
    tip_of,
    wrench_of,
)
from capture_sim.hardware.stage import LoopStage, SafeStopError
from capture_sim.hardware.touch import Touch
from capture_sim.interrupts import STOP
from capture_sim.launch.scenes import load_scene
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.parameters import ParameterError
from capture_sim.nodes.process import run
from capture_sim.nodes.start import FAILED, OK

#: The tip's first position is sent this often, s (wall).
FIRST_POSE_PERIOD = 0.005
#: Lateness up to this share of a step is caught up with: positions are never closer than 0.8 step.
MAX_JITTER = 0.2
#: A Runge-Kutta step is about this long, s.
SUBSTEP = 2.5e-5


class LoopSimulatorNode(BenchNode):
    """Simulates vehicles and buffer; the contact comes from a rig on loop/wrench.

    It measures bias and noise of the load cell at rest. Then it sends the tip's position on
    loop/tip with every step and uses the newest wrench. A step that is late shifts all later ones.
    At a limit of energy, force, torque, speed, acceleration, latency or lateness it stops and exits
    with status 1.
    """

    def __init__(self) -> None:
        super().__init__(LOOP_SIMULATOR)
        number = partial(self.declare, low=0.0)
        name = self.declare("scene", "_loop", "scene: name in config/scenes, or file")
        overrides = self.declare("overrides", list, "changes of the scene (SI), e.g. buffer.c_A=13")
        rate = self.declare(
            "rate", 1000.0, "rate of steps and messages, Hz", low=10.0, high=10000.0
        )
        self._rtf = self.declare(
            "rtf", 1.0, "real-time factor: simulated seconds per second", low=0.001, high=1.0
        )
        limits = Limits(
            latency=self.declare(
                "timeout", Limits().latency, "latency of the wrench in use, s", low=0.001, high=10.0
            ),
            **{
                name: number(f"{name}_limit", getattr(Limits(), name), text, high=largest)
                for name, (text, largest) in LIMITS.items()
            },
        )
        self._max_lateness = self.declare(
            "lateness_limit", 0.05, "lateness of a step, s (wall)", low=0.0001, high=10.0
        )
        mass = number("mass", 0.0, "effective mass of the contact, kg; 0: the tip's", high=1e6)
        threshold = number(
            "touch_threshold",
            0.0,
            "force, N; 0: six standard deviations of the noise at rest",
            high=1e6,
        )
        method = self.declare("compensation", "none", "method against the delay", choices=METHODS)
        stiffness = number(
            "stiffness", 0.0, "model: first stiffness, N/m^exponent; 0: the scene's", high=1e12
        )
        exponent = self.declare(
            "exponent", 1.5, "exponent of the penetration: 1 spring, 1.5 Hertz", low=1.0, high=3.0
        )
        damping = number("damping", 0.0, "model: first damping, N s/m^(exponent + 1)", high=1e12)
        offset = self.declare(
            "wall_offset",
            0.0,
            "model: first offset of the walls towards the tip, m",
            low=-0.1,
            high=0.1,
        )
        self._start_timeout = self.declare(
            "start_timeout", 60.0, "wait for the answers at rest, s (wall)", low=0.1, high=86400.0
        )
        report = self.declare("report", "", "JSON file of the measured values; empty: none")
        self._report = Path(report) if report else None
        if self._report is not None and (reason := why_no_file(self._report)):
            raise ParameterError(
                f"parameter report = '{report}': must be a file that can be written: {reason}"
            )
        scene = load_scene(name, overrides)
        self._stage = LoopStage(scene, 1.0 / rate, max(1, round(1.0 / rate / SUBSTEP)))
        law = WallLaw(stiffness or scene.contact_stiffness, exponent, damping, offset)
        self._loop = Loop(self._stage, method, law, limits, mass or None, threshold)
        self._inbox: deque[tuple[float, float, Wrench]] = deque()  # arrival (wall), stamp, wrench
        self._rig_tips: dict[float, TipState] = {}
        self._sent: dict[float, float] = {}  # wall time by the tip's time
        self._ages: list[float] = []
        self._round_trips: list[float] = []
        self._late_steps, self._largest_lateness, self._reported_notes = 0, 0.0, 0
        self.open((TIP,))
        self.listen(RIG_TIP, self._receive_tip)
        self.listen(TIP_WRENCH, self._receive_wrench)

    def _receive_tip(self, message: Any) -> None:
        tip = tip_of(message)
        self._rig_tips[round(tip.t, 9)] = tip
        while len(self._rig_tips) > 200:
            del self._rig_tips[next(iter(self._rig_tips))]

    def _receive_wrench(self, message: Any) -> None:
        try:
            self._inbox.append((time.monotonic(), stamp_of(message), wrench_of(message)))
        except MessageError:
            self._loop.answers.reject("in another frame")
            raise

    def _hand_over_answers(self) -> None:
        """Give the loop what has arrived."""
        while self._inbox:
            arrival, stamp, wrench = self._inbox.popleft()
            key = round(stamp, 9) if math.isfinite(stamp) else 0.0
            self._loop.receive(stamp, wrench, self._rig_tips.pop(key, None))
            sent = self._sent.pop(key, None)
            if sent is not None:
                self._round_trips.append(arrival - sent)

    def work(self) -> int:
        """Run the loop to the scene's end; return the exit status."""
        stopped = ""
        try:
            self._await_rest()
            self._run()
        except SafeStopError as stop:
            stopped = f"stopped at t = {self._stage.t:.6g} s: {stop}"
            self.get_logger().error(stopped)
        self._loop.end()
        self._log_notes()
        self._report_result(stopped)
        return FAILED if stopped else OK

    def _await_rest(self) -> None:
        """Send the first position until the rig has answered it often enough."""
        self.get_logger().info("waiting for wrenches at rest on loop/wrench")
        deadline = time.monotonic() + self._start_timeout
        while self._loop.answers.n_at_rest < N_AT_REST:
            if time.monotonic() > deadline:
                away = self._loop.start_distance
                if away > MAX_START_DISTANCE:
                    raise CaptureSimError(
                        f"distance of loop/rig_tip from the first position = {away * 1e3:.3g} mm "
                        f"after {self._start_timeout:g} s (start_timeout): must be <= "
                        f"{MAX_START_DISTANCE * 1e3:g}"
                    )
                n, rejected = self._loop.answers.n_at_rest, dict(self._loop.answers.rejections)
                raise CaptureSimError(
                    f"answers at rest = {n} within {self._start_timeout:g} s: must be >= "
                    f"{N_AT_REST}" + (f"; rejected: {rejected}" if rejected else "")
                )
            self.send(TIP, tip_message(self.messages, 0.0, self._stage.tip))
            if STOP.wait(FIRST_POSE_PERIOD):
                raise KeyboardInterrupt
            self._hand_over_answers()
        self._loop.begin()
        self._rig_tips.clear()
        bias = ", ".join(f"{value:.3g}" for value in self._loop.answers.bias[:3])
        self.get_logger().info(
            f"the loop is closed; load cell at rest: bias {bias} N, noise "
            f"{self._loop.answers.noise:.3g} N; a touch begins at {self._loop.threshold:.3g} N"
        )

    def _run(self) -> None:
        period = self._stage.step / self._rtf
        due = time.monotonic()
        for _ in range(round(self._stage.scene.run.t_end / self._stage.step)):
            if STOP.wait(max(0.0, due - time.monotonic())):
                raise KeyboardInterrupt
            lateness = time.monotonic() - due
            if lateness > MAX_JITTER * period:  # never caught up with: the rig would be hurried
                self._late_steps += 1
                self._largest_lateness = max(self._largest_lateness, lateness)
                due += lateness
                if lateness > self._max_lateness:
                    raise SafeStopError(
                        f"lateness of a step = {lateness:.3g} s: must be <= {self._max_lateness:g} "
                        "(lateness_limit)"
                    )
            self._hand_over_answers()
            pose = self._loop.advance()
            self._ages.append(self._stage.t - self._stage.step - self._loop.answers.latest.stamp)
            self._sent[round(pose.t, 9)] = time.monotonic()
            self.send(TIP, tip_message(self.messages, pose.t, pose))
            self._log_notes()
            due += period

    def _log_notes(self) -> None:
        """Log the loop's notes that are new."""
        for note in self._loop.notes[self._reported_notes :]:
            self.get_logger().warning(note)
        self._reported_notes = len(self._loop.notes)

    def _report_result(self, stopped: str) -> None:
        """Log what was measured and write the report; RecordingError if that fails."""
        loop, ages = self._loop, sorted(self._ages) or [0.0]
        servo_lag = None if loop.known_lag is None else loop.servo_lag
        rejections = dict(loop.answers.rejections)
        report: dict[str, Any] = {
            "stopped": stopped,
            "notes": loop.notes,
            "steps": round(self._stage.t / self._stage.step),
            "late_steps": self._late_steps,
            "largest_lateness": self._largest_lateness,
            "refused": sum(rejections.values()),
            "rejections": rejections,
            "ages": self._ages,
            "round_trips": self._round_trips,
            "lag": {"servo": servo_lag, "force": loop.estimate.lag, "whole": loop.known_lag},
            "load_cell": {
                "bias": loop.answers.bias,
                "noise": loop.answers.noise,
                "threshold": loop.threshold,
            },
            "energy_excess": loop.energy.excess,
            "energy_withheld": loop.energy.withheld,
            "rig_peak_force": loop.rig_peak_force,
            "vehicle_peak_force": max((touch.peak_force for touch in loop.touches), default=0.0),
            "law": loop.estimate.law._asdict(),
            "touches": [_entry(touch) for touch in loop.touches],
        }
        whole = f"{loop.lag * 1e3:.1f} ms"
        if loop.known_lag is None:
            whole = f"not known: {whole} is above timeout"
        self.get_logger().info(
            f"{report['steps']} steps, latency {ages[len(ages) // 2] * 1e3:.1f} ms (median), "
            f"{ages[-1] * 1e3:.1f} ms (maximum), whole lag {whole}; peak "
            f"force on the rig {loop.rig_peak_force:.4g} N, energy added to the vehicles "
            f"{loop.energy.excess:.3g} J"
        )
        if rejections:
            self.get_logger().warning(f"wrenches rejected: {rejections}")
        if loop.touches:
            value = loop.touches[0].restitution
            shown = "not known" if math.isnan(value) else f"{value:.4f}"
            self.get_logger().info(f"first touch: restitution {shown}")
        if self._report is not None:
            try:
                text = json.dumps(report, default=np.ndarray.tolist)
                self._report.write_text(text, encoding="utf-8")
            except OSError as error:
                raise RecordingError(
                    f"report {self._report}: cannot be written: {error.strerror}"
                ) from None


def _entry(touch: Touch) -> dict[str, Any]:
    """Return a touch as the report has it; null for what is not known."""
    entry = {**asdict(touch), "restitution": touch.restitution}
    for name in ("restitution", "law_restitution"):
        if math.isnan(entry[name]):
            entry[name] = None
    return entry


main = partial(run, LoopSimulatorNode)

if __name__ == "__main__":
    raise SystemExit(main())
