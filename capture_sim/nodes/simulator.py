"""The node that runs the bench and publishes its measurements."""

from __future__ import annotations

import gc
import itertools
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from capture_sim.bench import Bench, compile_kernels
from capture_sim.compile_progress import watch_compilation
from capture_sim.control.pacing import FACTORS, Pacer
from capture_sim.control.simulation import CutKind, RunCut, SimulationControl, State
from capture_sim.errors import CaptureSimError, MessageError
from capture_sim.files import why_no_folder
from capture_sim.kernels import is_compiled
from capture_sim.launch.plan import LaunchPlan, plan_launch
from capture_sim.launch.scenes import load_requested, load_scene
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
from capture_sim.nodes.announcer import Announcer
from capture_sim.nodes.diagnostics import SimulatorDiagnostics
from capture_sim.nodes.endpoints import DISCOVERY_TIME
from capture_sim.nodes.follower import INTERRUPTED
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.parameters import ParameterError
from capture_sim.nodes.process import run
from capture_sim.nodes.robot_model import RobotModel
from capture_sim.nodes.roll import Part, Roll, number_of
from capture_sim.nodes.services import SimulationServices
from capture_sim.nodes.start import FAILED
from capture_sim.nodes.stepping import Stepping
from capture_sim.results import extremes_to_text
from capture_sim.scene.parts import Scene

#: A paced simulator hands its GIL over this often, s: Python's own 5 ms would make ticks late.
SWITCH_INTERVAL = 2e-4


@dataclass(frozen=True)
class RunOutcome:
    """How a run has ended: why it failed, if it did, and by which request, if by one."""

    failure: str = ""
    cut: CutKind | None = None


class LauncherLink:
    """What a launcher has commanded for the run that is on."""

    def __init__(self, control: SimulationControl) -> None:
        self._control = control
        self._run_id = ""
        self._scene: Scene | None = None
        self.armed: Any = None  # LaunchCommand
        self.is_released = False

    def begin(self, run_id: str, scene: Scene) -> None:
        """Take the commands for this run from now on."""
        self._run_id, self._scene = run_id, scene
        self.armed, self.is_released = None, False

    def pending(self) -> str:
        """Return what the run waits for; empty once it is released."""
        return "" if self.armed and self.is_released else "waiting for the release"

    def receive(self, command: Any) -> None:
        """Take a LaunchCommand; MessageError if it cannot be used."""
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


