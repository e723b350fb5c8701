"""The node that runs the bench and publishes what it measures, no faster than it is read."""

from __future__ import annotations

import itertools
import sys
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from capture_sim.bench import Bench, compile_kernels
from capture_sim.control.pacing import FACTORS, Pacer
from capture_sim.control.simulation import RunCut, SimulationControl, State
from capture_sim.errors import CaptureSimError
from capture_sim.kernels import is_compiled
from capture_sim.launch.plan import LaunchPlan, plan_launch
from capture_sim.launch.scenes import load_scene
from capture_sim.messages.convert import LaunchAction, RunDescription
from capture_sim.messages.telemetry import BenchTelemetry
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    LAUNCH_COMMAND,
    LAUNCHER,
    RUN_INFO,
    SIMULATOR,
    STREAM_ACK,
    STREAM_COUNTS,
    topics_of,
)
from capture_sim.nodes.diagnostics import SimulatorDiagnostics
from capture_sim.nodes.flow_control import ACK_EVERY, Followers, samples_between_acks
from capture_sim.nodes.following import INTERRUPTED, RECORDER
from capture_sim.nodes.gathering import Gathering
from capture_sim.nodes.memory import set_memory_aside, sweep_memory
from capture_sim.nodes.robot_model import RobotModel
from capture_sim.nodes.running import FAILED, OK, BenchNode, ParameterError, run
from capture_sim.nodes.simulation_services import SimulationServices
from capture_sim.nodes.stepping import Stepping
from capture_sim.scene.parts import Scene

#: After a run its followers get this long to close their files, s (wall).
CLOSING_TIME = 60.0
#: Python hands over between threads this often, s; its own 5 ms would make ticks late.
SWITCH_INTERVAL = 2e-4


@dataclass
class _Run:
    """A run that is announced: what is run, and what the launcher has said about it."""

    scene: Scene
    id: str = ""
    armed: Any = None  # LaunchCommand
    released: bool = False


