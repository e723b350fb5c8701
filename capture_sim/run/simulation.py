"""A complete run in one call, without ROS."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from capture_sim.base.software import software_versions
from capture_sim.detection.criteria import CaptureStatus
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.dynamics.drive import drive
from capture_sim.dynamics.memory import joined
from capture_sim.dynamics.sample_times import check_times
from capture_sim.dynamics.samples import SAMPLE, EventKind
from capture_sim.errors import SceneError, SimulationError
from capture_sim.run.lazy import Deferred, LazyMapping
from capture_sim.run.origin import Origin
from capture_sim.run.run import Check, Run
from capture_sim.run.sensors import sensor_series
from capture_sim.run.series import QUANTITIES, STATE, Series, SeriesBySource, series_in
from capture_sim.scene.files import Overrides, has_overrides
from capture_sim.scene.loading import change_scene, load_scene
from capture_sim.scene.parts import RunSettings, Scene


class RunError(SimulationError):
    """The integration of :func:`simulate` stopped early; ``result`` is the run up to the stop."""

    def __init__(self, message: str, partial: np.ndarray, result: Run) -> None:
        super().__init__(message, partial)
        self.result = result

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (*self.args, self.partial, self.result)


def simulate(
    scene: Scene | str | Path,
    overrides: Overrides = (),
    *,
    t_end: float | None = None,
    t_eval: ArrayLike | None = None,
    rtol: float | None = None,
    check: bool = False,
    trace: bool = False,
) -> Run:
    """Run a scene from the release to its end.

    Parameters
    ----------
    scene
        Scene, or the name or path of a scene for :func:`capture_sim.load_scene`.
    overrides
        Changed values as for :func:`capture_sim.load_scene`, e.g. ``{"buffer.c_A": 20}``,
        ``["buffer.c_A=20"]`` or a row of a pandas table.
    t_end
        Longest duration of the run, s; None for ``scene.run.t_end``.
    t_eval
        (n,) sample times, s: finite, ascending, from 0 to ``t_end``; None for the grid of
        ``scene.run.state_rate``.  There are no samples after the end of the run, which a latch
        may bring forward.
    rtol
        Relative error tolerance; None for ``scene.run.rtol``.
    check
        True to run a second time with a smaller tolerance and compare; see :class:`Check`.
    trace
        True to keep the contact at the integrator's own steps, as with ``scene.run.trace``.

    Returns
    -------
    Run
        Samples, touches and events with times in s since the release, the detector's verdict,
        loads and summary.  :func:`capture_sim.read_run` returns such a run from a recording.

    Raises
    ------
    SceneError
        A value is out of its range, or the samples need more than :data:`MAX_MEMORY`.
    RunError
        The integration stopped early; the message names time, phase and cause, and ``result`` has
        the run up to then.  It is a SimulationError.
    """
    if not isinstance(scene, Scene):
        scene = load_scene(scene, overrides)
    elif has_overrides(overrides):
        scene = change_scene(scene, overrides)
    run = scene.run
    if t_end is not None:
        run = dataclasses.replace(run, t_end=t_end)
    if rtol is not None:
        run = dataclasses.replace(run, rtol=rtol)
    if trace:
        run = dataclasses.replace(run, trace=True)
    scene = dataclasses.replace(scene, run=run)
    bench = Bench(scene)
    times = None if t_eval is None else check_times(t_eval, t_end=run.t_end)
    check_memory(run, run.t_end * run.state_rate if times is None else times.size)
    compile_kernels()
    start = time.perf_counter()
    if times is None:
        times = bench.times(0, math.floor(run.t_end * run.state_rate) + 2)
    pieces = list(drive(bench, times))
    failure = pieces[-1].failure
    samples = joined([piece.samples for piece in pieces])
    # the detector evaluates the grid
    statuses = None if t_eval is None else Deferred(partial(_grid_statuses, scene))
    grid = Deferred(partial(_grid_samples, scene, samples if t_eval is None else None))
    result = Run(
        name=scene.name,
        origin=Origin(software=Deferred(software_versions)),
        given_scene=scene,
        state=samples,
        series=_series_of(scene, samples, grid),
        located_touches=bench.touches,
        logged_events=tuple(bench.events),
        reported_statuses=statuses,
        located_extremes=bench.extremes,
        trace=bench.trace,
        plan=bench.plan,
        wall_time=time.perf_counter() - start,
        statistics=bench.statistics,
        failure="" if failure is None else str(failure),
    )
    if failure is not None:
        raise RunError(str(failure), failure.partial, result)
    if not check:
        return result
    try:
        finer = simulate(dataclasses.replace(scene, run=run.refined(100.0, 4.0)), t_eval=result.t)
    except RunError as error:
        finer = error.result
    return result.replaced(check=_compare(result, finer))


#: Largest memory for the samples of one run, bytes.
MAX_MEMORY = 4_000_000_000


def check_memory(
    run: RunSettings, count: float, rate: Literal["state_rate", "rate"] = "state_rate"
) -> None:
    """Raise SceneError if the samples at one of the run's rates would fill the memory."""
    # in pieces as they are computed, then joined
    needed = 2.0 * count * SAMPLE.itemsize
    if needed > MAX_MEMORY:
        raise SceneError(
            f"run.t_end = {run.t_end:g} s at run.{rate} = {getattr(run, rate):g} Hz: {count:.3g} "
            f"samples need {needed / 1e9:.3g} GB of memory: must be "
            f"at most {MAX_MEMORY / 1e9:g} GB"
        )


