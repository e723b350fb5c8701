"""A complete run in one call, without ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from capture_sim.base.software import software_versions
from capture_sim.detection.exact import Statuses
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.dynamics.drive import Control
from capture_sim.dynamics.sample_times import check_times
from capture_sim.dynamics.samples import EventKind
from capture_sim.dynamics.thrust import Commands
from capture_sim.errors import SceneError, SimulationError
from capture_sim.run.integration import Integration, check_memory, kept
from capture_sim.run.lazy import Deferred, LazyMapping
from capture_sim.run.origin import Origin
from capture_sim.run.run import Check, Integrated, Run
from capture_sim.run.sensors import sensor_series
from capture_sim.run.series import QUANTITIES, STATE, Series, SeriesBySource, series_in
from capture_sim.scene.files import Overrides, has_overrides
from capture_sim.scene.loading import change_scene, load_scene
from capture_sim.scene.parts import RunSettings, Scene
from capture_sim.scene.quantities import replaced


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
    control: Control | None = None,
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
        ``scene.run.state_rate``, which a second integration samples when they are first read.
        There are no samples after the end of the run, which a latch may bring forward.
    rtol
        Relative error tolerance; None for ``scene.run.rtol``.
    check
        True to run a second time with a smaller tolerance and compare; see :class:`Check`.
    trace
        True to keep the contact at the integrator's own steps, as with ``scene.run.trace``.
    control
        Controller of the scene's thrusters, see :class:`capture_sim.dynamics.drive.Control`;
        without ``t_eval``.

    Returns
    -------
    Run
        Samples, touches and events with times in s since the release, the detector's verdict,
        loads and summary.  :func:`capture_sim.read_run` returns such a run from a recording.

    Raises
    ------
    SceneError
        A value is out of its range, or the samples need more than
        :data:`capture_sim.run.integration.MAX_MEMORY`.
    RunError
        The integration stopped early; the message names time, phase and cause, and ``result`` has
        the run up to then.  It is a SimulationError.
    """
    if not isinstance(scene, Scene):
        scene = load_scene(scene, overrides)
    elif has_overrides(overrides):
        scene = change_scene(scene, overrides)
    run = scene.run
    changes = {"t_end": t_end, "rtol": rtol, "trace": trace or None}
    if changes := {name: value for name, value in changes.items() if value is not None}:
        run = replaced(run, changes)
        scene = _with_run(scene, run)
    times = None if t_eval is None else check_times(t_eval, t_end=run.t_end)
    check_memory(run, run.t_end * run.state_rate if times is None else times.size)
    compile_kernels()
    samples: np.ndarray | Deferred[np.ndarray]
    judged: Deferred[_Judged] | _Judged
    if control is not None:
        if times is not None:
            raise SceneError("t_eval: must be None with a controller")
        integration = Integration(scene)
        start = time.perf_counter()
        samples, statuses = integration.controlled(control)
        judged = _judged_as(integration, statuses)
        grid = Deferred(partial(np.asarray, samples))
    elif times is None:
        (memory,) = kept.memories(1)
        integration = Integration(scene, memory)
        start = time.perf_counter()
        judged = _judged(integration)
        end = judged.integrated.t_end
        samples = grid = Deferred(partial(_grid_samples, scene, end))
    else:
        integration = Integration(scene)
        start = time.perf_counter()
        samples = integration.sample(times)
        judged = Deferred(partial(_judged_again, scene))
        grid = Deferred(partial(_grid_samples, scene, run.t_end))
    wall_time = time.perf_counter() - start
    bench = integration.bench
    is_noisy = scene.sensors is not None and scene.sensors.motion_capture is not None
    result = Run(
        name=scene.name,
        origin=Origin(software=Deferred(software_versions)),
        given_scene=scene,
        state=samples,
        series=Deferred(partial(_series_of, scene, samples, grid)),
        located_touches=bench.touches,
        logged_events=bench.event_log,
        # of a noisy bench, the detector's own
        reported_statuses=None if is_noisy else _of_judged(judged, "statuses"),
        located_extremes=bench.extremes,
        trace=bench.trace,
        plan=bench.plan,
        wall_time=wall_time,
        statistics=bench.statistics,
        failure=integration.failure,
        integrated=_of_judged(judged, "integrated"),
    )
    if result.failure:
        raise RunError(result.failure, result.state, result)
    if not check:
        return result
    try:
        same: dict[str, Any] = {"t_eval": result.t} if control is None else {"control": control}
        finer = simulate(_with_run(scene, run.refined(100.0, 4.0)), **same)
    except RunError as error:
        finer = error.result
    return result.replaced(check=_compare(result, finer))