class SimulatorNode(BenchNode):
    """Runs scenes one after another.

    For each it announces the run, waits until its followers have taken it up and the
    launcher has armed and released, and sends the samples: at most a window ahead of the
    slowest follower.  Simulated time starts at the release, so no delay before it, and no
    pace after it, changes a number.

    The main thread steps the bench; callbacks and services have threads of their own.
    """

    def __init__(self) -> None:
        super().__init__(SIMULATOR)
        names = self.declare(
            "scenes",
            ["tilt_0"],
            "experiments, in turn: names in config/scenes, or files; changed while stopped",
            read_only=False,
            allowed="names of scenes or YAML files, each once",
        )
        overrides = self.declare(
            "overrides",
            list,
            "changes of the scenes, as buffer.c_A=13 (SI); changed while stopped",
            read_only=False,
            allowed="PART.FIELD=VALUE each, within the field's own range",
        )
        factor = self.declare(
            "pace",
            0.0,
            "real-time factor: simulated seconds per second; 0 as fast as it goes",
            low=FACTORS.low,
            high=FACTORS.high,
            read_only=False,
        )
        state = self.declare(
            "initial_state",
            "playing",
            "of the simulation, when the node has started",
            allowed="stopped, playing or paused",
            check=_check_state,
        )
        consumers = self.declare(
            "consumers",
            [RECORDER, CAPTURE_DETECTOR, LAUNCHER],
            "nodes that take part: awaited at the start, never outrun",
            allowed="names of nodes, each once",
        )
        self._window = self.declare(
            "window", 200, "samples that may be ahead of the slowest consumer", low=200, high=900
        )
        timeout = self.declare(
            "consumer_timeout",
            3.0,
            "s (wall), after which a consumer that is silent or stands still is left behind",
            low=1.0,
            high=600.0,
        )
        self._patience = self.declare(
            "start_timeout", 60.0, "s (wall), wait for the consumers", low=1.0, high=86400.0
        )
        self._exit_when_done = self.declare(
            "exit_when_done", False, "end this process after the last run"
        )
        consumers = [name for name in consumers if name]  # ROS has no empty list: [""] is none
        if len(set(consumers)) != len(consumers):
            raise ParameterError(
                f"parameter consumers = {list(consumers)!r}: allowed are names of nodes, each once"
            )
        self._scenes = _load(names, overrides)
        self._reporting = [SIMULATOR, *(name for name in consumers if topics_of(name))]
        self._followers = Followers(consumers, timeout)
        self.control = SimulationControl(
            State[state.upper()], Pacer(factor), changed=self._followers.changed
        )
        self._gathering = Gathering(
            self, self._followers, self.control, replaced=not self._exit_when_done
        )
        # run ids of one simulator begin alike, so that another's are known for what they are
        self._session = uuid.uuid4().hex[:24]
        self._numbers = itertools.count(1)
        self._run = _Run(self._scenes[0])
        self._telemetry: BenchTelemetry | None = None  # of the run that is on
        self._rival = ""  # experiment of another simulator on the same topics
        self.open(topics_of(SIMULATOR))
        self._model = RobotModel(self)
        self._diagnostics = SimulatorDiagnostics(self, self.control)
        self._served = SimulationServices(self, self.control)
        self.listen(STREAM_ACK, self._heard)
        self.listen(LAUNCH_COMMAND, self._commanded)
        self.listen(RUN_INFO, self._announced)
        self.add_on_set_parameters_callback(self._may_set)
        self.add_post_set_parameters_callback(self._parameters_set)

    # callbacks

    def _heard(self, ack: Any) -> None:
        self._followers.heard(ack.consumer, ack.run_id, ack.received)

    def _commanded(self, command: Any) -> None:
        with self._followers.changed:
            if command.run_id != self._run.id:
                return  # latched by an earlier run
            if command.action == LaunchAction.ARM:
                self._run.armed = command
            elif command.action == LaunchAction.RELEASE:
                self._run.released = True
            elif command.action == LaunchAction.ABORT:
                self.control.cut("aborted by the launcher")
            self._followers.changed.notify_all()

    def _announced(self, info: Any) -> None:
        """Take note of another simulator: with two on one topic, no stream would be whole."""
        with self._followers.changed:
            session = info.run_id[: len(self._session)]
            if session == self._session:
                return
            self._rival = info.name
            # both hear each other; the run that is on stays, of two the smaller number
            if self._telemetry is None or session < self._session:
                self.control.cut(self._rivalry())

    def _rivalry(self) -> str:
        topic = self.resolve_topic_name(RUN_INFO.name)
        return (
            f"another simulator, with {self._rival}, publishes {topic}: "
            "use another ROS_DOMAIN_ID or namespace"
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
                _load(*self._scene_parameters(wanted))
            except CaptureSimError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _parameters_set(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == "pace":
                self.control.set_factor(parameter.value)
            elif parameter.name in ("scenes", "overrides"):
                self._scenes = _load(*self._scene_parameters({}))

    def _scene_parameters(self, wanted: dict[str, Any]) -> tuple[list[str], list[str]]:
        present = {name: self.get_parameter_or(name).value for name in ("scenes", "overrides")}
        present.update(wanted)
        return list(present["scenes"] or ()), list(present["overrides"] or ())

    # in the main thread

    def work(self) -> int:
        """Run all scenes, as often as is asked for; return the exit status."""
        if not is_compiled():
            self.get_logger().info("compiling the kernels, once: some ten seconds")
        compile_kernels()
        sys.setswitchinterval(SWITCH_INTERVAL)
        set_memory_aside()
        status = OK
        while self.control.await_start() is not State.QUITTING:
            done, failed = self._go_through_all()
            if failed:
                status = FAILED
            if done and self._exit_when_done:
                break
            if done and self.control.state is State.STOPPED:
                self.get_logger().info("all runs are over; play runs them again, Ctrl-C ends")
        return status

    def interrupted(self) -> None:
        """Tell the followers that the run has ended early."""
        if self._telemetry is not None:
            self._end_run(INTERRUPTED)
            self.linger(STREAM_COUNTS)

    def destroy_node(self) -> None:
        """End the services, then the node."""
        self.control.close()
        self._served.close()
        super().destroy_node()

    def _go_through_all(self) -> tuple[bool, bool]:
        """Run the scenes in turn; return whether they are through, and whether one failed."""
        failed = False
        for scene in self._scenes:
            again = True
            while again:
                if self.control.state in (State.STOPPED, State.QUITTING):
                    return False, failed
                failure, again, stopped = self._go_through(
                    _Run(scene, f"{self._session}{next(self._numbers):08x}")
                )
                failed = failed or bool(failure or self._followers.lost)
                if stopped and not failure:
                    return False, failed
            if failed and (not self._exit_when_done or self._followers.lost or self._rival):
                break  # nobody there to see the others, or somebody ought to look first
        self.control.finish()
        return True, failed

    def _go_through(self, announced: _Run) -> tuple[str, bool, bool]:
        """Go through a run; return why it failed, whether it begins anew, and was stopped."""
        sweep_memory()
        with self._followers.changed:
            self._run = announced
        self.control.begin()
        failure, cut = "", None
        try:
            if self._rival and self.count_publishers(self.placed(RUN_INFO)) > 1:
                raise CaptureSimError(self._rivalry())
            self._rival = ""
            self._await(self._gathering.all_free, self._patience)
            self._begin_run()
            self._await(lambda: self._gathering.all_ready(announced.id), self._patience)
            self.control.ready()
            self._await(self._launched, None)
            self._followers.start(announced.id)
            failure = self._simulate(Bench(announced.scene, self._commanded_plan()))
        except RunCut as asked:
            cut = asked
            if not asked.asked_for:
                failure = str(asked)
        except CaptureSimError as error:
            failure = str(error)
        if failure:
            self._complain(failure)
        if self._telemetry is not None:
            self._end_run(failure or ("" if cut is None else str(cut)))
        if cut is None:
            failure = failure or self._see_off()
        self.control.end(failure)
        return failure, cut is not None and cut.again, cut is not None and not cut.again

    def _begin_run(self) -> None:
        scene = self._run.scene
        description = RunDescription.of(
            scene, self._run.id, self._reporting, consumers=self._followers.names
        )
        with self._followers.changed:
            self._telemetry = BenchTelemetry(self.messages, scene, description)
        self._model.begin(scene)
        self.publish(self._telemetry.begin())

    def _simulate(self, bench: Bench) -> str:
        """Send the whole run; return why it failed, or nothing."""
        assert self._telemetry is not None
        name = bench.scene.name
        self.get_logger().info(f"{name}: released")
        stepping = Stepping(bench, self._telemetry, self.control)
        self._diagnostics.begin(stepping)
        try:
            failure = stepping.run(self.send, self._leave_room, self._model.move)
        finally:
            self._diagnostics.end()
        self.get_logger().info(f"{name}: done, {stepping.count} samples, {stepping.figures}")
        return failure

    def _commanded_plan(self) -> LaunchPlan:
        """Return the launch with the mass and height that the launcher has set."""
        scene = self._run.scene
        if scene.string is None:
            return plan_launch(scene)
        fitted = replace(
            scene.string,
            impact_speed=None,
            hanging_mass=self._run.armed.hanging_mass,
            drop_height=self._run.armed.drop_height,
        )
        return plan_launch(replace(scene, string=fitted))

    def _end_run(self, reason: str) -> None:
        """Say how much was sent."""
        assert self._telemetry is not None
        for sent in self._telemetry.rest():
            self.publish(sent)
        self.publish(self._telemetry.end(complete=not reason, reason=reason))
        self._telemetry = None

    def _see_off(self) -> str:
        """Give the followers time to take in and write what was sent; return what failed."""
        try:
            self._await(self._gathering.all_closed, CLOSING_TIME)
        except RunCut:
            pass
        except CaptureSimError as error:
            self._complain(str(error))
            return str(error)
        return ""

    def _complain(self, failure: str) -> None:
        self.get_logger().error(f"{self._run.scene.name}: {failure}")

    # what is waited for

    def _leave_room(self, count: int) -> None:
        run = self._run.scene.run
        lot = samples_between_acks(run.state_rate, run.rate)
        # with many messages a sample fewer samples are a transport's fill
        window = self._window if lot == ACK_EVERY else 2 * lot
        for name in self._followers.wait_for(count - window, self._run.id):
            self._complain(f"{name}: {self._followers.lost[name]}; the run goes on without it")

    def _launched(self) -> str:
        return "" if self._run.armed and self._run.released else "waiting for the release"

    def _await(self, lacking: Callable[[], str], limit: float | None) -> None:
        self._gathering.wait(self._run.scene.name, lacking, limit)


def _load(names: Sequence[str], overrides: Sequence[str]) -> list[Scene]:
    """Return the scenes; refuses here what could not be launched later."""
    if not names:
        raise ParameterError("parameter scenes = []: allowed are names of scenes, one at least")
    scenes = [load_scene(name, list(overrides)) for name in names]
    for scene in scenes:
        plan_launch(scene)
    if len({scene.name for scene in scenes}) != len(scenes):
        raise ParameterError(
            f"parameter scenes = {list(names)!r}: allowed are experiments of different names"
        )
    return scenes


def _check_state(value: str) -> None:
    if value not in ("stopped", "playing", "paused"):
        raise ParameterError(
            f"parameter initial_state = {value!r}: allowed is stopped, playing or paused"
        )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; return the exit status."""
    return run(SimulatorNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
