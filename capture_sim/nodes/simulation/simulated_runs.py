"""The runs of the simulator node, one at a time, from their announcement to their end."""

from __future__ import annotations

import gc
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from capture_sim.dynamics.bench import Bench
from capture_sim.errors import CaptureSimError, MessageError
from capture_sim.messages.convert import LaunchAction, RunDescription
from capture_sim.messages.telemetry import BenchTelemetry
from capture_sim.messages.topics import (
    BENCH_STATE,
    LAUNCH_COMMAND,
    LAUNCHER,
    PLAYER,
    RUN_INFO,
    SIMULATOR,
    RunSource,
    topics_of,
)
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.protocol.announcer import Announcer, TrialOnError
from capture_sim.nodes.protocol.ends import INTERRUPTED, CutKind
from capture_sim.nodes.protocol.roll import Roll, RollPart, number_of
from capture_sim.nodes.simulation.control import RunCut, SimulationControl
from capture_sim.nodes.simulation.diagnostics import SimulatorDiagnostics
from capture_sim.nodes.simulation.robot_model import RobotModel
from capture_sim.nodes.simulation.stepping import Stepping
from capture_sim.nodes.simulation.thrust import ThrustCommands
from capture_sim.run.loads import extremes_to_text
from capture_sim.scene.launch_plan import LaunchPlan, plan_launch
from capture_sim.scene.parts import Scene


@dataclass(frozen=True)
class RunOutcome:
    """How a run has ended.

    ``failure`` says why it failed; it is empty if it did not.  ``cut`` is a request to end it that
    came before this outcome, of the user or by the launcher's abort; None without one.
    """

    failure: str = ""
    cut: CutKind | None = None


class LauncherLink:
    """Takes the commands of a launcher node for the present run.

    ``armed`` is the launcher's command to arm, with mass and drop height, None before it;
    ``is_released`` is True after its command to release.
    """

    def __init__(self, control: SimulationControl) -> None:
        self._control = control
        self._run_id = ""
        self._scene: Scene | None = None
        self.armed: Any = None  # LaunchCommand
        self.is_released = False

    def begin(self, run_id: str, scene: Scene) -> None:
        """Forget earlier commands, and take those for this run from now on."""
        self._run_id, self._scene = run_id, scene
        self.armed, self.is_released = None, False

    def pending(self) -> str:
        """Return the reason why the run waits; empty once the launcher has armed and released."""
        return "" if self.armed and self.is_released else "waiting for the release"

    def receive(self, command: Any) -> None:
        """Take a LaunchCommand; ignore one for another run.

        MessageError if the scene cannot be launched with its mass and height, or if its action is
        unknown.  The action ABORT ends the run.
        """
        if command.run_id != self._run_id or self._scene is None:
            return  # kept from an earlier run, for late subscribers
        if command.action == LaunchAction.ARM:
            try:
                _plan(self._scene, command)
            except CaptureSimError as error:
                raise MessageError(str(error)) from None
            self.armed = command
        elif command.action == LaunchAction.RELEASE:
            self.is_released = True
        elif command.action == LaunchAction.ABORT:
            self._control.abort("aborted by the launcher")
        else:
            raise MessageError(f"action = {command.action}: must be 1 to 3")


