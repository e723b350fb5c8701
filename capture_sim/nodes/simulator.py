"""The node that runs the bench and publishes what it measures."""

from __future__ import annotations

import gc
import itertools
import re
import sys
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import ListParameters
from rclpy.parameter import Parameter
from std_msgs.msg import Empty

from capture_sim.bench import Bench, compile_kernels
from capture_sim.compile_progress import watch_compilation
from capture_sim.control.pacing import FACTORS, Pacer
from capture_sim.control.simulation import RunCut, SimulationControl, State
from capture_sim.errors import CaptureSimError, MessageError
from capture_sim.kernels import is_compiled
from capture_sim.launch.plan import LaunchPlan, plan_launch
from capture_sim.launch.scenes import load_scene
from capture_sim.messages.convert import LaunchAction, RunDescription
from capture_sim.messages.telemetry import BenchTelemetry
from capture_sim.messages.topics import (
    BENCH_STATE,
    CAPTURE_DETECTOR,
    CAPTURE_STATUS,
    LAUNCH_COMMAND,
    LAUNCHER,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    Topic,
    topics_of,
)
from capture_sim.nodes.barrier import Barrier
from capture_sim.nodes.diagnostics import SimulatorDiagnostics
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.parameters import ParameterError
from capture_sim.nodes.participant import INTERRUPTED, RECORDER
from capture_sim.nodes.process import run
from capture_sim.nodes.robot_model import RobotModel
from capture_sim.nodes.services import SimulationServices
from capture_sim.nodes.start import FAILED, OK
from capture_sim.nodes.stepping import Stepping
from capture_sim.scene.parts import Scene

INFO = (
    "capture_sim: a step is one sample, 1 / run.state_rate s. Reset is of time and state together "
    "(scope 0, 3, 7 or 255) and keeps playing or paused. Worlds are experiments: set the "
    "parameters scenes and overrides while stopped."
)
#: Nodes that may be awaited.
ROLES = (RECORDER, CAPTURE_DETECTOR, LAUNCHER)
#: After a run the other nodes get this long to close their files, s (wall).
END_TIMEOUT = 60.0
#: The counts that end a run arrive within this long, s (wall).
COUNTS_TIMEOUT = 1.0
#: Python hands over between threads this often, s; its own 5 ms would make ticks late.
SWITCH_INTERVAL = 2e-4
#: Another simulator on the same topics, perhaps one that was killed, gets this long to leave, s
#: (wall): longer than DDS needs to notice (config/fast_dds*.xml, leaseDuration).
SECOND_SIMULATOR_TIMEOUT = 8.0
#: Hidden topic, without messages, by whose name simulators learn which of them is older.
SESSION = "bench/_simulator_"
#: Nodes discover each other within this long after one was created, s (wall), as a rule.
DISCOVERY = 0.3
_RUN_ID = re.compile("[0-9a-f]{32}")


@dataclass
class _Run:
    """A run that is announced: its scene, and the commands of the launcher."""

    scene: Scene
    id: str = ""
    armed: Any = None  # LaunchCommand
    released: bool = False


