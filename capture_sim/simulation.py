"""A whole run in one call, without ROS."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from capture_sim.bench import Bench, Statistics, compile_kernels
from capture_sim.detection.exact import (
    CaptureDetector,
    CaptureState,
    CaptureStatus,
    Observation,
)
from capture_sim.detection.watching import MotionCaptureWatch
from capture_sim.errors import SimulationError
from capture_sim.launch.plan import LaunchPlan
from capture_sim.results import summarize
from capture_sim.samples import ENERGIES, Event, EventKind
from capture_sim.scene.parts import Scene

#: Samples per call into the core; large enough to make the call's own cost vanish.
BLOCK = 4096


@dataclass(frozen=True)
class Check:
    """Comparison of a run with a second, finer one.

    The second has a hundredth of the tolerance (a quarter of the step with rk4).

    Attributes
    ----------
    error : ndarray (n,)
        Largest difference of the two so far, at each sample time, m; angles count by what
        they move the tip.  Of the order of the first run's true error.
    same_touches : bool
        Both have the same walls touched in the same order.  If not, the sequence of touches
        hangs on the tolerance, and what follows the first difference is one of several
        possible courses.
    """

    error: np.ndarray
    same_touches: bool


@dataclass(frozen=True)
class Result:
    """What a run gave.

    Attributes
    ----------
    scene, plan
        What was run.
    samples : ndarray (n,) of dtype SAMPLE
        Everything at the sample times; units as in msg/BenchState.msg.
    touches : ndarray (m,) of dtype TOUCH
        Every touch of a wall, from located start to located end.
    events : list of Event
        In order, each with time and state.
    statuses : list of CaptureStatus
        The detector's view at ``run.rate`` (with motion capture: of every pose that it sees),
        the final verdict last.
    statistics : Statistics
        Steps, rejected steps and evaluations of the equations of motion.
    wall_time : float
        s, for the integration and the detector.
    failure : str
        Why the run had to stop; empty if it did not.
    check : Check or None
        How far the run can be trusted, if that was asked for.
    trace : ndarray (k,) of dtype SAMPLE or None
        The contact at the integrator's own resolution, if that was asked for: samples at the
        ends of its steps while a wall is touched.  It is recorded with the run.
    """

    scene: Scene
    plan: LaunchPlan
    samples: np.ndarray
    touches: np.ndarray
    events: list[Event]
    statuses: list[CaptureStatus]
    statistics: Statistics
    wall_time: float
    failure: str = ""
    check: Check | None = None
    trace: np.ndarray | None = None

    @property
    def t(self) -> np.ndarray:
        """Sample times (n,), s since the release."""
        return np.asarray(self.samples["t"])

    @property
    def q(self) -> np.ndarray:
        """Coordinates (n, 8): x_S, y_S, theta_S, theta_P, h, x_T, y_T, theta_T; m and rad."""
        return np.asarray(self.samples["q"])

    @property
    def v(self) -> np.ndarray:
        """Rates of ``q`` (n, 8), m/s and rad/s."""
        return np.asarray(self.samples["v"])

    @property
    def energy(self) -> dict[str, np.ndarray]:
        """The ledger by name, each (n,), J."""
        return {name: np.asarray(self.samples[name]) for name in ENERGIES}

    @property
    def verdict(self) -> CaptureState:
        """The detector's last word."""
        return self.statuses[-1].state

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The run in a few numbers, SI units; keys as in results.json."""
        return summarize(
            self.scene, self.samples, self.touches, self.events, self.verdict.label, self.wall_time
        )


def observation(sample: np.void) -> Observation:
    """Return what a perfect sensor would measure in a sample."""
    q, v = sample["q"].tolist(), sample["v"].tolist()
    return Observation(
        t=float(sample["t"]),
        chaser=(q[0], q[1], q[2]),
        chaser_rate=(v[0], v[1], v[2]),
        target=(q[5], q[6], q[7]),
        target_rate=(v[5], v[6], v[7]),
        stroke=float(sample["axial_stroke"]),
        stroke_rate=v[4],
        torsion=float(sample["torsion"]),
        torsion_rate=v[3] - v[2],
    )


def simulate(
    scene: Scene,
    t_end: float | None = None,
    t_eval: np.ndarray | None = None,
    rtol: float | None = None,
    check: bool = False,
    trace: bool = False,
) -> Result:
    """Run a scene from the release to its end.

    Parameters
    ----------
    scene
        From :func:`capture_sim.load_scene`.
    t_end
        s; None takes ``scene.run.t_end``.
    t_eval
        (n,) ascending sample times, s; None takes the grid of ``scene.run.state_rate``.
    rtol
        None takes ``scene.run.rtol``.
    check
        Run a second time, finer (see :class:`Check`), and tell how far the two agree.
    trace
        Keep the contact at the integrator's own resolution, as with ``scene.run.trace``.

    Returns
    -------
    Result

    Raises
    ------
    SceneError
        If a value is out of its range.
    SimulationError
        If the integration has to stop; names time, phase and cause, and holds the run up to
        there in ``result``.
    """
    run = scene.run
    if t_end is not None:
        run = dataclasses.replace(run, t_end=t_end)
    if rtol is not None:
        run = dataclasses.replace(run, rtol=rtol)
    if trace:
        run = dataclasses.replace(run, trace=True)
    scene = dataclasses.replace(scene, run=run)
    compile_kernels()
    began = time.perf_counter()
    bench = Bench(scene)
    blocks: list[np.ndarray] = []
    statuses: list[CaptureStatus] = []
    extra = None if t_eval is None else np.asarray(t_eval, dtype=float)
    failure: SimulationError | None = None
    try:
        for block in run_blocks(bench, extra):
            blocks.append(block.samples if extra is None else block.extra)
            statuses += block.statuses
    except SimulationError as error:
        failure = error
    result = Result(
        scene=scene,
        plan=bench.plan,
        samples=np.concatenate(blocks),
        touches=bench.touches,
        events=bench.events,
        statuses=statuses,
        statistics=bench.statistics,
        wall_time=time.perf_counter() - began,
        failure="" if failure is None else str(failure),
        trace=bench.trace if run.trace else None,
    )
    if failure is not None:
        failure.result = result
        raise failure
    if not check:
        return result
    finer = simulate(_finer(scene), t_eval=result.t)
    return dataclasses.replace(result, check=_compare(result, finer))


#: Smallest tolerance that rounding leaves room for.
_FINEST = 1e-13


def _finer(scene: Scene) -> Scene:
    """Return the scene with a finer integration, never with the same."""
    run = scene.run
    if run.method == "rk4":
        run = dataclasses.replace(run, step=run.step / 4.0)
    elif run.rtol > 10.0 * _FINEST:
        run = dataclasses.replace(run, rtol=max(run.rtol / 100.0, _FINEST))
    else:
        # no room below: another pair errs differently
        run = dataclasses.replace(run, method="dopri5" if run.method == "dop853" else "dop853")
    return dataclasses.replace(scene, run=run)


def _compare(coarse: Result, fine: Result) -> Check:
    """Return how far two runs of one scene agree, at the times that both have."""
    n = min(coarse.t.size, fine.t.size)
    difference = np.abs(coarse.q[:n] - fine.q[:n])
    arm = coarse.scene.buffer.a + coarse.scene.rest_length
    at_target = coarse.scene.cone.L_T + coarse.scene.cone.R_c
    difference *= np.array([1.0, 1.0, arm, arm, 1.0, 1.0, 1.0, at_target])
    worst = np.maximum.accumulate(difference.max(axis=1, initial=0.0))
    error = np.full(coarse.t.size, np.inf)
    error[:n] = worst
    return Check(error, _touch_sequence(coarse) == _touch_sequence(fine))


def _touch_sequence(result: Result) -> list[tuple[str, int]]:
    return [
        (event.kind.label, event.wall)
        for event in result.events
        if event.kind in (EventKind.TOUCH, EventKind.LIFT_OFF)
    ]


def _motion_capture_watch(scene: Scene) -> MotionCaptureWatch | None:
    """Return what judges by motion capture; None where the detector sees the truth."""
    if scene.sensors is None or scene.sensors.motion_capture is None:
        return None
    return MotionCaptureWatch(scene)


class Block(NamedTuple):
    """A piece of a run: what is new since the piece before."""

    samples: np.ndarray  # (n,) of dtype SAMPLE, on the grid
    extra: np.ndarray  # (m,) likewise, at the extra times
    events: list[Event]
    statuses: list[CaptureStatus]


def run_blocks(bench: Bench, extra: np.ndarray | None = None) -> Iterator[Block]:
    """Run a bench to its end piece by piece, with the detector watching.

    Parameters
    ----------
    bench
        At its release.
    extra
        (m,) ascending times to sample beside the grid, s.

    Yields
    ------
    Block
        The last one holds the final verdict.

    Raises
    ------
    SimulationError
        After what was computed until then has been yielded.
    """
    scene = bench.scene
    detector = CaptureDetector(scene)
    watch = _motion_capture_watch(scene)
    every = round(scene.run.state_rate / scene.run.rate)
    first = seen = 0
    failure: SimulationError | None = None
    while not bench.done and failure is None:
        grid = bench.times(first, BLOCK)
        wanted, last = grid, np.inf if grid.size < BLOCK else grid[-1]
        if extra is not None:
            # each piece takes the times after the last grid point of the one before
            begin = (first - 1) / scene.run.state_rate if first else -np.inf
            wanted = np.union1d(grid, extra[(extra > begin) & (extra <= last)])
        try:
            taken = bench.advance(wanted)
        except SimulationError as error:
            failure, taken = error, error.partial
        samples = taken if extra is None else taken[np.isin(taken["t"], grid)]
        beside = taken[:0] if extra is None else taken[np.isin(taken["t"], extra)]
        if watch is not None:
            statuses = watch.look(samples)
        else:
            statuses = [detector.update(observation(s)) for s in samples[(-first) % every :: every]]
        if bench.done or failure is not None:
            cut = failure is not None
            statuses += [detector.finish(cut=cut)] if watch is None else watch.finish(cut=cut)
        events, seen = bench.events[seen:], len(bench.events)
        yield Block(samples, beside, events, statuses)
        first += BLOCK
    if failure is not None:
        raise failure