def _compare(coarse: Run, fine: Run) -> Check:
    """Return the comparison of two runs of one scene, at the times that both have."""
    n = min(coarse.t.size, fine.t.size)
    difference = np.abs(coarse.q[:n] - fine.q[:n])
    arm = coarse.scene.buffer.hinge_offset + coarse.scene.rest_length
    at_target = coarse.scene.cone.L_T + coarse.scene.cone.R_c
    difference *= np.array([1.0, 1.0, arm, arm, 1.0, 1.0, 1.0, at_target])
    error = np.full(coarse.t.size, np.inf)
    error[:n] = np.maximum.accumulate(difference.max(axis=1, initial=0.0))
    return Check(error, _touch_sequence(coarse) == _touch_sequence(fine), fine.failure)


def _touch_sequence(result: Run) -> list[tuple[str, int]]:
    return [
        (event.kind.label, event.wall)
        for event in result.events
        if event.kind in (EventKind.TOUCH, EventKind.LIFT_OFF)
    ]


def _on_grid(scene: Scene) -> Run:
    """Run a scene again, sampled at ``run.state_rate``."""
    try:
        return simulate(scene)
    except RunError as error:
        return error.result


def _series_of(scene: Scene, samples: np.ndarray, grid: Deferred[np.ndarray]) -> SeriesBySource:
    """Return the series of exact samples and of the scene's simulated sensors.

    The sensors read the samples of ``grid``, at ``run.state_rate``, when they are used.
    """
    series: dict[str, dict[str, Callable[[], Series]]] = {}

    def add(quantity: str, source: str, make: Callable[[], Series]) -> None:
        series.setdefault(quantity, {})[source] = make

    exact = Deferred(partial(series_in, samples))
    for quantity in QUANTITIES:
        add(quantity, STATE, partial(_of_quantity, exact, quantity))
    if scene.sensors is not None:
        sensed = Deferred(partial(_sensed, scene, grid))
        periodic = Deferred(partial(_periodic, scene, grid))
        for quantity in ("stroke", "torsion", "stroke_rate", "torsion_rate"):
            add(quantity, "bench/buffer", partial(_of_quantity, periodic, quantity))
        if scene.sensors.motion_capture is not None:
            for vehicle in ("chaser", "target"):
                add(vehicle, f"motion_capture/{vehicle}", partial(_of_quantity, sensed, vehicle))
        if scene.sensors.load_cell is not None:
            add("cone_force", "load_cell/wrench", partial(_of_quantity, sensed, "cone_force"))
    return {quantity: LazyMapping(sources) for quantity, sources in series.items()}


def _grid_statuses(scene: Scene) -> Sequence[CaptureStatus]:
    return _on_grid(scene).statuses


def _grid_samples(scene: Scene, samples: np.ndarray | None) -> np.ndarray:
    """Return samples at ``run.state_rate``, or at the times of another run if it is given."""
    return _on_grid(scene).state if samples is None else samples


def _sensed(scene: Scene, grid: Deferred[np.ndarray]) -> dict[str, Series]:
    return sensor_series(scene, grid.value)


def _periodic(scene: Scene, grid: Deferred[np.ndarray]) -> dict[str, Series]:
    """Return the series of the samples at ``run.rate``."""
    return series_in(grid.value[:: round(scene.run.state_rate / scene.run.rate)])


def _of_quantity(series: Deferred[dict[str, Series]], quantity: str) -> Series:
    return series.value[quantity]
