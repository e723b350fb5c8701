"""The node that simulates the bench and publishes its measurements."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from capture_sim.base.compiled.progress import watch_compilation
from capture_sim.base.exit_status import FAILED
from capture_sim.base.files import folder_problem
from capture_sim.dynamics.compilation import compile_kernels, is_compiled
from capture_sim.errors import CaptureSimError
from capture_sim.messages.topics import (
    SIMULATOR,
)
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.base.parameters import ParameterError
from capture_sim.nodes.base.process import run
from capture_sim.nodes.protocol.ends import CutKind
from capture_sim.nodes.simulation.control import SimulationControl, State
from capture_sim.nodes.simulation.pacing import RunPacer
from capture_sim.nodes.simulation.services import SimulationServices
from capture_sim.nodes.simulation.simulated_runs import RunOutcome, SimulatedRuns
from capture_sim.scene.launch_plan import plan_launch
from capture_sim.scene.loading import load_requested, load_scene
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import REAL_TIME_FACTORS

#: A paced simulator hands its GIL over this often, s: Python's own 5 ms would make ticks late.
SWITCH_INTERVAL = 2e-4


class SimulatorNode(BenchNode):
    """Simulates scenes one after another and publishes each run.

    If a launcher is running, the launcher arms and releases; otherwise the simulator does so by
    itself, after the launch plan of the scene.  The parameter ``wait_for`` names the nodes that a
    run waits for.  No subscriber with history KEEP_ALL loses a message: the simulator waits while
    such a subscriber reads nothing, for ``reader_timeout`` at most.  Simulated time is zero at the
    release, so neither a delay before it nor the real-time factor changes a number.
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
        self._scene_folder = self.declare_path("scene_folder", "", text, "a folder", folder_problem)
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
            low=REAL_TIME_FACTORS.low,
            high=REAL_TIME_FACTORS.high,
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
            "nodes that every run waits for, by role or name, also nodes of your own; list a "
            "name twice to wait for two such nodes",
            allowed="roles (recorder, capture_detector, launcher) or names of nodes",
        )
        self.topic_publishers.reader_timeout = self.declare(
            "reader_timeout",
            15.0,
            "s (wall), after which a run continues without a subscriber that reads nothing",
            low=1.0,
            high=600.0,
        )
        start_timeout = self.declare(
            "start_timeout", 60.0, "s (wall), wait for the nodes in wait_for", low=1.0, high=86400.0
        )
        self._exit_when_done = self.declare(
            "exit_when_done", False, "end this process after the last run"
        )
        self._scenes = self._requested = _load(names, overrides, load_scene)
        self._names_at_start = tuple(names)
        self.control = SimulationControl(
            State[state.upper()], RunPacer(factor), lambda limit: self.wait(limit=limit)
        )
        self._simulation_services = SimulationServices(self, self.control)
        self._runs = SimulatedRuns(self, self.control, wait_for, start_timeout)
        self.add_on_set_parameters_callback(self._may_set)
        self.add_post_set_parameters_callback(self._parameters_set)

    # callbacks

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
        """Return the scene of a name that is set while the node runs.

        A name that was given at the start may be any file.  Others are packaged scenes or scenes of
        ``scene_folder``, so that nobody opens other files over the network.
        """
        if name in self._names_at_start:
            return load_scene(name, overrides)
        return load_requested(name, overrides, self._scene_folder)

    # runs

    def work(self) -> int:
        """Run all scenes each time that the state is set to playing; return the exit status."""
        self._compile()
        sys.setswitchinterval(SWITCH_INTERVAL)
        self.freeze_objects()
        try:
            while True:
                self.wait(lambda: self.control.state is not State.STOPPED)
                if self.control.state is State.QUITTING:
                    break
                all_run = self._run_all()
                if self._runs.has_met_trial or (all_run and self._exit_when_done):
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
        """Load the compiled kernels; if there are none yet, compile them and log the progress."""
        if is_compiled():
            compile_kernels()
            return
        began = time.monotonic()

        def report(done: int, count: int) -> None:
            left = (time.monotonic() - began) * (count - done) / max(done, 1)
            text = f"compiling the kernels: {done} of {count}, about {left:.0f} s left"
            self.get_logger().info(text, throttle_duration_sec=5.0, skip_first=True)

        self.get_logger().info("compiling the kernels, once for this version: about half a minute")
        with watch_compilation(report), self._runs.roll.keep_reporting():
            compile_kernels(announce=False)
        self.get_logger().info(f"compiled in {time.monotonic() - began:.0f} s")

    def _run_all(self) -> bool:
        """Run the scenes in turn; return False if they did not come to their end.

        They do not if the simulation is stopped, the node is to quit, or a trial of a real bench
        is on.  A run that is reset begins anew.
        """
        for scene in self._scenes:
            outcome, failed = RunOutcome(cut=CutKind.RESET), False
            while outcome.cut is CutKind.RESET:
                if self.control.state in (State.STOPPED, State.QUITTING):
                    return False
                outcome = self._runs.run(scene)
                failed = failed or bool(outcome.failure) or self._runs.has_dropped_participants()
                self.exit_status = FAILED if failed else self.exit_status
                if self._runs.has_met_trial:
                    return False
            if outcome.cut in (CutKind.STOPPED, CutKind.QUITTING):
                return False
            if failed and (not self._exit_when_done or self._runs.has_dropped_participants()):
                break  # the operator decides what to do about it before the next run begins
        self.control.finish()
        return True


def _load(
    names: Sequence[str],
    overrides: Sequence[str],
    load: Callable[[str, list[str]], Scene],
) -> list[Scene]:
    """Return the scenes of these names with the overrides.

    CaptureSimError if a scene cannot be loaded or launched, if none is named, or if two experiments
    have the same name.
    """
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