class SimulatorNode(BenchNode):
    """Runs scenes one after another.

    Alone it launches by its own plan and publishes; a launcher that is there takes over.  The
    parameter ``consumers`` names the nodes that a run waits for.  No subscriber with KEEP_ALL loses
    a message.  Simulated time starts at the release, so neither a delay before it nor the real-time
    factor changes a number.

    The main thread steps the bench; callbacks have a thread of their own.
    """

    has_coroutines = True

    def __init__(self) -> None:
        super().__init__(SIMULATOR)
        names = self.declare(
            "scenes",
            ["tilt_0"],
            "scenes, in turn: names in config/scenes, or files; changed while stopped",
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
        consumers = self.declare(
            "consumers", list, "roles of the nodes that every run waits for", choices=ROLES
        )
        self.reader_timeout = self.declare(
            "consumer_timeout",
            10.0,
            "s (wall), after which a run continues without a subscriber that reads nothing",
            low=1.0,
            high=600.0,
        )
        self._start_timeout = self.declare(
            "start_timeout", 60.0, "s (wall), wait for the consumers", low=1.0, high=86400.0
        )
        self._exit_when_done = self.declare(
            "exit_when_done", False, "end this process after the last run"
        )
        self._scenes = _load(names, overrides)
        self._consumers = consumers
        self.control = SimulationControl(State[state.upper()], Pacer(factor))
        streams = topics_of(SIMULATOR)
        self._barrier = Barrier(self, consumers, streams, (SIMULATOR,), self.control.check)
        # run ids begin with it: those of an older simulator are smaller
        self._session = f"{time.time_ns():016x}{uuid.uuid4().hex[:8]}"
        self._numbers = itertools.count(1)
        self._run = _Run(self._scenes[0])
        self._telemetry: BenchTelemetry | None = None  # of the run that is on
        self._description: RunDescription  # of the last run that was announced
        self.open(topics_of(SIMULATOR))
        self.create_publisher(Empty, f"{SESSION}{self._session}", 1)
        self._model = RobotModel(self)
        self._diagnostics = SimulatorDiagnostics(self, self.control)
        self._simulation_services = SimulationServices(self, self.control, INFO)
        self.listen(LAUNCH_COMMAND, self._commanded)
        self.listen(RUN_INFO, self._run_announced)
        self.add_on_set_parameters_callback(self._may_set)
        self.add_post_set_parameters_callback(self._parameters_set)

    # callbacks

    def _commanded(self, command: Any) -> None:
        with self.control.changed:
            if command.run_id != self._run.id:
                return  # latched by an earlier run
            if command.action == LaunchAction.ARM:
                try:
                    _plan(self._run.scene, command)
                except CaptureSimError as error:
                    raise MessageError(str(error)) from None
                self._run.armed = command
            elif command.action == LaunchAction.RELEASE:
                self._run.released = True
            elif command.action == LaunchAction.ABORT:
                self.control.cut("aborted by the launcher")
            else:
                raise MessageError(f"action = {command.action}: must be 1 to 3")

    def _run_announced(self, info: Any) -> None:
        """End if an older simulator publishes here: with two on a topic no stream is complete."""
        simulated = SIMULATOR in info.publishers and _RUN_ID.fullmatch(info.run_id)
        if simulated and info.run_id[: len(self._session)] < self._session:
            self.fail(CaptureSimError(self._second_simulator()))

    def _second_simulator(self) -> str:
        topic = self.resolve_topic_name(BENCH_STATE.name)
        return f"another simulator publishes {topic}: use another ROS_DOMAIN_ID or namespace"

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
            if parameter.name == "rtf":
                self.control.set_factor(parameter.value)
            elif parameter.name in ("scenes", "overrides"):
                self._scenes = _load(*self._scene_parameters({}))

    def _scene_parameters(self, wanted: dict[str, Any]) -> tuple[list[str], list[str]]:
        present = {name: self.get_parameter(name).value for name in ("scenes", "overrides")}
        present.update(wanted)
        return list(present["scenes"]), [change for change in present["overrides"] if change]

    # in the main thread

    def work(self) -> int:
        """Run all scenes, as often as requested; return the exit status."""
        self._compile()
        sys.setswitchinterval(SWITCH_INTERVAL)
        gc.collect()
        gc.freeze()  # out of all later sweeps: over it one takes longer than a tick
        time.sleep(max(0.0, self.created + DISCOVERY - time.monotonic()))
        self._check_only_simulator()
        status = OK
        try:
            while self.control.await_start() is not State.QUITTING:
                done, failed = self._go_through_all()
                if failed:
                    status = FAILED
                if done and self._exit_when_done:
                    break
                if done and self.control.state is State.STOPPED:
                    self.get_logger().info(
                        "all runs finished; set the state to playing to repeat them, or press "
                        "Ctrl-C to exit"
                    )
        finally:
            self._simulation_services.close()
        return status

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

    def stalled_readers(self, topic: Topic) -> list[str]:
        """Return the readers of a topic that do not respond, or all if all respond."""
        clients = {
            name: self.create_client(ListParameters, f"{name}/list_parameters")
            for name in super().stalled_readers(topic)
        }
        time.sleep(DISCOVERY)
        answers = {
            name: client.call_async(ListParameters.Request())
            for name, client in clients.items()
            if client.service_is_ready()  # a listener of `ros2 topic` has none
        }
        time.sleep(1.0)
        silent = [name for name, answer in answers.items() if not answer.done()]
        for client in clients.values():
            # in the thread that waits for it, or that wait may fail
            self.executor.create_task(self.destroy_client, client)
        return silent or list(clients)

    def _check_only_simulator(self) -> None:
        """End if an older simulator, or a player, publishes here; give it time to leave."""
        self._barrier.wait("start", self._rival, SECOND_SIMULATOR_TIMEOUT)

    def _rival(self) -> str:
        """Return that another node publishes here which stays: not a younger simulator."""
        prefix = self.resolve_topic_name(SESSION)
        names = [name for name, _ in self.get_topic_names_and_types()]
        sessions = [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
        is_oldest = min(sessions, default=self._session) >= self._session
        others = self.publishers_of(BENCH_STATE) - max(len(sessions), 1)
        return "" if is_oldest and others <= 0 else self._second_simulator()

    def _go_through_all(self) -> tuple[bool, bool]:
        """Run the scenes in turn; return whether all have been run, and whether one failed."""
        failed = False
        for scene in self._scenes:
            again = True
            while again:
                if self.control.state in (State.STOPPED, State.QUITTING):
                    return False, failed
                failure, again, stopped = self._go_through(
                    _Run(scene, f"{self._session}{next(self._numbers):08x}")
                )
                dropped = self.participants(self.dropped_readers)
                failed = failed or bool(failure or dropped)
                if stopped and not failure:
                    return False, failed
            if failed and (not self._exit_when_done or dropped):
                break  # somebody ought to look first
        self.control.finish()
        return True, failed

    def _go_through(self, announced: _Run) -> tuple[str, bool, bool]:
        """Go through a run; return why it failed, whether it is to be repeated, and was stopped."""
        gc.collect()
        with self.control.changed:
            self._run = announced
        name = announced.scene.name
        self.control.begin()
        failure, cut = "", None
        try:
            self._barrier.wait(name, self._barrier.all_there, self._start_timeout)
            launched_by_hand = self._begin_run()
            self.control.ready()
            if launched_by_hand:
                self._barrier.wait(name, self._launched, None)
            failure = self._simulate(
                Bench(announced.scene, _plan(announced.scene, self._run.armed))
            )
        except RunCut as request:
            cut = request
            if not request.asked_for:
                failure = str(request)
        except CaptureSimError as error:
            failure = str(error)
        except KeyboardInterrupt:
            if self._telemetry is not None:
                self._end_run(INTERRUPTED)
            raise
        if failure:
            self.get_logger().error(f"{name}: {failure}")
        if self._telemetry is not None:
            self._end_run(failure or ("" if cut is None else str(cut)))
            failure = failure or self._await_participants(name)
        self.control.end(failure)
        return failure, cut is not None and cut.again, cut is not None and not cut.again

    def _begin_run(self) -> bool:
        """Announce the run; return True if a launcher is there to arm and release."""
        scene = self._run.scene
        launcher = self.publishers_of(LAUNCH_COMMAND) > 0
        reporting = [SIMULATOR, *[LAUNCHER] * launcher]
        if self.publishers_of(CAPTURE_STATUS):
            reporting.append(CAPTURE_DETECTOR)
        self._description = description = RunDescription.of(
            scene, self._run.id, reporting, consumers=self._consumers
        )
        self._barrier.begin(self._run.id)
        self._telemetry = BenchTelemetry(self.messages, scene, description)
        self._model.begin(scene)
        self.publish(self._telemetry.begin())
        self.drain(self.reader_timeout, [RUN_INFO])  # it comes before all else of the run
        return launcher

    def _simulate(self, bench: Bench) -> str:
        """Send the run; return why it failed, or nothing."""
        assert self._telemetry is not None
        name = bench.scene.name
        self.get_logger().info(f"{name}: released")
        stepping = Stepping(bench, self._telemetry, self.control)
        self._diagnostics.begin(stepping)
        try:
            failure = stepping.run(self.send, self._model.move)
        finally:
            self._diagnostics.end()
        self.get_logger().info(f"{name}: done, {stepping.count} samples, {stepping.figures}")
        return failure

    def _launched(self) -> str:
        return "" if self._run.armed and self._run.released else "waiting for the release"

    def _end_run(self, reason: str) -> None:
        """Wait until all that was sent has arrived, then report the counts."""
        assert self._telemetry is not None
        for sent in self._telemetry.rest():
            self.publish(sent)
        if not self.drain(self.reader_timeout) and not reason and not self.dropped_readers:
            for topic in self.unread()[:1]:
                self.report_stalled_readers(topic)
        self.publish(self._telemetry.end(complete=not reason, reason=reason))
        self._telemetry = None

    def _await_participants(self, name: str) -> str:
        """Wait until the other nodes have received and written the run; return what failed."""
        try:
            self.drain(COUNTS_TIMEOUT, [STREAM_COUNTS])
            self._barrier.wait(name, self._barrier.all_ended, END_TIMEOUT)
        except RunCut:
            pass
        except CaptureSimError as error:
            self.get_logger().error(f"{name}: {error}")
            return str(error)
        finally:
            self.send_run_info(replace(self._description, run_id=""))  # no run is on
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


def _load(names: Sequence[str], overrides: Sequence[str]) -> list[Scene]:
    """Return the scenes; rejects those that could not be launched later."""
    if not names:
        raise ParameterError("parameter scenes = []: must be names of scenes, one at least")
    scenes = [load_scene(name, list(overrides)) for name in names]
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