class SimulatedRuns:
    """Runs scenes for the simulator node.

    Create it after all other publishers and subscriptions of the node, because it creates those of
    bench/roll, where nodes report that they are ready.  ``wait_for`` are the nodes that a run waits
    for, by role or name, for ``start_timeout``, s (wall), at most.
    """

    def __init__(
        self,
        node: BenchNode,
        control: SimulationControl,
        wait_for: Sequence[str],
        start_timeout: float,
    ) -> None:
        #: True if the last failed run failed because a trial of a real bench was running.
        self.has_met_trial = False
        self._node, self._control, self._start_timeout = node, control, start_timeout
        self._launcher = LauncherLink(control)
        self._model = RobotModel(node)
        self._thrust = ThrustCommands(
            node, wait_for, control.check, lambda: node.topic_publishers.reader_timeout
        )
        self._diagnostics = SimulatorDiagnostics(node, control)
        node.listen(LAUNCH_COMMAND, self._launcher.receive)
        topics = topics_of(SIMULATOR)
        node.open([*(topic for topic in topics if topic is not RUN_INFO), RUN_INFO])
        self._numbers = itertools.count(1)
        self.roll = Roll(node, SIMULATOR, on_part=self._check_part)
        self._announcer = Announcer(node, self.roll, RunSource.SIMULATION, wait_for, control.check)

    def run(self, scene: Scene) -> RunOutcome:
        """Run a scene, and return how the run has ended.

        The run begins when the awaited nodes are there and ready, and the launcher, if there is
        one, has released.  It ends when the other nodes have received and written it.  An error in
        a callback of the node is raised.  KeyboardInterrupt is passed on after the end of the run
        has been announced.
        """
        gc.collect()
        self._control.begin()
        telemetry: BenchTelemetry | None = None
        failure = extremes = ""
        cut: CutKind | None = None
        try:
            self._thrust.listen(scene)
            self._announcer.await_nodes(scene.name, self._start_timeout)
            telemetry, has_launcher = self._begin_run(scene)
            if has_launcher:
                self._announcer.await_none(scene.name, self._launcher.pending, math.inf)
            bench = Bench(scene, _plan(scene, self._launcher.armed))
            failure = self._simulate(bench, telemetry)
            extremes = "" if failure else extremes_to_text(bench.extremes)
        except RunCut as request:
            cut = request.kind
            failure = "" if cut.is_requested else str(request)
        except CaptureSimError as error:
            if error is self._node.failure:
                raise
            failure = str(error)
            self.has_met_trial = isinstance(error, TrialOnError)
        except KeyboardInterrupt:
            if telemetry is not None:
                self._end_run(telemetry, INTERRUPTED)
            raise
        if failure:
            self._node.get_logger().error(f"{scene.name}: {failure}")
        if telemetry is not None:
            self._end_run(telemetry, failure or ("" if cut is None else cut.value), extremes)
            failure = failure or self._await_participants(scene.name)
        # also a request that came after the last sample
        cut = cut or self._control.cut_kind
        if cut is CutKind.ABORTED and not failure:
            failure = "aborted after its last sample"
            self._node.get_logger().error(f"{scene.name}: {failure}")
        self._control.end()
        return RunOutcome(failure, cut)

    def has_dropped_participants(self) -> bool:
        """Return True if a node that takes part in runs was dropped because it read nothing."""
        return any(
            part.node in self._node.topic_publishers.dropped for part in self.roll.parts.values()
        )

    def _begin_run(self, scene: Scene) -> tuple[BenchTelemetry, bool]:
        """Announce a run; return what makes its messages, and True if a launcher takes part."""
        taking_part = self._announcer.participants(scene.name)
        run_id = f"{number_of(self.roll.id)}{next(self._numbers):08x}"
        description = RunDescription.of(
            scene,
            run_id,
            [SIMULATOR, *taking_part.publishers],
            announcer=self.roll.id,
            participants=taking_part.participants,
        )
        self._launcher.begin(run_id, scene)
        telemetry = BenchTelemetry(self._node.messages, scene, description)
        self._model.begin(scene)
        try:
            self._announcer.announce(description, telemetry.begin().data)
        except CaptureSimError:
            self._announcer.close()  # nodes that have heard it would wait for its end
            raise
        return telemetry, LAUNCHER in taking_part.roles

    def _simulate(self, bench: Bench, telemetry: BenchTelemetry) -> str:
        """Step the run and send its messages; return why it failed, or an empty text."""
        name = bench.scene.name
        self._node.get_logger().info(f"{name}: released")
        stepping = Stepping(bench, telemetry, self._control, self._thrust)
        self._diagnostics.begin(stepping)
        try:
            failure = stepping.run(self._node.send, self._model.move)
        finally:
            self._diagnostics.end()
        self._node.get_logger().info(f"{name}: done, {stepping.count} samples, {stepping.figures}")
        return failure

    def _end_run(self, telemetry: BenchTelemetry, reason: str, extremes: str = "") -> None:
        """Send the messages that are left, then publish how many messages the run had.

        Between the two, wait until all that was sent has arrived, for ``reader_timeout`` at most.
        """
        for sent in telemetry.rest():
            self._node.publish(sent)
        self._announcer.await_read()
        self._node.publish(telemetry.end(reason, extremes))

    def _await_participants(self, name: str) -> str:
        """Wait until the other nodes have received and written the run; end its announcement.

        Return an empty text, or, if some are not done in time, a text that names them.
        """
        try:
            self._announcer.await_done()
        except CaptureSimError as error:
            if error is self._node.failure:
                raise
            self._node.get_logger().error(f"{name}: {error}")
            return str(error)
        finally:
            self._announcer.close()
        return ""

    def _check_part(self, part: RollPart) -> None:
        """Raise CaptureSimError if this simulator must not publish beside another node.

        ``part`` is what that node reports of itself.  It is one that is in a trial of a real bench,
        or a simulator or player that started earlier: two of these would publish the same topics,
        and no topic would be complete.
        """
        self._announcer.check_part(part)
        if part.role in (SIMULATOR, PLAYER) and part.number < number_of(self.roll.id):
            topic = self._node.resolve_topic_name(BENCH_STATE.name)
            raise CaptureSimError(
                f"another {part.role}, {part.node}, publishes {topic}: use another ROS_DOMAIN_ID "
                "or namespace"
            )


def _plan(scene: Scene, armed: Any) -> LaunchPlan:
    """Return the launch plan of a scene.

    ``armed`` is the launcher's command to arm, whose mass and drop height replace those of the
    scene; None without a launcher.  CaptureSimError if the scene cannot be launched so.
    """
    if scene.string is None or armed is None:
        return plan_launch(scene)
    fitted = replace(
        scene.string,
        impact_speed=None,
        hanging_mass=armed.hanging_mass,
        drop_height=armed.drop_height,
    )
    return plan_launch(replace(scene, string=fitted))