def applied_again(run: Run) -> Control | None:
    """Return a controller that applies the thrust of an exact run again; None if it has none.

    The wrenches are those of the samples, so a change between two samples comes with the next one.
    """
    thrust = run.samples["thrust"]
    if run.scene.thrusters is None or not thrust.any():
        return None
    rate = run.scene.run.state_rate

    def command(sample: np.void) -> Commands:
        # a sample shows the wrench up to its time
        applied = thrust[min(round(float(sample["t"]) * rate) + 1, len(thrust) - 1)]
        return applied[:3], applied[3:]

    return Control(command, rate, as_applied=True)


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


class _Judged(NamedTuple):
    """A run as its detector samples it, at ``run.rate``."""

    statuses: Statuses
    integrated: Integrated


def _judged(integration: Integration) -> _Judged:
    return _judged_as(integration, integration.statuses())


def _judged_as(integration: Integration, statuses: Statuses) -> _Judged:
    return _Judged(statuses, Integrated(integration.t_end, integration.energy_residual))


def _judged_again(scene: Scene) -> _Judged:
    (memory,) = kept.memories(1)
    return _judged(Integration(_untraced(scene), memory))


def _of_judged(judged: _Judged | Deferred[_Judged], name: str) -> Any:
    if isinstance(judged, _Judged):
        return getattr(judged, name)
    return Deferred(partial(_read_judged, judged, name))


def _read_judged(judged: Deferred[_Judged], name: str) -> Any:
    return getattr(judged.value, name)


def _untraced(scene: Scene) -> Scene:
    if not scene.run.trace:
        return scene
    return _with_run(scene, replaced(scene.run, {"trace": False}))


def _with_run(scene: Scene, run: RunSettings) -> Scene:
    changed: Scene = replaced(scene, {"run": run})
    return changed


def _grid(scene: Scene, end: float) -> np.ndarray:
    """Return the sample times of a run that ends at ``end`` (s) or within a period of its rate."""
    run = scene.run
    count = math.floor((end + 1.0 / run.rate) * run.state_rate) + 2
    times: np.ndarray = np.arange(count) / run.state_rate
    return times[times <= run.t_end]


def _grid_samples(scene: Scene, end: float) -> np.ndarray:
    """Return the samples of a run at ``run.state_rate``; it ends as in :func:`_grid`."""
    return Integration(_untraced(scene)).sample(_grid(scene, end))


def _series_of(
    scene: Scene, samples: np.ndarray | Deferred[np.ndarray], grid: Deferred[np.ndarray]
) -> SeriesBySource:
    """Return the series of exact samples and of the scene's simulated sensors.

    The sensors read the samples of ``grid``, at ``run.state_rate``, when they are used.
    """
    series: dict[str, dict[str, Callable[[], Series]]] = {}

    def add(quantity: str, source: str, make: Callable[[], Series]) -> None:
        series.setdefault(quantity, {})[source] = make

    exact = Deferred(partial(_series_in, samples))
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


def _series_in(samples: np.ndarray | Deferred[np.ndarray]) -> dict[str, Series]:
    return series_in(samples.value if isinstance(samples, Deferred) else samples)


def _sensed(scene: Scene, grid: Deferred[np.ndarray]) -> dict[str, Series]:
    return sensor_series(scene, grid.value)


def _periodic(scene: Scene, grid: Deferred[np.ndarray]) -> dict[str, Series]:
    """Return the series of the samples at ``run.rate``."""
    return series_in(grid.value[:: round(scene.run.state_rate / scene.run.rate)])


def _of_quantity(series: Deferred[dict[str, Series]], quantity: str) -> Series:
    return series.value[quantity]
