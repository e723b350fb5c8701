"""The node that runs the bench and publishes what it measures, no faster than it is read."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from capture_sim.bench import Bench, compile_kernels
from capture_sim.errors import CaptureSimError, SimulationError
from capture_sim.kernels import is_compiled
from capture_sim.launching import LaunchPlan, plan_launch
from capture_sim.messages import LaunchAction, RunDescription
from capture_sim.nodes.flow_control import POLL, Followers
from capture_sim.nodes.following import FOLLOWED, INTERRUPTED, RECORDER
from capture_sim.nodes.running import (
    FAILED,
    OK,
    BenchNode,
    ParameterError,
    run,
)
from capture_sim.scene import Scene
from capture_sim.scene_files import load_scene
from capture_sim.telemetry import BenchTelemetry
from capture_sim.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    CAPTURE_DETECTOR,
    LAUNCH_COMMAND,
    LAUNCHER,
    SIMULATOR,
    STREAM_ACK,
    STREAM_COUNTS,
    topics_of,
)

#: Samples that the core computes at a time.
BLOCK = 100
#: ... fewer when they would stand for more wall time than this, s.
BLOCK_TIME = 0.05
#: Progress is said this often, s (wall).
REPORT_PERIOD = 2.0
#: After a run its followers get this long to close their files, s (wall).
CLOSING_TIME = 60.0


@dataclass
class _Run:
    """A run that is announced: what is run, and what the launcher has said about it."""

    scene: Scene
    id: str = field(default_factory=lambda: uuid.uuid4().hex)
    armed: Any = None  # LaunchCommand
    released: bool = False
    aborted: bool = False


class Pacer:
    """Lets simulated time pass at a given rate of wall time; what is late is not waited for.

    Parameters
    ----------
    pace
        Simulated seconds per second; 0 does not wait at all.
    """

    def __init__(self, pace: float) -> None:
        self._pace = pace
        self._start = time.monotonic()

    def wait_for(self, t: float) -> None:
        """Wait until t, s since the release, is due."""
        if self._pace > 0.0:
            delay = self._start + t / self._pace - time.monotonic()
            if delay > 0.0:
                time.sleep(delay)


class SimulatorNode(BenchNode):
    """Runs scenes one after another.

    For each it announces the run, waits until its followers have taken it up and the
    launcher has armed and released, and sends the samples: at most a window ahead of the
    slowest follower.  Simulated time starts at the release, so no delay before it, and no
    pace after it, changes a number.
    """

    def __init__(self) -> None:
        super().__init__(SIMULATOR)
        names = self.declare(
            "scenes", ["tilt_0"], "experiments, in turn: names in config/scenes, or files"
        )
        overrides = self.declare("overrides", list, "changes of the scenes, as buffer.c_A=13 (SI)")
        self._pace = self.declare(
            "pace", 0.0, "simulated seconds per second; 0 as fast as it goes", low=0.0, high=1000.0
        )
        consumers = self.declare(
            "consumers",
            [RECORDER, CAPTURE_DETECTOR, LAUNCHER],
            "nodes that take part: awaited at the start, never outrun",
        )
        self._window = self.declare(
            "window", 800, "samples that may be ahead of the slowest consumer", low=200, high=900
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
        if not all(consumers) or len(set(consumers)) != len(consumers):
            raise ParameterError(
                f"parameter consumers = {list(consumers)!r}: allowed are names of nodes, each once"
            )
        self._scenes = [load_scene(name, overrides) for name in names]
        for scene in self._scenes:
            plan_launch(scene)  # refuses here what could not be launched later
        if len({scene.name for scene in self._scenes}) != len(self._scenes):
            raise ParameterError(
                f"parameter scenes = {list(names)!r}: allowed are experiments of different names"
            )
        self._reporting = [SIMULATOR, *(name for name in consumers if topics_of(name))]
        self._followers = Followers(consumers, timeout)
        self._run = _Run(self._scenes[0])
        self._telemetry: BenchTelemetry | None = None  # of the run that is on
        self.open(topics_of(SIMULATOR))
        self.listen(STREAM_ACK, self._heard)
        self.listen(LAUNCH_COMMAND, self._commanded)

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
                self._run.aborted = True
            self._followers.changed.notify_all()

    # in the main thread

    def work(self) -> int:
        """Run all scenes; return the exit status."""
        if not is_compiled():
            self.get_logger().info("compiling the kernels, once: some ten seconds")
        compile_kernels()
        status = OK
        for scene in self._scenes:
            if self._go_through(_Run(scene)):
                status = FAILED
            if self._followers.lost:
                status = FAILED
                break
        if not self._exit_when_done:
            self.get_logger().info("all runs are over; Ctrl-C ends this node")
            threading.Event().wait()
        return status

    def interrupted(self) -> None:
        """Tell the followers that the run has ended early."""
        if self._telemetry is not None:
            self._end_run(INTERRUPTED)
            self.linger(STREAM_COUNTS)

    def _go_through(self, announced: _Run) -> str:
        """Go through a run; return why it ended early, or nothing."""
        with self._followers.changed:
            self._run = announced
        try:
            self._await(self._all_free, self._patience)
            self._begin_run()
            self._await(self._all_ready, self._patience)
            self._await(self._launched, None)
            failure = self._simulate(Bench(announced.scene, self._commanded_plan()))
        except CaptureSimError as error:
            failure = str(error)
        if failure:
            self._complain(failure)
        if self._telemetry is not None:
            self._end_run(failure)
            failure = self._see_off() or failure
        return failure

    def _begin_run(self) -> None:
        scene = self._run.scene
        description = RunDescription.of(scene, self._run.id, self._reporting)
        self._telemetry = BenchTelemetry(self.messages, scene, description)
        for sent in self._telemetry.begin():
            self.send(*sent)

    def _simulate(self, bench: Bench) -> str:
        """Send the whole run; return why it ended early, or nothing."""
        assert self._telemetry is not None
        block = BLOCK
        if self._pace > 0.0:
            due = BLOCK_TIME * self._pace * bench.scene.run.state_rate
            block = int(np.clip(due, 1, BLOCK))
        self.get_logger().info(f"{bench.scene.name}: released")
        pacer = Pacer(self._pace)
        progress = _Progress(self, bench.scene)
        count = seen = 0
        failure = ""
        while not (bench.done or failure):
            try:
                samples = bench.advance(bench.times(count, block))
            except SimulationError as error:
                samples, failure = error.partial, str(error)
            self._leave_room(count + len(samples) - self._window)
            if self._run.aborted:
                return "aborted by the launcher"
            events, seen = bench.events[seen:], len(bench.events)
            for topic, message in self._telemetry.block(samples, events):
                if topic is BENCH_STATE or topic is BENCH_EVENT:
                    pacer.wait_for(message.t)
                self.send(topic, message)
            count += len(samples)
            progress.report(count)
        progress.finish(count)
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
        for sent in self._telemetry.end(complete=not reason, reason=reason):
            self.send(*sent)
        self._telemetry = None

    def _see_off(self) -> str:
        """Give the followers time to take in and write what was sent; return what failed."""
        try:
            self._await(self._all_free, CLOSING_TIME)
        except CaptureSimError as error:
            self._complain(str(error))
            return str(error)
        return ""

    def _complain(self, failure: str) -> None:
        self.get_logger().error(f"{self._run.scene.name}: {failure}")

    # what is waited for

    def _leave_room(self, count: int) -> None:
        for name in self._followers.wait_for(count, self._run.id):
            self._complain(f"{name}: {self._followers.lost[name]}; the run goes on without it")

    def _all_free(self) -> str:
        if unheard := self._followers.unheard():
            return f"waiting for {', '.join(unheard)} to start"
        if busy := self._followers.not_in(""):
            return f"waiting for {', '.join(busy)} to end the last run"
        return ""

    def _all_ready(self) -> str:
        if outside := self._followers.not_in(self._run.id):
            return f"waiting for {', '.join(outside)} to take up the run"
        for topic in topics_of(SIMULATOR):
            readers = [name for name in self._followers.names if topic in FOLLOWED.get(name, ())]
            if self.matched(topic) < len(readers):
                return f"waiting for {topic.name} to be connected to {', '.join(readers)}"
        return ""

    def _launched(self) -> str:
        if self._run.aborted:
            raise CaptureSimError("aborted by the launcher before the release")
        return "" if self._run.armed and self._run.released else "waiting for the release"

    def _await(self, lacking: Callable[[], str], limit: float | None) -> None:
        """Wait until ``lacking`` returns nothing; say what it returns, ever more seldom.

        Raises
        ------
        CaptureSimError
            After ``limit`` (s), or when a follower falls silent meanwhile.
        """
        began = said = time.monotonic()
        silence = REPORT_PERIOD
        with self._followers.changed:
            while text := lacking():
                self._followers.changed.wait(POLL)
                for name in self._followers.drop_silent():
                    raise CaptureSimError(f"{name}: {self._followers.lost[name]}")
                now = time.monotonic()
                if limit is not None and now - began > limit:
                    raise CaptureSimError(f"{text}: given up after {limit:g} s")
                if now - said > silence:
                    said, silence = now, 2.0 * silence
                    self.get_logger().info(f"{self._run.scene.name}: {text}")


class _Progress:
    """Says at times how far a run is."""

    def __init__(self, node: SimulatorNode, scene: Scene) -> None:
        self._log = node.get_logger()
        self._scene = scene
        self._began = self._said = time.monotonic()

    def report(self, count: int) -> None:
        """Say it if it is time to; ``count`` samples are sent."""
        if time.monotonic() - self._said > REPORT_PERIOD:
            self._said = time.monotonic()
            limit = self._scene.run.t_end
            self._log.info(f"{self._scene.name}: {self._figures(count)}, at most {limit:g} s")

    def finish(self, count: int) -> None:
        """Say how long it took."""
        self._log.info(f"{self._scene.name}: done, {count} samples, {self._figures(count)}")

    def _figures(self, count: int) -> str:
        simulated = count / self._scene.run.state_rate
        spent = max(time.monotonic() - self._began, 1e-9)
        return f"{simulated:.2f} s simulated in {spent:.2f} s ({simulated / spent:.1f} x real time)"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; return the exit status."""
    return run(SimulatorNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
