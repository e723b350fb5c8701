"""The node that simulates vehicles and buffer while hardware answers with the contact force."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim.base.exit_status import FAILED, OK
from capture_sim.base.files import file_problem, writing_problem
from capture_sim.errors import CaptureSimError, MessageError, RecordingError, SceneError
from capture_sim.hardware.guard import LoopLimits
from capture_sim.hardware.law import TipState, WallLaw, Wrench
from capture_sim.hardware.loop import MAX_START_DISTANCE, METHODS, N_AT_REST, Loop
from capture_sim.hardware.messages import (
    HOLD,
    LOOP_SIMULATOR,
    RIG_TIP,
    TIP,
    TIP_WRENCH,
    stamp_of,
    tip_message,
    tip_of,
    wrench_message,
    wrench_of,
)
from capture_sim.hardware.pacing import LoopPacer, request_priority
from capture_sim.hardware.record import LoopRecord
from capture_sim.hardware.report import Timing, report_of, summary
from capture_sim.hardware.stage import LoopStage, SafeStopError
from capture_sim.messages.topics import Topic
from capture_sim.nodes.base.endpoints import message_class
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.base.parameters import declare_scene
from capture_sim.nodes.base.process import run
from capture_sim.recording.offline import write_run
from capture_sim.run.integration import check_memory

#: The tip's first position is sent this often, s (wall).
FIRST_POSE_PERIOD = 0.005
#: Measured tips that are kept until their wrench comes.
_MAX_RIG_TIPS = 200


class LoopSimulatorNode(BenchNode):
    """Simulates vehicles and buffer; a contact rig sends the contact force on loop/wrench.

    First it measures bias and noise of the rig's load cell at rest. Then it sends the position of
    the tip on loop/tip with every step, and uses the newest wrench that has arrived. The tip is
    brought from rest to the speed at which the scene begins during the time ``run_up``. A step that
    is late shifts all later ones. If a limit is exceeded, the node sends the reason on loop/hold,
    stops and exits with status 1.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(LOOP_SIMULATOR, **options)
        number = partial(self.declare, low=0.0)
        scene = declare_scene(self, "scene of the vehicles", "_loop")
        assert scene is not None
        rate = self.declare(
            "rate", 1000.0, "rate of steps and messages, Hz", low=10.0, high=10000.0
        )
        self._rtf = self.declare(
            "rtf", 1.0, "real-time factor: simulated seconds per second", low=0.001, high=1.0
        )
        limits = self.declare_fields(
            LoopLimits(), lambda name: "timeout" if name == "latency" else f"{name}_limit"
        )
        self._max_lateness = self.declare(
            "lateness_limit", 0.05, "lateness of a step, s (wall)", low=0.0001, high=10.0
        )
        self._max_late_share = number(
            "late_share_limit", 0.2, "share of late steps among the latest 1000", high=1.0
        )
        self._priority = self.declare(
            "priority", 0, "SCHED_FIFO priority of the process; 0: ordinary", low=0, high=99
        )
        run_up = self.declare(
            "run_up", 0.2, "time from rest to the vehicles' first speed, s", low=0.0, high=0.9
        )
        threshold = number(
            "touch_threshold",
            0.0,
            "force, N; 0: six standard deviations of the noise at rest",
            high=1e6,
        )
        method = self.declare("compensation", "none", "method against the delay", choices=METHODS)
        law = self.declare_fields(
            WallLaw(0.0, 1.5), lambda name: "wall_offset" if name == "offset" else name
        )
        self._start_timeout = self.declare(
            "start_timeout", 60.0, "wait for the answers at rest, s (wall)", low=0.1, high=86400.0
        )
        kind = "a file or folder that can be written"
        text = "JSON file of the measured values; empty: none"
        self._report = self.declare_path("report", "", text, kind, file_problem)
        text = "MCAP file of the run, or its folder; empty: none"
        self._record_path = self.declare_path("record", "runs", text, kind, _record_problem)
        self._t_end = scene.run.t_end
        if method != "model" and not law.stiffness:
            law = WallLaw(0.0, law.exponent, offset=law.offset)  # nothing is known of the walls
        elif not law.stiffness and scene.contact.force_table is not None:
            raise SceneError("stiffness = 0: must be > 0 with contact.force_table of the scene")
        elif not law.stiffness:
            law = replace(law, stiffness=scene.contact_stiffness)
        self._loop = Loop(LoopStage(scene, 1.0 / rate), method, law, limits, threshold, run_up)
        self._inbox: deque[tuple[float, float, Wrench]] = deque()  # arrival (wall), stamp, wrench
        self._rig_tips: dict[float, TipState] = {}
        self._timing = Timing()
        self._pacer: LoopPacer | None = None
        self._record: LoopRecord | None = None  # from the first step on
        self._exchanged: dict[Topic, list[tuple[float, Any]]] = {
            topic: [] for topic in (TIP, TIP_WRENCH, RIG_TIP)
        }
        self._reported_notes = 0
        self.open((TIP, HOLD))
        self.listen(RIG_TIP, self._receive_tip)
        self.listen(TIP_WRENCH, self._receive_wrench)

    def _receive_tip(self, message: Any) -> None:
        tip = tip_of(message)
        self._rig_tips[round(tip.t, 9)] = tip
        while len(self._rig_tips) > _MAX_RIG_TIPS:
            del self._rig_tips[next(iter(self._rig_tips))]

    def _receive_wrench(self, message: Any) -> None:
        try:
            self._inbox.append((time.monotonic(), stamp_of(message), wrench_of(message)))
        except MessageError:
            self._loop.answers.reject("in another frame")
            raise

    def _hand_over_answers(self) -> None:
        """Pass the wrenches that have arrived to the loop."""
        while self._inbox:
            arrival, stamp, wrench = self._inbox.popleft()
            key = round(stamp, 9) if math.isfinite(stamp) else 0.0
            tip = self._rig_tips.pop(key, None)
            self._loop.receive(stamp, wrench, tip)
            if self._record is not None:
                self._exchanged[TIP_WRENCH].append((stamp, wrench))
                if tip is not None:
                    self._exchanged[RIG_TIP].append((stamp, tip))
            self._timing.answered(key, arrival)

    def work(self) -> int:
        """Run the loop up to the end of the scene or to a safe stop; return the exit status.

        CaptureSimError if the rig does not answer at rest, or if a file cannot be written.
        """
        self.freeze_objects()
        stopped, hold = "", "interrupted"
        self._hold("")
        try:
            self._await_rest()
            self._run()
            hold = "end of the run"
        except SafeStopError as stop:
            hold = stopped = f"stopped at t = {self._loop.t:.6g} s: {stop}"
            self.get_logger().error(stopped)
        except CaptureSimError as error:
            hold = str(error)
            raise
        finally:
            self._hold(hold)
        self._loop.end()
        self._log_notes()
        self._report_result(stopped)
        self._write_record(stopped)
        return FAILED if stopped else OK

    def _write_record(self, stopped: str) -> None:
        """Write a recording of the run, if one is wanted and a step was taken.

        It contains all messages exchanged with the rig.  ``stopped``: why the run was stopped;
        empty if it was not.  RecordingError if it cannot be written.
        """
        if self._record is None or self._record_path is None:
            return
        make, run = self.messages, self._record.run(stopped)
        others = {
            topic: [
                (t, (wrench_message if topic is TIP_WRENCH else tip_message)(make, t, value))
                for t, value in exchanged
            ]
            for topic, exchanged in self._exchanged.items()
        }
        path = self._record_path
        if path.suffix != ".mcap":
            path = path / f"{run.name}.mcap"
        self.get_logger().info(f"recorded: {write_run(run, path, others=others)}")

    def _hold(self, reason: str) -> None:
        self.send(HOLD, message_class(HOLD.type_name)(data=reason))

    def _await_rest(self) -> None:
        """Send the first position until the rig has answered it N_AT_REST times; begin the loop.

        CaptureSimError if that takes longer than the parameter ``start_timeout``.
        """
        self.get_logger().info("waiting for wrenches at rest on loop/wrench")
        loop, deadline = self._loop, time.monotonic() + self._start_timeout
        while loop.answers.n_at_rest < N_AT_REST:
            if time.monotonic() > deadline:
                raise CaptureSimError(self._rest_problem())
            self.send(TIP, tip_message(self.messages, loop.t, loop.pose))
            self.wait(limit=FIRST_POSE_PERIOD)
            self._hand_over_answers()
        loop.begin()
        self._rig_tips.clear()
        bias = ", ".join(f"{value:.3g}" for value in loop.answers.bias[:3])
        self.get_logger().info(
            f"the loop is closed; load cell at rest: bias {bias} N, noise "
            f"{loop.answers.noise:.3g} N; a contact begins at {loop.contact.threshold:.3g} N"
        )

    def _rest_problem(self) -> str:
        answers, away, limit = self._loop.answers, self._loop.start_distance, self._start_timeout
        if away > MAX_START_DISTANCE:
            return (
                f"distance of loop/rig_tip from the first position = {away * 1e3:.3g} mm after "
                f"{limit:g} s (start_timeout): must be <= {MAX_START_DISTANCE * 1e3:g}"
            )
        rejected = f"; rejected: {dict(answers.rejections)}" if answers.rejections else ""
        return (
            f"answers at rest = {answers.n_at_rest} within {limit:g} s: must be >= "
            f"{N_AT_REST}{rejected}"
        )

    def _run(self) -> None:
        """Take the steps at their times up to the end of the scene, and send a position with each.

        SafeStopError at a limit.
        """
        loop, log = self._loop, self.get_logger()
        if self._priority and (reason := request_priority(self._priority)):
            log.warning(reason)
        period = loop.stage.step / self._rtf
        if self._record_path is not None:
            check_memory(loop.stage.scene.run, self._t_end / loop.stage.step)
            self._record = LoopRecord(loop.stage)
        pacer = self._pacer = LoopPacer(period, self._max_lateness, self._max_late_share)
        while loop.t < self._t_end - 1e-9:
            self.wait(limit=pacer.time_to_work())
            self._hand_over_answers()
            self._timing.latencies.append(loop.t - loop.answers.latest.stamp)
            pose = loop.advance()
            pacer.work_done()
            self.wait(limit=pacer.time_to_send())
            pacer.release()
            self.send(TIP, tip_message(self.messages, pose.t, pose))
            if self._record is not None:
                self._exchanged[TIP].append((pose.t, pose))
                if pose.t > 0.5 * loop.stage.step:
                    self._record.add()
            self._timing.sent(round(pose.t, 9), time.monotonic())
            self._log_notes()

    def _log_notes(self) -> None:
        """Log the notes that the loop has made since the last call."""
        for note in self._loop.notes[self._reported_notes :]:
            self.get_logger().warning(note)
        self._reported_notes = len(self._loop.notes)

    def _report_result(self, stopped: str) -> None:
        """Log the results and write the report, if one is wanted.

        ``stopped``: why the run was stopped; empty if it was not.  RecordingError if the report
        cannot be written.
        """
        report = report_of(self._loop, self._pacer, self._timing, stopped)
        for line in summary(self._loop, report):
            self.get_logger().info(line)
        if report["rejections"]:
            self.get_logger().warning(f"wrenches rejected: {report['rejections']}")
        if self._report is not None:
            try:
                text = json.dumps(report, default=np.ndarray.tolist)
                self._report.write_text(text, encoding="utf-8")
            except OSError as error:
                raise RecordingError(
                    f"report {self._report}: cannot be written: {error.strerror}"
                ) from None


def _record_problem(path: Path) -> str:
    """Return the reason why no run can be recorded in this file or folder; empty if one can.

    A path that ends in .mcap is a file, any other a folder.
    """
    return file_problem(path) if path.suffix == ".mcap" else writing_problem(path)


main = partial(run, LoopSimulatorNode)

if __name__ == "__main__":
    raise SystemExit(main())
