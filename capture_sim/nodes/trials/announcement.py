"""Messages by which the launcher announces, reports and closes a trial for the other nodes."""

from __future__ import annotations

import uuid
from collections.abc import Collection
from dataclasses import replace
from typing import Any

from capture_sim.launcher.state_machine import LauncherPhase
from capture_sim.messages.convert import LaunchAction, RunDescription
from capture_sim.messages.telemetry import LauncherTelemetry
from capture_sim.messages.topics import CAPTURE_DETECTOR, LAUNCHER, RECORDER, RunSource
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.protocol.announcer import Announcement, Participants
from capture_sim.nodes.protocol.roll import DONE, READY, Roll, RunReport
from capture_sim.trial.trial import Trial, TrialPhase, TrialStep

#: Problem of a participant that has left a trial without a report.
GONE = "gone without a report: killed, or its network is down"
#: Why the announcement of a trial is withdrawn before its release.
WITHDRAWN = "a node that was to take part has gone: announced again once another one is there"


class TrialAnnouncement:
    """Publishes what the other nodes need of one trial, and follows which of them take part in it.

    It does not let the chaser go: :class:`capture_sim.nodes.trials.bench.TrialBench` does.

    ``required``: roles of nodes, e.g. ``recorder``, that must take part before the chaser is let
    go.  An unmet requirement is reported by :meth:`state_of_others`; the trial then does not
    release.
    """

    def __init__(
        self, node: BenchNode, roll: Roll, trial: Trial, required: Collection[str] = ()
    ) -> None:
        self.trial = trial
        self._required = sorted(required)
        self._node, self._roll = node, roll
        self._announced: Announcement | None = None
        self._taking_part = Participants([])
        self._absent: list[str] = []  # a line for each node that is there, but in another run
        self._telemetry: LauncherTelemetry
        self._is_closed = self._is_delivered = False

    def perform(self, step: TrialStep, stamp: int) -> None:
        """Publish the messages of a step that the trial has decided.

        ``stamp``: stamp of the chaser's latest pose, ns, which the messages of an abort get.
        Announce the trial before any other step.
        """
        launcher = self.trial.launcher
        match step:
            case TrialStep.ANNOUNCE:
                self._announce()
            case TrialStep.RELEASE:
                for action in (LaunchAction.ARM, LaunchAction.RELEASE):
                    self._node.publish(self._telemetry.command(0.0, action, launcher.plan))
                self._node.publish(*self._telemetry.status(0.0, launcher.status))
                self._node.get_logger().info(f"{self.trial.goal.name}: released")
            case TrialStep.ABORT:
                self._telemetry.zero_ns = stamp
                self._node.publish(self._telemetry.command(0.0, LaunchAction.ABORT, launcher.plan))
                self._node.publish(*self._telemetry.status(0.0, launcher.status))
            case TrialStep.CLOSE:
                self._close(self.trial.failure)
            case TrialStep.WITHDRAW:
                self._close(WITHDRAWN)
                self._announced, self._is_closed = None, False
                self._node.get_logger().warning(f"{self.trial.goal.name}: {WITHDRAWN}")

    def report_launch(self) -> None:
        """Publish the launcher's statuses that the poses since the last call have given.

        They are published from the release to the close.  The first contact is logged once.
        """
        for stamp, status in self.trial.take_statuses():
            if self.trial.is_released and not self._is_closed:
                self._telemetry.zero_ns = stamp
                self._node.publish(*self._telemetry.status(0.0, status))
            if status.state is LauncherPhase.DELIVERED and not self._is_delivered:
                self._is_delivered = True
                text = status.reason or f"contact at {status.measured_speed:.4g} m/s"
                self._node.get_logger().info(f"{self.trial.goal.name}: {text}")

    def state_of_others(self) -> dict[str, Any]:
        """Return which other nodes have joined or left the trial, as arguments of Trial.set_others.

        Before the announcement, it contains which required roles cannot take part, and which roles
        more than one node fills (``absent``).
        After it, it contains which nodes the trial waits for (``pending``) and, until the close,
        which required roles have left the trial (``lost``).
        """
        if self._announced is None:
            absent = "; ".join([*self._absences(self._required), *self._doubles()])
            return {"ready": False, "done": False, "pending": "", "absent": absent}
        not_joined, not_left = self._announced.not_joined(), self._announced.not_left()
        return {
            "ready": not not_joined,
            "done": self._is_closed and not not_left,
            "pending": not_joined if self.trial.phase is TrialPhase.PREPARING else not_left,
            "lost": {} if self._is_closed else self._lost(),
        }

    def result(self) -> dict[str, Any]:
        """Return the fields of the action's result (action/RunTrial.action); call it at the end."""
        trial, reports = self.trial, self._announced.reports() if self._announced else []
        verdict, reason = trial.outcome
        if CAPTURE_DETECTOR not in self._taking_part.roles and trial.is_released:
            reason = reason or "no capture_detector takes part"
        files = [report.file for report in reports if report.file]
        problems = [*self._absent, *trial.problems, *trial.sensor_problems]
        problems += [problem for report in reports for problem in report.problems]
        if self._announced is not None:
            problems += [f"{node}: {GONE}" for node in self._announced.gone()]
        return {
            "verdict": verdict,
            "reason": reason,
            "as_expected": trial.goal.expected in ("", verdict),
            "recording": files[0] if files else "",
            "complete": bool(files) and not problems,
            "problems": problems,
            "impact_speed": trial.impact_speed,
            "max_force": trial.loads.max_force,
            "max_stroke": trial.loads.max_stroke,
            "max_torsion": trial.loads.max_torsion,
        }

    def _absences(self, roles: Collection[str]) -> list[str]:
        """Return a line for each of ``roles`` that has no node which can take part in a trial.

        A node cannot take part while it is in another run.
        """
        free = {part.role for part in self._roll.free(RunSource.TRIAL)}
        busy = {part.role: part.node for part in self._roll.busy(RunSource.TRIAL)}
        return [
            f"{busy[role]} does not take part: it is in another run"
            if role in busy
            else f"no {role} takes part"
            for role in roles
            if role not in free
        ]

    def _doubles(self) -> list[str]:
        """Return a line for each role that two nodes fill, launchers included."""
        launchers = [
            f"{part.node} is a {LAUNCHER} too: one alone may drive launcher/hold"
            for part in self._roll.parts.values()
            if part.role == LAUNCHER and self._roll.is_there(part.id)
        ]
        return launchers + self._roll.doubles(self._roll.free(RunSource.TRIAL), self._required)

    def _lost(self) -> dict[str, str]:
        """Return a line, by role, for each required role without a node in the trial any more.

        The line has the problems that a node of this role has reported, or :data:`GONE`.
        """
        assert self._announced is not None
        here = {part.role for part in self._announced.present()}
        reports = {
            part.role: part.report.problems
            for part in self._announced.parts()
            if part.is_done(self._announced.key)
        }
        return {
            role: f"{role}: {'; '.join(reports.get(role, ())) or GONE}"
            for role in self._required
            if role not in here
        }

    def _announce(self) -> None:
        """Announce the trial to all nodes that take part in trials and are in no other run."""
        goal = self.trial.goal
        self._taking_part = taking_part = Participants(self._roll.free(RunSource.TRIAL))
        self._absent = self._absences((CAPTURE_DETECTOR, RECORDER))
        run = RunDescription.of(
            self.trial.scene,
            uuid.uuid4().hex,
            sorted({LAUNCHER, *taking_part.publishers}),
            source=RunSource.TRIAL,
            announcer=self._roll.id,
            participants=sorted({self._roll.id, *taking_part.participants}),
        )
        run = replace(
            run, name=goal.name, note=goal.note, expected=goal.expected, waived=self.trial.waived
        )
        self._announced = Announcement(self._node, self._roll, run)
        self._telemetry = LauncherTelemetry(self._node.messages, run.run_id)
        self._roll.report(READY, run)
        self._node.get_logger().info(f"{goal.name}: {self.trial.launcher.plan.text}")

    def _close(self, failure: str) -> None:
        """End the trial for the other nodes.

        The counts of the launcher's messages are sent, then the announcement that no run is on.
        ``failure``: why the trial ends early; empty if it does not.
        """
        assert self._announced is not None
        self._node.publish(self._telemetry.end(failure))
        self._announced.close()
        self._roll.report(DONE, self._announced.run, RunReport((failure,) if failure else ()))
        self._is_closed = True
