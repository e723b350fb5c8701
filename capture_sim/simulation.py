"""A whole run in one call, without ROS."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from capture_sim.bench import Bench, Statistics, check_times, compile_kernels, drive
from capture_sim.detection.align import Source
from capture_sim.detection.exact import CaptureState, CaptureStatus, ExactDetector
from capture_sim.detection.noisy import NoisyDetector
from capture_sim.launch.plan import LaunchPlan
from capture_sim.results import summarize
from capture_sim.samples import ENERGIES, Event, EventKind
from capture_sim.scene.parts import Scene
from capture_sim.sensors import Sensors


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
    grid = times = bench.times(0, math.floor(run.t_end * run.state_rate) + 2)
    if t_eval is not None:
        wanted = check_times(t_eval, t_end=run.t_end)
        times = np.union1d(grid, wanted)
    pieces = list(drive(bench, times))
    failure = pieces[-1].failure
    samples = np.concatenate([piece.samples for piece in pieces])
    statuses = _judge(
        scene, samples if t_eval is None else _at(samples, grid), cut=failure is not None
    )
    result = Result(
        scene=scene,
        plan=bench.plan,
        samples=samples if t_eval is None else _at(samples, wanted),
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


def _at(samples: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the samples at some of the times."""
    taken: np.ndarray = samples[np.isin(samples["t"], times)]
    return taken


def _judge(scene: Scene, samples: np.ndarray, *, cut: bool) -> list[CaptureStatus]:
    """Return what the detector says of a run's samples at ``run.state_rate``, verdict last."""
    every = round(scene.run.state_rate / scene.run.rate)
    if scene.sensors is None or scene.sensors.motion_capture is None:
        exact = ExactDetector(scene)
        return [*exact.update(samples[::every]), exact.finish(cut=cut)]
    detector, sensors = NoisyDetector(scene), Sensors(scene)
    statuses: list[CaptureStatus] = []
    for k, sample in enumerate(samples):
        t, v = float(sample["t"]), sample["v"].tolist()
        if k % every == 0:
            buffer = (float(sample["axial_stroke"]), float(sample["torsion"]))
            statuses += detector.measure(Source.BUFFER, t, (*buffer, v[4], v[3] - v[2]))
        reading = sensors.read(sample)
        if reading.chaser is not None and reading.target is not None:
            statuses += detector.measure(Source.CHASER, t, reading.chaser)
            statuses += detector.measure(Source.TARGET, t, reading.target)
    return [*statuses, *detector.finish(cut=cut)]
