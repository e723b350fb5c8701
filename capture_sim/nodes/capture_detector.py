"""The node that detects, from poses and buffer state alone, whether the tip is captured."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

from capture_sim.detection.criteria import CaptureState, CaptureStatus
from capture_sim.detection.detector import CaptureDetector
from capture_sim.detection.measurements import REORDER, Source, Values
from capture_sim.errors import CaptureSimError, SceneError, one_line
from capture_sim.messages.convert import EPOCH_NS, rejected
from capture_sim.messages.measurements import (
    OF_A_BENCH,
    TOPICS_OF_SOURCE,
    DetectorInput,
    MeasurementReader,
)
from capture_sim.messages.telemetry import DetectorTelemetry
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    HOLD,
    LOAD_CELL,
    RunSource,
    Topic,
    topics_of,
)
from capture_sim.nodes.base.diagnostics import DiagnosticStatus, Level
from capture_sim.nodes.base.endpoints import ANYONE, BOOL, message_class
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.base.parameters import ParameterError, declare_scene
from capture_sim.nodes.base.process import run
from capture_sim.nodes.base.sources import SOURCES_TIMEOUT, SourceDiagnostics
from capture_sim.nodes.protocol.ends import RunEnd
from capture_sim.nodes.protocol.follower import AnnouncedRun, Follower, RunPart
from capture_sim.nodes.protocol.roll import RunReport
from capture_sim.nodes.trials.evidence import Evidence, refusing
from capture_sim.plausibility.clocks import OF_ARRIVALS
from capture_sim.scene.parts import Detector
from capture_sim.trial.hold import HoldListener

#: As many measurements are evaluated together at most: then other callbacks are due.
MAX_BATCH = 200
#: A trial without measurements fails after this time, s (wall), if its launcher waits that long.
MAX_SOURCES_WAIT = 120.0
#: The detector's warnings are looked at this often, s (wall).
WARNING_PERIOD = 0.1
CRITERION = {field.name: field for field in fields(Detector)}


class CaptureDetectorNode(BenchNode, RunPart):
    """Publishes whether the tip is captured, for every instant at which the poses were measured.

    It takes part in announced runs and trials; with the parameter ``scene``, it also evaluates a
    bench where no node announces runs.  docs/detection.md explains the criteria.

    The final status of a trial is the trial's verdict.  Therefore this node, which publishes it,
    asks the rules of plausibility before: a verdict by doubtful measurements is undecided.  And it
    evaluates nothing once the chaser is held again.
    """

    # of the run that is on
    _detector: CaptureDetector
    _input: DetectorInput
    _telemetry: DetectorTelemetry
    _criteria_in_force: Detector
    _hold: HoldListener
    _evidence: Evidence | None  # of a trial that a launcher announces, else None
    _doubts: str | None  # why the verdict of this trial is undecided; None before the verdict

    def __init__(self, **options: Any) -> None:
        super().__init__(CAPTURE_DETECTOR, **options)
        self._declare_criteria()
        self._scene = declare_scene(
            self,
            "evaluate by this scene from the start, for a bench where no node announces runs; "
            "empty to wait for a run",
        )
        self._waiting: list[tuple[Source, int, Values, int | None]] = []  # read, not evaluated
        self._due: list[tuple[Source, int, Values, int | None]] = []  # ... before a hold
        self._warned = -math.inf  # s (wall), when the detector's warnings were looked at
        self._readers = {topic: MeasurementReader(topic) for topic in OF_A_BENCH}
        self._follower = Follower(self, CAPTURE_DETECTOR, self, list(RunSource))
        self._sources = SourceDiagnostics(self, self._progress)
        for topics in TOPICS_OF_SOURCE.values():
            self._sources.watch(*topics)
        for topic in self._readers:
            take, watch = (partial(f, topic) for f in (self._receive_measurement, self._diagnose))
            self._follower.follow(topic, take, raw=True, watch=watch)
        self.listen(LOAD_CELL, self._receive_force, raw=True)
        self.create_subscription(
            message_class(BOOL), HOLD, self.guarded(self._receive_hold), ANYONE
        )
        self.open(topics_of(CAPTURE_DETECTOR))
        self._follower.join()

    @property
    def run(self) -> Any:
        """The run that this node takes part in at the moment (AnnouncedRun), or None."""
        return self._follower.run

    def work(self) -> int:
        """Take part until the process is to end; return the exit status."""
        if self._scene is not None:
            self._follower.assume(self._scene)
            self.get_logger().info(f"evaluated by {self._scene.name} until Ctrl-C")
        return self._follower.work()

    def prepare(self, run: AnnouncedRun) -> None:
        """Make a new detector for the scene of this run, with the criteria set as parameters.

        In a trial, also wait for the measurements: see :meth:`_await_sources`.
        """
        criteria = self._criteria()
        scene = replace(run.scene, detector=replace(run.scene.detector, **criteria))
        self._criteria_in_force = scene.detector
        # a bench has a clock of its own: the detector takes its time from the first measurement
        self._detector = CaptureDetector(
            scene,
            is_released=run.simulated,
            zero=EPOCH_NS if run.simulated else None,
            reorder=0 if run.simulated else REORDER,
        )
        self._input = DetectorInput(scene, is_simulated=run.simulated, readers=self._readers)
        self._waiting.clear()
        self._rejected_at, self._rejected = -1, dict[str, list[int]]()
        self._telemetry = DetectorTelemetry(self.messages, run.id)
        if criteria:
            given = ", ".join(
                f"{n} = {v:g} {CRITERION[n].metadata['unit']}" for n, v in criteria.items()
            )
            self.get_logger().info(f"{run.name}: evaluated by {given}; else by the scene")
        is_launched = run.info.source == RunSource.TRIAL
        is_launched = is_launched and run.info.announcer != self._follower.roll.id
        self._hold, self._doubts = HoldListener(), None
        self._due.clear()
        self._evidence = Evidence(run.info.waived) if is_launched else None
        if is_launched:
            self._await_sources(run.name)

    def _await_sources(self, name: str) -> None:
        """Wait until the measurements of a trial arrive; CaptureSimError after MAX_SOURCES_WAIT.

        The launcher does not let the chaser go before this node is ready.  On a busy machine this
        node can discover a driver seconds after the launcher has, and without poses from before
        the contact it gives no verdict.  ``name`` is the trial's, for the warnings.
        """

        def is_over() -> bool:
            return self._follower.has_ended or not self._unseen()

        if self.wait(is_over, SOURCES_TIMEOUT):
            return
        missing = [" or ".join(topic.name for topic in topics) for topics in self._unseen()]
        text = f"{name}: no measurement of {' and '.join(missing)} yet"
        self.get_logger().warning(f"{text}: this node joins once there is one")
        if not self.wait(is_over, MAX_SOURCES_WAIT):
            raise CaptureSimError(f"{text}, after {MAX_SOURCES_WAIT:g} s")

    def _unseen(self) -> list[tuple[Topic, ...]]:
        """Return, for each source of measurements that is missing, the topics that can give it.

        A source is chaser, target or buffer.  It is missing if no message has arrived lately; the
        buffer only if a node publishes it, as not every bench measures it.
        """
        return [
            topics
            for source, topics in TOPICS_OF_SOURCE.items()
            if not any(map(self._sources.is_fresh, topics))
            and (source is not Source.BUFFER or any(map(self.nodes_that_publish, topics)))
        ]

    def begin(self, run: AnnouncedRun) -> None:
        """Publish the criteria that this run is evaluated by."""
        del run
        self.publish(self._telemetry.begin(self._criteria_in_force))

    def end(self, run: AnnouncedRun, end: RunEnd) -> RunReport:
        """Publish the final verdict and how many messages were sent; return what went wrong."""
        self._evaluate()
        self._waiting.clear()  # of a chaser that may be held
        is_held = self._evidence is not None and self._hold.may_be_held(time.monotonic())
        statuses = self._detector.finish(cut=self._follower.was_cut or is_held)
        if is_held and not statuses[-1].state.is_verdict:
            why = self._follower.failure or "the chaser was held"
            last = statuses[-1]._replace(
                state=CaptureState.UNDECIDED, final=True, reason=f"{why} ({statuses[-1].reason})"
            )
            statuses = [*statuses[:-1], last]
        if self._doubts == "":  # what has come since the verdict may contradict it
            self._doubts = self._refusal(but=OF_ARRIVALS)
        self._send_all(statuses)
        verdict = self._checked(statuses[-1])
        self.get_logger().info(f"{run.name}: {verdict.label}, {verdict.reason}")
        if verdict.not_used:
            self.get_logger().warning(f"{run.name}: measurements not used: {verdict.not_used}")
        self.publish(self._telemetry.end(end.reason))
        return end.report

    def _declare_criteria(self) -> None:
        """Declare a parameter for each criterion, with unit and range.

        NaN, the default, leaves the criterion as the scene has it.  A change applies from the next
        run on: a run is evaluated by the same criteria from its start to its end.
        """
        for name, field in CRITERION.items():
            unit, allowed = field.metadata["unit"], field.metadata["allowed"]
            self.declare(
                name,
                float,
                f"{unit}, {field.metadata['doc']}; .nan: the scene's",
                allowed=f"a number with a decimal point, {allowed} {unit}",
                read_only=False,
                check=partial(_check_criterion, name),
            )

    def _criteria(self) -> dict[str, float]:
        """Return the criteria that are set as parameters, by name; the rest is as in the scene."""
        values = {name: float(self.get_parameter(name).value) for name in CRITERION}
        return {name: value for name, value in values.items() if not math.isnan(value)}

    def _diagnose(self, topic: Topic, data: bytes) -> None:
        """Report a measurement to the diagnostics, without its time derivatives."""
        stamp, values = self._readers[topic](data)
        count = 2 if OF_A_BENCH[topic] is Source.BUFFER else 3
        self._sources.add(topic, stamp, values[:count])

    def _progress(self) -> list[DiagnosticStatus]:
        """Return a diagnostic: how far the evaluation is behind the newest measurement.

        The list is empty while no run is on, and in simulated runs.
        """
        if self._follower.run is None or self._follower.run.simulated:
            return []
        behind, delay = self._detector.behind, self._detector.delay
        values = {"behind [s]": f"{behind:.3f}", "delay of the smoother [s]": f"{delay:.3f}"}
        text = f"{behind:.2f} s behind the newest measurement"
        return [DiagnosticStatus("evaluation", Level.OK, text, values)]

    def _receive_hold(self, message: Any) -> None:
        if self.run is None:
            return
        if message.data:  # what has come before the hold is evaluated
            self._due += self._waiting
            self._waiting.clear()
        else:
            self._follower.begin()
        self._hold.note(is_held=bool(message.data), now=time.monotonic())

    def _receive_force(self, data: bytes) -> None:
        if self.run is not None and self._evidence is not None:
            self._evidence.add(LOAD_CELL, data, time.monotonic_ns())

    def _receive_measurement(self, topic: Topic, data: bytes) -> None:
        if self._evidence is not None:
            if self._hold.is_held:
                return
            self._evidence.add(topic, data, time.monotonic_ns())
        measurement = self._input.read(topic, data)
        if measurement is None:
            return
        arrival = None if self.run.simulated else time.monotonic_ns()
        self._waiting.append((*measurement, arrival))

    def serve(self, limit: float = 0.0) -> None:
        """Run callbacks; then evaluate the measurements that these have read, all together.

        At most about MAX_BATCH are read before they are evaluated.  ``limit``: how long to wait for
        a first callback, s (wall).
        """
        super().serve(limit)
        count = 0
        while count < len(self._waiting) < MAX_BATCH and self._follower.run is not None:
            count = len(self._waiting)
            super().serve()
        if (self._waiting or self._due) and not self.in_callback:
            self.guarded(self._evaluate)()

    def _evaluate(self) -> None:
        """Evaluate the measurements that wait for it; publish the statuses that result.

        While launcher/hold is silent they wait: its next message says whether the chaser is held.
        They also wait for the begin of the run.
        """
        if not self._follower.is_on:
            return
        waiting, self._due = self._due, []
        if self._evidence is None or not self._hold.may_be_held(time.monotonic()):
            waiting += self._waiting
            self._waiting = []
        self._send_all([s for each in waiting for s in self._detector.measure(*each)])
        if waiting and (now := time.monotonic()) >= self._warned + WARNING_PERIOD:
            self._warned = now
            if warnings := self._detector.warnings:
                self.get_logger().warning("; ".join(warnings), throttle_duration_sec=5.0)

    def _send_all(self, statuses: Sequence[CaptureStatus]) -> None:
        """Publish statuses, a verdict only if no rule of plausibility refuses it."""
        statuses = list(map(self._checked, statuses))
        self._telemetry.zero_ns = self._detector.zero
        if statuses:
            counts = self._detector.counts
            if counts.n_changes != self._rejected_at:
                self._rejected_at, self._rejected = counts.n_changes, rejected(counts)
            known = [(status.t, status) for status in statuses]
            further = {name: [row] * len(known) for name, row in self._rejected.items()}
            for messages in self._telemetry.statuses(known, further):
                self.publish(*messages)

    def _checked(self, status: CaptureStatus) -> CaptureStatus:
        """Return a status as it may be published: undecided instead of a doubtful verdict.

        The rules are checked when there is a verdict, and again at the end of the run: some need
        the whole contact.  Those of clocks are not checked again: this node may be late by then.
        """
        if self._evidence is None or not status.state.is_verdict:
            return status
        if self._doubts is None:
            self._doubts = self._refusal()
        if not self._doubts:
            return status
        return status._replace(state=CaptureState.UNDECIDED, final=True, reason=self._doubts)

    def _refusal(self, but: Collection[str] = ()) -> str:
        """Return the broken rules that refuse a verdict, in a line; '' if there are none.

        ``but``: names of rules that are not checked.
        """
        assert self._evidence is not None
        doubts = refusing(self._evidence.of_trial(self.run.scene, but))
        return one_line("; ".join(doubt.line for doubt in doubts))


def _check_criterion(name: str, value: float) -> None:
    try:
        Detector(**{name: value})
    except SceneError as error:
        raise ParameterError(f"parameter {str(error).removeprefix('Detector.')}") from None


main = partial(run, CaptureDetectorNode)

if __name__ == "__main__":
    raise SystemExit(main())