class SimulatorNode(BenchNode):
    """Runs scenes one after another.

    Alone, it launches by its own plan; if a launcher is running, the launcher does.  The
    parameter ``wait_for`` names the nodes that a run waits for.  No subscriber with KEEP_ALL loses
    a message.  Simulated time starts at the release, so neither a delay before it nor the real-time
    factor changes a number.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(SIMULATOR, **options)
        names = self.declare(
            "scenes",
            ["tilt_0"],
            "scenes, in turn: names in config/scenes, or files; changed while stopped",
            read_only=False,
            allowed="names of scenes or YAML files, each once",
        )
        text = "folder of scenes that may be set while the node runs; empty: none"
        self._scene_folder = self.declare_path("scene_folder", "", text, "a folder", why_no_folder)
        overrides = self.declare(
            "overrides",
            list,
            "changes of the scenes, as buffer.c_A=13 (SI); changed while stopped",
            read_only=False,
            allowed="PART.FIELD=VALUE each, within the field's own range",
        )
        factor = self.declare(
            "rtf",
            1.0,
            "real-time factor: simulated seconds per second; 0 runs without pacing",
            low=FACTORS.low,
            high=FACTORS.high,
            read_only=False,
        )
        state = self.declare(
            "initial_state",
            "playing",
            "state of the simulation when the node has started",
            choices=("stopped", "playing", "paused"),
        )
        wait_for = self.declare(
            "wait_for",
            list,
            "nodes that every run waits for, by role or name, also nodes of your own",
            allowed="roles (recorder, capture_detector, launcher) or names of nodes",
        )
        self.outbox.reader_timeout = self.declare(
            "reader_timeout",
            10.0,
            "s (wall), after which a run continues without a subscriber that reads nothing",
            low=1.0,
            high=600.0,
        )
        self._start_timeout = self.declare(
            "start_timeout", 60.0, "s (wall), wait for the nodes in wait_for", low=1.0, high=86400.0
        )
        self._exit_when_done = self.declare(
            "exit_when_done", False, "end this process after the last run"
        )
        self._scenes = self._requested = _load(names, overrides, load_scene)
        self._names_at_start = tuple(names)
        self.control = SimulationControl(
            State[state.upper()], Pacer(factor), lambda limit: self.wait(limit=limit)
        )
        self._launcher = LauncherLink(self.control)
        self._model = RobotModel(self)
        self._diagnostics = SimulatorDiagnostics(self, self.control)
        self._simulation_services = SimulationServices(self, self.control)
        self.listen(LAUNCH_COMMAND, self._launcher.receive)
        topics = topics_of(SIMULATOR)
        self.open([*(topic for topic in topics if topic is not RUN_INFO), RUN_INFO])
        self._numbers = itertools.count(1)
        self.roll = Roll(self, SIMULATOR, on_part=self._check_part)
        self._announcer = Announcer(
            self, self.roll, RunSource.SIMULATION, wait_for, self.control.check
        )
        self.add_on_set_parameters_callback(self._may_set)
        self.add_post_set_parameters_callback(self._parameters_set)

    # callbacks

    def _check_part(self, part: Part) -> None:
        """End if a trial is on, or an older simulator or player: with two no stream is complete."""
        self._announcer.check_part(part)
        if part.role in (SIMULATOR, PLAYER) and part.number < number_of(self.roll.id):
            topic = self.resolve_topic_name(BENCH_STATE.name)
            raise CaptureSimError(
                f"another {part.role}, {part.node}, publishes {topic}: use another ROS_DOMAIN_ID "
                "or namespace"
            )

    def _may_set(self, parameters: list[Parameter]) -> SetParametersResult:
        wanted = {p.name: p.value for p in parameters if p.name in ("scenes", "overrides")}
        if wanted:
            try:
                if self.control.state is not State.STOPPED:
                    raise ParameterError(
                        f"parameter {next(iter(wanted))}: may be changed while the simulation is "
                        f"stopped; it is {self.control.state.name.lower()}"
                    )
                present = {name: self.get_parameter(name).value for name in ("scenes", "overrides")}
                names, overrides = (wanted.get(name, now) for name, now in present.items())
                self._requested = _load(names, [text for text in overrides if text], self._request)
            except CaptureSimError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _parameters_set(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == "rtf":
                self.control.pacer.factor = parameter.value
            elif parameter.name in ("scenes", "overrides"):
                self._scenes = self._requested

    def _request(self, name: str, overrides: list[str]) -> Scene:
        """Return a scene that is set over the network; one given at the start may be a file."""
        if name in self._names_at_start:
            return load_scene(name, overrides)
        return load_requested(name, overrides, self._scene_folder)

    # runs

    def work(self) -> int:
        """Run all scenes, as often as requested; return the exit status."""
        self._compile()
        sys.setswitchinterval(SWITCH_INTERVAL)
        self.freeze_objects()
        self.wait(limit=max(0.0, self.created + DISCOVERY_TIME - time.monotonic()))
        try:
            while True:
                self.wait(lambda: self.control.state is not State.STOPPED)
                if self.control.state is State.QUITTING:
                    break
                all_run = self._run_all()
                if all_run and self._exit_when_done:
                    break
                if all_run and self.control.state is State.STOPPED:
                    self.get_logger().info(
                        "all runs finished; set the state to playing to repeat them, or press "
                        "Ctrl-C to exit"
                    )
        finally:
            self._simulation_services.close()
        return self.exit_status

    def _compile(self) -> None:
        """Load the kernels; compile them if this version never was, and log how far that is."""
        if is_compiled():
            compile_kernels()
            return
        began = time.monotonic()

        def report(done: int, count: int) -> None:
            left = (time.monotonic() - began) * (count - done) / max(done, 1)
            text = f"compiling the kernels: {done} of {count}, about {left:.0f} s left"
            self.get_logger().info(text, throttle_duration_sec=5.0, skip_first=True)

        self.get_logger().info("compiling the kernels, once for this version: about half a minute")
        with watch_compilation(report):
            compile_kernels(announce=False)
        self.get_logger().info(f"compiled in {time.monotonic() - began:.0f} s")

    def _run_all(self) -> bool:
        """Run the scenes in turn; return False if a request has ended that."""
        for scene in self._scenes:
            outcome, failed = RunOutcome(cut=CutKind.RESET), False
            while outcome.cut is CutKind.RESET:
                if self.control.state in (State.STOPPED, State.QUITTING):
                    return False
                outcome = self._run_scene(scene)
                failed = failed or bool(outcome.failure) or self._has_dropped_participants()
                self.exit_status = FAILED if failed else self.exit_status
            if outcome.cut in (CutKind.STOPPED, CutKind.QUITTING):
                return False
            if failed and (not self._exit_when_done or self._has_dropped_participants()):
                break  # somebody ought to look first
        self.control.finish()
        return True

    def _has_dropped_participants(self) -> bool:
        """Return True if a reader was dropped that takes part in runs."""
        return any(part.node in self.outbox.dropped for part in self.roll.parts.values())

    def _run_scene(self, scene: Scene) -> RunOutcome:
        """Wait for the others, run a scene, and wait until they have written it."""
        gc.collect()
        self.control.begin()
        telemetry: BenchTelemetry | None = None
        failure = extremes = ""
        cut: CutKind | None = None
        try:
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
            if error is self.failure:
                raise
            failure = str(error)
        except KeyboardInterrupt:
            if telemetry is not None:
                self._end_run(telemetry, INTERRUPTED)
            raise
        if failure:
            self.get_logger().error(f"{scene.name}: {failure}")
        if telemetry is not None:
            self._end_run(telemetry, failure or ("" if cut is None else cut.value), extremes)
            failure = failure or self._await_participants(scene.name)
        cut = cut or self.control.cut_kind
        self.control.end()
        return RunOutcome(failure, cut)

    def _begin_run(self, scene: Scene) -> tuple[BenchTelemetry, bool]:
        """Announce the run; return its telemetry, and True if a launcher arms and releases."""
        cast = self._announcer.cast()
        run_id = f"{number_of(self.roll.id)}{next(self._numbers):08x}"
        description = RunDescription.of(
            scene,
            run_id,
            [SIMULATOR, *cast.publishers],
            announcer=self.roll.id,
            participants=cast.participants,
        )
        self._launcher.begin(run_id, scene)
        telemetry = BenchTelemetry(self.messages, scene, description)
        self._model.begin(scene)
        self._announcer.announce(description, telemetry.begin().data)
        return telemetry, LAUNCHER in cast.roles

    def _simulate(self, bench: Bench, telemetry: BenchTelemetry) -> str:
        """Send the run; return why it failed, or an empty text."""
        name = bench.scene.name
        self.get_logger().info(f"{name}: released")
        stepping = Stepping(bench, telemetry, self.control)
        self._diagnostics.begin(stepping)
        try:
            failure = stepping.run(self.send, self._model.move)
        finally:
            self._diagnostics.end()
        self.get_logger().info(f"{name}: done, {stepping.count} samples, {stepping.figures}")
        return failure

    def _end_run(self, telemetry: BenchTelemetry, reason: str, extremes: str = "") -> None:
        """Wait until all that was sent has arrived, then report the counts."""
        for sent in telemetry.rest():
            self.publish(sent)
        self._announcer.await_read()
        self.publish(telemetry.end(reason, extremes))

    def _await_participants(self, name: str) -> str:
        """Wait until the other nodes have received and written the run; return their failures."""
        try:
            self._announcer.await_done()
        except CaptureSimError as error:
            if error is self.failure:
                raise
            self.get_logger().error(f"{name}: {error}")
            return str(error)
        finally:
            self._announcer.close()
        return ""


def _plan(scene: Scene, armed: Any) -> LaunchPlan:
    """Return the launch with the mass and height that a launcher has set, if one has."""
    if scene.string is None or armed is None:
        return plan_launch(scene)
    fitted = replace(
        scene.string,
        impact_speed=None,
        hanging_mass=armed.hanging_mass,
        drop_height=armed.drop_height,
    )
    return plan_launch(replace(scene, string=fitted))


def _load(
    names: Sequence[str],
    overrides: Sequence[str],
    load: Callable[[str, list[str]], Scene],
) -> list[Scene]:
    """Return the scenes; reject a scene that could not be launched."""
    if not names:
        raise ParameterError("parameter scenes = []: must be names of scenes, one at least")
    scenes = [load(name, list(overrides)) for name in names]
    for scene in scenes:
        plan_launch(scene)
    if len({scene.name for scene in scenes}) != len(scenes):
        raise ParameterError(
            f"parameter scenes = {list(names)!r}: must be experiments of different names"
        )
    return scenes


main = partial(run, SimulatorNode)

if __name__ == "__main__":
    raise SystemExit(main())
